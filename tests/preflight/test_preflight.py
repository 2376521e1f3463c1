"""Preflight: what is known before the robot moves, and what is refused because of it."""

from __future__ import annotations

import re
from itertools import pairwise

import numpy as np
import pytest
from preflight_cases import (
    DOME,
    NO_OBJECT,
    PARK,
    RIG,
    TOP,
    checked,
    only_refusal,
    plan_of,
    rig_of,
    schedule_of,
)

from coupole.motion.itinerary import bodies_of, plan_itinerary
from coupole.plan.marks import MARKS
from coupole.plan.plan import Plan
from coupole.plan.rig_devices import upload_s
from coupole.preflight.preflight import BURST_OVERHEAD_S, SETTLE_CHECK_S


def test_a_view_out_of_reach_is_named() -> None:
    far = {**TOP, "name": "far", "target_mm": [3000, 0, 0], "elevation_deg": 45}
    report = checked(plan_of(views=[{**TOP, "elevation_deg": 80}, far]))
    assert only_refusal(report).startswith("view far: ")
    assert [view.joints_deg is None for view in report.views] == [False, True]


def test_a_joint_over_its_limit_is_named_with_the_limit() -> None:
    bent = {**PARK, "name": "bent", "joints_deg": [0, -170, 150, 0, -130, 0]}
    refusal = only_refusal(checked(plan_of(views=[PARK, bent])))
    assert refusal.startswith("view bent: ")
    assert "A5" in refusal
    assert "-120" in refusal


def test_a_camera_inside_a_keep_out_is_refused_naming_view_part_and_volume() -> None:
    ball = {"kind": "sphere", "name": "lamp", "center_mm": (0, 0, 365), "radius_mm": 60}
    view = {**TOP, "name": "over", "target_mm": [0, 0, 30], "elevation_deg": 85}
    report = checked(plan_of(views=[view]), rig_of(keep_out=[ball]))
    assert only_refusal(report).startswith("view over: camera would be inside keep-out `lamp`")


def test_a_camera_that_grazes_the_support_is_refused_with_the_distance() -> None:
    low = {**TOP, "name": "low", "target_mm": [200, 0, 32], "distance_mm": 200, "elevation_deg": 9}
    refusal = only_refusal(checked(plan_of(views=[{**low, "azimuth_deg": 180}]), rig_of(keep_out=[])))
    assert re.fullmatch(r"view low: camera would be \d mm from the support; 10 mm must be kept", refusal)


def test_a_camera_too_near_to_the_object_is_refused_with_the_distance() -> None:
    near = {**TOP, "name": "near", "distance_mm": 80, "elevation_deg": 80}
    plan, rig = plan_of(views=[near]), rig_of()
    schedule = schedule_of(plan, rig, DOME)
    flat = np.array([[[-50.0, -50, 30], [50, -50, 30], [0, 80, 30]]])
    itinerary = plan_itinerary(schedule.views, rig, bodies_of(rig, DOME, flat), rig.motion.home_joints_deg)
    assert len(itinerary.refusals) == 1
    assert itinerary.refusals[0].startswith("view near: camera would be ")
    assert itinerary.refusals[0].endswith("mm from the object; 50 mm must be kept")


def test_a_motion_that_would_touch_the_support_takes_another_way() -> None:
    view = {**TOP, "elevation_deg": 45, "azimuth_deg": 0}
    plan, rig = plan_of(views=[view]), rig_of()
    schedule = schedule_of(plan, rig, DOME)
    bodies = bodies_of(rig, DOME, NO_OBJECT)
    start = np.array([-65.0, -150.0, 140.0, 0.0, -60.0, 0.0])
    (visit,) = plan_itinerary(schedule.views, rig, bodies, start.tolist()).visits
    assert visit is not None
    places = [start, *visit.leg.waypoints]
    assert all(bodies.contact_on_the_way(a, b) is None for a, b in pairwise(places))


def three_views(order: str) -> Plan:
    """From near to home, far away and back again."""
    places = {"near": -60, "far": 60, "between": 0}
    views = [{**TOP, "name": n, "azimuth_deg": azimuth, "elevation_deg": 45} for n, azimuth in places.items()]
    return plan_of(views=views, order=order)


def test_views_are_reported_in_the_order_in_which_they_are_visited() -> None:
    as_written, fastest = (checked(three_views(order)) for order in ("as_written", "fastest"))
    assert [view.name for view in as_written.views] == ["near", "far", "between"]
    assert [view.name for view in fastest.views][1] == "between"
    assert sum(view.move_s for view in fastest.views) < sum(view.move_s for view in as_written.views)


def test_views_that_are_refused_are_reported_last() -> None:
    far = {**TOP, "name": "far", "target_mm": [3000, 0, 0], "elevation_deg": 45}
    report = checked(plan_of(views=[far, {**TOP, "elevation_deg": 80}]))
    assert [view.name for view in report.views] == ["top", "far"]


def test_a_name_that_stands_twice_is_refused_once() -> None:
    views = [{**TOP, "elevation_deg": elevation} for elevation in (80, 75, 70)]
    refusal = only_refusal(checked(plan_of(views=views)))
    assert refusal == "view top: expected a name of its own, found it more than once in the plan"


def test_a_lens_that_is_set_otherwise_than_the_plan_believes_is_refused() -> None:
    refusal = only_refusal(checked(plan_of(optics={"f_number": 11})))
    assert refusal == "optics: the plan is for f-number 11, the rig's lens is set to 8"


def test_the_duration_is_the_sum_of_moves_upload_bursts_and_overheads() -> None:
    views = [{**TOP, "name": f"v{k}", "elevation_deg": 80 - 10 * k} for k in range(3)]
    bracket = {"kind": "bracket", "exposures_us": [2000, 8000]}
    plan = plan_of(views=views, exposure=bracket)
    report = checked(plan)
    schedule = schedule_of(plan, rig_of(), DOME)
    table_s = sum(int(b.table["period_us"].sum(dtype=np.int64)) for v in schedule.bursts for b in v) / 1e6
    moves_s = sum(view.move_s for view in report.views)
    upload = max(0.0, upload_s(RIG, len(schedule.bursts[0][0].table)) - report.views[0].move_s)
    others_s = 6 * BURST_OVERHEAD_S + 3 * SETTLE_CHECK_S
    assert sum(view.burst_s for view in report.views) == pytest.approx(table_s)
    assert report.ideal_s == pytest.approx(moves_s + table_s)
    assert report.duration_s == pytest.approx(moves_s + table_s + upload + others_s)


def test_a_view_where_the_arm_stands_already_costs_only_its_settling() -> None:
    again = {**PARK, "name": "again"}
    views = checked(plan_of(views=[PARK, again]), start_joints_deg=PARK["joints_deg"]).views
    assert views[0].move_s == views[1].move_s < 1.0


def test_the_bytes_are_those_of_all_frames() -> None:
    report = checked(plan_of())
    assert report.bytes == (1080 + 2 + MARKS) * 512 * 384 * 2


def test_thirty_views_under_all_leds_at_three_exposures_check_out() -> None:
    grid = {
        "kind": "grid",
        "name": "g",
        "target_mm": [0, 0, 30],
        "distance_mm": 335,
        "azimuths_deg": [-120, -110, -100, -90, -80, -70],
        "elevations_deg": [45, 55, 65, 75, 85],
    }
    bracket = {"kind": "bracket", "exposures_us": [2000, 8000, 32000]}
    report = checked(plan_of(views=[grid], exposure=bracket))
    assert report.refusals == []
    assert len(report.views) == 30
    assert report.shots == 30 * 1080 * 3
