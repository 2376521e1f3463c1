"""Signals that end a session are obeyed at once, whatever the main thread is in."""

from __future__ import annotations

import contextlib
import ctypes
import os
import signal
import subprocess
import sys
import threading
import time
import weakref
from collections.abc import Iterator

import cells
import pytest
from llvmlite.binding.ffi import OutputString

from coupole.acquisition.observer import Control
from coupole.acquisition.signals import (
    ENDING,
    SignalReceived,
    drop_signals,
    obeyed_by,
    raise_outside_sessions,
    signal_behind,
    unheard_end,
)
from coupole.errors import Interrupted


@pytest.fixture(autouse=True)
def as_in_a_terminal() -> Iterator[None]:
    """Whoever runs the tests may have ignored a signal."""
    before = {number: signal.signal(number, signal.SIG_DFL) for number in ENDING}
    yield
    raise_outside_sessions()  # forgets what a test has received
    for number, handler in before.items():
        signal.signal(number, handler)


@pytest.mark.parametrize("number", ENDING)
def test_a_session_obeys_while_the_main_thread_is_held_by_a_call(number: signal.Signals) -> None:
    """The call is one that a signal does not end, as of a disk that stands still: here it ends by what the session
    does."""
    control = Control()
    held_fd, act_fd = os.pipe()
    sender = threading.Timer(0.1, os.kill, (os.getpid(), number))
    in_vain = threading.Timer(cells.PATIENCE_S, os.write, (act_fd, b"waited in vain"))

    def act() -> tuple[()]:
        os.write(act_fd, b"acted")
        return ()

    with obeyed_by(control, act):
        blocked = signal.pthread_sigmask(signal.SIG_BLOCK, {number})  # so that another thread takes the signal
        try:
            sender.start()
            in_vain.start()
            happened = ctypes.create_string_buffer(20)
            ctypes.CDLL(None).read(held_fd, happened, 20)
        finally:
            signal.pthread_sigmask(signal.SIG_SETMASK, blocked)
            in_vain.cancel()
    os.close(held_fd)
    os.close(act_fd)
    assert happened.value == b"acted"
    with pytest.raises(Interrupted) as stopped:
        control.go_on()
    assert stopped.value.exit_code == 128 + number


class _Collected:
    """Something that is collected."""


def test_a_signal_that_python_drops_is_raised_again() -> None:
    """As while modules are imported: an exception in the callback of a weak reference is printed and forgotten."""
    something = _Collected()
    watched = weakref.ref(something, lambda _: signal.raise_signal(signal.SIGTERM))
    with unheard_end():
        raise_outside_sessions()
        del something
        assert watched() is None
        with pytest.raises(SignalReceived) as received:
            time.sleep(10.0)
    assert received.value.number == signal.SIGTERM


def test_a_signal_that_python_drops_ends_the_session_that_has_begun_meanwhile() -> None:
    something, control, acted = _Collected(), Control(), threading.Event()
    watched = weakref.ref(something, lambda _: signal.raise_signal(signal.SIGTERM))
    with unheard_end():
        raise_outside_sessions()
        del something
        with obeyed_by(control, acted.set):
            assert watched() is None
            assert acted.wait(10.0)
            for thread in threading.enumerate():
                if isinstance(thread, threading.Timer):
                    thread.join()  # it sends the signal again, which must not meet the next test
    with pytest.raises(Interrupted):
        control.go_on()


def test_a_signal_that_other_code_swallows_ends_the_session_that_has_begun_meanwhile() -> None:
    """A library catches all exceptions, around an import, say."""
    control, acted = Control(), threading.Event()
    raise_outside_sessions()
    with contextlib.suppress(BaseException):
        signal.raise_signal(signal.SIGTERM)
    with obeyed_by(control, lambda: acted.set() or ()):
        assert acted.is_set()
    with pytest.raises(Interrupted) as stopped:
        control.go_on()
    assert stopped.value.exit_code == 143


def test_other_exceptions_that_python_drops_are_told_as_before(monkeypatch: pytest.MonkeyPatch) -> None:
    told: list[str] = []
    monkeypatch.setattr(sys, "unraisablehook", lambda dropped: told.append(str(dropped.exc_value)))
    something = _Collected()
    watched = weakref.ref(something, lambda _: {}["a defect"])
    with unheard_end():
        del something
    assert (watched(), told) == (None, ["'a defect'"])


