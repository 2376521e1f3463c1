"""One of the thousands of cases of `tools/fail_every_call.py`, another every day."""

from __future__ import annotations

import datetime
import random
import threading
from collections.abc import Callable
from pathlib import Path

import cells
import pytest
from cells import TOP
from failing_calls import KINDS, Failure, acquire, cell_in, count_calls, run_case
from happenings import FILES, MEANWHILE, Event
from judged_sessions import MeanwhileCase, draw_pair, run_events, wrong_in_what_was_read

from coupole.acquisition.recorder import RunRecorder

CALLS = 350
"""A session has some more; all of them are gone through by the tool."""


@pytest.mark.timeout(600)
def test_whatever_call_fails_in_whatever_way_the_cell_is_safe_and_the_run_goes_on(
    tmp_path: Path, scale: Callable[[int, int], int]
) -> None:
    today = datetime.datetime.now(datetime.UTC).date()
    drawn = random.Random(today.toordinal())
    (tmp_path / "calls").mkdir()
    calls = len(count_calls(tmp_path / "calls"))
    for number in range(scale(1, 8)):
        k, kind = drawn.randint(1, calls), drawn.choice(KINDS)
        folder = tmp_path / str(number)
        folder.mkdir()
        case = run_case(folder, k, kind)
        assert not case.wrong, (today, case)


@pytest.mark.timeout(600)
def test_whatever_stops_stalls_or_changes_at_whatever_call_the_cell_is_safe_and_the_run_is_what_was_read(
    tmp_path: Path, scale: Callable[[int, int], int]
) -> None:
    today = datetime.datetime.now(datetime.UTC).date()
    drawn = random.Random(f"meanwhile {today}")
    kinds = [kind for kind in MEANWHILE if scale(0, 1) or "20 s" not in kind]  # it takes that long
    for number in range(scale(1, 8)):
        folder = tmp_path / str(number)
        folder.mkdir()
        case = run_events(folder, (Event(drawn.randint(1, CALLS), drawn.choice(kinds)),))
        assert not case.wrong, (today, case)


@pytest.mark.timeout(600)
def test_whatever_two_failures_a_session_has_the_cell_is_safe_and_the_run_goes_on(
    tmp_path: Path, scale: Callable[[int, int], int]
) -> None:
    today = datetime.datetime.now(datetime.UTC).date()
    drawn = random.Random(f"pairs {today}")
    for number in range(scale(1, 8)):
        folder = tmp_path / str(number)
        folder.mkdir()
        pair = draw_pair(drawn, CALLS)
        while not scale(0, 1) and any("20 s" in event.kind for event in pair):
            pair = draw_pair(drawn, CALLS)
        case = run_events(folder, pair)
        assert not case.wrong, (today, case)


@pytest.mark.full
def test_a_harness_sees_what_was_changed_where_the_run_does_not_keep_what_it_read(tmp_path: Path) -> None:
    """The judge itself: a run whose kept inputs are edited is told."""
    run_events(tmp_path, (Event(CALLS // 2, "plan edited"),))
    run = next((tmp_path / "storage").glob("2*/run.json")).parent
    originals = {name: (tmp_path / path).read_bytes() for name, path in FILES.items()}
    case = MeanwhileCase(1, "plan edited", code=0)
    assert not wrong_in_what_was_read(run, case, originals)
    kept = run / "inputs/plan.yaml"
    kept.write_text(kept.read_text().replace("20000", "10000"))
    assert "inputs/plan.yaml is another plan" in wrong_in_what_was_read(run, case, originals)


def test_an_unexpected_error_ends_with_one_a_safe_cell_a_true_journal_and_its_trace(tmp_path: Path) -> None:
    cell = cell_in(tmp_path)
    with cell.world() as world:
        ended = acquire(cell, Failure(0, "unexpected", "led box.edges"))
        assert cells.safe(world)
    assert ended.code == 1
    run = cell.run_folder
    assert cells.events(run, "stop")[-1]["outcome"] == "failed"
    (fault,) = cells.events(run, "fault")
    assert fault["kind"] == "UnexpectedError"
    (trace,) = run.glob("trace-*.txt")
    assert "put into led box.edges" in trace.read_text()
    assert "lights are off, the arm is at rest, the camera is disarmed" in ended.err
    assert str(trace) in ended.err
    assert f"--resume {run}" in ended.err
    assert (run / "report.html").exists()


def test_a_signal_while_the_end_is_noted_cuts_nothing_off(tmp_path: Path) -> None:
    cell = cell_in(tmp_path)
    with cell.world():
        ended = acquire(cell, Failure(0, "sighup", "robot.statistics"))
    assert ended.code == 129, "all is there, but nothing may follow a stop"
    assert cells.events(cell.run_folder, "stop")[-1]["outcome"] == "done"
    assert ended.document["missing"] == 0


def test_an_unsafe_end_is_told_and_is_no_success(tmp_path: Path) -> None:
    """All frames are there, but nobody knows whether the lights went off."""
    cell = cell_in(tmp_path)
    with cell.world():
        ended = acquire(cell, Failure(0, "unexpected", "led box.lights_off"))
    assert ended.code == 4
    assert "not sure that it is safe (lights off)" in ended.err
    assert ended.document["missing"] == 0
    assert "lights off" in cells.events(cell.run_folder, "fault")[-1]["message"]


@pytest.mark.parametrize("call", ["camera.next_frame", "led box.poll_log", "robot.measured"])
def test_lights_are_off_before_the_disk_hears_of_an_error(
    tmp_path: Path, call: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A disk may take seconds: nothing shines when it is asked to keep what was taken."""
    cell = cell_in(tmp_path)
    cell.write(views=[TOP], lights={"kind": "every", "every": 4})
    shone: list[list[int]] = []
    commit = RunRecorder.commit
    with cell.world() as world:
        failed = threading.Event()

        def watched_commit(self: RunRecorder, *, now: bool) -> None:
            if failed.is_set() and now:
                shone.extend(world.ask("state")["shining"] for _ in range(20))
            commit(self, now=now)

        monkeypatch.setattr(RunRecorder, "commit", watched_commit)
        in_a_burst = Failure(0, "unexpected", call, on_event=failed.set, after="led box.start")
        ended = acquire(cell, in_a_burst)
    assert ended.code == 1
    assert len(shone) >= 20
    assert not any(shone)
