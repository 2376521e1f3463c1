"""Limits of LEDs and boards: on-times, rests, heat."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from preflight_cases import PARK, RIG, TOP, checked, only_refusal, plan_of, rig_of, schedule_of, sphere

from coupole.devices import NO_LED
from coupole.plan.led_table import LedTable
from coupole.plan.rig import Rig
from coupole.plan.schedule import Schedule
from coupole.preflight.preflight import Report


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


def test_an_led_rests_in_the_order_of_the_visits() -> None:
    same = [{**PARK, "name": name} for name in ("first", "second")]
    away = {**TOP, "name": "away", "azimuth_deg": 60, "elevation_deg": 45}
    rig = rig_of(led_limits=limits(cooldown_ratio=100.0))
    few = {"lights": {"kind": "ids", "ids": [5]}, "darks_per_view": 0, "views": [same[0], away, same[1]]}
    assert checked(plan_of(order="as_written", **few), rig).refusals == []
    assert "led0005/e0: LED 5 rests " in only_refusal(checked(plan_of(order="fastest", **few), rig))
