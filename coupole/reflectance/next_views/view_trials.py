"""Computes, once before a run, which parts of the object each candidate view would show, and how much information
it would add.
"""

from __future__ import annotations

from collections.abc import Sequence
from copy import deepcopy
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from coupole.geometry import farthest_first
from coupole.plan.light_selection import select_leds
from coupole.plan.plan_lights import AdaptiveLights
from coupole.plan.schedule import ViewPose
from coupole.preflight.framing import camera_at
from coupole.preflight.job import Job
from coupole.reflectance.ggx import UNKNOWNS
from coupole.reflectance.next_views.supposed_surface import supposed_surface
from coupole.reflectance.suggestion.supposed_materials import SUPPOSED
from coupole.reflectance.suggestion.supposed_signal import Surface, seen_by
from coupole.reflectance.suggestion.view_information import Information, ViewInformation, information_of
from coupole.reflectance.triangle_fit import FEWEST

Floats = NDArray[np.float64]

_MOST_LEDS = 240
"""Greatest number of LEDs with which a view is tried. They are spread over all LEDs of the plan."""
_MESH_NOISE_UM = 30.0
"""Usual standard uncertainty of the mesh's vertices."""


@dataclass(frozen=True)
class Trial:
    """A candidate view."""

    view: ViewPose
    joints_deg: Floats
    """[6] posture of the arm."""
    is_shown: NDArray[np.bool_]
    """[parts] True where the view shows the part sharply and not too obliquely, and at least one LED lights it."""
    information: tuple[ViewInformation, ...]
    """Information of the view about the parts, for each supposed material."""
    samples: Floats
    """[parts] number of samples that it gives of each part."""


@dataclass
class Knowledge:
    """Knowledge about the parts, from some views."""

    information: tuple[Information, ...]
    """Sums over the samples of the parts, for each supposed material."""
    decreases: Floats
    """[materials, parts] half the decrease of the logarithm of the covariance's determinant by these views."""
    samples: Floats
    """[parts] number of samples."""

    def add(self, trial: Trial) -> None:
        """Add a view."""
        for number, (information, view) in enumerate(zip(self.information, trial.information, strict=True)):
            self.decreases[number, view.parts] += information.gains(view, 0)
            information.add(view, 0)
        self.samples += trial.samples


@dataclass(frozen=True)
class Trials:
    """All candidates of a plan."""

    of_view: dict[str, Trial]
    shares: Floats
    """[parts] area of each part, as a share of the surface."""
    priors: tuple[Information, ...]
    """Knowledge before any view, for each supposed material."""

    def knowledge_after(self, names: Sequence[str]) -> Knowledge:
        """Return the knowledge after some views."""
        count = len(self.shares)
        knowledge = Knowledge(deepcopy(self.priors), np.zeros((len(self.priors), count)), np.zeros(count))
        for name in names:
            knowledge.add(self.of_view[name])
        return knowledge

    def value(self, knowledge: Knowledge) -> float:
        """Return the decrease of the logarithm of the uncertainty, for each of a material's unknowns: the mean
        over the surface and the supposed materials. A fit needs `FEWEST` samples. A part with fewer samples
        counts in proportion to their number.
        """
        usable_shares = np.minimum(knowledge.samples / FEWEST, 1.0) * self.shares
        return float(np.mean(knowledge.decreases @ usable_shares)) / UNKNOWNS

    def gain(self, knowledge: Knowledge, name: str) -> float:
        """Return the expected decrease of the uncertainty by a further view, as a share."""
        after = deepcopy(knowledge)
        after.add(self.of_view[name])
        return float(-np.expm1(self.value(knowledge) - self.value(after)))

    def coverage(self, names: Sequence[str]) -> float:
        """Return the share of the surface that these views show, of all that the candidates show."""
        all_shown = np.any([trial.is_shown for trial in self.of_view.values()], axis=0)
        is_shown = np.zeros(len(self.shares), np.bool_)
        for name in names:
            is_shown |= self.of_view[name].is_shown
        return float(self.shares[is_shown].sum() / max(self.shares[all_shown].sum(), 1e-300))


def trials_of(job: Job) -> Trials:
    """Return the trials of all candidates of a job."""
    surface = supposed_surface(job)
    led_rows, each_stands_for = _judging_leds(job)
    trials = {view.name: _trial(job, surface, view, led_rows, each_stands_for) for view in job.schedule.views}
    areas_mm2 = job.motion.occlusions.patches.areas_mm2
    priors = tuple(Information.before(surface, _MESH_NOISE_UM) for _ in SUPPOSED)
    return Trials(trials, areas_mm2 / areas_mm2.sum(), priors)


def _judging_leds(job: Job) -> tuple[NDArray[np.int64], float]:
    """Return rows of the LED table that represent the plan's LEDs, and the number of LEDs that each of them
    represents. If LEDs are chosen in the run, they are supposed to be spread."""
    lights, leds = job.plan.lights, job.cell.leds
    rows = select_leds(lights, leds, job.cell.rig.support.base_from_support.matrix())
    count = min(len(rows), lights.until.lights) if isinstance(lights, AdaptiveLights) else len(rows)
    places = [place for place, _ in farthest_first(leds.positions_mm[rows], 0)]
    some = rows[places[: min(count, _MOST_LEDS)]]
    return some, count / len(some)


def _trial(
    job: Job, surface: Surface, view: ViewPose, led_rows: NDArray[np.int64], each_stands_for: float
) -> Trial:
    joints_deg = job.motion.ways.visit(view).joints_deg
    pose = view.support_from_camera
    seen_parts = seen_by(
        job.motion.occlusions,
        surface,
        joints_deg,
        camera_at(joints_deg, job.cell.rig) if pose is None else pose,
    )
    return Trial(
        view,
        joints_deg,
        (seen_parts.pixels > 0.0) & seen_parts.is_lit[:, led_rows].any(axis=1),
        tuple(
            _scale(
                information_of(
                    surface, seen_parts, material, job.plan.exposure.exposures_us, led_rows, (len(led_rows),)
                ),
                each_stands_for,
            )
            for material in SUPPOSED.values()
        ),
        each_stands_for * np.where(seen_parts.pixels > 0.0, seen_parts.is_lit[:, led_rows].sum(axis=1), 0),
    )


def _scale(information: ViewInformation, factor: float) -> ViewInformation:
    return replace(information, bread=factor * information.bread, meat=factor * information.meat)
