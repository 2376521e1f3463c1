"""Preflight: what is known before the robot moves, and what is refused because of it."""

from __future__ import annotations

import errno
import os
import re
from collections.abc import Sequence
from dataclasses import replace
from itertools import pairwise
from pathlib import Path
from typing import Any
from unittest import mock

import numpy as np
import pytest
from places import REPO

from coupole.devices import NO_LED
from coupole.motion.itinerary import bodies_of, plan_itinerary
from coupole.plan.led_table import LedTable, read_led_table
from coupole.plan.marks import MARKS
from coupole.plan.plan import Plan
from coupole.plan.rig import Rig
from coupole.plan.rig_devices import upload_s
from coupole.plan.schedule import Schedule, build_schedule
from coupole.plan.yamlfile import read
from coupole.preflight.checking import storage_of
from coupole.preflight.preflight import BURST_OVERHEAD_S, SETTLE_CHECK_S, Report, StorageFacts, check
from coupole.storage.ledger import Ledger
from coupole.storage.write_speed import measure_write_speed

ROOT = REPO
RIG, _ = read(ROOT / "configs/rigs/sim.yaml").problems(Rig)
DOME = read_led_table(ROOT / "configs/domes/coupole.csv")
ROOMY = StorageFacts(free_bytes=10**15, write_bytes_s=10e9)
CENTRE = np.zeros((1, 3))
NO_OBJECT = np.zeros((0, 3, 3))
TOP = {"kind": "look_at", "name": "top", "target_mm": [0, 0, 30], "distance_mm": 335, "azimuth_deg": -90}
PARK = {"kind": "joints", "name": "park", "joints_deg": [0, -170, 150, 0, -70, 0]}


def plan_of(**changes: Any) -> Plan:
    asked = {
        "schema_version": 1,
        "name": "test",
        "rig": "rig.yaml",
        "views": [{**TOP, "elevation_deg": 80}],
        "lights": {"kind": "all"},
        "exposure": {"kind": "fixed", "exposure_us": 8000},
    }
    return Plan.model_validate(asked | changes)


def rig_of(**changes: Any) -> Rig:
    """The simulated cell with some of its sections changed."""
    assert RIG is not None
    return Rig.model_validate({**RIG.model_dump(), **changes})


def schedule_of(plan: Plan, rig: Rig, leds: LedTable) -> Schedule:
    return build_schedule(
        plan,
        leds,
        rig.support.base_from_support.matrix(),
        rise_us=rig.led_limits.rise_us,
        readout_us=1e6 / rig.sensor.max_frames_per_s,
        exposure_gap_us=rig.sensor.exposure_gap_us,
    )


def checked(
    plan: Plan,
    rig: Rig | None = None,
    leds: LedTable = DOME,
    storage: StorageFacts = ROOMY,
    points: np.ndarray[Any, Any] = CENTRE,
    start_joints_deg: Sequence[float] | None = None,
    **known: Any,
) -> Report:
    rig = rig or rig_of()
    schedule = schedule_of(plan, rig, leds)
    bodies = bodies_of(rig, DOME, NO_OBJECT)
    start_deg = start_joints_deg or rig.motion.home_joints_deg
    itinerary = plan_itinerary(schedule.views, rig, bodies, start_deg, plan.order)
    return check(plan, rig, schedule, leds, storage, itinerary, object_points_support_mm=points, **known)


def only_refusal(report: Report) -> str:
    assert len(report.refusals) == 1, report.refusals
    return report.refusals[0]


# ------------------------------------------------------------------------------------------ light dose


