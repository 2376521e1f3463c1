"""Checks the stated intervals of LED power in random cells with effects for which a plain calibration has no term.

    python tools/prove_led_power.py [--cells 20] [--causes gain gloss ...] [--leds 120] [--jobs 1] [--keep FILE]
        [--json]

Each cell has its own dome, LEDs, tile and camera. Signals of the tile are computed, not rendered. The forward
model shares no equation with the calibration. Each effect is varied from nothing to a strength at which a plain
calibration fails:

    gain       gain or light changes linearly over the session, relative
    wave       gain goes up and down, relative amplitude (`sim.strangers`)
    warming    lamps lose light while they warm, relative (`sim.strangers`)
    gloss      the tile has a lobe (GGX), reflectance at normal incidence
    stain      the tile has a stain, share of light in its middle
    dies       dies are tilted, standard deviation in degrees
    exponents  lobes of the LEDs differ, standard deviation of the cosine's exponent
    moved      the tile is tilted before the last view, degrees

Compared is the light at five places where an object may be (`drawn_lights.PLACES_MM`), not the flux, which no
camera sees. For each strength, figures are printed for cells that were not refused: the share of the 95 %
intervals of LEDs against their mean that contain the truth, rms(error/u), and the share of cells in which fewer
than 80 % do so; the same for the common scale (share, rms). `plain` is a calibration without suspects. Then follow
the number of cells that named a suspect, the number of refused cells with the limits, and the median and mean
width of u against the plain one.

With `--keep FILE`, cells are added to a file as they end, and cells of this file are not computed again.
"""

from __future__ import annotations

import argparse
import json
import os
import sys
from collections import Counter
from collections.abc import Iterable, Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import asdict, dataclass
from functools import partial
from pathlib import Path

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

import numpy as np

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

from coupole.calibration.light.irradiance import irradiance_per_flux
from coupole.calibration.light.led_power import LedPower, calibrate_led_power
from coupole.calibration.light.led_power_records import power_limits
from coupole.calibration.light.power_suspects import names_of
from coupole.errors import InputError
from drawn_lights import PLACES_MM, TILE, DrawnPowers, draw_powers
from kept_cells import keep_cell, read_cells
from smallest import add_smallest

SWEEP = {
    "gain": (0.0, 0.001, 0.003, 0.01, 0.03),
    "wave": (0.001, 0.003, 0.01, 0.03),
    "warming": (0.003, 0.01, 0.03),
    "gloss": (0.002, 0.005, 0.02, 0.05),
    "stain": (0.01, 0.03, 0.1),
    "dies": (2.0, 5.0),
    "exponents": (0.2,),
    "moved": (0.3, 1.0),
}
"""Strengths of each effect; 0 is computed only once."""
_HEAD = """\
| cause | plain: held, rms, cells < 80 %; scale | held | rms | cells < 80 % | scale | named | refused | width |
|---|---|---|---|---|---|---|---|---|"""


@dataclass(frozen=True)
class Held:
    """One calibration, compared with the truth."""

    share: float
    """Share of the intervals of LEDs against their mean."""
    square: float
    """Mean of (error/u)^2 of these."""
    scale: float
    """Error/u of the common scale."""
    u: float
    """Median relative standard uncertainty against the mean."""


@dataclass(frozen=True)
class Judged:
    """One cell."""

    plain: Held | None
    """None if the plain calibration was refused."""
    ours: Held | None
    named_suspects: tuple[str, ...]
    refusals: tuple[str, ...]
    """Limits that are missed, or an error."""


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--cells", type=int, default=20, help="of each cause and strength")
    parser.add_argument("--causes", nargs="+", choices=SWEEP, default=list(SWEEP))
    parser.add_argument("--leds", type=int, default=120)
    parser.add_argument("--first-seed", type=int, default=1)
    parser.add_argument("--jobs", type=int, default=1)
    parser.add_argument("--keep", type=Path, help="file of cells that are not computed again (JSON lines)")
    parser.add_argument("--json", action="store_true")
    add_smallest(parser, cells=1, causes=["warming"], leds=60)
    arguments = parser.parse_args()
    seeds = range(arguments.first_seed, arguments.first_seed + arguments.cells)
    kept_cells = read_kept(arguments.keep)
    if not arguments.json:
        print(_HEAD)
    with ProcessPoolExecutor(arguments.jobs) as pool:
        for cause in arguments.causes:
            for strength in SWEEP[cause]:
                missing = [seed for seed in seeds if (cause, strength, arguments.leds, seed) not in kept_cells]
                work = partial(judge_cell, leds=arguments.leds, cause=cause, strength=strength)
                for seed, judgement in zip(missing, pool.map(work, missing), strict=True):
                    kept_cells[cause, strength, arguments.leds, seed] = judgement
                    keep_cell(arguments.keep, (cause, strength, arguments.leds, seed), judgement)
                cells = [kept_cells[cause, strength, arguments.leds, seed] for seed in seeds]
                tell(cause, strength, cells, as_json=arguments.json)


