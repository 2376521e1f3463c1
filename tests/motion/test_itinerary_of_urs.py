"""Plans on a UR10e: what is planned is clear; what grazes is refused with both bodies and the figure."""

from __future__ import annotations

import re
from functools import cache
from itertools import pairwise

import numpy as np
import pytest
from places import REPO

from coupole.geometry import look_at
from coupole.motion.itinerary import arm_of, plan_itinerary
from coupole.motion.path_deviation import deviation_at_rest_mm
from coupole.plan.schedule import ViewPose
from coupole.preflight.job import Job, read_job


@cache
def job() -> Job:
    return read_job(REPO / "configs/plans/demo.yaml", REPO / "configs/rigs/sim-ur.yaml")


def refusal(view: ViewPose) -> str:
    rig = job().cell.rig
    (only,) = plan_itinerary([view], rig, job().motion.bodies, rig.motion.home_joints_deg).refusals
    return only


def standing(*joints_deg: float) -> ViewPose:
    return ViewPose("odd", None, joints_deg, None)


def test_the_demo_is_planned_and_every_motion_is_clear_at_every_place() -> None:
    rig, bodies = job().cell.rig, job().motion.bodies
    found = job().motion.itinerary(job().schedule.views, rig.motion.home_joints_deg)
    assert found.refusals == ()
    here = np.array(rig.motion.home_joints_deg)
    for index in found.order:
        visit = found.visits[index]
        assert visit is not None
        for start, goal in pairwise([here, *visit.leg.waypoints]):
            places = start + np.linspace(0, 1, 300)[:, None] * (goal - start)
            assert bodies.tightest_mm(places).min() >= 0.0
        here = visit.joints_deg


def test_a_view_that_grazes_the_object_is_refused() -> None:
    said = refusal(ViewPose("odd", look_at((0, 0, 30), 110, -90, 60), None, (0, 0, 30)))
    assert re.fullmatch(r"view odd: camera would be \d+ mm from the object; 50 mm must be kept", said)


KEPT = r"would be (inside|\d+ mm from)"


@pytest.mark.parametrize(
    ("joints_deg", "says"),
    [
        ((0, -100, 20, -20, -90, 0), rf"view odd: [\w ]+ {KEPT} (the support|the object|keep-out `support`); .*"),
        ((0, -10, 10, 10, 80, 0), rf"view odd: [\w ]+ {KEPT} the dome; 20 mm must be kept"),
        ((0, -150, 60, 150, 30, 0), rf"view odd: [\w ]+ {KEPT} the arm's [\w ]+; [\d.]+ mm must be kept"),
        ((0, -170, 160, -90, 130, 110), "view odd: A3 would be 160.000 deg, its limits are -155 to 155 deg"),
        ((0, -170, 150, -90, 2, 110), r"view odd: the wrist would be stretched, with A5 2.0 deg .*"),
    ],
    ids=["support", "dome", "itself", "limit", "singularity"],
)
def test_a_posture_in_something_is_refused_and_says_in_what(joints_deg: tuple[float, ...], says: str) -> None:
    assert re.fullmatch(says, refusal(standing(*joints_deg)))


def test_a_pose_beyond_its_reach_is_refused() -> None:
    said = refusal(ViewPose("odd", look_at((0, 0, 1000), 1500, 180, 30), None, (0, 0, 1000)))
    assert re.fullmatch(r"view odd: out of reach: the flange would be \d+ mm from the shoulder", said)


def test_the_watch_over_the_way_counts_the_urs_own_reach() -> None:
    here = np.array(job().cell.rig.motion.home_joints_deg)
    off_mm = deviation_at_rest_mm([here], here + np.eye(6)[0], np.zeros(6), job().motion.bodies.reach_mm, 0.0)
    assert off_mm > np.radians(1.0) * 1300.0  # the arm's reach, by its data sheet


def test_durations_are_those_of_trapezoids_of_the_leading_joints_speed() -> None:
    arm = arm_of(job().cell.rig)
    from coupole.kinematics import move_duration_s

    # 90 deg at 36 deg/s and 80 deg/s2: d / v + v / a
    assert move_duration_s(arm, np.zeros(6), (5, 0, 0, 90, 0, 0)) == pytest.approx(90 / 36 + 36 / 80)
    assert move_duration_s(arm, np.zeros(6), (0, 0, 0, 0, 5, 0)) == pytest.approx(2 * np.sqrt(5 / 80))
