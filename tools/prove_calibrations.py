"""Checks the stated intervals of calibrations on many random simulated cells, rendered and calibrated.

    python tools/prove_calibrations.py --cells 100 [--width 1024] [--images 20] [--absolute] [--stranger NAME]
        [--keep FILE] [--json]

Each cell (`random_cells`) has its own lens, hand-eye, arm, dome and object. One line is printed for each
parameter: the fraction of the stated 95 % intervals that contain the truth, and the root mean square of error over
standard uncertainty, which should be about 1. Then the distances of camera, LEDs and mesh from the truth are
printed, as median and 95th percentile over the cells. The file `--keep` gets a line for each cell; a later call
computes only missing cells.

With `--stranger`, each cell has one effect for which calibrations have no parameter (`strange_cells`). Camera and
hand-eye are then compared by their rays; LEDs are compared if the effect concerns them. Cells whose calibration is
refused are counted with the reasons; the intervals of all others must contain the truth.

The exit code is 1 if a cell could not be calibrated, or if a parameter's intervals are wrong: 90 to 99 % must
contain the truth, and rms(error/u) must be between 0.8 and 1.25; both limits are widened to the values that chance
exceeds once in 1000 for this number of cells.
"""

from __future__ import annotations

import argparse
import json
import os
import sys
import time
from collections import Counter
from collections.abc import Sequence
from concurrent.futures import ProcessPoolExecutor, as_completed
from dataclasses import asdict, dataclass
from functools import partial
from pathlib import Path
from typing import Any

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

import numpy as np
from scipy.stats import binom, chi2

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

from cell_proof import Judged, Proof, prove_cell
from coupole.errors import CoupoleError
from random_cells import Postures, postures
from ray_proof import LIGHT_STRANGERS
from smallest import add_smallest
from strange_cells import STRANGERS

SETTINGS = ("width", "images", "samples", "led_boards", "absolute", "stranger")
"""Options that determine the cells."""
_CHANCE = 1e-3


@dataclass(frozen=True)
class Verdict:
    """One parameter over all cells."""

    name: str
    cells: int
    values: int
    covered: float
    rms_over_u: float
    median_error: float
    """Median of the error's magnitude, in the name's unit."""
    median_u: float

    @property
    def faults(self) -> list[str]:
        """Return the violated limits. Values of one cell are correlated, so the number of cells counts, not that
        of values."""
        faults = []
        if binom.cdf(round(self.covered * self.cells), self.cells, 0.90) < _CHANCE:
            faults.append(f"{self.name}: {self.covered:.1%} of the intervals hold the truth")
        if binom.sf(round(self.covered * self.cells) - 1, self.cells, 0.99) < _CHANCE:
            faults.append(f"{self.name}: {self.covered:.1%} of the intervals hold the truth: they are too wide")
        low, high = chi2.ppf((_CHANCE / 2, 1 - _CHANCE / 2), self.cells) / self.cells
        if not 0.8**2 * low < self.rms_over_u**2 < 1.25**2 * high:
            faults.append(f"{self.name}: rms(error/u) is {self.rms_over_u:.2f}")
        return faults


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--cells", type=int, default=100)
    parser.add_argument("--first-seed", type=int, default=1)
    parser.add_argument("--width", type=int, default=1024, help="of frames, px; 4096 is the real camera")
    parser.add_argument("--images", type=int, default=20, help="of the board")
    parser.add_argument("--led-boards", type=int, help="number of boards instead of the whole dome: quick to plan")
    parser.add_argument("--samples", type=int, default=8, help="rays per pixel and direction")
    parser.add_argument("--jobs", type=int, default=1)
    parser.add_argument("--absolute", action="store_true", help="add absolute errors of the arm: 0.3 mm, 0.02 deg")
    parser.add_argument("--stranger", choices=STRANGERS, help="a cause without a term in any calibration")
    parser.add_argument("--keep", type=Path, help="file of finished cells, one line of JSON each")
    parser.add_argument("--json", action="store_true")
    add_smallest(parser, cells=1, width=768, images=20, led_boards=8, samples=2)
    arguments = parser.parse_args()
    settings = {name: getattr(arguments, name) for name in SETTINGS}
    proof_of_seed, failures = read_proofs(arguments.keep, settings), list[str]()
    all_seeds = range(arguments.first_seed, arguments.first_seed + arguments.cells)
    seeds = [seed for seed in all_seeds if seed not in proof_of_seed]
    if seeds:
        work = partial(
            prove_cell,
            at=_postures(arguments),
            width_px=arguments.width,
            samples=arguments.samples,
            absolute=arguments.absolute,
            stranger=arguments.stranger,
        )
        started_s = time.monotonic()
        with ProcessPoolExecutor(arguments.jobs) as pool:
            seed_of = {pool.submit(work, seed): seed for seed in seeds}
            for future in as_completed(seed_of):
                seed = seed_of[future]
                try:
                    proof_of_seed[seed] = future.result()
                except CoupoleError as error:
                    failures.append(f"cell {seed}: {error}")
                else:
                    keep(arguments.keep, settings, seed, proof_of_seed[seed])
                spent_s = time.monotonic() - started_s
                print(
                    f"\r{len(proof_of_seed)} of {len(all_seeds)} cells, {spent_s:.0f} s", end="", file=sys.stderr
                )
        print(file=sys.stderr)
    proofs = [proof_of_seed[seed] for seed in all_seeds if seed in proof_of_seed]
    tell_refused(proofs, as_json=arguments.json)
    proofs = [proof for proof in proofs if proof.refused is None]
    for verdict in verdicts(proofs):
        failures += verdict.faults
        if arguments.json:
            print(json.dumps(asdict(verdict)))
        else:
            print(
                f"{verdict.name:32} covered {verdict.covered:6.1%}  rms(error/u) {verdict.rms_over_u:5.2f}  "
                f"median error {verdict.median_error:.3g}, u {verdict.median_u:.3g}  ({verdict.values} values)"
            )
    tell_accuracies(proofs, as_json=arguments.json)
    if failures:
        sys.exit("\n".join(failures))