def sphere(distance_mm: float = 1000.0, flux_lm: float = 1800.0, count: int = 1080) -> LedTable:
    """LEDs on a half sphere about the support's centre, all facing it."""
    assert RIG is not None
    rng = np.random.default_rng(1)
    outward = rng.normal(size=(count, 3))
    outward[:, 2] = np.abs(outward[:, 2])
    outward /= np.linalg.norm(outward, axis=1, keepdims=True)
    base_from_support = RIG.support.base_from_support.matrix()
    positions = outward @ base_from_support[:3, :3].T * distance_mm + base_from_support[:3, 3]
    index = np.arange(count)
    return LedTable(index, index // 6, positions, -outward @ base_from_support[:3, :3].T, np.full(count, flux_lm))


TEN_MS_ON = {"kind": "fixed", "exposure_us": 10_000 - 1_000 - 200}
"""An exposure whose LEDs are on for 10 ms: rise and margin stand around it."""


def test_a_sweep_at_one_metre_with_ten_ms_for_each_led_gives_1_7_lux_hours() -> None:
    report = checked(plan_of(exposure=TEN_MS_ON), leds=sphere())
    assert report.dose_lux_h == pytest.approx(1.7, rel=0.02)


def test_the_dose_falls_with_the_square_of_the_distance() -> None:
    near, far = (checked(plan_of(), leds=sphere(distance)).dose_lux_h for distance in (1000.0, 2000.0))
    assert near == pytest.approx(4 * far)


def test_the_dose_of_a_plan_is_the_sum_over_its_views_exposures_and_repeats() -> None:
    one = checked(plan_of()).dose_lux_h
    views = [{**TOP, "name": f"v{k}", "elevation_deg": 80 - k} for k in range(3)]
    assert checked(plan_of(views=views, repeats=2)).dose_lux_h == pytest.approx(6 * one)


def test_the_point_of_the_object_that_gets_most_light_counts() -> None:
    points = np.array([[0.0, 0.0, 0.0], [0.0, 0.0, 300.0], [500.0, 0.0, 100.0]])
    alone = [checked(plan_of(), points=point[None]).dose_lux_h for point in points]
    assert checked(plan_of(), points=points).dose_lux_h == pytest.approx(max(alone))


def test_panels_count_in_the_dose() -> None:
    report = checked(plan_of(lights={"kind": "panels", "panels": [1]}))
    seconds = report.views[0].burst_s + BURST_OVERHEAD_S
    assert report.dose_lux_h == pytest.approx(180 * seconds / 3600)


def test_dark_frames_give_no_dose() -> None:
    assert checked(plan_of(lights={"kind": "none"})).dose_lux_h == 0.0


def with_budget(budget_lux_h: float) -> Plan:
    return plan_of(object={"id": "shroud", "dose_budget_lux_h": budget_lux_h}, exposure=TEN_MS_ON)


def test_a_plan_within_the_objects_budget_is_not_refused() -> None:
    assert checked(with_budget(1.75), leds=sphere()).refusals == []


def test_a_plan_over_the_objects_budget_is_refused_with_dose_and_budget() -> None:
    refusal = only_refusal(checked(with_budget(1.65), leds=sphere()))
    assert "object shroud" in refusal
    assert "1.72 lux.h" in refusal
    assert "its budget is 1.65 lux.h" in refusal


def test_what_the_ledger_says_counts_against_the_budget(tmp_path: Path) -> None:
    ledger = Ledger(tmp_path, "shroud")
    ledger.enter(1.25, "earlier")
    ledger.enter(1.25, "later")
    before = ledger.read().total_lux_h
    refusal = only_refusal(checked(with_budget(4.0), leds=sphere(), dose_before_lux_h=before))
    assert "after 2.50 lux.h before; its budget is 4 lux.h" in refusal


# ------------------------------------------------------------------------------------- LEDs and boards


def limits(**changes: Any) -> dict[str, Any]:
    assert RIG is not None
    return {**RIG.led_limits.model_dump(), **changes}


def board(**changes: float) -> dict[str, Any]:
    return limits(board={**limits()["board"], **changes})


def test_an_on_time_over_the_limit_is_refused_naming_shot_led_and_limit() -> None:
    rig = rig_of(led_limits=limits(on_us=(1000, 9000)))
    refusal = only_refusal(checked(plan_of(lights={"kind": "ids", "ids": [417]}), rig))
    assert refusal == "shot top/led0417/e0: LED 417 would be on for 9200 us; the limits are 1000 to 9000 us"


def test_an_on_time_under_the_limit_is_refused() -> None:
    rig = rig_of(led_limits=limits(on_us=(20_000, 30_000)))
    assert "would be on for 9200 us" in only_refusal(checked(plan_of(), rig))


def test_each_exposure_of_a_bracket_that_is_too_long_is_refused() -> None:
    rig = rig_of(led_limits=limits(on_us=(1000, 9000)))
    bracket = {"kind": "bracket", "exposures_us": [2000, 8000, 16000]}
    refusals = checked(plan_of(exposure=bracket), rig).refusals
    assert [refusal.split(":")[0].rpartition("/")[2] for refusal in refusals] == ["e1", "e2"]


def test_on_times_are_checked_in_every_view_not_in_the_first_alone() -> None:
    rig = rig_of(led_limits=limits(on_us=(1000, 9000)))
    views = [{**PARK, "lights": {"kind": "none"}}, {**PARK, "name": "lit"}, {**PARK, "name": "too"}]
    refusal = only_refusal(checked(plan_of(views=views, lights={"kind": "ids", "ids": [417]}), rig))
    assert refusal.startswith("shot lit/led0417/e0 (and in 1 more views): LED 417 would be on for 9200 us")


def test_boards_are_heated_by_the_lights_of_each_view_not_by_those_of_the_first() -> None:
    rig = rig_of(led_limits=board(rise_c_per_j=2.0, limit_c=60.0, ambient_c=25.0))
    hot = {"kind": "boards", "boards": [3]}
    views = [{**PARK, "lights": {"kind": "none"}}, {**PARK, "name": "lit", "lights": hot}]
    plan = plan_of(views=views, order="as_written", exposure={"kind": "fixed", "exposure_us": 1_000_000})
    report = checked(plan, rig)
    assert only_refusal(report).startswith("LED boards: the hottest would reach ")
    alone = checked(plan.model_copy(update={"views": plan.views[1:]}), rig)
    assert report.peak_board_c == pytest.approx(alone.peak_board_c)


def test_a_board_of_any_number_takes_no_memory_of_its_own() -> None:
    leds = replace(sphere(count=12), boards=np.repeat([0, 2**31], 6))
    assert checked(plan_of(), leds=leds).peak_board_c > 25.0


def integrated_peak_c(
    schedule: Schedule, report: Report, rig: Rig, leds: LedTable, *, step_s: float = 2e-4
) -> float:
    """Peak over all boards of dT/dt = power * rise - T / tau, in explicit small steps of time."""
    model = rig.led_limits.board
    board_of = dict(zip(leds.ids.tolist(), leds.boards.tolist(), strict=True))
    rise, peak = np.zeros(int(leds.boards.max()) + 1), 0.0

    def run(seconds: float, lit_board: int | None) -> None:
        nonlocal peak
        steps = max(1, round(seconds / step_s))
        dt = seconds / steps
        for _ in range(steps):
            rise[:] -= rise * dt / model.time_constant_s
            if lit_board is not None:
                rise[lit_board] += model.led_power_w * model.rise_c_per_j * dt
        peak = max(peak, float(rise.max()))

    for bursts, view in zip(schedule.bursts, report.views, strict=True):
        run(view.move_s, None)
        for burst in bursts:
            for led, on_us, _, period_us, _ in burst.table.tolist():
                run(on_us / 1e6, None if led == NO_LED else board_of[led])
                run((period_us - on_us) / 1e6, None)
    return model.ambient_c + peak


@pytest.mark.parametrize("seed", range(4))
def test_the_hottest_boards_temperature_agrees_with_an_integration_in_small_steps(seed: int) -> None:
    rng = np.random.default_rng(seed)
    count = 14
    leds = replace(sphere(count=count), boards=rng.integers(0, 3, count))
    rig = rig_of(led_limits=board(time_constant_s=float(rng.uniform(0.5, 3.0)), rise_c_per_j=1.0, limit_c=1000.0))
    bracket = {"kind": "bracket", "exposures_us": sorted(rng.integers(2_000, 90_000, 3).tolist())}
    views = [PARK, {**PARK, "name": "near", "joints_deg": [2, -170, 150, 0, -70, 0]}]
    plan = plan_of(views=views, exposure=bracket, lights={"kind": "every", "every": 1 + seed % 2})
    report = checked(plan, rig, leds)
    expected_c = integrated_peak_c(schedule_of(plan, rig, leds), report, rig, leds)
    rise, expected = (peak_c - rig.led_limits.board.ambient_c for peak_c in (report.peak_board_c, expected_c))
    assert expected > 1.0
    assert (
        0.999 * expected < rise < 1.06 * expected
    )  # a lit LED's heat comes at once: a little too hot, never too cool


def test_a_board_over_its_temperature_is_refused_with_both_figures() -> None:
    exposure = {"kind": "fixed", "exposure_us": 1_000_000}
    rig = rig_of(led_limits=board(rise_c_per_j=2.0, limit_c=60.0, ambient_c=25.0))
    refusal = only_refusal(checked(plan_of(lights={"kind": "boards", "boards": [3]}, exposure=exposure), rig))
    assert refusal.startswith("LED boards: the hottest would reach ")
    assert refusal.endswith("C; the limit is 60 C")


def test_dark_frames_heat_no_board() -> None:
    assert RIG is not None
    report = checked(plan_of(lights={"kind": "none"}))
    assert report.peak_board_c == RIG.led_limits.board.ambient_c


def test_an_led_that_rests_too_shortly_is_refused_naming_shot_and_rest() -> None:
    rig = rig_of(led_limits=limits(cooldown_ratio=200.0))
    plan = plan_of(lights={"kind": "ids", "ids": [5]}, repeats=2, darks_per_view=0)
    refusal = only_refusal(checked(plan, rig))
    assert refusal.startswith("shot top/led0005/e0/r1: LED 5 rests ")
    assert "before it is lit for 0.009 s; it needs 1.840 s" in refusal


def test_an_led_that_rests_long_enough_is_not_refused() -> None:
    plan = plan_of(lights={"kind": "ids", "ids": [5]}, repeats=2, darks_per_view=0)
    assert checked(plan).refusals == []


# ---------------------------------------------------------------------------------------- arm and cell


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


def test_an_led_rests_in_the_order_of_the_visits() -> None:
    same = [{**PARK, "name": name} for name in ("first", "second")]
    away = {**TOP, "name": "away", "azimuth_deg": 60, "elevation_deg": 45}
    rig = rig_of(led_limits=limits(cooldown_ratio=100.0))
    few = {"lights": {"kind": "ids", "ids": [5]}, "darks_per_view": 0, "views": [same[0], away, same[1]]}
    assert checked(plan_of(order="as_written", **few), rig).refusals == []
    assert "led0005/e0: LED 5 rests " in only_refusal(checked(plan_of(order="fastest", **few), rig))


def test_a_name_that_stands_twice_is_refused_once() -> None:
    views = [{**TOP, "elevation_deg": elevation} for elevation in (80, 75, 70)]
    refusal = only_refusal(checked(plan_of(views=views)))
    assert refusal == "view top: expected a name of its own, found it more than once in the plan"


def test_a_lens_that_is_set_otherwise_than_the_plan_believes_is_refused() -> None:
    refusal = only_refusal(checked(plan_of(optics={"f_number": 11})))
    assert refusal == "optics: the plan is for f-number 11, the rig's lens is set to 8"


# --------------------------------------------------------------------------------------------- storage


def test_a_run_that_does_not_fit_on_the_disk_is_refused() -> None:
    assert RIG is not None
    need = (1080 + 2 + MARKS) * RIG.frame_bytes + RIG.storage.reserve_bytes
    assert checked(plan_of(), storage=StorageFacts(free_bytes=need)).refusals == []
    refusal = only_refusal(checked(plan_of(), storage=StorageFacts(free_bytes=need - 1)))
    assert "must stay free" in refusal


def test_the_folder_of_the_run_is_named_not_that_of_the_rig() -> None:
    refusal = only_refusal(checked(plan_of(), storage=StorageFacts(0, folder=Path("/elsewhere/runs"))))
    assert refusal.startswith("storage /elsewhere/runs: the run needs ")


def test_what_a_resumed_run_has_allocated_is_not_asked_for_again() -> None:
    assert RIG is not None
    need = (1080 + 2 + MARKS) * RIG.frame_bytes + RIG.storage.reserve_bytes
    facts = StorageFacts(need - 10**6, allocated_bytes=10**6)
    assert checked(plan_of(), storage=facts).refusals == []
    assert len(checked(plan_of(), storage=replace(facts, allocated_bytes=10**6 - 1)).refusals) == 1


def test_a_disk_that_cannot_be_written_is_refused_and_not_taken_for_one_without_limit(tmp_path: Path) -> None:
    occupied = tmp_path / "runs"
    occupied.write_text("a file where the folder of the runs should be")
    facts = storage_of(occupied / "below", rig_of())
    assert facts.write_bytes_s == 0.0
    refusal = only_refusal(checked(plan_of(), storage=replace(facts, free_bytes=10**15)))
    assert refusal == (
        f"storage {occupied / 'below'}: expected a folder that can be written; {occupied} is a file"
    )


def test_a_disk_whose_test_fails_is_refused_with_the_reason(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def failing(fd: int, data: object, offset: int) -> int:
        raise OSError(errno.EIO, "Input/output error")

    monkeypatch.setattr(os, "pwrite", failing)
    facts = storage_of(tmp_path, rig_of())
    assert "Input/output error" in only_refusal(checked(plan_of(), storage=replace(facts, free_bytes=10**15)))
    assert list(tmp_path.iterdir()) == []


def test_the_test_of_a_disk_leaves_nothing_and_never_writes_into_the_reserve(tmp_path: Path) -> None:
    seen: list[int] = []
    original = os.pwrite

    def counted(fd: int, data: Any, offset: int) -> int:
        seen.append(len(data))
        assert list(tmp_path.iterdir()) == []  # a file without a name: kill -9 leaves nothing
        return original(fd, data, offset)

    with mock.patch("os.pwrite", counted):
        assert measure_write_speed(tmp_path, frame_bytes=25_000_000, room_bytes=2**40) > 0.0
        assert sum(seen) <= 128 * 2**20
        seen.clear()
        assert measure_write_speed(tmp_path, room_bytes=63 * 2**20) == 0.0
    assert seen == []
    assert list(tmp_path.iterdir()) == []


def test_a_frame_that_is_no_multiple_of_a_page_is_warned_of() -> None:
    assert RIG is not None
    rig = rig_of(sensor={**RIG.sensor.model_dump(), "width_px": 500})
    assert "500 x 384 is no multiple of 4096 bytes" in checked(plan_of(), rig).warnings[0]


# ----------------------------------------------------------------------------------------- whole plans


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
