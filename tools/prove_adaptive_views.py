"""Compares chosen views with spread and random views of the same number, by the errors of fits.

    python tools/prove_adaptive_views.py [--object NAME...] [--views N...] [--random N] [--every N] [--smallest]

The views are those that `views: {kind: adaptive}` chooses among 24 candidates. For each material, samples are
drawn as the views would give them, with noise, errors of the LEDs, and Fresnel's term in the highlight, which the
fitted model lacks. The code that fits results fits these samples. The choice knows neither samples nor material.
The error of a part is the mean of the relative errors of kd, ks and alpha and of the normal's error over 2
degrees. Each error counts as at most 1, and as 1 for a part that no view shows. The figure is the mean over the
surface that the candidates show. The exit code is 1 if chosen views are more than 5 % worse than spread ones,
except with `--smallest`.
"""

from __future__ import annotations

import argparse
import json
import sys
import tempfile
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

ROOT = Path(__file__).resolve().parent.parent
sys.path[:0] = [str(ROOT)]

from coupole.geometry import farthest_first  # noqa: E402
from coupole.plan.light_selection import select_leds  # noqa: E402
from coupole.plan.plan import AdaptiveViews  # noqa: E402
from coupole.plan.view_choices import ChosenView  # noqa: E402
from coupole.preflight.job import Job, read_job  # noqa: E402
from coupole.reflectance.next_views.next_views import NextViews  # noqa: E402
from coupole.reflectance.next_views.supposed_surface import supposed_surface  # noqa: E402
from coupole.reflectance.suggestion.drawn_triangles import MeshParts  # noqa: E402
from coupole.reflectance.suggestion.rehearsal import PlannedFrames, drawn_samples  # noqa: E402
from coupole.reflectance.suggestion.supposed_materials import SUPPOSED, SupposedMaterial  # noqa: E402
from coupole.reflectance.suggestion.supposed_signal import SeenParts, seen_by  # noqa: E402
from coupole.reflectance.triangle_fit import fit_triangles  # noqa: E402
from smallest import add_smallest  # noqa: E402

Floats = NDArray[np.float64]

OBJECTS = {"relief": ("objects/relief.ply", [0, 0, 30]), "bust": ("restorations/bust.ply", [0, 0, 90])}
AZIMUTHS_DEG, ELEVATIONS_DEG = [-150, -120, -90, -60, -30, 0, 60, 120], [35, 55, 80]
MOST_WORSE = 1.05
_NORMAL_DEG, _MESH_NOISE_UM, _TRIANGLES = 2.0, 30.0, 400


def job_of(folder: Path, name: str, every: int) -> Job:
    """Return the job of a plan whose views are chosen among all candidates that the arm can reach."""
    mesh, target_mm = OBJECTS[name]
    grid = {"kind": "grid", "name": "v", "target_mm": target_mm, "distance_mm": 335}
    grid |= {"azimuths_deg": AZIMUTHS_DEG, "elevations_deg": ELEVATIONS_DEG}
    plan = {
        "schema_version": 1,
        "name": name,
        "rig": str(ROOT / "configs/rigs/sim.yaml"),
        "calibrations": "none",
        "object": {"id": name, "mesh": str(ROOT / "configs" / mesh)},
        "views": {"kind": "adaptive", "candidates": [grid], "until": {"views": 24}},
        "lights": {"kind": "every", "every": every},
        "exposure": {"kind": "fixed", "exposure_us": 8000},
    }
    path = folder / "plan.yaml"
    path.write_text(json.dumps(plan))
    job = read_job(path)
    visits = job.motion.ways.itinerary(job.schedule.views).visits
    names = {view.name for view, visit in zip(job.schedule.views, visits, strict=True) if visit is not None}
    return replace(job, schedule=replace(job.schedule.only_views(names), most_views=len(names)))