def _postures(arguments: argparse.Namespace) -> Postures:
    needs_leds = arguments.stranger in (None, *LIGHT_STRANGERS)
    return postures(arguments.images, led_boards=arguments.led_boards, leds=needs_leds)


def read_proofs(path: Path | None, settings: dict[str, Any]) -> dict[int, Proof]:
    """Cells of an earlier call with the same settings, by seed."""
    if path is None or not path.exists():
        return {}
    cells = [json.loads(line) for line in path.read_text(encoding="utf-8").splitlines()]
    if other_settings := [cell["settings"] for cell in cells if cell["settings"] != settings]:
        sys.exit(f"{path}: its cells were made with {other_settings[0]}, now it is {settings}; name another file")
    return {
        cell["seed"]: Proof(
            [Judged(**judgement) for judgement in cell["judged"]], cell["accuracy"], cell.get("refused")
        )
        for cell in cells
    }


def keep(path: Path | None, settings: dict[str, Any], seed: int, proof: Proof) -> None:
    if path is not None:
        with path.open("a", encoding="utf-8") as file:
            file.write(json.dumps({"seed": seed, "settings": settings, **asdict(proof)}) + "\n")


def tell_refused(proofs: Sequence[Proof], *, as_json: bool) -> None:
    """Print how many cells were refused, and why."""
    reasons = Counter(proof.refused for proof in proofs if proof.refused is not None)
    if as_json and reasons:
        print(json.dumps({"refused": reasons.total(), "cells": len(proofs), "reasons": reasons}))
    elif reasons:
        print(f"{reasons.total()} of {len(proofs)} cells refused:")
        for reason, cells in reasons.most_common():
            print(f"  {cells}: {reason}")


def tell_accuracies(proofs: Sequence[Proof], *, as_json: bool) -> None:
    for name, (median, most) in accuracies(proofs).items():
        if as_json:
            print(json.dumps({"name": name, "median": median, "percent_95": most}))
        else:
            print(f"{name:32} median {median:.4f}, 95 % of cells below {most:.4f}")


def accuracies(proofs: Sequence[Proof]) -> dict[str, tuple[float, float]]:
    """Return median and 95th percentile over the cells, for each figure."""
    names = proofs[0].accuracy if proofs else ()
    figures = {name: [proof.accuracy[name] for proof in proofs] for name in names}
    return {
        name: (float(np.median(figures_of_name)), float(np.quantile(figures_of_name, 0.95)))
        for name, figures_of_name in figures.items()
    }


def verdicts(proofs: Sequence[Proof]) -> list[Verdict]:
    """Return the comparison of the intervals with the truth."""
    results = []
    cells = [proof.judged for proof in proofs]
    for name in dict.fromkeys(judgement.name for cell in cells for judgement in cell):
        judgements = [judgement for cell in cells for judgement in cell if judgement.name == name]
        error, u = (
            np.array([judgement.error for judgement in judgements]),
            np.array([judgement.u for judgement in judgements]),
        )
        inside = np.abs(error) <= np.array([judgement.half_width for judgement in judgements])
        results.append(
            Verdict(
                name,
                sum(any(judgement.name == name for judgement in cell) for cell in cells),
                len(judgements),
                float(inside.mean()),
                float(np.sqrt(np.mean((error / u) ** 2))),
                float(np.median(np.abs(error))),
                float(np.median(u)),
            )
        )
    return results


if __name__ == "__main__":
    main()
