"""Waits that end, though what they wait for never does."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Iterator
from typing import Any

import cells
import pytest
from watchers_clock import WatchersClock

from coupole import bounded
from coupole.bounded import DISK, NOW, Workers, left_behind, on_disk, under_way
from coupole.errors import DeviceTimeout, StorageError


class EndedError(Exception):
    """What the work itself raises."""


@pytest.fixture(autouse=True)
def short(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(bounded, "DEVICE_S", 0.2)
    monkeypatch.setattr(bounded, "DISK_S", 0.2)
    monkeypatch.setattr(bounded, "STOPPED_S", 0.2)
    monkeypatch.setattr(bounded, "_BACK_S", 0.1)


@pytest.fixture
def never() -> Iterator[threading.Event]:
    """An event that comes when the test is over."""
    event = threading.Event()
    yield event
    event.set()
    cells.wait_until(lambda: not left_behind(), "the end of what hung")


def test_what_ends_is_returned_and_what_it_raises_is_raised() -> None:
    def fail() -> None:
        raise EndedError

    assert bounded.run_bounded(lambda: 7) == 7
    with pytest.raises(EndedError):
        bounded.run_bounded(fail)
    assert not left_behind()


def test_a_call_that_never_returns_is_given_up_with_its_name(never: threading.Event) -> None:
    def hang() -> None:
        with under_way("camera", "arm"):
            never.wait()

    with pytest.raises(DeviceTimeout, match="camera: expected the call `arm` to return") as raised:
        bounded.run_bounded(hang)
    assert raised.value.device == "camera"
    assert left_behind()
    assert bounded.hangs("camera") == "arm"
    assert bounded.hangs("robot") == ""


def test_who_waits_for_something_else_hears_of_a_call_that_is_given_up(
    never: threading.Event, monkeypatch: pytest.MonkeyPatch
) -> None:
    clock, is_under_way = WatchersClock(), threading.Event()
    monkeypatch.setattr(bounded, "time", clock)

    def hang() -> None:
        with under_way("camera", "next_frame"):
            is_under_way.set()
            never.wait()

    since_s = clock.now_s
    threading.Thread(target=hang, daemon=True).start()
    assert is_under_way.wait(cells.PATIENCE_S)
    clock.now_s += 0.9 * bounded.DEVICE_S
    bounded.refuse_overdue(since_s)
    clock.now_s += 0.2 * bounded.DEVICE_S
    with pytest.raises(DeviceTimeout, match="next_frame"):
        bounded.refuse_overdue(since_s)
    assert left_behind()


def test_a_file_that_never_answers_is_a_fault_of_the_disk(never: threading.Event) -> None:
    with pytest.raises(StorageError, match=r"journal\.jsonl: the disk has not answered"):
        on_disk("journal.jsonl", never.wait)


def test_a_call_in_another_thread_of_the_work_is_given_up_too(never: threading.Event) -> None:
    workers = Workers(1, "keep")

    def write() -> None:
        with under_way(DISK, "views/top.h5"):
            never.wait()

    with pytest.raises(StorageError, match="views/top"):
        bounded.run_bounded(lambda: workers.submit(write).result())


def test_what_takes_its_time_by_the_work_asked_is_waited_for() -> None:
    def sync() -> str:
        time.sleep(0.5)
        return "synced"

    assert on_disk("views/top.h5", sync, work_s=20.0) == "synced"


@pytest.mark.parametrize("goes_on", [True, False])
def test_what_goes_on_is_waited_for_however_slow_it_is(monkeypatch: pytest.MonkeyPatch, goes_on: bool) -> None:
    clock = WatchersClock()
    monkeypatch.setattr(bounded, "time", clock)

    def read() -> str:
        with under_way(DISK, "views/top.h5") as reading:
            for _ in range(4):
                clock.advance(0.15)
                if goes_on:
                    reading.goes_on()
        return "read"

    if goes_on:
        assert bounded.run_bounded(read) == "read"
    else:
        with pytest.raises(StorageError, match="has not answered"):
            bounded.run_bounded(read)


def test_once_a_session_is_to_end_a_device_has_less_time(never: threading.Event) -> None:
    def hang() -> None:
        with under_way("robot", "wait_settled", work_s=1000.0):
            never.wait()

    with pytest.raises(DeviceTimeout, match="wait_settled"):
        bounded.run_bounded(hang, stop=NOW)


def test_a_rescue_may_bring_a_call_back(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(bounded, "_BACK_S", cells.PATIENCE_S)
    back = threading.Event()

    def hang() -> str:
        with under_way("camera", "next_frame"):
            back.wait()
        return "came back"

    assert bounded.run_bounded(hang, rescue=back.set) == "came back"
    assert not left_behind()


def test_what_comes_after_all_is_passed_to_whoever_does_away_with_it(never: threading.Event) -> None:
    late: list[str] = []

    def hang() -> str:
        with under_way("camera", "open"):
            never.wait()
        return "an opened camera"

    with pytest.raises(DeviceTimeout):
        bounded.run_bounded(hang, discard=late.append)
    never.set()
    cells.wait_until(lambda: late, "what came after all")
    assert late == ["an opened camera"]


def test_a_thread_whose_call_returns_late_does_nothing_more(never: threading.Event) -> None:
    """A session that is left behind would fire its next burst; with `discard` it ends what it was asked for."""
    done: list[str] = []

    def work() -> None:
        with under_way("led box", "start"):
            never.wait()
        done.append("the next burst")

    with pytest.raises(DeviceTimeout):
        bounded.run_bounded(work)
    never.set()
    cells.wait_until(lambda: not left_behind(), "the end of the thread")
    assert done == []


def test_a_signal_ends_the_work_as_it_ends_who_waits_for_it() -> None:
    cleaned = threading.Event()

    def work() -> None:
        try:
            while True:
                time.sleep(0.01)
        finally:
            cleaned.set()

    def handler(*_: object) -> None:
        raise EndedError

    before = signal.signal(signal.SIGUSR2, handler)
    try:
        threading.Timer(0.1, os.kill, (os.getpid(), signal.SIGUSR2)).start()
        with pytest.raises(EndedError):
            bounded.run_bounded(work)
    finally:
        signal.signal(signal.SIGUSR2, before)
    assert cleaned.wait(cells.PATIENCE_S)


def test_workers_do_all_in_turn_and_end() -> None:
    workers = Workers(3, "turn")
    futures = [workers.submit(str, number) for number in range(100)]
    assert [future.result() for future in futures] == list(map(str, range(100)))
    workers.end()
    assert not [thread for thread in threading.enumerate() if thread.name == "turn"]


LEAVES = """
import sys, threading
from coupole import bounded
def hang():
    threading.Event().wait()
