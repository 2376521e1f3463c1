"""Are the intervals of calibrations true? Many random simulated cells, rendered, calibrated, held against truth.

    python tools/prove_calibrations.py --cells 100 [--width 1024] [--images 20] [--absolute] [--keep FILE] [--json]

Each cell (`random_cells`) has a lens, a hand-eye, an arm, a dome and an object of its own. One line for each
parameter: how many of the stated 95 % intervals hold the truth, and the root mean square of error over standard
uncertainty, about 1. Then how far camera, LEDs and mesh are from the truth, in the cells' median and 95th percent.
What `--keep` names gets a line for each cell; called again, only missing cells are done.
"""

from __future__ import annotations

import argparse
import json
import os
import sys
import time
from collections.abc import Sequence
from concurrent.futures import ProcessPoolExecutor, as_completed
from dataclasses import asdict, dataclass
from functools import partial
from pathlib import Path

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

import numpy as np

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

from cell_proof import Judged, Proof, prove_cell
from coupole.errors import CoupoleError
from random_cells import postures


@dataclass(frozen=True)
class Verdict:
    """One parameter over all cells."""

    name: str
    cells: int
    values: int
    covered: float
    rms_over_u: float
    median_error: float
    """Of its size, in the name's unit."""
    median_u: float


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--cells", type=int, default=100)
    parser.add_argument("--first-seed", type=int, default=1)
    parser.add_argument("--width", type=int, default=1024, help="of frames, px; 4096 is the real camera")
    parser.add_argument("--images", type=int, default=20, help="of the board")
    parser.add_argument("--led-boards", type=int, help="so many boards instead of the whole dome: quick to plan")
    parser.add_argument("--samples", type=int, default=8, help="rays a pixel and direction")
    parser.add_argument("--jobs", type=int, default=1)
    parser.add_argument("--absolute", action="store_true", help="the arm is off by 0.3 mm and 0.02 deg as well")
    parser.add_argument("--keep", type=Path, help="file of cells that are done, one line of JSON each")
    parser.add_argument("--json", action="store_true")
    arguments = parser.parse_args()
    done, refused = kept(arguments.keep), list[str]()
    wanted = range(arguments.first_seed, arguments.first_seed + arguments.cells)
    seeds = [seed for seed in wanted if seed not in done]
    if seeds:
        work = partial(
            prove_cell,
            at=postures(arguments.images, led_boards=arguments.led_boards),
            width_px=arguments.width,
            samples=arguments.samples,
            absolute=arguments.absolute,
        )
        started_s = time.monotonic()
        with ProcessPoolExecutor(arguments.jobs) as pool:
            seed_of = {pool.submit(work, seed): seed for seed in seeds}
            for future in as_completed(seed_of):
                seed = seed_of[future]
                try:
                    done[seed] = future.result()
                except CoupoleError as error:
                    refused.append(f"cell {seed}: {error}")
                else:
                    keep(arguments.keep, seed, done[seed])
                spent_s = time.monotonic() - started_s
                print(f"\r{len(done)} of {len(wanted)} cells, {spent_s:.0f} s", end="", file=sys.stderr)
        print(file=sys.stderr)
    proofs = [done[seed] for seed in wanted if seed in done]
    for verdict in verdicts(proofs):
        if arguments.json:
            print(json.dumps(asdict(verdict)))
        else:
            print(
                f"{verdict.name:32} covered {verdict.covered:6.1%}  rms(error/u) {verdict.rms_over_u:5.2f}  "
                f"median error {verdict.median_error:.3g}, u {verdict.median_u:.3g}  ({verdict.values} values)"
            )
    for name, (median, most) in accuracies(proofs).items():
        if arguments.json:
            print(json.dumps({"name": name, "median": median, "percent_95": most}))
        else:
            print(f"{name:32} median {median:.4f}, 95 % of cells below {most:.4f}")
    if refused:
        sys.exit("\n".join(["not calibrated:", *refused]))


def kept(path: Path | None) -> dict[int, Proof]:
    """Cells of an earlier call, by seed."""
    if path is None or not path.exists():
        return {}
    cells = [json.loads(line) for line in path.read_text(encoding="utf-8").splitlines()]
    return {cell["seed"]: Proof([Judged(**one) for one in cell["judged"]], cell["accuracy"]) for cell in cells}


def keep(path: Path | None, seed: int, proof: Proof) -> None:
    if path is not None:
        with path.open("a", encoding="utf-8") as file:
            file.write(json.dumps({"seed": seed, **asdict(proof)}) + "\n")


def accuracies(proofs: Sequence[Proof]) -> dict[str, tuple[float, float]]:
    """Median and 95th percent over the cells of each figure."""
    names = proofs[0].accuracy if proofs else ()
    figures = {name: [proof.accuracy[name] for proof in proofs] for name in names}
    return {name: (float(np.median(one)), float(np.quantile(one, 0.95))) for name, one in figures.items()}


def verdicts(proofs: Sequence[Proof]) -> list[Verdict]:
    """What the intervals are worth."""
    found = []
    cells = [proof.judged for proof in proofs]
    for name in dict.fromkeys(one.name for cell in cells for one in cell):
        mine = [one for cell in cells for one in cell if one.name == name]
        error, u = np.array([one.error for one in mine]), np.array([one.u for one in mine])
        inside = np.abs(error) <= np.array([one.half_width for one in mine])
        found.append(
            Verdict(
                name,
                sum(any(one.name == name for one in cell) for cell in cells),
                len(mine),
                float(inside.mean()),
                float(np.sqrt(np.mean((error / u) ** 2))),
                float(np.median(np.abs(error))),
                float(np.median(u)),
            )
        )
    return found


if __name__ == "__main__":
    main()