def test_a_session_obeys_though_the_main_threads_handler_was_first() -> None:
    """Whichever hears of the signal first: the lights go off and the arm stops at once."""
    control, acted = Control(), threading.Event()
    with obeyed_by(control, acted.set):
        control.stop_by(signal.SIGTERM)
        signal.raise_signal(signal.SIGTERM)
        assert acted.wait(10.0)


def test_the_first_signal_counts() -> None:
    control = Control()
    control.stop_by(signal.SIGTERM)
    control.stop_by(signal.SIGINT)
    assert control.interruption().exit_code == 143


def test_sigusr1_pauses_and_continues_and_stops_nothing() -> None:
    control, acts = Control(), []
    with obeyed_by(control, lambda: acts.append(1)):
        os.kill(os.getpid(), signal.SIGUSR1)
        assert control.pause.wait(5.0)
        os.kill(os.getpid(), signal.SIGUSR1)
        assert not control.pause.is_set()
    assert not control.stop.is_set()
    assert acts == []


@pytest.mark.parametrize("number", ENDING)
def test_outside_sessions_a_signal_raises_and_after_one_again(number: signal.Signals) -> None:
    for _ in range(2):
        raise_outside_sessions()
        with pytest.raises(SignalReceived) as received:
            os.kill(os.getpid(), number)
        assert received.value.number == number
        with obeyed_by(Control(), lambda: None):
            os.kill(os.getpid(), number)
        with drop_signals():
            os.kill(os.getpid(), number)


def test_a_signal_within_llvmlite_is_raised_only_afterwards() -> None:
    """An exception in `close`, between the call that frees a text and the line that notes it, frees the text
    twice. That crashed 2 of 14 processes in which 25 such signals came while numba compiled."""
    raise_outside_sessions()
    text, has_closed = OutputString(), threading.Event()

    def close() -> None:
        signal.raise_signal(signal.SIGTERM)
        time.sleep(0.1)  # the signal is sent again meanwhile, in vain
        has_closed.set()

    def close_and_wait() -> None:
        text.__exit__(None, None, None)
        del text.close
        time.sleep(10.0)

    text.close = close
    with pytest.raises(SignalReceived) as received:
        close_and_wait()
    assert has_closed.is_set()
    assert received.value.number == signal.SIGTERM


def test_a_second_signal_at_once_is_the_same_wish() -> None:
    """A terminal that closes may send two; an exception within the handling of the first would hide it."""
    raise_outside_sessions()
    with pytest.raises(SignalReceived) as received:
        signal.raise_signal(signal.SIGTERM)
    signal.raise_signal(signal.SIGHUP)
    assert received.value.number == signal.SIGTERM


def test_a_signal_within_compiled_code_is_known_behind_its_error() -> None:
    """numba calls back into Python; an exception there comes out of the compiled code as a SystemError."""
    error = SystemError("returned a result with an exception set")
    error.__cause__ = SignalReceived(signal.SIGTERM)
    behind = signal_behind(error)
    assert behind is not None
    assert behind.number == signal.SIGTERM
    raise_outside_sessions()
    assert signal_behind(ValueError("a defect")) is None


def test_a_signal_that_other_code_answers_with_an_error_of_its_own_is_known_behind_it() -> None:
    raise_outside_sessions()
    with contextlib.suppress(SignalReceived):
        signal.raise_signal(signal.SIGTERM)
    behind = signal_behind(ImportError("cannot import a library"))
    assert behind is not None
    assert behind.number == signal.SIGTERM


LEAVES = """
import os, signal, sys
from coupole.acquisition.signals import exit_from_now, ignore_from_now, raise_outside_sessions
raise_outside_sessions()
exit_from_now() if sys.argv[1] == "0" else ignore_from_now()
os.kill(os.getpid(), signal.SIGTERM)
sys.exit(int(sys.argv[1]))
"""


@pytest.mark.parametrize(("code", "ends_with"), [(0, 143), (4, 4), (129, 129)])
def test_a_signal_in_the_last_moment_stops_a_script_and_hides_no_failure(code: int, ends_with: int) -> None:
    ended = subprocess.run([sys.executable, "-c", LEAVES, str(code)], check=False)
    assert ended.returncode == ends_with


def test_a_hang_up_that_is_ignored_stays_ignored() -> None:
    control = Control()
    signal.signal(signal.SIGHUP, signal.SIG_IGN)
    raise_outside_sessions()
    with obeyed_by(control, lambda: None):
        os.kill(os.getpid(), signal.SIGHUP)
    assert not control.stop.is_set()
