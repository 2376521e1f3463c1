"""Proves registration: many scans of a tower from an independent ray caster, in random order and with unknown
poses.

    python tools/prove_registration.py [--scans 167] [--across 570] [--seeds 1] [--keep DIR]

167 scans of 570 x 570 rays have 54 million rays, about the number of points of Notre-Dame's west front (Callet et
al. 2010). Surfaces hide each other, a third of the material is dark and loses rays, and ranges have noise of 0.5
mm. Reading, registration and merging are timed, and memory is measured. `--seeds` repeats this with other towers,
positions and noise, because the errors of the poses of one registration are correlated. Only several registrations
show how often 95 % regions contain the truth. Exits with 1 if a scan is placed wrongly or not at all, if fewer
than 90 % of the poses are in their 95 % regions, if one registration took more than 30 minutes, or if a process
took more than 8 GB.
"""

from __future__ import annotations

import argparse
import resource
import sys
import tempfile
import time
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from scipy.stats import chi2

ROOT = Path(__file__).resolve().parent.parent
sys.path[:0] = [str(ROOT), str(ROOT / "tests")]

from ray_scanner import RayScanner, tower  # noqa: E402

from coupole.scan.registration.merging import merge  # noqa: E402
from coupole.scan.registration.registering import Registration, register  # noqa: E402
from coupole.scan.registration.small_motions import displacement_mm, inverse_of, step_between  # noqa: E402
from smallest import add_smallest  # noqa: E402

SCANS = 167
RADIUS_MM, HEIGHT_MM, STATUES, FACETS = 4000.0, 8000.0, 700, 1500
NOISE_MM, FIELD_DEG, AWAY_MM = 0.5, 55.0, 3200.0
MOST_MINUTES, MOST_GB, LEAST_COVERED, MOST_OFF_MM = 30.0, 8.0, 0.90, 20.0


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--scans", type=int, default=SCANS)
    parser.add_argument("--across", type=int, default=570, help="rays along each side of a scan's field")
    parser.add_argument("--mesh-mm", type=float, default=10.0)
    parser.add_argument("--keep", type=Path, help="folder for scans, mesh and clouds")
    parser.add_argument("--seeds", type=int, default=1, help="towers, one registration each")
    add_smallest(parser, scans=12, across=200, mesh_mm=40.0)
    arguments = parser.parse_args()
    outcomes = []
    for seed in range(arguments.seeds):
        with tempfile.TemporaryDirectory(prefix="coupole-registration-") as scratch:
            folder = (arguments.keep or Path(scratch)) / f"seed{seed}"
            folder.mkdir(parents=True, exist_ok=True)
            outcomes.append(register_once(folder, arguments, seed))
    memory = max(
        resource.getrusage(process_kind).ru_maxrss
        for process_kind in (resource.RUSAGE_SELF, resource.RUSAGE_CHILDREN)
    )
    coverage = float(np.mean([outcome.coverage for outcome in outcomes]))
    squared_ratio = float(np.mean([outcome.squared_ratio for outcome in outcomes]))
    off_mm, minutes = max(outcome.off_mm for outcome in outcomes), max(outcome.minutes for outcome in outcomes)
    gb = memory / 1e6
    print(
        f"in 95 % regions {100 * coverage:.1f} % of the poses; mean squared error {squared_ratio:.2f} times the "
        f"stated one; {off_mm:.3f} mm at worst; {minutes:.1f} minutes at most; {gb:.2f} GB in the largest process"
    )
    wrong = any(outcome.unplaced_count for outcome in outcomes) or off_mm > MOST_OFF_MM or coverage < LEAST_COVERED
    return int(wrong or minutes > MOST_MINUTES or gb > MOST_GB)


@dataclass(frozen=True)
class Outcome:
    """Errors of one registration."""

    unplaced_count: int
    off_mm: float
    """Root mean square displacement of the worst scan's points."""
    coverage: float
    """Share of the poses in their 95 % regions."""
    squared_ratio: float
    """Mean squared error of the poses, relative to the stated one."""
    minutes: float


