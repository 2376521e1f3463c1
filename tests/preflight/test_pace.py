"""How far apart a plan's frames come: as camera, LED, disk and heat ask, whichever asks most."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from places import REPO

from coupole.devices import NO_LED
from coupole.plan.bursts import FASTEST, Pace
from coupole.plan.rig import BoardThermal, LedLimits
from coupole.preflight.checking import check_job
from coupole.preflight.job import Job, at_pace, read_job
from coupole.preflight.preflight import DISK_SHARE, StorageFacts

ROOT = REPO
ROOMY = 10**15


@pytest.fixture(scope="module")
def demo() -> Job:
    return read_job(ROOT / "configs/plans/demo.yaml")


def with_limits(job: Job, **limits: object) -> Job:
    rig = job.cell.rig
    return replace(job, cell=replace(job.cell, rig=rig.model_copy(update={"led_limits": LedLimits(**limits)})))


def test_a_fast_disk_and_cool_leds_leave_the_camera_to_decide(demo: Job) -> None:
    job, report = check_job(demo, StorageFacts(ROOMY, 4e9), paths=False)
    assert job.pace.led_duty == 1.0
    assert [timing.bound for timing in report.timings] == ["camera"]


def test_a_slow_disk_sets_the_pace(demo: Job) -> None:
    disk_bytes_s = 10e6
    job, report = check_job(demo, StorageFacts(ROOMY, disk_bytes_s), paths=False)
    (timing,) = report.timings
    assert timing.bound == "disk"
    assert report.refusals == []
    assert 0.99 * DISK_SHARE * disk_bytes_s < report.asked_bytes_s <= DISK_SHARE * disk_bytes_s
    assert job.schedule.bursts[0][0].table["period_us"].min() == timing.period_us
    assert report.duration_s > 1080 * 3 * timing.period_us * 1e-6


def test_leds_stay_on_as_long_however_slow_the_pace(demo: Job) -> None:
    slow, _ = check_job(demo, StorageFacts(ROOMY, 10e6), paths=False)
    assert (slow.schedule.bursts[0][0].table["on_us"] == demo.schedule.bursts[0][0].table["on_us"]).all()


def test_boards_that_would_get_too_hot_set_the_pace_and_stay_below_their_limit(demo: Job) -> None:
    hot = BoardThermal(led_power_w=15.0, rise_c_per_j=2.0, time_constant_s=3.0, ambient_c=25.0, limit_c=25.5)
    warm = with_limits(demo, board=hot, cooldown_ratio=2.0)
    job, report = check_job(warm, StorageFacts(ROOMY, 4e9), paths=False)
    (timing,) = report.timings
    assert timing.bound == "heat"
    assert report.refusals == []
    assert report.peak_board_c <= hot.limit_c
    faster = at_pace(job, replace(job.pace, led_duty=job.pace.led_duty / 0.9))
    assert check_job(faster, StorageFacts(ROOMY, 4e9), paths=False)[0].pace == job.pace  # none faster would do


def test_leds_that_must_rest_longer_set_the_pace(demo: Job) -> None:
    plan = demo.plan.model_copy(update={"lights": type(demo.plan.lights)(kind="all"), "repeats": 2})
    again = with_limits(at_pace(replace(demo, plan=plan), Pace(led_duty=0.999)), cooldown_ratio=2000.0)
    _, report = check_job(again, StorageFacts(ROOMY, 4e9), paths=False)
    assert [timing.bound for timing in report.timings] == ["heat"]
    assert report.refusals == []


def test_what_no_pace_can_cool_is_refused_at_the_fastest_one(demo: Job) -> None:
    hopeless = BoardThermal(rise_c_per_j=2.0, time_constant_s=1e6, ambient_c=25.0, limit_c=25.1)
    job, report = check_job(with_limits(demo, board=hopeless), StorageFacts(ROOMY, 4e9), paths=False)
    assert job.pace.led_duty == 1.0
    assert len(report.refusals) == 1
    assert report.refusals[0].startswith("LED boards: the hottest would reach")


def test_a_job_at_another_pace_has_the_same_shots_without_the_same_hidden_lights(demo: Job) -> None:
    view = demo.schedule.views[0].name
    hidden = {view: [3, 5]}
    skipping = replace(demo, schedule=demo.schedule.without(hidden), hidden_leds=hidden)
    slower = at_pace(skipping, Pace(disk_us=20_000))
    assert slower.schedule.bursts[0][0].labels == skipping.schedule.bursts[0][0].labels
    lit = slower.schedule.bursts[0][0].table["led"]
    assert not np.isin(lit[lit != NO_LED], [3, 5]).any()
    assert at_pace(slower, FASTEST).schedule.bursts[0][0].duration_s == skipping.schedule.bursts[0][0].duration_s
