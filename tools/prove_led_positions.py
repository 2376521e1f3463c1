"""Checks the stated intervals of LED positions in random cells with effects for which a plain adjustment has no
term.

    python tools/prove_led_positions.py [--cells 100] [--causes primary window ...] [--boards 8] [--views 12]
        [--jobs 1] [--json]

Each cell has its own dome, lens, hand-eye, arm, and records with errors of their stated size. Spots are computed,
not rendered. The forward model shares no equation with the calibration: it has Brown's lens, squares of many
points, and the primary lens of `sim.strangers`. Each effect is varied from nothing to a strength at which a plain
adjustment fails:

    primary   lenses on the dies, mm (shift of the image over the sine of the angle to the normal)
    each      the same, of each die another: standard deviation 30 %
    oval      lenses that are not round: the shift along one side is half of that along the other
    window    a flat window of silicone over the dies, mm thick, by Snell's law
    field     spots farther from the middle of the field than the record's lens says, 1e-4
    near      the same, in proportion to the nearness: what an entrance pupil that wanders does, 1e-4 at 1 m
    arm       positions of the arm too large, 1e-4
    moved     the dome moves between the first half of the views and the second, mm

For each strength, figures are printed for the LEDs of cells that were not refused: the share of the 95 % intervals
of coordinates that contain the truth (`plain`: by an adjustment without suspects), rms(error/u), and the share of
cells in which fewer than 80 % do so. Then follow the number of cells that named a suspect, the number of refused
cells, and the median and mean width of u relative to the plain adjustment.
"""

from __future__ import annotations

import argparse
import json
import os
import sys
from collections import Counter
from collections.abc import Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import asdict, dataclass
from datetime import UTC, datetime
from functools import partial
from operator import attrgetter
from pathlib import Path

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

import numpy as np
from numpy.typing import NDArray

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

from coupole.calibration.adjustment import coverage_factor
from coupole.calibration.leds.adjustment import LedGeometry, adjust_leds
from coupole.calibration.leds.boards import board_poses, boards_of
from coupole.calibration.leds.equations import Stated, problem_of
from coupole.calibration.leds.workflow import LedsFound, leds_from
from coupole.calibration.request import Request
from drawn_leds import DrawnLeds, Floats, draw_leds
from smallest import add_smallest

SWEEP = {
    "primary": (0.0, 0.05, 0.1, 0.2, 0.4, 0.8),
    "each": (0.4,),
    "oval": (0.4,),
    "window": (0.5,),
    "field": (2.0, 4.0),
    "near": (2.0, 4.0),
    "arm": (1.0,),
    "moved": (0.3,),
}
"""Strengths of each effect; 0 is computed only once."""
_REQUEST = Request("drawn", datetime(2026, 1, 1, tzinfo=UTC))


@dataclass(frozen=True)
class Judged:
    """One cell, compared with the truth."""

    held_share: float
    held_share_plain: float
    square: float
    """Mean of (error/u)^2."""
    square_plain: float
    width: float
    """Median of u, relative to that of the plain adjustment."""
    named_suspects: tuple[str, ...]
    broken_limits: tuple[str, ...]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--cells", type=int, default=100, help="of each cause and strength")
    parser.add_argument("--causes", nargs="+", choices=SWEEP, default=list(SWEEP))
    parser.add_argument("--boards", type=int, default=8)
    parser.add_argument("--views", type=int, default=12)
    parser.add_argument("--first-seed", type=int, default=1)
    parser.add_argument("--jobs", type=int, default=1)
    parser.add_argument("--json", action="store_true")
    add_smallest(parser, cells=2, causes=["oval"])
    arguments = parser.parse_args()
    seeds = range(arguments.first_seed, arguments.first_seed + arguments.cells)
    if not arguments.json:
        print(_HEAD)
    with ProcessPoolExecutor(arguments.jobs) as pool:
        for cause in arguments.causes:
            for strength in SWEEP[cause]:
                work = partial(
                    judge_cell, boards=arguments.boards, views=arguments.views, cause=cause, strength=strength
                )
                print(f"\r{cause} {strength:g} ", end="", file=sys.stderr, flush=True)
                cells = list(pool.map(work, seeds))
                print("\r", end="", file=sys.stderr)
                tell(cause, strength, cells, as_json=arguments.json)


