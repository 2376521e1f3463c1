"""The choice of views: near the best of all sets, never much worse than spread views by the errors of fits."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import combinations
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from cells import CellFolder
from in_part import in_part

from coupole.geometry import farthest_first
from coupole.plan.view_choices import ChosenView
from coupole.preflight.job import Job, read_job
from coupole.reflectance.next_views.next_views import NextViews
from coupole.reflectance.next_views.supposed_surface import supposed_surface
from coupole.reflectance.next_views.view_trials import Trials, trials_of
from coupole.reflectance.suggestion.drawn_triangles import MeshParts
from coupole.reflectance.suggestion.rehearsal import PlannedFrames, drawn_samples
from coupole.reflectance.suggestion.supposed_materials import SUPPOSED
from coupole.reflectance.suggestion.supposed_signal import seen_by
from coupole.reflectance.triangle_fit import fit_triangles

GRID = {
    "kind": "grid",
    "name": "v",
    "target_mm": [0, 0, 30],
    "distance_mm": 335,
    "azimuths_deg": [-150, -90, -30, 60],
    "elevations_deg": [40, 60, 80],
}
"""12 views."""


def _job(folder: Path, **until: Any) -> Job:
    cell = CellFolder(folder)
    views = {"kind": "adaptive", "candidates": [GRID], "until": {"views": 3} | until}
    cell.write(views=views, lights={"kind": "every", "every": 20})
    return read_job(cell.plan)


def _choose(job: Job, **until: Any) -> list[ChosenView]:
    next_views = NextViews(job, job.plan.views.until.model_copy(update=until))
    choices: list[ChosenView] = []
    while not choices or choices[-1].view:
        choices.append(next_views.choose(choices, job.schedule))
    return choices


@pytest.fixture(scope="module")
def job(tmp_path_factory: pytest.TempPathFactory) -> Job:
    return _job(tmp_path_factory.mktemp("views"))


@pytest.fixture(scope="module")
def trials(job: Job) -> Trials:
    return trials_of(job)


def _value(trials: Trials, names: Sequence[str]) -> float:
    return trials.value(trials.knowledge_after(names))


def test_views_one_by_one_are_nearly_the_best_of_all_sets(job: Job, trials: Trials) -> None:
    names = [choice.view for choice in _choose(job) if choice.view]
    assert len(names) == 3
    best = max(_value(trials, list(some)) for some in combinations(trials.of_view, 3))
    worst = min(_value(trials, list(some)) for some in combinations(trials.of_view, 3))
    assert worst < 0.8 * best
    assert _value(trials, names) > 0.95 * best


def test_the_first_views_show_more_than_most_random_ones(job: Job, trials: Trials) -> None:
    names = [choice.view for choice in _choose(job) if choice.view]
    coverages = [trials.coverage(some) for some in combinations(trials.of_view, 3)]
    assert trials.coverage(names) > np.median(coverages)


@pytest.mark.parametrize("material", in_part(list(SUPPOSED), "glossy"))
def test_fits_to_chosen_views_are_at_most_a_little_worse_than_to_spread_ones(job: Job, material: str) -> None:
    surface, rows = supposed_surface(job), np.arange(0, len(job.cell.leds.ids), 20)
    seen = {
        view.name: seen_by(
            job.motion.occlusions, surface, job.motion.ways.visit(view).joints_deg, view.support_from_camera
        )
        for view in job.schedule.views
    }
    corners_mm, truth = job.shape.corners_mm, SUPPOSED[material]
    mesh = MeshParts(corners_mm, job.motion.occlusions.patches.of_triangles(len(corners_mm)))
    triangles = mesh.drawn(400, np.random.default_rng(2))
    pixels = {name: triangles.pixels(surface, of_view) for name, of_view in seen.items()}
    is_seen = np.any([of_view > 0.0 for of_view in pixels.values()], axis=0)
    weights = np.where(is_seen, triangles.areas_mm2, 0.0)

    def error(names: Sequence[str]) -> float:
        random = np.random.default_rng(1)
        drawn = np.stack([surface.noise.drawn_pixels(pixels[name], random) for name in names])
        views = [seen[name] for name in names]
        samples = drawn_samples(surface, triangles, drawn, PlannedFrames(views, (8000,), rows), truth, random)
        fitted = fit_triangles(samples, np.ones(len(samples.led_mm), np.bool_), 30.0)
        wrong = [fitted.kd[:, 0] / truth.kd, fitted.ks[:, 0] / truth.ks, fitted.alpha / truth.alpha]
        errors = np.abs(np.array(wrong) - 1.0)
        of_parts = np.minimum(np.where(np.isfinite(errors), errors, 1.0), 1.0).mean(axis=0)
        return float(of_parts @ weights / weights.sum())

    cameras_mm = np.array([view.support_from_camera[:3, 3] for view in job.schedule.views])
    order = [number for number, _ in farthest_first(cameras_mm, int(np.argmax(cameras_mm[:, 2])))]
    for count in (2, 3, 4):
        chosen = [choice.view for choice in _choose(job, views=count) if choice.view]
        spread = [job.schedule.views[number].name for number in order[:count]]
        assert error(chosen) <= 1.05 * error(spread)


def test_the_same_plan_gives_the_same_choices(tmp_path: Path, job: Job) -> None:
    assert _choose(_job(tmp_path)) == _choose(job)


def test_a_choice_does_not_depend_on_how_many_were_asked_at_a_time(job: Job) -> None:
    choices = _choose(job, views=4)
    for place in range(len(choices)):
        next_views = NextViews(job, job.plan.views.until.model_copy(update={"views": 4}))
        assert next_views.choose(choices[:place], job.schedule) == choices[place]


def test_the_same_view_again_gains_less(trials: Trials) -> None:
    name = next(iter(trials.of_view))
    first = trials.gain(trials.knowledge_after(()), name)
    again = trials.gain(trials.knowledge_after([name]), name)
    assert 0.0 < again < 0.5 * first


def test_a_way_that_costs_time_counts_if_time_is_limited(job: Job) -> None:
    """With little time, what is gained in a second counts, so the arm moves less."""
    free, limited = _choose(job, views=4), _choose(job, views=4, seconds=60.0)
    moves_s = [sum(c.figures["chosen"]["move_s"] for c in choices if c.view) for choices in (free, limited)]
    assert moves_s[1] <= moves_s[0]
    assert limited[0].figures["chosen"]["score"] < free[0].figures["chosen"]["score"]


@pytest.mark.parametrize(
    ("until", "key"), [({"gain": 0.2}, "gain"), ({"coverage": 0.8}, "coverage"), ({"frames": 100}, "frames")]
)
def test_limits_end_the_choice_with_their_names(job: Job, until: dict[str, float], key: str) -> None:
    *choices, last = _choose(job, views=12, **until)
    assert last.reason.startswith(f"enough by `{key}`")
    assert 0 < len(choices) < 12
    if key == "gain":
        assert all(choice.figures["chosen"]["gain"] > 0.98 * 0.2 for choice in choices)


def test_all_candidates_are_taken_if_nothing_ends_the_choice(job: Job) -> None:
    *choices, last = _choose(job, views=400)
    assert {choice.view for choice in choices} == {view.name for view in job.schedule.views}
    assert last.reason == "all candidates are taken"
