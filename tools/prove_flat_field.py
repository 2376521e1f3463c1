"""Checks the stated intervals of the flat field in random cells with effects for which a plain fit has no term.

    python tools/prove_flat_field.py [--cells 20] [--causes panel oval ...] [--keep FILE] [--json]

Views of a panel are drawn as blocks; no code of the processing computes their light. Each effect is varied from
nothing to a strength at which a plain fit fails:

    panel   the panel's light has three waves of 12 to 30 cm, relative amplitude of each
    oval    the fall-off has an oval part, at the field's side
    slant   the fall-off has a part of degree 2 and 3 that is not symmetric
    beam    the panel's light depends on the direction, exponent of the cosine beyond Lambert's law

The fall-off is compared with the truth at 25 places, each against its mean over the field. For each strength,
figures are printed: the share of the 95 % intervals that contain the truth, rms(error/u), and the share of cells
in which fewer than 80 % do so, of a plain fit and of cells that were not refused. Then follow the number of cells
that named a suspect, the number of refused cells, and the median width of u against that of the plain fit.

With `--keep FILE`, cells are added to a file as they end, and cells of this file are not computed again.
"""

from __future__ import annotations

import argparse
import json
import os
import sys
from collections import Counter
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

import numpy as np

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

from coupole.calibration.light.flat_field import FlatField, fit_flat_field
from coupole.calibration.light.flat_field_records import limits_of
from drawn_panels import FOCAL_PX, SIZE_PX, DrawnField, draw_field
from kept_cells import keep_cell, read_cells
from smallest import add_smallest

SWEEP = {
    "panel": (0.0, 0.001, 0.003, 0.01),
    "oval": (0.001, 0.003, 0.01, 0.03),
    "slant": (0.003, 0.01),
    "beam": (0.01, 0.1),
}
"""Strengths of each effect; 0 is computed only once."""
_HEAD = """\
| cause | plain: held, rms, cells < 80 % | held, rms, cells < 80 % | named | refused | width |
|---|---|---|---|---|---|"""


@dataclass(frozen=True)
class Held:
    """One fit, compared with the truth."""

    share: float
    """Share of the intervals that contain the truth."""
    square: float
    """Mean of (error/u)^2."""
    u: float
    """Median relative standard uncertainty."""


@dataclass(frozen=True)
class Judged:
    """One cell."""

    plain: Held
    ours: Held
    named_suspects: tuple[str, ...]
    missed_limits: tuple[str, ...]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--cells", type=int, default=20, help="of each cause and strength")
    parser.add_argument("--causes", nargs="+", choices=SWEEP, default=list(SWEEP))
    parser.add_argument("--first-seed", type=int, default=1)
    parser.add_argument("--keep", type=Path, help="file of cells that are not computed again (JSON lines)")
    parser.add_argument("--json", action="store_true")
    add_smallest(parser, cells=1, causes=["slant"])
    arguments = parser.parse_args()
    kept_cells = read_kept(arguments.keep)
    if not arguments.json:
        print(_HEAD)
    for cause in arguments.causes:
        for strength in SWEEP[cause]:
            cells = []
            for seed in range(arguments.first_seed, arguments.first_seed + arguments.cells):
                key = (cause, strength, seed)
                if key not in kept_cells:
                    kept_cells[key] = judge_cell(seed, cause, strength)
                    keep_cell(arguments.keep, key, kept_cells[key])
                cells.append(kept_cells[key])
            tell(cause, strength, cells, as_json=arguments.json)


Key = tuple[str, float, int]


def read_kept(path: Path | None) -> dict[Key, Judged]:
    """Cells of an earlier call, by cause, strength and seed."""
    kept_cells = {}
    for cell in read_cells(path):
        cause, strength, seed = cell["key"]
        kept_cells[cause, strength, seed] = Judged(
            Held(**cell["plain"]),
            Held(**cell["ours"]),
            tuple(cell["named_suspects"]),
            tuple(cell["missed_limits"]),
        )
    return kept_cells


def tell(cause: str, strength: float, cells: Sequence[Judged], *, as_json: bool) -> None:
    """Print the figures of one strength."""
    if as_json:
        print(json.dumps({"cause": cause, "strength": strength, "cells": [asdict(cell) for cell in cells]}))
        return
    accepted_cells = [cell.ours for cell in cells if not cell.missed_limits]
    named_suspects = Counter(name for cell in cells for name in cell.named_suspects)
    limits = Counter(name for cell in cells for name in cell.missed_limits)
    reasons = f" ({_counts(limits)})" if limits else ""
    width = float(np.median([cell.ours.u / cell.plain.u for cell in cells]))
    print(
        f"| {cause} {strength:g} | {_of([cell.plain for cell in cells])} | {_of(accepted_cells)} "
        f"| {_counts(named_suspects) or 0} | {len(cells) - len(accepted_cells)} of {len(cells)}{reasons} "
        f"| {width:.2f} |",
        flush=True,
    )


def _of(helds: Sequence[Held]) -> str:
    if not helds:
        return "-"
    share, square, _ = np.array([[row.share, row.square, row.u] for row in helds]).T
    return f"{share.mean():.1%}, {np.sqrt(square.mean()):.2f}, {np.mean(share < 0.8):.0%}"


def _counts(counter: Counter[str]) -> str:
    return ", ".join(f"{name} {count}" for name, count in counter.items())


# -- one cell -------------------------------------------------------------------------------------------------


def judge_cell(seed: int, cause: str, strength: float) -> Judged:
    """Draw a cell; return the comparison of its fall-off with the truth, with the suspects and without."""
    cell = draw_field(seed, cause, strength)
    plain, ours = (
        fit_flat_field(cell.views, channel="G", focal_px=1.02 * FOCAL_PX, size_px=SIZE_PX, search=search)
        for search in (False, True)
    )
    missed_limits = tuple(limit.what for limit in limits_of({"G": ours}, (), SIZE_PX) if not limit.is_met)
    return Judged(
        _against_truth(cell, plain), _against_truth(cell, ours), tuple(ours.causes.names()), missed_limits
    )


def _against_truth(cell: DrawnField, fit: FlatField) -> Held:
    places_px, grid_px = _grid(5), _grid(13)
    mean = float(np.mean(np.log(fit.at(grid_px) / cell.falloff(grid_px))))
    u = fit.u_at(places_px)
    ratios = (np.log(fit.at(places_px) / cell.falloff(places_px)) - mean) / u
    return Held(float(np.mean(np.abs(ratios) < 1.96)), float(np.mean(ratios**2)), float(np.median(u)))


def _grid(steps: int) -> np.ndarray[tuple[int, int], np.dtype[np.float64]]:
    x, y = np.meshgrid(*(np.linspace(0.0, side - 1.0, steps) for side in SIZE_PX))
    return np.column_stack([x.ravel(), y.ravel()])


if __name__ == "__main__":
    main()
