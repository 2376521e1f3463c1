"""From plan to bursts: order, ids, marks, light selections, times."""

from __future__ import annotations

from collections import Counter
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from places import REPO

from coupole.devices import NO_LED
from coupole.geometry import transform
from coupole.plan.bursts import Burst, DeviceTimes, burst_timing
from coupole.plan.led_table import LedTable, read_led_table
from coupole.plan.light_selection import interleave, missing_lights
from coupole.plan.marks import MARKS, START_MARK_EXTRA
from coupole.plan.plan import Plan
from coupole.plan.schedule import Schedule, build_schedule
from coupole.plan.shot_id import Led, ShotLabel

DOME = read_led_table(REPO / "configs/domes/coupole.csv")
BASE_FROM_SUPPORT = transform((200, 0, 1450), (0, 0, 180))
TOP = {"kind": "look_at", "name": "top", "target_mm": [0, 0, 30], "distance_mm": 335, "azimuth_deg": 0}
ALL = {"kind": "all"}
START = len(START_MARK_EXTRA)


def plan_of(lights: dict[str, Any] | None = None, **changes: Any) -> Plan:
    asked = {
        "schema_version": 1,
        "name": "test",
        "rig": "rig.yaml",
        "views": [{**TOP, "elevation_deg": 80}, {**TOP, "name": "side", "elevation_deg": 40}],
        "lights": lights or ALL,
        "exposure": {"kind": "fixed", "exposure_us": 8000},
    }
    return Plan.model_validate(asked | changes)


def schedule_of(
    plan: Plan, leds: LedTable = DOME, readout_us: float = 10_000.0, *, runs_tables: bool = True
) -> Schedule:
    times = DeviceTimes(rise_us=1000, readout_us=readout_us, exposure_gap_us=100)
    return build_schedule(plan, leds, BASE_FROM_SUPPORT, times, runs_tables=runs_tables)


def lit_leds(burst: Burst) -> list[int]:
    return [int(led) for led in burst.table["led"] if led != NO_LED]


def first_burst(lights: dict[str, Any] | None = None, **changes: Any) -> Burst:
    return schedule_of(plan_of(lights, **changes)).bursts[0][0]


def test_neighbours_in_time_sit_on_different_boards() -> None:
    boards = DOME.boards[DOME.rows(lit_leds(first_burst()))]
    assert np.all(boards[1:] != boards[:-1])


def test_each_board_is_lit_once_before_any_is_lit_again() -> None:
    boards = DOME.boards[DOME.rows(lit_leds(first_burst()))]
    assert all(len(set(turn)) == 180 for turn in boards.reshape(6, 180))


@given(st.lists(st.integers(0, 20), max_size=60))
def test_interleaving_keeps_every_led(boards: list[int]) -> None:
    assert sorted(interleave(np.array(boards, np.int64))) == list(range(len(boards)))


def test_every_light_is_shot_once_in_a_burst() -> None:
    assert sorted(lit_leds(first_burst())) == list(range(1080))


def test_ids_are_view_light_exposure() -> None:
    ids = first_burst({"kind": "ids", "ids": [417]}, darks_per_view=1).shots
    assert list(map(str, ids[START : START + 2])) == ["top/dark10/e0", "top/led0417/e0"]


def test_marks_are_the_dark_frames_that_begin_and_end_a_burst() -> None:
    ids = first_burst({"kind": "ids", "ids": [3]}, darks_per_view=0).shots
    assert list(map(str, ids)) == [*(f"top/dark{k}/e0" for k in range(5)), "top/led0003/e0"] + [
        f"top/dark{k}/e0" for k in range(5, 10)
    ]


def test_the_led_of_a_step_is_that_of_its_id() -> None:
    burst = first_burst()
    for led, label in zip(burst.table["led"], burst.labels, strict=True):
        assert label.light == Led(led) if led != NO_LED else label.is_dark


def test_all_ids_of_a_plan_differ() -> None:
    bracket = {"kind": "bracket", "exposures_us": [2000, 8000]}
    schedule = schedule_of(plan_of({"kind": "every", "every": 50}, exposure=bracket, repeats=3))
    ids = Counter(shot for view in schedule.bursts for burst in view for shot in burst.shots)
    assert set(ids.values()) == {1}
    assert len(ids) == schedule.frames


def test_darks_of_a_view_are_added_to_the_marks() -> None:
    burst = first_burst(darks_per_view=7)
    assert int(np.sum(burst.table["led"] == NO_LED)) == MARKS + 7


