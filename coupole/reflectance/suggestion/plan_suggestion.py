"""Suggests a plan for an object: the most informative views, LEDs and exposures within a budget.

For each possible exposure and number of LEDs, views are chosen until time or light is used up, or until a further
view adds little information (`view_choice`). Preflight gives the cost of a view. The best of these plans is
checked with paths; views without a path are replaced.
"""

from __future__ import annotations

import math
import os
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from itertools import product
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from coupole.errors import InputError, PreflightRefused
from coupole.geometry import farthest_first
from coupole.plan.held_out import HELD_OUT_EVERY
from coupole.plan.plan import LookAt
from coupole.preflight.checking import calibration_refusals, check_job
from coupole.preflight.job import Job, read_job
from coupole.preflight.preflight import Report, StorageFacts
from coupole.reflectance.suggestion.candidate_views import Candidate, candidates_of
from coupole.reflectance.suggestion.drawn_triangles import MeshParts
from coupole.reflectance.suggestion.plan_text import PlanText
from coupole.reflectance.suggestion.rehearsal import PlannedFrames, Rehearsal, rehearse
from coupole.reflectance.suggestion.supposed_materials import SupposedMaterial, supposed_materials
from coupole.reflectance.suggestion.supposed_signal import SupposedCell, signal_quantile
from coupole.reflectance.suggestion.view_choice import ViewChoice, choose_views
from coupole.reflectance.suggestion.view_information import Information, ViewInformation, information_of

Said = Callable[[str, int, int], None]

LED_NUMBERS = (60, 120, 240, 480)
"""Numbers of LEDs that are tried besides all LEDs."""
LONGER = 8
"""Factor between the exposures that are tried; the shorter exposure saturates nothing."""
_SATURATED_SHARE = 1e-3
"""Share of samples that may be brighter than the range of the shorter exposure."""
_FULL = 0.85
"""Share of the camera's range that the brightest of the remaining samples reach."""
_ROUNDS = 8
_TRIAL_VIEWS = 3
_ENDLESS = StorageFacts(free_bytes=1 << 60)
_MOST_KNOWN, _ENOUGH_PIXELS = 0.5, 6.0
"""A mesh is too fine if fewer triangles get a material, and if fewer pixels lie on a triangle. Six adjacent pixels
nearly always have all three channels of a Bayer pattern."""
_SAME = 0.02
"""Plans with a smaller difference of value are equally good; the shortest one is taken."""


@dataclass(frozen=True)
class Budget:
    """The largest allowed cost of a plan."""

    seconds: float
    lux_h: float | None = None
    views: int = 24


@dataclass(frozen=True)
class SuggestionRequest:
    """A request for a plan."""

    text: PlanText
    """Names of the files, as they will be written in the plan."""
    path: Path
    """The file of the plan to be written; relative paths in the plan begin there."""
    material: str
    """One of `supposed_materials.SUPPOSED`, or `unknown`."""
    budget: Budget
    scan_noise_um: float = 30.0
    """Standard uncertainty of each coordinate of the mesh's vertices."""


class Settings(NamedTuple):
    """Everything in a plan besides its views."""

    exposures_us: tuple[int, ...]
    leds: int
    """Index of the chosen number of LEDs."""