if sys.argv[1] == "hung":
    thread = threading.Thread(target=hang)  # not a daemon: the interpreter would wait for it
    thread.start()
    bounded.leave_behind(thread)
print("all that there is to say")
bounded.leave(4)
"""


@pytest.mark.parametrize("what", ["hung", "whole"])
def test_a_process_leaves_with_its_code_and_words_whatever_hangs(what: str) -> None:
    command = [sys.executable, "-c", LEAVES, what]
    ended = subprocess.run(command, check=False, capture_output=True, text=True, timeout=60)
    assert (ended.returncode, ended.stdout) == (4, "all that there is to say\n")


STANDS = """
import sys, time
from coupole import bounded
bounded.DEVICE_S = 5.0
def take():
    with bounded.under_way("camera", "next_frame"):
        print("takes", flush=True)
        sys.stdin.readline()
        time.sleep(0.3)  # several looks at it
bounded.run_bounded(take, rescue=lambda: print("given up"))
"""


def test_time_in_which_the_process_itself_stood_is_no_hang() -> None:
    pipes: dict[str, Any] = {"stdin": subprocess.PIPE, "stdout": subprocess.PIPE, "text": True}
    with subprocess.Popen([sys.executable, "-c", STANDS], **pipes) as process:
        assert process.stdout is not None
        assert process.stdout.readline() == "takes\n"
        process.send_signal(signal.SIGSTOP)
        time.sleep(6.0)
        process.send_signal(signal.SIGCONT)
        assert process.communicate("\n", timeout=cells.PATIENCE_S)[0] == ""


UNHEARD = """
import sys
from concurrent.futures import ThreadPoolExecutor
from coupole.acquisition import signals
from coupole import bounded
from coupole.acquisition.signals import raise_outside_sessions, unheard_end
bounded.STOPPED_S = signals._LEAVES_WITHIN_S = 0.3
raise_outside_sessions()
with unheard_end():
    print("hangs", flush=True)
    import ctypes
    mutex = ctypes.create_string_buffer(64)
    def hang():
        for _ in range(2):  # the second lock never returns, and no signal ends it, as with a dead disk
            ctypes.CDLL(None).pthread_mutex_lock(mutex)
    if sys.argv[1] == "main thread":
        hang()
    with ThreadPoolExecutor(1) as pool:
        pool.submit(hang).result()
"""


@pytest.mark.parametrize("what", ["main thread", "thread that the main thread joins"])
def test_a_signal_ends_a_process_that_waits_for_what_never_returns(what: str) -> None:
    command = [sys.executable, "-c", UNHEARD, what]
    with subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True) as process:
        assert process.stdout is not None
        assert process.stdout.readline() == "hangs\n"
        time.sleep(0.2)
        process.send_signal(signal.SIGTERM)
        assert process.wait(60) == 128 + signal.SIGTERM
        assert process.stderr is not None
        assert "waited in a call that does not return" in process.stderr.read()