def test_repeats_take_no_more_darks_than_their_marks() -> None:
    first, again = schedule_of(plan_of(darks_per_view=7, repeats=2)).bursts[0]
    assert len(again.labels) == len(first.labels) - 7


def test_shots_count_lights_only_and_frames_count_all() -> None:
    schedule = schedule_of(plan_of(darks_per_view=2))
    assert schedule.shots == 2 * 1080
    assert schedule.frames == 2 * (1080 + 2 + MARKS)


def test_tables_are_shared_between_views() -> None:
    top, side = schedule_of(plan_of()).bursts
    assert top[0].table is side[0].table


def test_a_bracket_gives_one_burst_for_each_exposure_named_by_its_number() -> None:
    bracket = {"kind": "bracket", "exposures_us": [2000, 8000, 32000]}
    bursts = schedule_of(plan_of({"kind": "ids", "ids": [9]}, exposure=bracket)).bursts[0]
    assert [b.timing.exposure_us for b in bursts] == [2000, 8000, 32000]
    assert [str(label) for b in bursts for label in b.labels if label.is_shot] == [
        "led0009/e0",
        "led0009/e1",
        "led0009/e2",
    ]


def test_repeats_after_the_first_are_named_by_their_number() -> None:
    bursts = schedule_of(plan_of({"kind": "ids", "ids": [9]}, repeats=3)).bursts[0]
    assert [str(label) for b in bursts for label in b.labels if label.is_shot] == [
        "led0009/e0",
        "led0009/e0/r1",
        "led0009/e0/r2",
    ]


def labels(*texts: str) -> set[ShotLabel]:
    return set(map(ShotLabel.parse, texts))


def test_only_keeps_wanted_shots_and_all_marks() -> None:
    burst = first_burst().only(labels("led0700/e0", "led0001/e0"))
    assert sorted(lit_leds(burst)) == [1, 700]
    assert len(burst.table) == MARKS + 2


def test_only_drops_the_labels_of_marks_that_are_not_wanted() -> None:
    burst = first_burst().only(labels("led0700/e0", "dark3/e0"))
    assert [str(label) for label in burst.labels if label] == ["dark3/e0", "led0700/e0"]
    assert burst.shots.count(None) == MARKS - 1


def test_in_a_burst_that_is_shot_again_the_led_of_a_step_is_that_of_its_id() -> None:
    burst = first_burst()
    again = burst.only(set(burst.labels[100:200:7]))
    assert len(lit_leds(again)) == 15
    for led, label in zip(again.table["led"], again.labels, strict=True):
        assert label is None if led == NO_LED else label.light == Led(led)


def test_only_gives_the_marks_of_a_fresh_burst() -> None:
    again = first_burst(darks_per_view=0).only(labels("led0007/e0"))
    fresh = first_burst({"kind": "ids", "ids": [7]}, darks_per_view=0)
    assert np.array_equal(again.table, fresh.table)


def test_only_of_one_mark_is_a_burst_of_marks() -> None:
    burst = first_burst().only(labels("dark0/e0"))
    assert len(burst.table) == MARKS
    assert not burst.is_light().any()


def test_only_keeps_the_order_of_the_burst() -> None:
    burst = first_burst()
    wanted = set(burst.labels[100:200:3])
    kept = [label for label in burst.only(wanted).labels if label]
    assert kept == [label for label in burst.labels if label in wanted]


def test_lights_by_id_are_those_leds() -> None:
    assert sorted(lit_leds(first_burst({"kind": "ids", "ids": [5, 3, 1079]}))) == [3, 5, 1079]


def test_lights_by_board_are_all_its_leds() -> None:
    leds = lit_leds(first_burst({"kind": "boards", "boards": [2, 179]}))
    assert sorted(leds) == sorted(DOME.ids[np.isin(DOME.boards, [2, 179])].tolist())


def test_every_nth_light_starts_at_the_offset() -> None:
    assert sorted(lit_leds(first_burst({"kind": "every", "every": 500, "offset": 70}))) == [70, 570, 1070]


def test_lights_in_a_cone_are_seen_from_the_supports_centre_within_its_angle() -> None:
    cone = {"kind": "cone", "azimuth_deg": 30, "elevation_deg": 50, "half_angle_deg": 20}
    lit = set(lit_leds(first_burst(cone)))
    axis = [np.cos(np.radians(50)) * np.cos(np.radians(30)), np.cos(np.radians(50)) * 0.5, np.sin(np.radians(50))]
    support = np.linalg.inv(BASE_FROM_SUPPORT) @ np.c_[DOME.positions_mm, np.ones(1080)].T
    towards = support[:3] / np.linalg.norm(support[:3], axis=0)
    angle_deg = np.degrees(np.arccos(np.clip(axis @ towards, -1, 1)))
    assert lit == set(DOME.ids[angle_deg <= 20].tolist())
    assert 10 < len(lit) < 500