def register_once(folder: Path, arguments: argparse.Namespace, seed: int) -> Outcome:
    truth = make_scans(folder, arguments.scans, arguments.across, seed)
    paths = [folder / name for name in truth]
    start_s = time.monotonic()
    registration = register(paths, "mm", say=_say)
    placed_scans = [registration.scans[k] for k in registration.placed_numbers]
    poses = [registration.first_from_scan[k] for k in registration.placed_numbers]
    out = Path(tempfile.mkdtemp(dir=folder))
    merged_mesh = merge(placed_scans, poses, "mm", arguments.mesh_mm, (5.0, 10.0, 50.0, 250.0), out, _say)
    minutes = (time.monotonic() - start_s) / 60
    print(f"{merged_mesh.points:,} points; {merged_mesh.triangles:,} triangles; {merged_mesh.levels}")
    off_mm, coverage, squared_ratio = compare_with_truth(registration, truth)
    loops = [loop.error_mm for loop in registration.loops] or [np.inf]
    print(
        f"{len(registration.placed_numbers)} placed, {len(registration.unplaced_numbers)} not; "
        f"{registration.pairs} pairs, "
        f"{len(registration.rejected_motions)} rejected, {len(registration.sliding_pairs)} slide; "
        f"{len(loops)} loops: median {np.median(loops):.3f} mm, worst {max(loops):.3f} mm; factor "
        f"{registration.loop_factor:.2f}, inflation {registration.fit.inflation:.2f}, "
        f"noise {registration.fit.noise_mm:.3f} mm"
    )
    print(
        f"off {np.median(off_mm):.3f} mm in the median, {off_mm.max():.3f} mm at worst; in 95 % regions "
        f"{100 * coverage:.1f} %, mean squared error {squared_ratio:.2f} times the stated one; "
        f"{minutes:.1f} minutes",
        flush=True,
    )
    return Outcome(len(registration.unplaced_numbers), float(off_mm.max()), coverage, squared_ratio, minutes)


def make_scans(folder: Path, count: int, across: int, seed: int) -> dict[str, np.ndarray]:
    """Return scans around the tower at several heights, shuffled, and `world_from_scan` of each by its file's
    name."""
    rng = np.random.default_rng(2 + 1000 * seed)
    scale = (count / SCANS) ** 0.5  # with fewer scans, the tower is smaller
    radius_mm, whole_mm, statues = scale * RADIUS_MM, scale * HEIGHT_MM, round(scale**2 * STATUES)
    object_scanned = tower(radius_mm, whole_mm, statues, FACETS, 1 + 1000 * seed)
    scanner = RayScanner(object_scanned, noise_mm=NOISE_MM, seed=3 + 1000 * seed)
    truth = {}
    for place, number in enumerate(rng.permutation(count)):
        share = (number + 0.5) / count
        angle = 2 * np.pi * number * 0.6180339887  # the golden angle spreads them evenly
        height_mm = (share - 0.5) * 0.72 * whole_mm
        wall = radius_mm * np.array([np.cos(angle), np.sin(angle), 0]) + [0, 0, height_mm]
        side = rng.uniform(-0.25, 0.25)
        away = np.array([np.cos(angle + side), np.sin(angle + side), 0])
        eye = (radius_mm + AWAY_MM * rng.uniform(0.8, 1.1)) * away + [0, 0, height_mm + rng.uniform(-600, 600)]
        scan = scanner.scan(eye, wall, FIELD_DEG, across)
        truth[scan.write(folder / f"scan{place:03d}.ply").name] = scan.world_from_scan
    return truth


def compare_with_truth(
    registration: Registration, truth: dict[str, np.ndarray]
) -> tuple[np.ndarray, float, float]:
    """Return three figures: the displacement of each placed scan's points from the truth, in the first scan's
    frame; the share of poses in their 95 % regions; and the mean squared error relative to the stated one.

    The share is a mean over the frames of all scans, because the error of one frame is contained in all poses.
    """
    world_from = [truth[registration.names[number]] for number in registration.placed_numbers]
    first_from_world = inverse_of(world_from[0])
    off_mm = [
        displacement_mm(
            registration.first_from_scan[n], first_from_world @ true, registration.scans[n].coarse.points_mm
        )
        for n, true in zip(registration.placed_numbers, world_from, strict=True)
    ]
    squared_errors = np.concatenate([_squared_errors(registration, world_from, r) for r in range(len(world_from))])
    return np.array(off_mm), float(np.mean(squared_errors < chi2.ppf(0.95, 6))), float(np.mean(squared_errors) / 6)


def _squared_errors(registration: Registration, world_from: list[np.ndarray], reference: int) -> list[float]:
    """Return squared errors of the poses, seen from one scan, relative to their covariances."""
    fit, squared_errors = registration.fit, []
    true_from_world = fit.common_from_scan[reference] @ inverse_of(world_from[reference])
    for k, pose in enumerate(fit.common_from_scan):
        if k == reference:
            continue
        x, y, z = fit.pivots_mm[k] - fit.pivots_mm[reference]
        transport = np.eye(6)  # converts a step about the reference's pivot to one about this scan's pivot
        transport[:3, 3:] = [[0, z, -y], [-z, 0, x], [y, -x, 0]]
        jacobian = np.zeros((6, fit.covariance.shape[0]))
        jacobian[:, 6 * k : 6 * k + 6] += np.eye(6)
        jacobian[:, 6 * reference : 6 * reference + 6] -= transport
        step = step_between(pose, true_from_world @ world_from[k], fit.pivots_mm[k])
        squared_errors.append(float(step @ np.linalg.solve(jacobian @ fit.covariance @ jacobian.T, step)))
    return squared_errors


def _say(step: str, done_count: int, of: int) -> None:
    if done_count == of:
        print(f"{time.strftime('%H:%M:%S')} {step}", file=sys.stderr, flush=True)


if __name__ == "__main__":
    sys.exit(main())
