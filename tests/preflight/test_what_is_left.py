"""Preflight of a resumed run: dose, duration, heat and storage of what is left, beside those of the whole."""

from __future__ import annotations

import io
from pathlib import Path

import pytest
from places import REPO
from rich.console import Console

from coupole.plan.shot_id import ShotId
from coupole.preflight.checking import check_job
from coupole.preflight.job import Job, read_job
from coupole.preflight.preflight import Report, StorageFacts, room_bytes
from coupole.storage.frame_file import SPARE_SLOTS
from coupole.storage.run import Occupied
from coupole.viewing.preflight_table import show_preflight

ROOMY = StorageFacts(10**15, 4e9)


@pytest.fixture(scope="module")
def demo() -> Job:
    return read_job(REPO / "configs/plans/demo.yaml")


def proven_of(job: Job, views: int, of_next: int = 0) -> set[ShotId]:
    """All frames of the plan's first views, and some of the view after them."""
    shots = [[shot for burst in bursts for shot in burst.shots if shot] for bursts in job.schedule.bursts]
    return {shot for own in shots[:views] for shot in own} | set(shots[views][:of_next])


def left_of(job: Job, proven: set[ShotId]) -> Report:
    return check_job(job, ROOMY, paths=False, proven=proven)[1]


def test_views_that_are_done_cost_no_light_and_no_time(demo: Job) -> None:
    _, full = check_job(demo, ROOMY, paths=False)
    report = left_of(demo, proven_of(demo, 2))
    assert [view.name for view in report.views] == [demo.schedule.views[2].name]
    assert report.frames == full.frames // 3
    assert report.dose_lux_h == pytest.approx(full.dose_lux_h / 3, rel=1e-6)
    assert report.duration_s < 0.4 * full.duration_s
    assert report.bytes == report.frames * demo.cell.rig.frame_bytes
    assert report.whole is not None
    assert report.whole.frames == full.frames
    assert report.whole.dose_lux_h == pytest.approx(full.dose_lux_h)
    assert report.whole.duration_s == pytest.approx(full.duration_s)


def test_dark_frames_that_are_done_take_no_light_off_what_is_left(demo: Job) -> None:
    """A share of frames is no share of light: the marks and darks at a burst's beginning give none."""
    _, full = check_job(demo, ROOMY, paths=False)
    darks = {shot for shot in proven_of(demo, 0, 40) if not shot.is_shot}
    assert darks
    assert left_of(demo, darks).dose_lux_h == pytest.approx(full.dose_lux_h)


def test_a_budget_that_holds_for_the_rest_is_kept_although_the_whole_exceeds_it(demo: Job) -> None:
    assert demo.plan.object is not None
    tight = demo.plan.object.model_copy(update={"dose_budget_lux_h": 1.0})
    job = Job(
        demo.plan.model_copy(update={"object": tight}),
        *(demo.document, demo.cell, demo.shape, demo.schedule, demo.motion),
    )
    assert "its budget is 1 lux.h" in check_job(job, ROOMY, paths=False)[1].refusals[0]
    assert left_of(job, proven_of(job, 2)).refusals == []


def test_a_run_with_nothing_left_is_checked_as_nothing(demo: Job) -> None:
    everything = proven_of(demo, 2) | {s for b in demo.schedule.bursts[2] for s in b.shots if s}
    report = left_of(demo, everything)
    assert (report.views, report.frames, report.dose_lux_h, report.refusals) == ([], 0, 0.0, [])


def test_what_is_left_and_the_whole_are_both_shown(demo: Job) -> None:
    written = io.StringIO()
    report = left_of(demo, proven_of(demo, 2))
    show_preflight(Console(file=written, width=120), report, name="demo", rig="cell")
    text = written.getvalue()
    assert "1, 1080, 1092 left of 3, 3240, 3276" in text
    assert "0.731 lux.h left of 2.193" in text
    assert " s left of " in text


def test_the_same_bytes_are_not_asked_for_twice(demo: Job, tmp_path: Path) -> None:
    """Two views' files are on the disk, with all that they will ever need."""
    frame_bytes, reserve = demo.cell.rig.frame_bytes, demo.cell.rig.storage.reserve_bytes
    a_view = (1092 + SPARE_SLOTS) * frame_bytes
    need = room_bytes(3276, 3, frame_bytes) - 2 * a_view + reserve
    for free_bytes, refused in ((need, False), (need - 1, True)):
        facts = StorageFacts(free_bytes, 4e9, tmp_path, Occupied({"top": 2 * a_view}))
        _, report = check_job(demo, facts, paths=False, proven=proven_of(demo, 1, 500))
        assert bool(report.refusals) == refused