def test_panels_have_a_burst_each_and_no_led() -> None:
    bursts = schedule_of(plan_of({"kind": "panels", "panels": [2, 4]})).bursts[0]
    assert [b.panel for b in bursts] == [2, 4]
    assert all(lit_leds(b) == [] for b in bursts)
    assert ["top/panel2/e0" in list(map(str, b.shots)) for b in bursts] == [True, False]


def test_the_marks_of_a_panels_burst_are_not_called_dark() -> None:
    burst = first_burst({"kind": "panels", "panels": [2]})
    assert not any(label.is_dark for label in burst.labels)
    assert sum(burst.is_light()) == 1


def test_no_lights_is_marks_and_darks() -> None:
    schedule = schedule_of(plan_of({"kind": "none"}, darks_per_view=3))
    assert schedule.shots == 0
    assert len(schedule.bursts[0][0].table) == MARKS + 3


def test_a_light_that_the_dome_does_not_have_is_named() -> None:
    problems = missing_lights(plan_of({"kind": "ids", "ids": [3, 1080]}), DOME, BASE_FROM_SUPPORT)
    assert problems == [(("lights", "ids", 1), "the dome has no LED 1080; it has 0 to 1079")]


def test_a_board_that_the_dome_does_not_have_is_named() -> None:
    problems = missing_lights(plan_of({"kind": "boards", "boards": [180]}), DOME, BASE_FROM_SUPPORT)
    assert problems == [(("lights", "boards", 0), "the dome has no board 180; it has 0 to 179")]


def test_a_cone_in_which_no_led_lies_is_named() -> None:
    below = {"kind": "cone", "azimuth_deg": 0, "elevation_deg": -80, "half_angle_deg": 5}
    (problem,) = missing_lights(plan_of(below), DOME, BASE_FROM_SUPPORT)
    assert problem == (("lights",), "expected lights, none of the dome's LEDs lies in that cone")


def test_a_view_may_have_lights_of_its_own() -> None:
    own = {**TOP, "name": "own", "elevation_deg": 60, "lights": {"kind": "ids", "ids": [5, 900]}}
    panel = {**TOP, "name": "panel", "elevation_deg": 50, "lights": {"kind": "panels", "panels": [3]}}
    schedule = schedule_of(plan_of(ALL, views=[{**TOP, "elevation_deg": 80}, own, panel]))
    assert [len(lit_leds(bursts[0])) for bursts in schedule.bursts] == [1080, 2, 0]
    assert sorted(lit_leds(schedule.bursts[1][0])) == [5, 900]
    assert schedule.bursts[2][0].panel == 3
    assert schedule.shots == 1080 + 2 + 1
    assert [len(labels) for labels in schedule.labels] == [len(bursts[0].labels) for bursts in schedule.bursts]


def test_a_light_of_a_view_that_the_dome_does_not_have_is_named_at_the_view() -> None:
    own = {**TOP, "elevation_deg": 60, "lights": {"kind": "ids", "ids": [1080]}}
    (problem,) = missing_lights(plan_of(ALL, views=[own]), DOME, BASE_FROM_SUPPORT)
    assert problem == (("views", 0, "lights", "ids", 0), "the dome has no LED 1080; it has 0 to 1079")


def test_views_with_the_same_lights_share_their_tables() -> None:
    schedule = schedule_of(plan_of(ALL))
    assert schedule.bursts[0][0].table is schedule.bursts[1][0].table


def test_a_grid_is_named_by_azimuth_and_elevation() -> None:
    grid = {k: TOP[k] for k in ("name", "target_mm", "distance_mm")} | {"kind": "grid"}
    plan = plan_of(views=[{**grid, "azimuths_deg": [0, -120.5], "elevations_deg": [45, 60]}])
    names = [view.name for view in schedule_of(plan).views]
    assert names == ["top-az0-el45", "top-az-120.5-el45", "top-az0-el60", "top-az-120.5-el60"]


exposures_us = st.integers(10, 1_900_000)
device_times = st.builds(
    DeviceTimes,
    rise_us=st.integers(0, 5_000),
    readout_us=st.floats(100, 1e6),
    exposure_gap_us=st.integers(0, 5_000),
)


