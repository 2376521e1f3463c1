"""Signals that end a session (Ctrl-C, SIGTERM, and SIGHUP when the terminal is gone), and signals that stop its
process.

Outside a session they raise `SignalReceived` in the main thread, again if Python drops it (`unheard_end`), and
not before code that an exception would leave broken has ended (`_BREAKABLE`). In a
session (`obeyed_by`) a thread of their own obeys them at once, whatever the main thread waits for. The main thread
learns of them from `Control`. While a cell is made safe (`drop_signals`) they do nothing, so that a second Ctrl-C
does not cut it short.

Ctrl-Z (SIGTSTP) makes the cell safe before the process stops. A process cannot notice SIGSTOP, or the machine's
sleep, in advance. When it runs again, the session is held, and a person is asked (`Control.hold`).
"""

from __future__ import annotations

import math
import os
import select
import signal
import sys
import threading
import time
from collections import deque
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from functools import partial
from types import FrameType
from typing import Any

from coupole import bounded
from coupole.acquisition.observer import Control, frozen
from coupole.acquisition.safeguard import Safeguard, unsure
from coupole.supervision import ASKS_FROM_S
from coupole.viewing.text_outlet import say_now

Act = Callable[[], Sequence["Safeguard | str"]]
ENDING = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)
_heard_s = deque([-math.inf], maxlen=1)
"""Time when the main thread last received a signal, outside sessions."""

_raised_s = deque([-math.inf], maxlen=1)
"""Time when a SignalReceived was last raised."""
_raised_number = deque([0], maxlen=1)
"""Number of the first signal that was raised outside sessions; 0 for none. A session that begins afterwards obeys
it: other people's code has caught the exception (a bare `except` around an import, say)."""
_SAME_S = 1.0
"""Outside a session, two signals within this time count as one request, because a terminal that closes may send
two. The later signal is dropped, because an exception within the handling of the first signal would hide the
first."""

_PULSE_S, _TOLD_WITHIN_S = 0.25, 0.1
_AGAIN_AFTER_S = 0.02
"""Time after which a signal that Python has dropped, or that came within `_BREAKABLE` code, is sent again."""
_BREAKABLE = "llvmlite"
"""Package in whose code no signal raises. It frees LLVM's objects by hand: an exception between a call of LLVM and
the line that notes that it has taken an object frees the object twice, and the process crashes. numba uses it to
compile."""
_LEAVES_WITHIN_S = 300.0
"""The closing of hanging devices and the writing of a report take less time."""
_STOPS_WITHIN_S = 0.1
"""A process that stops itself may run on for a moment. This allowance keeps the time of the stop from counting as
a freeze."""
_SAFE_WITHIN_S = 4.0
"""Ctrl-Z stops the process after this time even if the cell is perhaps not safe; a message says so."""


class SignalReceived(BaseException):
    """One of `ENDING`, outside a session. It is not a KeyboardInterrupt, because typer would give exit code 130
    for each signal."""

    def __init__(self, number: int) -> None:
        super().__init__(number)
        self.number = number


def raise_outside_sessions() -> None:
    """Have each signal raise SignalReceived from now on. A hang-up that is ignored (`nohup`) stays ignored. Ctrl-C
    and SIGTERM always count, even in the background of a script."""
    _raised_s.append(-math.inf)
    _raised_number.append(0)
    for number in ENDING:
        if not _stays_ignored(number):
            signal.signal(number, _raise)


def ignore_from_now() -> None:
    """Ignore signals from now on, because the process is about to exit with the code of a failure or of an earlier
    signal."""
    _raised_number.append(0)
    for number in ENDING:
        signal.signal(number, signal.SIG_IGN)


def exit_from_now() -> None:
    """Have each signal end the process at once with its code from now on. All is done, but a script must not go on
    after the signal."""
    for number in ENDING:
        if not _stays_ignored(number):
            signal.signal(number, lambda number, _: os._exit(128 + number))


def signal_behind(error: BaseException) -> SignalReceived | None:
    """Return the SignalReceived that caused an error, if there is one. Compiled code that is interrupted raises a
    SystemError in its place; other people's code may raise an error of its own."""
    causes: list[BaseException] = []
    cause: BaseException | None = error
    while cause is not None and cause not in causes:
        if isinstance(cause, SignalReceived):
            return cause
        causes.append(cause)
        cause = cause.__cause__ or cause.__context__
    return SignalReceived(_raised_number[0]) if _raised_number[0] else None


