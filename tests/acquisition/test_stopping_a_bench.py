"""A stop of a bench, against what was asked before it and is still being prepared."""

from __future__ import annotations

import errno
import os
import subprocess
import threading
import time
from types import SimpleNamespace
from typing import Any

import pytest

from coupole.acquisition.cell_bench import bench_service
from coupole.acquisition.cell_bench.bench_frames import BenchFrames
from coupole.acquisition.cell_bench.bench_requests import FrameAsked
from coupole.acquisition.cell_bench.bench_service import BenchService
from coupole.acquisition.cell_bench.bench_work import Work, Works
from coupole.acquisition.observer import Control
from coupole.errors import InputError


class SlowPlan:
    """A plan that is read for as long as the test wants."""

    def __init__(self) -> None:
        self.begun, self.goes_on = threading.Event(), threading.Event()

    def job_of(self, _: Any) -> None:
        self.begun.set()
        assert self.goes_on.wait(10.0)

    def refuse_motion(self) -> None:
        """It may move."""


@pytest.mark.parametrize("command", ["stop", "close"])
def test_a_metering_that_is_still_prepared_when_a_stop_comes_never_begins(
    command: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    moved: list[object] = []
    monkeypatch.setattr(bench_service, "metering_job", lambda job: job)
    monkeypatch.setattr(bench_service, "metered", lambda *asked: moved.append(asked))
    monkeypatch.setattr(BenchService, "_state", lambda _: {})
    plan, service = SlowPlan(), BenchService.__new__(BenchService)
    parts = {
        "works": Works(),
        "_control": Control(),
        "closing": threading.Event(),
        "_ending": False,
        "_arm": plan,
        "_opened": SimpleNamespace(halt=list),
        "_devices": SimpleNamespace(in_use=threading.Lock()),
        "_frames": SimpleNamespace(release=lambda: None, begin_counting=lambda: None),
    }
    vars(service).update(parts)
    answers: list[dict[str, Any]] = []
    metering = threading.Thread(target=lambda: answers.append(service.ask("meter", plan="/plan.yaml")))
    metering.start()
    assert plan.begun.wait(10.0)
    assert service.ask(command)["trouble"] == []
    plan.goes_on.set()
    metering.join(10.0)
    assert "stopped before it began" in answers[0]["error"]
    assert (moved, service.works.running) == ([], None)
    if command == "stop":
        assert "error" not in service.ask("meter", plan="/plan.yaml"), "what is asked after it begins"
    else:
        assert "closing" in service.ask("meter", plan="/plan.yaml")["error"]


def test_who_lights_again_and_again_is_refused_after_a_stop(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(BenchFrames, "_refuse_what_there_is_not", lambda *_: None)
    frames: Any = BenchFrames.__new__(BenchFrames)
    asked = FrameAsked.model_validate({"version": 1, "command": "frame", "exposure_us": 100, "stops": 0})
    with pytest.raises(InputError, match="the bench was stopped while it waited"):
        frames.frame(asked, stops=1)


def test_a_stop_ends_what_is_under_way() -> None:
    works, ended = Works(), threading.Event()
    work = Work(Control(), "drive", {}, lambda control: {"stopped": control.stop.wait(10.0) and not ended.set()})
    works.begin(work, works.stops)
    works.stop()
    assert ended.wait(10.0)


def test_work_is_stopped_if_the_process_that_asked_for_it_has_ended_or_cannot_be_watched(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    def no_more_files(_: int) -> int:
        raise OSError(errno.EMFILE, "Too many open files")

    def outcome(pid: int) -> str:
        works = Works()
        work = Work(Control(), "drive", {}, until_stopped)
        works.begin(work, works.stops, pid)
        work.join(10.0)
        figures = work.figures()
        assert figures["state"] == "stopped"
        return str(figures["why"])

    def until_stopped(control: Control) -> dict[str, Any]:
        assert control.stop.wait(10.0), "it went on"
        raise control.interruption()

    ended = subprocess.Popen(["true"])
    ended.wait()
    assert outcome(ended.pid) == f"process {ended.pid}, which asked for it, has ended"
    monkeypatch.setattr(os, "pidfd_open", no_more_files)
    assert "cannot be watched: Too many open files" in outcome(os.getpid())


def test_no_work_of_a_bench_goes_on_before_it_is_known_why_its_process_stood_still() -> None:
    """The work's own thread runs again before the one that hears of SIGCONT: it waits for that one's word."""
    session, went_on = Control(), threading.Event()
    session.pulse_s = time.monotonic() - 2.0

    def move(control: Control) -> dict[str, Any]:
        control.await_word()
        control.go_on()
        went_on.set()
        return {}

    works = Works()
    work = Work(session, "drive", {}, move)
    works.begin(work, works.stops)
    time.sleep(0.05)
    session.hold("the program did not run for 2.0 s")
    work.join(10.0)
    assert (work.figures()["state"], went_on.is_set()) == ("stopped", False)
    assert "did not run" in work.figures()["why"]