@given(exposures_us, device_times)
def test_a_period_is_never_shorter_than_the_camera_allows(exposure_us: int, times: DeviceTimes) -> None:
    timing = burst_timing(exposure_us, times, hardware=True)
    assert timing.period_us >= times.readout_us
    assert timing.period_us >= exposure_us + times.exposure_gap_us


@given(exposures_us, device_times)
def test_an_led_is_on_from_before_the_exposure_to_after_it_and_off_before_the_next(
    exposure_us: int, times: DeviceTimes
) -> None:
    timing = burst_timing(exposure_us, times, hardware=True)
    assert timing.trigger_delay_us >= times.rise_us
    assert timing.on_us > timing.trigger_delay_us + exposure_us
    assert timing.period_us > timing.on_us


def test_no_step_of_a_burst_is_shorter_than_the_bursts_period() -> None:
    burst = first_burst()
    assert int(burst.table["period_us"].min()) == burst.timing.period_us


def test_with_software_trigger_no_step_sends_an_edge_and_there_are_no_marks() -> None:
    burst = first_burst(trigger="software", darks_per_view=2)
    assert not burst.table["sends_edge"].any()
    assert len(burst.table) == 1080 + 2


def by_host(**changes: Any) -> Burst:
    """The first burst of a plan for a box that runs no tables and keeps no log."""
    return schedule_of(plan_of(trigger="software", **changes), runs_tables=False).bursts[0][0]


def test_without_a_log_a_burst_has_a_dark_mark_at_each_end() -> None:
    burst = by_host(darks_per_view=2)
    assert not burst.table["sends_edge"].any()
    assert len(burst.table) == 1 + 2 + 1080 + 1
    assert np.flatnonzero(burst.table["led"] == NO_LED).tolist() == [0, 1, 2, 1083]
    assert [str(burst.labels[i]) for i in (0, 1, 2, -1)] == ["dark0/e0", "dark2/e0", "dark3/e0", "dark1/e0"]
    assert np.all(burst.table["period_us"] == burst.timing.period_us)


def test_the_marks_of_a_panels_burst_have_names_of_their_own() -> None:
    burst = by_host(lights={"kind": "panels", "panels": [2]})
    assert list(map(str, burst.labels)) == ["panel2-mark0/e0", "panel2/e0", "panel2-mark1/e0"]


def test_a_burst_without_a_log_that_is_shot_again_has_its_marks_anew() -> None:
    burst = by_host(darks_per_view=0).only(labels("led0007/e0"))
    assert burst.labels == (None, ShotLabel(Led(7), 0), None)
    assert burst.table["led"].tolist() == [NO_LED, 7, NO_LED]


def assert_legal_for_the_box(table: np.ndarray[Any, Any], edge_width_us: int = 50) -> None:
    """The limits of docs/reference/ledbox-protocol.md, written out anew."""
    assert 1 <= len(table) <= 4096
    last_off: dict[int, tuple[int, int]] = {}
    t_on = 0
    for led, on, delay, period, edge in table.tolist():
        lit = led != NO_LED
        assert -1 <= led <= 1079
        assert (1000 if lit else 0) <= on <= 2_000_000
        assert not (lit and edge) or delay <= on
        assert period >= max(on, 100, delay + edge_width_us if edge else 0)
        if lit:
            off, was_on = last_off.get(led, (-(10**12), 0))
            assert t_on - off >= 2 * was_on
            last_off[led] = t_on + on, on
        t_on += period


@pytest.mark.parametrize(
    "lights",
    [ALL, {"kind": "ids", "ids": [0]}, {"kind": "boards", "boards": [7]}, {"kind": "panels"}, {"kind": "none"}],
)
@pytest.mark.parametrize("exposure_us", [10, 8_000, 1_998_000])
@pytest.mark.parametrize("trigger", ["hardware", "software"])
def test_every_table_is_legal_for_the_box(lights: dict[str, Any], exposure_us: int, trigger: str) -> None:
    if trigger == "software" and exposure_us > 1_000_000:
        exposure_us = 1_900_000
    exposure = {"kind": "fixed", "exposure_us": exposure_us}
    schedule = schedule_of(plan_of(lights, exposure=exposure, trigger=trigger))
    for burst in schedule.bursts[0]:
        assert_legal_for_the_box(burst.table)


def test_the_table_of_a_reshot_burst_is_legal_for_the_box() -> None:
    assert_legal_for_the_box(first_burst().only(labels("led0007/e0", "led0008/e0")).table)