Key = tuple[str, float, int, int]


def read_kept(path: Path | None) -> dict[Key, Judged]:
    """Cells of an earlier call, by cause, strength, LEDs and seed."""
    kept_cells = {}
    for cell in read_cells(path):
        plain, ours = (None if cell[name] is None else Held(**cell[name]) for name in ("plain", "ours"))
        cause, strength, leds, seed = cell["key"]
        kept_cells[cause, strength, leds, seed] = Judged(
            plain, ours, tuple(cell["named_suspects"]), tuple(cell["refusals"])
        )
    return kept_cells


def tell(cause: str, strength: float, cells: Sequence[Judged], *, as_json: bool) -> None:
    """Print the figures of one strength."""
    accepted_cells = [cell.ours for cell in cells if cell.ours is not None and not cell.refusals]
    plain = [cell.plain for cell in cells if cell.plain is not None]
    suspect_counts, refusal_counts = (
        _counts(names) for names in ([c.named_suspects for c in cells], [c.refusals for c in cells])
    )
    widths = [c.ours.u / c.plain.u for c in cells if c.ours is not None and c.plain is not None]
    if as_json:
        document = {"cause": cause, "strength": strength, "plain": _of(plain), "ours": _of(accepted_cells)}
        print(
            json.dumps(
                {
                    **document,
                    "named": suspect_counts,
                    "refused": refusal_counts,
                    "cells": [asdict(c) for c in cells],
                }
            )
        )
        return
    figures = _of(accepted_cells).replace(",", " |", 2).replace(";", " |")
    width = f"{np.median(widths):.2f}, {np.mean(widths):.2f}" if widths else "-"
    reasons = f" ({refusal_counts})" if refusal_counts else ""
    print(
        f"| {cause} {strength:g} | {_of(plain)} | {figures} | {suspect_counts or 0} "
        f"| {len(cells) - len(accepted_cells)} of {len(cells)}{reasons} | {width} |",
        flush=True,
    )


def _of(helds: Sequence[Held]) -> str:
    if not helds:
        return "-, -, -; -"
    share, square, scale, _ = np.array([[row.share, row.square, row.scale, row.u] for row in helds]).T
    return (
        f"{share.mean():.1%}, {np.sqrt(square.mean()):.2f}, {np.mean(share < 0.8):.0%}; "
        f"{np.mean(np.abs(scale) < 1.96):.0%}, {np.sqrt(np.mean(scale**2)):.2f}"
    )


def _counts(names: Iterable[Sequence[str]]) -> str:
    return ", ".join(f"{name} {count}" for name, count in Counter(name for some in names for name in some).items())


# -- one cell -------------------------------------------------------------------------------------------------


def judge_cell(seed: int, *, leds: int, cause: str, strength: float) -> Judged:
    """Draw a cell; return the comparison of its LEDs with the truth, with the suspects and without."""
    cell = draw_powers(seed, leds, cause, strength)
    plain = _powers_of(cell, search=False)
    power = _powers_of(cell, search=True)
    of_plain = None if isinstance(plain, str) else _against_truth(cell, plain)
    if isinstance(power, str):
        return Judged(of_plain, None, (), (power,))
    missed_limits = tuple(limit.what for limit in power_limits({"G": power}, {}) if not limit.is_met)
    return Judged(of_plain, _against_truth(cell, power), tuple(names_of(power.causes, power.parts)), missed_limits)


def _powers_of(cell: DrawnPowers, *, search: bool) -> LedPower | str:
    """Return the powers, or the reason of a refusal."""
    try:
        return calibrate_led_power(cell.views, cell.positions, TILE, search=search)
    except InputError as error:
        return str(error).split(";")[0].split(": view")[0]


def _against_truth(cell: DrawnPowers, power: LedPower) -> Held:
    leds, up = cell.positions, np.array([0.0, 0.0, 1.0])
    h = irradiance_per_flux(PLACES_MM, up, leds.centres_mm[:, None], leds.normals[:, None])
    good = np.isfinite(power.power) & (power.power > 0)
    error = (np.log(power.power[:, None] * h) - np.log(cell.irradiance))[good]
    mean, u = float(error[:, 0].mean()), power.u_against_mean()[good]
    ratios = (error - mean) / u[:, None]
    return Held(
        float(np.mean(np.abs(ratios) < 1.96)),
        float(np.mean(ratios**2)),
        mean / power.u_scale(),
        float(np.median(u)),
    )


if __name__ == "__main__":
    main()