class Judge:
    """Errors of fits to samples of some views."""

    def __init__(self, job: Job) -> None:
        self._job, self._surface = job, supposed_surface(job)
        self._rows = select_leds(job.plan.lights, job.cell.leds, job.cell.rig.support.base_from_support.matrix())
        self.seen_parts: dict[str, SeenParts] = {}
        for view in job.schedule.views:
            assert view.support_from_camera is not None
            joints_deg = job.motion.ways.visit(view).joints_deg
            self.seen_parts[view.name] = seen_by(
                job.motion.occlusions, self._surface, joints_deg, view.support_from_camera
            )
        corners_mm = job.shape.corners_mm
        mesh = MeshParts(corners_mm, job.motion.occlusions.patches.of_triangles(len(corners_mm)))
        self._triangles = mesh.drawn(_TRIANGLES, np.random.default_rng(0))
        self._pixels = {
            name: self._triangles.pixels(self._surface, parts) for name, parts in self.seen_parts.items()
        }
        is_shown = np.any([pixels > 0.0 for pixels in self._pixels.values()], axis=0)
        self._weights = np.where(is_shown, self._triangles.areas_mm2, 0.0)
        self._weights /= self._weights.sum()

    def error(self, names: Sequence[str], material: SupposedMaterial, seed: int) -> float:
        """Return the mean error over the surface after these views."""
        random, noise = np.random.default_rng(seed), self._surface.noise
        samples = drawn_samples(
            self._surface,
            self._triangles,
            np.stack([noise.drawn_pixels(self._pixels[name], random) for name in names]),
            PlannedFrames(
                [self.seen_parts[name] for name in names], self._job.plan.exposure.exposures_us, self._rows
            ),
            material,
            random,
        )
        materials = fit_triangles(samples, np.ones(len(samples.led_mm), np.bool_), _MESH_NOISE_UM)
        cosines = np.clip(np.sum(materials.normals * self._triangles.normals, axis=1), -1.0, 1.0)
        errors = np.stack(
            [
                np.abs(materials.kd[:, 0] / material.kd - 1.0),
                np.abs(materials.ks[:, 0] / material.ks - 1.0),
                np.abs(materials.alpha / material.alpha - 1.0),
                np.degrees(np.arccos(cosines)) / _NORMAL_DEG,
            ]
        )
        errors = np.minimum(np.where(np.isfinite(errors), errors, 1.0), 1.0)
        return float(errors.mean(axis=0) @ self._weights)


def chosen_views(job: Job, count: int) -> list[str]:
    """Return the views that the run would choose."""
    assert isinstance(job.plan.views, AdaptiveViews)
    next_views = NextViews(job, job.plan.views.until.model_copy(update={"views": count}))
    choices: list[ChosenView] = []
    while not choices or choices[-1].view:
        choices.append(next_views.choose(choices, job.schedule))
    return [choice.view for choice in choices if choice.view]


def spread_views(job: Job, count: int) -> list[str]:
    """Return views whose cameras are as far from each other as possible; the highest is the first."""
    cameras_mm = np.array([view.support_from_camera[:3, 3] for view in job.schedule.views])  # type: ignore[index]
    order = [number for number, _ in farthest_first(cameras_mm, int(np.argmax(cameras_mm[:, 2])))]
    return [job.schedule.views[number].name for number in order[:count]]


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--object", nargs="+", choices=OBJECTS, default=list(OBJECTS))
    parser.add_argument("--views", nargs="+", type=int, default=[2, 3, 4, 6, 8])
    parser.add_argument("--random", type=int, default=12, help="sets of random views")
    parser.add_argument("--every", type=int, default=20, help="every n-th LED of the dome")
    add_smallest(parser, object=["relief"], views=[2], random=1, every=90)
    options = parser.parse_args()
    worst = 0.0
    print("object material views: chosen, spread, random median (best to worst); chosen over spread")
    for name in options.object:
        with tempfile.TemporaryDirectory() as folder:
            job = job_of(Path(folder), name, options.every)
            judge, random = Judge(job), np.random.default_rng(1)
            names = [view.name for view in job.schedule.views]
            for count in options.views:
                random_sets = [random.choice(names, count, replace=False).tolist() for _ in range(options.random)]
                sets = {"chosen": chosen_views(job, count), "spread": spread_views(job, count)}
                for material_name, material in SUPPOSED.items():
                    errors = {key: judge.error(views, material, 1) for key, views in sets.items()}
                    of_random = sorted(judge.error(views, material, 1) for views in random_sets)
                    ratio = errors["chosen"] / errors["spread"]
                    worst = max(worst, ratio)
                    print(
                        f"{name:8} {material_name:8} {count}: {errors['chosen']:.4f}, {errors['spread']:.4f}, "
                        f"{np.median(of_random):.4f} ({of_random[0]:.4f} to {of_random[-1]:.4f}); {ratio:.3f}",
                        flush=True,
                    )
    print(f"worst: {worst:.3f} of the spread views' error")
    return int(worst > MOST_WORSE and not options.smallest)


if __name__ == "__main__":
    sys.exit(main())
