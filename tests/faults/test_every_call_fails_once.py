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

from coupole.acquisition.recorder import RunRecorder


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
    assert ended.code == 0
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
