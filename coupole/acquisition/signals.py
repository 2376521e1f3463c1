"""Signals that end a session: Ctrl-C, SIGTERM, and SIGHUP when the terminal is gone.

Outside a session they raise `SignalReceived` in the main thread. In a session (`obeyed_by`) they are obeyed at
once from a thread of their own, whatever the main thread waits for, and the main thread learns of it from
`Control`. While a cell is made safe (`held`) they do nothing, so that a second Ctrl-C does not cut it short.
"""

from __future__ import annotations

import os
import signal
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any

from coupole.acquisition.observer import Control

ENDING = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)


class SignalReceived(BaseException):
    """One of `ENDING`, outside a session. No KeyboardInterrupt: typer would make exit code 130 of each."""

    def __init__(self, number: int) -> None:
        super().__init__(number)
        self.number = number


def raise_outside_sessions() -> None:
    """Have each signal raise SignalReceived from now on. A hang-up that is ignored (`nohup`) stays so; Ctrl-C and
    SIGTERM always count, also in the background of a script."""
    for number in ENDING:
        if not _stays_ignored(number):
            signal.signal(number, _raise)


def _stays_ignored(number: int) -> bool:
    return number == signal.SIGHUP and signal.getsignal(number) is signal.SIG_IGN


def _raise(number: int, _: Any) -> None:
    raise SignalReceived(number)


@contextmanager
def held() -> Iterator[None]:
    """What arrives within is dropped: whoever uses this is ending the session already."""
    with _handlers(dict.fromkeys(ENDING, lambda *_: None)):
        yield


@contextmanager
def obeyed_by(control: Control, act: Callable[[], object]) -> Iterator[None]:
    """A signal that ends the session sets `control.stop` and calls `act` at once, in another thread; SIGUSR1
    pauses the session or continues it.

    Signals are delivered to Python's main thread only between two of its steps, and a disk or a device may hold it
    for seconds within one. The interpreter writes each signal's number to a pipe without delay; a thread reads it.
    """
    if threading.current_thread() is not threading.main_thread():
        yield
        return
    ours, pythons = os.pipe()
    os.set_blocking(pythons, False)

    def obey() -> None:
        acted = False
        while numbers := os.read(ours, 64):
            for number in numbers:
                if number in ENDING and not acted:  # whether or not the main thread's handler was first
                    acted = True
                    control.stop_by(number)
                    act()

    thread = threading.Thread(target=obey, name="signals", daemon=True)
    before = signal.set_wakeup_fd(pythons, warn_on_full_buffer=False)
    thread.start()
    try:
        with _handlers(
            {number: lambda number, _: control.stop_by(number) for number in ENDING}
            | {signal.SIGUSR1: lambda *_: control.toggle_pause()}
        ):
            yield
    finally:
        signal.set_wakeup_fd(before)
        os.close(pythons)
        thread.join()
        os.close(ours)


@contextmanager
def _handlers(wanted: dict[signal.Signals, Any]) -> Iterator[None]:
    """These handlers, in the main thread; the former ones at the end."""
    if threading.current_thread() is not threading.main_thread():
        yield
        return
    wanted = {number: handler for number, handler in wanted.items() if not _stays_ignored(number)}
    before = {number: signal.signal(number, handler) for number, handler in wanted.items()}
    try:
        yield
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)
