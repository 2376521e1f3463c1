"""Proves that E_n of independent artefacts is at most 1 as often as stated, and that wrong artefacts are found.

    python tools/prove_artefacts.py [--cells 40] [--jobs 2]

Each random cell is calibrated with a first board and a first tile. It then measures a second board at five
positions and a second tile at three. Lens, arm, room, boards and tiles are drawn for each cell within their stated
uncertainties; separate code of the tests computes corners and signals (`tests/calibration/artefact_cells.py`).
Then the same cells measure a board whose certificate is 200 ppm wrong and a tile whose certificate is 2 % wrong.
Exits with 1 unless 93 to 98 % of all E_n are at most 1, and the wrong artefacts are found in at least nine of ten
cells.
"""

from __future__ import annotations

import argparse
import os
import sys
import tempfile
from concurrent.futures import ProcessPoolExecutor
from multiprocessing import get_context
from pathlib import Path

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
ROOT = Path(__file__).resolve().parent.parent
sys.path[:0] = [str(ROOT), str(ROOT / "tests" / "calibration")]

import numpy as np  # noqa: E402
from artefact_cells import board_checks, tile_checks  # noqa: E402

from coupole.calibration.check.workflow import Checked, limits_of  # noqa: E402
from smallest import add_smallest  # noqa: E402

LOW, HIGH = 0.93, 0.98
LEAST_FOUND = 0.9
BOARD_PPM, TILE = 200.0, 0.02
Found = tuple[list[float], list[float], bool]
"""E_n of all values; errors of positions, divided by their standard uncertainty; and True if the check is
accepted."""


def checks_of(seed: int) -> dict[str, Found]:
    """Return all checks of one cell."""
    sign = 1.0 if seed % 2 else -1.0
    with tempfile.TemporaryDirectory() as folder:
        good_board, bad_board = board_checks(seed, Path(folder), wrong_ppm=(0.0, sign * BOARD_PPM))
    good_tile, bad_tile = tile_checks(seed, wrong=(0.0, sign * TILE))
    checks = {"board": good_board, "wrong board": bad_board, "tile": good_tile, "wrong tile": bad_tile}
    return {name: _figures(check) for name, check in checks.items()}


def _figures(check: Checked) -> Found:
    ratios = [(parameter.value or 0.0) / parameter.u for parameter in check.parameters]
    is_accepted = all(limit.is_met for limit in limits_of(check, {}))
    return [value.en for value in check.comparisons], ratios, is_accepted


def main() -> int:
    """Run the proof; see the module's text."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--cells", type=int, default=40, help="number of drawn cells")
    parser.add_argument("--first", type=int, default=0, help="seed of the first one")
    parser.add_argument("--jobs", type=int, default=2, help="cells at the same time")
    add_smallest(parser, cells=1, jobs=1)
    options = parser.parse_args()
    seeds = range(options.first, options.first + options.cells)
    with ProcessPoolExecutor(options.jobs, mp_context=get_context("spawn")) as pool:
        cells = []
        for seed, cell in zip(seeds, pool.map(checks_of, seeds), strict=True):
            cells.append(cell)
            largest = ", ".join(f"{name} {max(figures[0]):.2f}" for name, figures in cell.items())
            print(f"cell {seed}: largest E_n: {largest}", flush=True)
    is_good = True
    for name in ("board", "tile"):
        en = np.array([value for cell in cells for value in cell[name][0]])
        ratios = np.array([value for cell in cells for value in cell[name][1]])
        share = float(np.mean(en <= 1.0))
        accepted_count = sum(cell[name][2] for cell in cells)
        rms = float(np.sqrt(np.mean(ratios**2)))
        print(
            f"{name}: E_n at most 1 in {share:.1%} of {len(en)} values, largest {en.max():.2f}; rms(error/u) of "
            f"positions {rms:.2f}; accepted in {accepted_count} of {len(cells)} cells"
        )
        is_good &= LOW <= share <= HIGH
    for name, words in (("wrong board", f"{BOARD_PPM:g} ppm"), ("wrong tile", f"{TILE:.0%}")):
        found_count = sum(not cell[name][2] for cell in cells)
        print(f"{name}, {words}: found in {found_count} of {len(cells)} cells")
        is_good &= found_count >= LEAST_FOUND * len(cells)
    return 0 if is_good or options.smallest else 1


if __name__ == "__main__":
    sys.exit(main())
