"""The light that a plan gives its object, and the budget that refuses it."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from preflight_cases import TEN_MS_ON, TOP, checked, only_refusal, plan_of, sphere

from coupole.plan.plan import Plan
from coupole.preflight.preflight import BURST_OVERHEAD_S
from coupole.storage.ledger import Ledger


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
    before = ledger.read_history().total_lux_h
    refusal = only_refusal(checked(with_budget(4.0), leds=sphere(), dose_before_lux_h=before))
    assert "after 2.50 lux.h before; its budget is 4 lux.h" in refusal