@dataclass(frozen=True)
class Suggestion:
    """A plan and its expected uncertainty."""

    text: str
    """The plan's YAML."""
    report: Report
    """Preflight's report, with paths."""
    views: tuple[LookAt, ...]
    """The views, the most informative one first."""
    exposures_us: tuple[int, ...]
    leds: int
    rehearsals: dict[str, Rehearsal]
    """The expected uncertainty for each supposed material, by its name."""
    job: Job

    @property
    def known_share(self) -> float:
        """Share of the mesh's triangles that get a material, for the supposed material with the smallest share."""
        return min(rehearsal.known_share for rehearsal in self.rehearsals.values())

    @property
    def coarser_mesh(self) -> int | None:
        """Number of triangles of a mesh that the camera resolves, if this mesh is too fine for most of its
        triangles to get a material; otherwise None."""
        pixels = max(rehearsal.pixels for rehearsal in self.rehearsals.values())
        if self.known_share >= _MOST_KNOWN or pixels >= _ENOUGH_PIXELS:
            return None
        count = len(self.job.shape.corners_mm) * pixels / _ENOUGH_PIXELS
        return int(float(f"{max(count, 1.0):.1g}"))

    def medians(self) -> dict[str, dict[str, float | None]]:
        """Median standard uncertainties of the triangles that get a material, by supposed material; None without
        such triangles."""
        return {
            name: {key: _median(values) for key, values in rehearsal.uncertainty.items()}
            for name, rehearsal in self.rehearsals.items()
        }

    def figures(self) -> dict[str, Any]:
        """Figures as JSON values."""
        return {
            "views": [view.name for view in self.views],
            "leds": self.leds,
            "exposures_us": list(self.exposures_us),
            "duration_s": self.report.duration_s,
            "dose_lux_h": self.report.dose_lux_h,
            "frames": self.report.frames,
            "bytes": self.report.bytes,
            "known_share": self.known_share,
            "expected": self.medians(),
            "warnings": self.report.warnings,
        }


def suggest_plan(request: SuggestionRequest, say: Said = lambda step, count, total: None) -> Suggestion:
    """Suggest a plan. Raises InputError if no view is possible, or a record is missing. Raises PreflightRefused if
    the budget does not allow a single view, or if the cell's records are not valid."""
    first = LookAt(
        kind="look_at", name="first", target_mm=(0, 0, 0), distance_mm=300, azimuth_deg=0, elevation_deg=80
    )
    job = _job_of(request, request.text.with_views([first], (1000,), None))
    if refusals := calibration_refusals(job):
        raise PreflightRefused(refusals)
    cell = SupposedCell(job)
    candidates = candidates_of(job, cell, say)
    if not candidates:
        raise InputError(
            f"{request.text.mesh}: the arm can take no view of it at the camera's focus of "
            f"{cell.rig.lens.focus_distance_mm:g} mm. Is its place on the support right, and its unit?"
        )
    trial = _Trial(request, job, cell, candidates, say)
    return trial.best()


def _job_of(request: SuggestionRequest, text: str) -> Job:
    """Read a plan that is not written yet. Raises InputError; its places name only files that exist."""
    try:
        return read_job(request.path, text=text)
    except InputError as error:
        unwritten = str(request.path.absolute())
        reasons = [
            problem.message if str(Path(problem.file).absolute()) == unwritten else str(problem)
            for problem in error.problems
        ]
        if not reasons:
            raise
        text = "\n".join(f"{request.text.mesh}: {why}" for why in reasons)
        raise InputError(text.replace("`mesh_unit: ", "`--unit ")) from error