_HEAD = (
    "| cause, strength | plain: held, rms, below 80 % | held | rms | below 80 % | named | refused | width |\n"
    "|---|---|---|---|---|---|---|---|"
)


def tell(cause: str, strength: float, cells: Sequence[Judged], *, as_json: bool) -> None:
    """Print one line of the table."""
    if as_json:
        print(json.dumps({"cause": cause, "strength": strength, "cells": [asdict(cell) for cell in cells]}))
        return
    accepted_cells = [cell for cell in cells if not cell.broken_limits]
    suspects, limits = (
        _counts([name for cell in cells for name in names(cell)])
        for names in (attrgetter("named_suspects"), attrgetter("broken_limits"))
    )
    width = np.array([cell.width for cell in cells])
    print(
        f"| {cause} {strength:g} | {_of([(cell.held_share_plain, cell.square_plain) for cell in cells])} "
        f"| {_of([(cell.held_share, cell.square) for cell in accepted_cells]).replace(',', ' |')} "
        f"| {suspects or 0} | {len(cells) - len(accepted_cells)} {f'({limits})' if limits else ''}"
        f" | {np.median(width):.2f}, {width.mean():.2f} |",
        flush=True,
    )


def _of(pairs: Sequence[tuple[float, float]]) -> str:
    """Return the share of intervals that contain the truth, rms(error/u), and the share of cells below 80 %."""
    if not pairs:
        return "-, -, -"
    held_share, square = np.array(pairs).T
    return f"{held_share.mean():.1%}, {np.sqrt(square.mean()):.2f}, {np.mean(held_share < 0.8):.0%}"


def _counts(names: Sequence[str]) -> str:
    return ", ".join(f"{name} {count}" for name, count in Counter(names).items())


# -- one cell -------------------------------------------------------------------------------------------------


def judge_cell(seed: int, *, boards: int, views: int, cause: str, strength: float) -> Judged:
    """Draw a cell; return the comparison of its LEDs with the truth, with the suspects and without."""
    cell = draw_leds(seed, boards, views, cause, strength)
    calibration = leds_from(cell.images, cell.table, cell.prior, _REQUEST, stated_noise=Stated())
    plain = _plain(cell, calibration)
    is_found = np.isfinite(calibration.u_mm)
    (held_share, square, u), (held_share_plain, square_plain, u_plain) = (
        _against_truth(geometry, cell.true_mm, is_found) for geometry in (calibration.geometry, plain)
    )
    broken_limits = tuple(
        limit.what for limit in calibration.record.limits if not limit.is_met and limit.what != _MISSING
    )
    named_suspects = tuple(suspect.name for suspect in calibration.geometry.suspects if suspect.is_named)
    return Judged(
        held_share,
        held_share_plain,
        square,
        square_plain,
        float(np.median(u / u_plain)),
        named_suspects,
        broken_limits,
    )


_MISSING = "LEDs not found"
"""Warning that is accepted: a random cell has few views, and some LEDs are in too few of them."""


def _plain(cell: DrawnLeds, calibration: LedsFound) -> LedGeometry:
    boards, matching = boards_of(cell.table), calibration.matching
    sightings = matching.sightings
    problem = problem_of(sightings, sightings.led, boards, cell.images.base_from_flange, cell.prior, Stated(), ())
    return adjust_leds(problem, board_poses(boards, matching.by_place_mm))


def _against_truth(geometry: LedGeometry, true_mm: Floats, rows: NDArray[np.bool_]) -> tuple[float, float, Floats]:
    """Return the share of coordinates within their 95 % intervals, the mean of (error/u)^2, and u [n] of the
    positions."""
    off = (geometry.centres_mm - true_mm)[rows]
    u = np.sqrt(np.einsum("nii->ni", geometry.centre_covariance[rows]))
    k = coverage_factor(geometry.degrees[rows])[:, None]
    return float(np.mean(np.abs(off) < k * u)), float(np.mean((off / u) ** 2)), np.linalg.norm(u, axis=1)


if __name__ == "__main__":
    main()