def _stays_ignored(number: int) -> bool:
    return number == signal.SIGHUP and signal.getsignal(number) is signal.SIG_IGN


def _raise(number: int, frame: FrameType | None) -> None:
    now_s = time.monotonic()
    _heard_s.append(now_s)
    if _is_within(_BREAKABLE, frame):
        _send_later(number)
    elif now_s > _raised_s[-1] + _SAME_S:
        _raised_s.append(now_s)
        _raised_number.append(_raised_number[0] or number)
        raise SignalReceived(number)


def _is_within(package: str, frame: FrameType | None) -> bool:
    """Tell whether a function of a package is under way in the thread of a frame."""
    while frame is not None:
        if str(frame.f_globals.get("__name__", "")).partition(".")[0] == package:
            return True
        frame = frame.f_back
    return False


def _send_later(number: int) -> None:
    """Send a signal to this process a moment later, and thus elsewhere in the main thread."""
    threading.Timer(_AGAIN_AFTER_S, os.kill, (os.getpid(), number)).start()


def _drop(number: int, _: Any) -> None:
    _heard_s.append(time.monotonic())


@contextmanager
def unheard_end() -> Iterator[None]:
    """End the process after a signal outside sessions even if the main thread hangs; nothing shines or moves then.
    The process ends if the main thread has not received the signal after `STOPPED_S`, because a call never returns
    (a dead network disk). It also ends if the main thread is still there `_LEAVES_WITHIN_S` after the signal,
    because it waits for a thread that hangs.

    Python prints and drops an exception that is raised in a finalizer, or in the callback of a weak reference;
    there are some while modules are imported. A `SignalReceived` that was dropped is sent again as its signal."""
    if threading.current_thread() is not threading.main_thread():
        yield
        return
    read_fd, write_fd = os.pipe()
    os.set_blocking(write_fd, False)
    before = signal.set_wakeup_fd(write_fd, warn_on_full_buffer=False)
    hook_before = sys.unraisablehook
    sys.unraisablehook = partial(_send_again, hook_before)
    threading.Thread(target=_end_unheard, args=(read_fd,), name="unheard signals", daemon=True).start()
    try:
        yield
    finally:
        sys.unraisablehook = hook_before
        signal.set_wakeup_fd(before)
        os.close(write_fd)


def _send_again(otherwise: Callable[[Any], object], dropped: Any) -> None:
    """Send the signal behind an exception that Python drops again. `otherwise` gets all other exceptions."""
    if isinstance(dropped.exc_value, SignalReceived):
        _raised_s.append(-math.inf)
        _send_later(dropped.exc_value.number)
    else:
        otherwise(dropped)


def _end_unheard(read_fd: int) -> None:
    number, since_s, heard_s = 0, math.inf, math.inf
    while True:
        if select.select([read_fd], [], [], _PULSE_S)[0]:
            if not (numbers := os.read(read_fd, 64)):
                os.close(read_fd)
                return
            if since_s == math.inf and (ending := [signum for signum in numbers if signum in ENDING]):
                number, since_s = ending[0], time.monotonic()
        if _heard_s[-1] > since_s - ASKS_FROM_S:  # the handler may have been faster than this thread
            heard_s, since_s = min(heard_s, since_s), math.inf
        if time.monotonic() > heard_s + _LEAVES_WITHIN_S or time.monotonic() > since_s + bounded.STOPPED_S:
            _tell("the program waited in a call that does not return (perhaps to a disk), and was ended\n")
            os._exit(128 + number)


@contextmanager
def drop_signals() -> Iterator[None]:
    """Drop signals that arrive within the context, because the caller is ending the session already."""
    with _handlers(dict.fromkeys(ENDING, _drop)):
        yield


