"""Ways among views whose order is not known: free of contact, and never longer than over home."""

from __future__ import annotations

from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest
from cells import CellFolder

from coupole.errors import PreflightRefused
from coupole.motion.ways_from_home import WaysFromHome
from coupole.preflight.job import Job, read_job

GRID = {
    "kind": "grid",
    "name": "v",
    "target_mm": [0, 0, 30],
    "distance_mm": 335,
    "azimuths_deg": [-150, -30, 60],
    "elevations_deg": [40, 80],
}


@pytest.fixture(scope="module")
def job(tmp_path_factory: pytest.TempPathFactory) -> Job:
    cell = CellFolder(tmp_path_factory.mktemp("ways"))
    cell.write(views={"kind": "adaptive", "candidates": [GRID], "until": {"views": 2}})
    return read_job(cell.plan)


def _is_clear(job: Job, start_deg: np.ndarray, waypoints: tuple[np.ndarray, ...]) -> bool:
    return all(job.motion.bodies.is_clear(a, b) for a, b in pairwise([start_deg, *waypoints]))


def test_ways_between_all_views_are_clear_and_bounded_by_the_way_over_home(job: Job) -> None:
    ways, views = job.motion.ways, job.schedule.views
    itinerary = ways.itinerary(views)
    assert itinerary.refusals == ()
    assert itinerary.order == tuple(range(6))
    assert itinerary.is_from_home
    for view, visit in zip(views, itinerary.visits, strict=True):
        assert visit is not None
        assert _is_clear(job, np.array(job.cell.rig.motion.home_joints_deg, float), visit.leg.waypoints)
        for other in views:
            leg = ways.leg(visit.joints_deg, other)
            if other.name == view.name:
                continue
            there = ways.visit(other)
            assert np.array_equal(leg.waypoints[-1], there.joints_deg)
            assert leg.duration_s <= visit.leg.duration_s + there.leg.duration_s + 1e-9
            assert _is_clear(job, visit.joints_deg, leg.waypoints)


def test_least_times_bound_the_legs(job: Job) -> None:
    ways, views = job.motion.ways, job.schedule.views
    start_deg = ways.visit(views[0]).joints_deg
    least_s = ways.least_s(start_deg, views[1:])
    legs_s = [ways.leg(start_deg, view).duration_s for view in views[1:]]
    assert np.all(least_s <= np.array(legs_s) + 1e-9)
    assert least_s.min() > 0.1


def test_the_posture_of_a_view_depends_on_no_other_view(job: Job) -> None:
    views = job.schedule.views
    alone = WaysFromHome(job.cell.rig, job.motion.bodies).itinerary(views[3:4]).visits[0]
    among = job.motion.planned_itinerary(views).visits[3]
    assert alone is not None
    assert among is not None
    assert np.array_equal(alone.joints_deg, among.joints_deg)
    assert alone.leg.duration_s == among.leg.duration_s


def test_a_view_that_cannot_be_reached_is_refused_with_its_name(tmp_path: Path) -> None:
    cell = CellFolder(tmp_path)
    far = {**GRID, "name": "far", "distance_mm": 3000, "azimuths_deg": [0], "elevations_deg": [45]}
    cell.write(views={"kind": "adaptive", "candidates": [GRID, far], "until": {"views": 2}})
    job = read_job(cell.plan)
    itinerary = job.motion.planned_itinerary(job.schedule.views)
    assert [refusal.split(":")[0] for refusal in itinerary.refusals] == ["view far-az0-el45"]
    assert itinerary.visits[6] is None
    with pytest.raises(PreflightRefused, match="view far-az0-el45"):
        job.motion.ways.visit(job.schedule.views[6])
