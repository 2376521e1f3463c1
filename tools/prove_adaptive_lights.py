"""Proves `lights: {kind: adaptive}` on objects that are rendered under all LEDs of the simulated cell's dome.

    python tools/prove_adaptive_lights.py [--every N] [--keep FILE]

Each object is acquired once, in one view, with every N-th LED. Every tenth LED is held out: it cannot be chosen.
From the other LEDs, four sets are chosen, using the frames on the disk: LEDs at random; spread LEDs; LEDs that
leave the least variance if errors are equal everywhere (D-optimal, without feedback); and those of the chooser
that runs use. Pictures of the held-out LEDs are computed by scipy's interpolation, and compared with their frames.
Exits with 1 unless, at a third of the LEDs, the chooser's error is at most 1.05 times that of the spread LEDs on
each object, and smaller on half of the objects; not with `--smallest`.
"""

from __future__ import annotations

import argparse
import json
import sys
import tempfile
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.interpolate import RBFInterpolator

ROOT = Path(__file__).resolve().parent.parent
sys.path[:0] = [str(ROOT), str(ROOT / "tests")]

import cells  # noqa: E402

from coupole.acquisition.frame_samples import frame_sample  # noqa: E402
from coupole.preflight.job import read_job  # noqa: E402
from coupole.preflight.next_lights import next_lights, spread_lights  # noqa: E402
from sim.objects.specimens import SPECIMENS  # noqa: E402
from smallest import add_smallest  # noqa: E402

FIRST, BURST, HELD_OUT = 24, 32, 10
PARTS = (12, 6, 3, 2)
"""Shares of the LEDs that are chosen: a twelfth, a sixth, and so on."""
CHROME = {"diffuse": (0.0, 0.0, 0.0), "f0": (0.55, 0.55, 0.55), "roughness": 0.12}
MIXED = "mixed"
Floats = NDArray[np.float64]


@dataclass(frozen=True)
class Frames:
    """An object's pixels under each LED."""

    directions: Floats
    """[leds, 3] from the view's target."""
    signals: Floats
    """[leds, pixels] DN for unit illuminance."""

    def error(self, lit_leds: NDArray[np.int64], held_out: NDArray[np.int64]) -> float:
        """Rms error of the held-out pictures, as a share of the bright level."""
        relit = RBFInterpolator(self.directions[lit_leds], self.signals[lit_leds], kernel="linear", degree=1)
        off = relit(self.directions[held_out]) - self.signals[held_out]
        return float(np.sqrt(np.mean(off**2)) / np.quantile(self.signals, 0.999))


def acquire(folder: Path, material: str, every: int) -> Frames:
    """Render and prove one view of an object of the material."""
    folder.mkdir(parents=True)
    cell = cells.CellFolder(folder, speed=10.0, write_now=False)
    cell.rig_data["sensor"] |= {"width_px": 256, "height_px": 192, "pixel_pitch_um": 88.0}
    cell.world_settings.update(white_at_us=8000, shading="pixel", interreflection=False)
    if material != MIXED:
        cell.world_settings["material"] = CHROME if material == "chrome" else {"specimen": material}
    cell.write(views=[cells.TOP], lights={"kind": "every", "every": every})
    outcome = cell.acquire()
    if outcome.code:
        raise RuntimeError(f"{material}: {outcome.err}")
    job = read_job(cell.plan)
    target_mm = np.array([[0.0, 0.0, 30.0]]) + job.cell.rig.support.base_from_support.matrix()[:3, 3]
    by_led = {
        int(frame.record["led"]): frame_sample(frame.pixels, cells.BLACK_DN, 4095).signal_dn[::3].astype(float)
        for shot, frame in cells.stored(cell.run_folder).items()
        if cells.is_light(shot)
    }
    rows = job.cell.leds.rows(sorted(by_led))
    lux = job.cell.leds.illuminance_lux(target_mm, emission=job.cell.rig.dome.emission)[0, rows]
    ways = job.cell.leds.positions_mm[rows] - target_mm
    signals = np.stack([by_led[led] for led in sorted(by_led)]) / (lux / lux.mean())[:, None]
    return Frames(ways / np.linalg.norm(ways, axis=1, keepdims=True), signals)