@contextmanager
def obeyed_by(control: Control, act: Act, *, is_watched: bool = True) -> Iterator[None]:
    """Obey signals. A signal that ends the session sets `control.stop` and calls `act` at once, in another thread.
    A signal that was raised before the session, and did not end the program, counts too.
    SIGUSR1 pauses the session or continues it. Ctrl-Z calls `act`, stops the process, and holds the session. `act`
    begins to make the cell safe. It returns its `Safeguard`s, and sentences on devices that are perhaps not safe.

    Without `is_watched` another process watches the arm and the lamps. A freeze of this process then causes no
    hold.

    Signals are delivered to Python's main thread only between two of its steps, and a disk or a device may hold it
    for seconds within one. The interpreter writes each signal's number to a pipe without delay; a thread reads it.
    """
    if threading.current_thread() is not threading.main_thread():
        yield
        return
    read_fd, write_fd = os.pipe()
    os.set_blocking(write_fd, False)

    obey = partial(_obey, read_fd, control, act, is_watched=is_watched)
    thread = threading.Thread(target=obey, name="signals", daemon=True)
    before = signal.set_wakeup_fd(write_fd, warn_on_full_buffer=False)
    thread.start()
    try:
        with _handlers(
            {number: lambda number, _: control.stop_by(number) for number in ENDING}
            | {signal.SIGUSR1: lambda *_: control.toggle_pause()}
            | {number: lambda *_: None for number in (signal.SIGTSTP, signal.SIGCONT)}
        ):
            if _raised_number[0]:
                control.stop_by(_raised_number[0])
                act()
            yield
    finally:
        signal.set_wakeup_fd(before)
        os.close(write_fd)
        thread.join()
        os.close(read_fd)
        control.pulse_s = math.inf


def _obey(read_fd: int, control: Control, act: Act, *, is_watched: bool) -> None:
    """Obey the signals whose numbers come through a pipe, until the pipe is closed. Also record again and again
    that the process runs."""
    has_acted, stood_s, noticed_s = False, 0.0, 0.0
    slept_s = _slept_s()
    control.pulse_s = time.monotonic()
    while True:
        ready = select.select([read_fd], [], [], _PULSE_S)[0]
        now_s = time.monotonic()
        silent_s, control.pulse_s = now_s - control.pulse_s, now_s
        if silent_s > ASKS_FROM_S:  # SIGCONT may be heard a moment later; without it the machine was only busy
            stood_s = silent_s
            control.stood_at_s = noticed_s = now_s
        if (asleep_s := _slept_s() - slept_s) > ASKS_FROM_S:
            slept_s += asleep_s
            if is_watched:
                _hold(control, act, frozen(asleep_s))
        if not ready:
            continue
        if not (numbers := os.read(read_fd, 64)):
            return
        for number in numbers:
            if number in ENDING and not has_acted:  # whether or not the main thread's handler was first
                has_acted = True
                control.stop_by(number)
                act()
            elif number == signal.SIGTSTP:
                _suspend(control, act)
            elif number == signal.SIGCONT and stood_s and now_s - noticed_s < ASKS_FROM_S:
                if is_watched:
                    _hold(control, act, frozen(stood_s))
                stood_s = 0.0


def _slept_s() -> float:
    """Return for how long this machine has slept since it started."""
    return time.clock_gettime(time.CLOCK_BOOTTIME) - time.clock_gettime(time.CLOCK_MONOTONIC)


def _hold(control: Control, act: Act, why: str) -> None:
    """Hold the session: switch the lights off and bring the arm to rest."""
    control.halting.set()
    try:
        control.hold(why)
        answer = act()
        words = [told for told in answer if isinstance(told, str)]
        safeguards = [told for told in answer if isinstance(told, Safeguard)]
        control.unsure = [*words, *unsure(safeguards, _SAFE_WITHIN_S)]
    finally:
        control.halting.clear()


def _suspend(control: Control, act: Act) -> None:
    """Obey Ctrl-Z: first make the cell safe, then stop the process. When it goes on, ask a person."""
    _hold(control, act, "suspended by Ctrl-Z: the lights were switched off and the arm was stopped first")
    state = "; ".join(control.unsure) or "lights are off, the arm is at rest"
    then = "the run then asks" if control.can_stand else "which then ends"
    _tell(f"\n{state}; suspended (`fg` continues the program, {then})\n")
    os.kill(os.getpid(), signal.SIGSTOP)
    time.sleep(_STOPS_WITHIN_S)
    control.pulse_s = time.monotonic()


def _tell(text: str) -> None:
    """Write to the terminal, if it takes the text within a moment. The queue of messages cannot be used, because
    the process is about to stop."""
    say_now(text, _TOLD_WITHIN_S)


@contextmanager
def _handlers(new_handlers: dict[signal.Signals, Any]) -> Iterator[None]:
    """Set these handlers in the main thread, and restore the former handlers at the end."""
    if threading.current_thread() is not threading.main_thread():
        yield
        return
    new_handlers = {number: handler for number, handler in new_handlers.items() if not _stays_ignored(number)}
    before = {number: signal.signal(number, handler) for number, handler in new_handlers.items()}
    try:
        yield
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)