class _Trial:
    """Comparison of possible plans for a request."""

    def __init__(
        self, request: SuggestionRequest, job: Job, cell: SupposedCell, candidates: list[Candidate], say: Said
    ) -> None:
        self._request, self._job, self._candidates, self._say = request, job, candidates, say
        self._surface = cell.surface
        self._materials = supposed_materials(request.material)
        leds = job.cell.leds
        self._order = np.array([row for row, _ in farthest_first(leds.positions_mm, 0)])
        self._numbers = [*(number for number in LED_NUMBERS if number < len(self._order)), len(self._order)]
        fitted_share = 1.0 - 1.0 / HELD_OUT_EVERY  # the others are kept for the check
        self._fitted_numbers = [round(fitted_share * number) for number in self._numbers]
        self._priors = [Information.before(self._surface, request.scan_noise_um) for _ in self._materials]
        self._exposures = self._exposures_to_try()
        self._cut_off = set[str]()
        """Names of views that have no path."""

    def best(self) -> Suggestion:
        """Return the best plan that has paths and is within the budget."""
        choices = self._choices()
        most_value = max((choice.value for choice, _ in choices.values()), default=0.0)

        def rank(settings: Settings) -> tuple[float, float]:
            choice, view_s = choices[settings]
            behind = most_value - choice.value
            return (behind if behind > _SAME else 0.0), view_s * len(choice.views)

        for settings in sorted(choices, key=rank)[:_ROUNDS]:
            if suggestion := self._with_paths(settings):
                return suggestion
        budget = self._request.budget
        light = "" if budget.lux_h is None else f" and {budget.lux_h:g} lux h"
        refusal = f"the budget of {budget.seconds / 60:.3g} min{light} allows not one view that the arm reaches"
        raise PreflightRefused([f"{refusal}, even with {self._numbers[0]} LEDs"])

    def _exposures_to_try(self) -> list[tuple[int, ...]]:
        """Return the exposures to try: short, long, and both. If several materials are supposed, the short
        exposure suits the brightest of them, and the long one the darkest."""
        noise, limits = self._surface.noise, self._job.cell.rig.led_limits.on_us
        parts_of_views = [candidate.seen_parts for candidate in self._candidates]
        brightest = [
            signal_quantile(self._surface, parts_of_views, material, 1.0 - _SATURATED_SHARE)
            for material in self._materials.values()
        ]
        longest_us = min(limits[1], 2_000_000)

        def exposure_us(dn_per_s: float) -> int:
            wanted_us = _FULL * noise.most_dn / dn_per_s * 1e6
            digits = 10 ** max(0, math.floor(math.log10(max(wanted_us, 1.0))) - 1)
            return int(np.clip(math.floor(wanted_us / digits) * digits, max(limits[0], 10), longest_us))

        short_us, long_us = exposure_us(max(brightest)), exposure_us(min(brightest) / LONGER)
        return [(short_us,)] if long_us <= short_us else [(short_us,), (long_us,), (short_us, long_us)]

    def _choices(self) -> dict[Settings, tuple[ViewChoice, float]]:
        """Return the choice of views and the time of a view, for all settings for which one view is within the
        budget."""
        choices = {}
        for count, exposures_us in enumerate(self._exposures, start=1):
            information = self._information(
                exposures_us, f"information of the views, exposure {count} of {len(self._exposures)}"
            )
            for leds in range(len(self._numbers)):
                settings = Settings(exposures_us, leds)
                most, view_s = self._most_views(settings)
                if most > 0:
                    choices[settings] = self._choose(information, leds, most), view_s
        return choices

    def _information(self, exposures_us: tuple[int, ...], step: str) -> list[list[ViewInformation]]:
        """[candidates][materials]"""
        pairs = list(product(self._candidates, self._materials.values()))

        def tell(pair: tuple[Candidate, SupposedMaterial]) -> ViewInformation:
            candidate, material = pair
            return information_of(
                self._surface, candidate.seen_parts, material, exposures_us, self._order, self._fitted_numbers
            )

        parts = []
        with ThreadPoolExecutor(len(os.sched_getaffinity(0))) as pool:
            for number, part in enumerate(pool.map(tell, pairs), start=1):
                self._say(step, number, len(pairs))
                parts.append(part)
        count = len(self._materials)
        return [parts[first : first + count] for first in range(0, len(parts), count)]

    def _choose(self, information: list[list[ViewInformation]], leds: int, most: int) -> ViewChoice:
        places = [n for n, candidate in enumerate(self._candidates) if candidate.view.name not in self._cut_off]
        some = [information[place] for place in places]
        choice = choose_views(some, leds, self._priors, self._surface.triangles, most)
        return replace(choice, views=tuple(places[view] for view in choice.views))

    def _most_views(self, settings: Settings) -> tuple[int, float]:
        """Return the number of views that the budget allows, and the time of one view, by preflight without
        paths."""
        budget = self._request.budget
        some = [candidate.view for candidate in self._candidates[:_TRIAL_VIEWS]]
        _, report = self._check_views(some, settings, paths=False)
        view_s, view_lux_h = report.duration_s / len(some), report.dose_lux_h / len(some)
        by_time = int(budget.seconds / view_s)
        by_light = budget.views if budget.lux_h is None else int(budget.lux_h / max(view_lux_h, 1e-9))
        return min(by_time, by_light, budget.views), view_s

    def _check_views(self, views: Sequence[LookAt], settings: Settings, *, paths: bool) -> tuple[Job, Report]:
        return check_job(read_job(self._request.path, text=self._text(views, settings)), _ENDLESS, paths=paths)

    def _text(self, views: Sequence[LookAt], settings: Settings, *remarks: str) -> str:
        number = self._numbers[settings.leds]
        rows = None if number == len(self._order) else self._order[:number]
        ids = None if rows is None else sorted(self._job.cell.leds.ids[rows].tolist())
        return self._request.text.with_views(views, settings.exposures_us, ids, remarks)

    def _with_paths(self, settings: Settings) -> Suggestion | None:
        """Return the suggestion with these settings and with views that have paths; None if no view fits the
        budget. Raises PreflightRefused for a refusal that no other choice can avoid."""
        information = self._information(settings.exposures_us, "information of the views, chosen exposure")
        most = self._most_views(settings)[0]
        for number in range(1, _ROUNDS + 1):
            self._say("paths to the views", number, _ROUNDS)
            choice = self._choose(information, settings.leds, most)
            views = [self._candidates[number].view for number in choice.views]
            if not views:
                return None
            job, report = self._check_views(views, settings, paths=True)
            cut_off = {view.name for view in report.views if view.joints_deg is None}
            if not cut_off and report.refusals:
                raise PreflightRefused(report.refusals)
            if cut_off:
                self._cut_off |= cut_off
            elif (over := self._over_budget(report)) > 1.0:
                most = min(len(views) - 1, int(len(views) / over))
            else:
                return self._suggestion(settings, choice, job, report)
        return None

    def _over_budget(self, report: Report) -> float:
        """Return the plan's time or light over the allowed amount, whichever ratio is larger."""
        budget = self._request.budget
        return max(report.duration_s / budget.seconds, report.dose_lux_h / (budget.lux_h or math.inf))

    def _suggestion(self, settings: Settings, choice: ViewChoice, job: Job, report: Report) -> Suggestion:
        self._say("samples that are drawn, and their fits", 0, len(self._materials))
        parts_of_views = [self._candidates[view].seen_parts for view in choice.views]
        led_rows = self._order[: self._fitted_numbers[settings.leds]]
        corners_mm = job.shape.corners_mm
        mesh = MeshParts(corners_mm, job.motion.occlusions.patches.of_triangles(len(corners_mm)))
        frames = PlannedFrames(parts_of_views, settings.exposures_us, led_rows)
        rehearsals = {}
        for number, (name, material) in enumerate(self._materials.items(), start=1):
            rehearsals[name] = rehearse(self._surface, mesh, frames, material, self._request.scan_noise_um)
            self._say("samples that are drawn, and their fits", number, len(self._materials))
        views = [self._candidates[view].view for view in choice.views]
        suggestion = Suggestion(
            "", report, tuple(views), settings.exposures_us, self._numbers[settings.leds], rehearsals, job,
        )  # fmt: skip
        remarks = ["Suggested by `coupole plan suggest`.", *_promises(suggestion.medians())]
        return replace(suggestion, text=self._text(views, settings, *remarks))


def _promises(medians: dict[str, dict[str, float | None]]) -> list[str]:
    """Return one line for each supposed material."""
    lines = []
    for name, figures in medians.items():
        if (normal_deg := figures["normal_deg"]) is None:
            continue
        shares = (f"{key} {figures[f'{key}_percent']:.2g} %" for key in ("kd", "ks", "alpha"))
        lines.append(
            f"Expected if {name}, median standard uncertainty: normal {normal_deg:.2g} degrees, "
            f"{', '.join(shares)}."
        )
    return lines


def _median(values: NDArray[np.float64]) -> float | None:
    """Median of the known values."""
    is_known = np.isfinite(values)
    return float(np.median(values[is_known])) if is_known.any() else None