def without_feedback(directions: Floats, candidates: NDArray[np.int64], count: int) -> NDArray[np.int64]:
    """Return the lights in the order in which each leaves the least variance, for a field whose errors are equal
    everywhere."""
    covariance = np.exp(-np.arccos(np.clip(directions @ directions.T, -1.0, 1.0)) / np.radians(60.0))
    lit_leds: list[int] = []
    variance = np.full(len(directions), -1.0)
    for _ in range(count):
        variance[candidates] = np.diag(covariance)[candidates]
        variance[lit_leds] = -1.0
        best = int(np.argmax(variance))
        lit_leds.append(best)
        covariance = covariance - np.outer(covariance[:, best], covariance[best]) / covariance[best, best]
    return np.array(lit_leds)


def judge(material: str, frames: Frames) -> dict[str, Any]:
    """Return the errors of each method by number of LEDs, and the number of LEDs with which the chooser does as
    well as all LEDs."""
    numbers = np.arange(len(frames.directions))
    held_out = numbers[::HELD_OUT]
    candidates = np.setdiff1d(numbers, held_out)
    counts = [len(candidates) // part for part in PARTS]
    adaptive_leds = spread_lights(frames.directions, candidates, min(FIRST, counts[0]))
    coming = 0  # LEDs of the last burst, whose frames are still to come when the next one is chosen
    while len(adaptive_leds) < counts[-1]:
        seen_leds, coming_leds = np.split(adaptive_leds, [len(adaptive_leds) - coming])
        signals = frames.signals[seen_leds]
        following = next_lights(
            signals, frames.directions, seen_leds, candidates, BURST, coming_lights=coming_leds
        )
        adaptive_leds = np.append(adaptive_leds, following.lights)
        coming = len(following.lights)
    random_leds = np.random.default_rng(0).permutation(candidates)
    ways = {
        "random": random_leds,
        "spread": spread_lights(frames.directions, candidates, counts[-1]),
        "without feedback": without_feedback(frames.directions, candidates, counts[-1]),
        "adaptive": adaptive_leds,
    }
    errors = {
        way: {count: frames.error(lights[:count], held_out) for count in counts} for way, lights in ways.items()
    }
    return {
        "material": material,
        "leds": len(candidates),
        "all": frames.error(candidates, held_out),
        "errors": errors,
    }


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__.split("\n", maxsplit=1)[0])
    parser.add_argument("--every", type=int, default=1, help="each so many-th LED of the dome")
    parser.add_argument("--keep", type=Path, default=ROOT / "runs" / "proofs" / "adaptive.jsonl", help="verdicts")
    add_smallest(parser)
    options = parser.parse_args()
    every = 8 if options.smallest else options.every
    materials = ["makie"] if options.smallest else [*SPECIMENS, "chrome", MIXED]
    faults, better = [], 0
    lines = []
    for material in materials:
        with tempfile.TemporaryDirectory(prefix="coupole-adaptive-") as folder:
            verdict = judge(material, acquire(Path(folder) / material, material, every))
        lines.append(verdict)
        print(f"{material}: {verdict['leds']} LEDs may be chosen; all of them miss {100 * verdict['all']:.2f} %")
        for way, by_count in verdict["errors"].items():
            print(f"  {way}: " + ", ".join(f"{count} LEDs {100 * e:.2f} %" for count, e in by_count.items()))
        third = verdict["leds"] // 3
        ratio = verdict["errors"]["adaptive"][third] / verdict["errors"]["spread"][third]
        print(f"  adaptive: {ratio:.2f} of the spread LEDs' error at a third", flush=True)
        better += ratio < 1.0
        if ratio > 1.05:
            faults.append(f"{material}: {ratio:.2f} of the spread LEDs' error, more than 1.05")
    options.keep.parent.mkdir(parents=True, exist_ok=True)
    options.keep.write_text("".join(json.dumps(line) + "\n" for line in lines))
    if 2 * better < len(materials):
        faults.append(f"better than spread LEDs on {better} of {len(materials)} objects only")
    print("\n".join(faults) or "as promised")
    return int(bool(faults) and not options.smallest)


if __name__ == "__main__":
    sys.exit(main())
