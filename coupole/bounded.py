"""Every wait ends: a call that never returns is reported and given up.

A library may hang in a call, or a network disk may be dead. A thread that waits there cannot be ended, neither by
a signal nor by another thread. So work that may hang runs in a thread that nobody needs (`run_bounded`). Each call
of a device or a disk notes that it is under way (`under_way`); this takes a microsecond and passes nothing to
another thread. The waiting side looks at these notes. It gives up a call that is under way for longer than its
work needs plus

==================  =========================================
`DEVICE_S`          a call of a device
`DISK_S`            a call of a disk
`STOPPED_S`         either, once the session is to end
==================  =========================================

on the machine's clock. This is longer than the time-outs of drivers and kernels, whose messages are better. Calls
that are left behind (`left_behind`) cannot be ended. Their process ends by `os._exit` (`leave`), after all
messages are written.
"""

from __future__ import annotations

import ctypes
import math
import os
import queue
import sys
import threading
import time
from collections import deque
from collections.abc import Callable, Iterator
from concurrent.futures import Future
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from typing import Any, Generic, NoReturn, TypeVar

from coupole.errors import CoupoleError, DeviceTimeout, StorageError

DEVICE_S, DISK_S, STOPPED_S = 30.0, 60.0, 15.0
_MOST_S = 120.0
"""A session that is to end is left behind after this time, even if all its calls return."""
_LOOK_S, _STOOD_S = 0.1, 1.0
_BACK_S = 1.0
"""Time for a call to return after the cell was made safe, or after the waiting thread was interrupted."""
_FLUSH_S = 2.0
DISK = "disk"

T = TypeVar("T")


# -- calls under way ------------------------------------------------------------------------------------------


@dataclass(eq=False, slots=True)
class Call:
    """A call of a device (by its name in errors) or of the `DISK`. It is noted while its context lasts."""

    of: str
    operation: str
    work_s: float = 0.0
    """Time that the work itself may take if nothing fails."""
    since_s: float = 0.0

    def __enter__(self) -> Call:
        if threading.get_ident() not in _BY_OTHERS:
            self.since_s = time.monotonic()
            _UNDER_WAY[self] = None
        return self

    def __exit__(self, *_: object) -> None:
        _UNDER_WAY.pop(self, None)

    def goes_on(self) -> None:
        """Note that a part of the slow work is done: the time of the call begins again."""
        self.since_s = time.monotonic()

    def end_s(self, stopped_s: float) -> float:
        """Return the monotonic time when the call is given up. The session is to end since `stopped_s`."""
        disk = self.of == DISK
        end_s = self.since_s + self.work_s + (DISK_S if disk else DEVICE_S)
        return min(end_s, max(self.since_s, stopped_s) + STOPPED_S + (min(self.work_s, DISK_S) if disk else 0.0))

    def error(self) -> CoupoleError:
        lasts_s = time.monotonic() - self.since_s
        if self.of == DISK:
            return StorageError(
                f"{self.operation}: the disk has not answered for {lasts_s:.0f} s. Check it (a network disk: its "
                "server and the network), then resume the run."
            )
        return DeviceTimeout(
            self.of,
            expected=f"the call `{self.operation}` to return",
            happened=f"it has not returned for {lasts_s:.0f} s; the program no longer waits for it",
            remedy="Switch the device off and on, then resume the run; if this happens again, report it with the "
            "versions of the device's library and firmware.",
        )


_UNDER_WAY: dict[Call, None] = {}
_BY_OTHERS: set[int] = set()
_looked_s = deque([0.0], maxlen=1)
_LEFT: list[threading.Thread | Call] = []


under_way = Call
"""`with under_way("camera", "arm"):` notes a call while its context lasts."""


@contextmanager
def waited_for() -> Iterator[None]:
    """Do not note calls of this thread, because another thread waits for it with a limit of its own."""
    _BY_OTHERS.add(threading.get_ident())
    try:
        yield
    finally:
        _BY_OTHERS.discard(threading.get_ident())


def overdue(since_s: float, stopped_s: float = math.inf) -> Call | None:
    """Return a call that began since then and is to be given up. The time in which this process stood still is
    not counted.
    """
    now_s = time.monotonic()
    looked_s = _looked_s[-1]
    _looked_s.append(now_s)
    if now_s - looked_s > _STOOD_S:
        for call in list(_UNDER_WAY):
            call.since_s = min(now_s, call.since_s + now_s - looked_s)
    late = (call for call in list(_UNDER_WAY) if call.since_s >= since_s and now_s > call.end_s(stopped_s))
    return next(late, None)


def refuse_overdue(since_s: float) -> None:
    """Raise DeviceTimeout or StorageError for a call that is given up. This is for threads that wait for something
    else."""
    if call := overdue(since_s):
        leave_behind(call)
        raise call.error()


def hangs(of: str) -> str:
    """Return the call of this device, or of the `DISK`, that was left behind and is still under way; empty if
    there is none."""
    return next((call.operation for call in list(_UNDER_WAY) if call.of == of), "") if left_behind() else ""


# -- whoever may hang -----------------------------------------------------------------------------------------


class _GivenUp(BaseException):
    """Raised in a thread for which nobody waits any more."""


class _Runner(Generic[T]):
    """Does work in a thread of its own."""

    def __init__(self, do: Callable[[], T], discard: Callable[[T], object]) -> None:
        self._do, self._unwanted = do, discard
        self._done: Future[T] = Future()
        self._lock = threading.Lock()
        self.is_left = False
        self.thread = threading.Thread(target=self._run, name="bounded", daemon=True)
        self.thread.start()

    def _run(self) -> None:
        try:
            outcome = self._do()
        except BaseException as error:  # noqa: BLE001  raised again in the thread that waits
            self._done.set_exception(error)
            return
        with self._lock:
            if not self.is_left:
                self._done.set_result(outcome)
                return
        with suppress(Exception):
            self._unwanted(outcome)

    def has_ended(self, within_s: float) -> bool:
        with suppress(TimeoutError):
            self._done.exception(within_s)
        return self._done.done()

    def leave(self) -> bool:
        """Stop waiting for the call, which is then left behind. Returns False if it has just ended."""
        with self._lock:
            self.is_left = not self._done.done()
        if self.is_left:
            _LEFT.append(self.thread)
        return self.is_left

    def interrupt(self) -> None:
        """End the thread at its next step of Python, as a signal would end the thread that waits for it."""
        ident = self.thread.ident
        if ident is not None and not self._done.done():
            ctypes.pythonapi.PyThreadState_SetAsyncExc(ctypes.c_ulong(ident), ctypes.py_object(_GivenUp))

    def result(self) -> T:
        return self._done.result()


def run_bounded(
    do: Callable[[], T],
    *,
    stop: threading.Event | None = None,
    rescue: Callable[[], object] = lambda: None,
    discard: Callable[[T], object] | None = None,
    since_s: float | None = None,
) -> T:
    """Run `do` in a thread of its own, and wait until it has ended or a call is given up. Errors of `do` are
    raised here. `stop` says that `do` is to end. `rescue` is called before a call is given up, and may make the
    call return. A late result is passed to `discard`; without `discard` the thread ends as soon as its call
    returns. Only calls that begin from now on, or from `since_s` on, are watched.

    Raises DeviceTimeout or StorageError for a call that is given up, and the error of a signal.
    """
    since_s = time.monotonic() if since_s is None else since_s
    stopped_s = math.inf
    runner = _Runner(do, discard or (lambda found: None))
    try:
        while not runner.has_ended(_LOOK_S):
            if stop is not None and stop.is_set():
                stopped_s = min(stopped_s, time.monotonic())
            call = overdue(since_s, stopped_s)
            if call is None and time.monotonic() > stopped_s + _MOST_S:
                call = Call("cell", "session", 0.0, stopped_s)
            if call is not None:
                rescue()
                if not runner.has_ended(_BACK_S) and runner.leave():
                    leave_behind(call)
                    if discard is None:
                        runner.interrupt()
                    raise call.error()
    except BaseException:
        if not runner.is_left:  # a signal, here
            runner.interrupt()
            if not runner.has_ended(_BACK_S):
                runner.leave()
        raise
    return runner.result()


NOW = threading.Event()
"""Event that is always set, for `stop` of work at the end of a session."""
NOW.set()


def on_disk(label: str, do: Callable[[], T], work_s: float = 0.0, *, stop: threading.Event | None = None) -> T:
    """`run_bounded` for work with files."""

    def work() -> T:
        with under_way(DISK, label, work_s):
            return do()

    return run_bounded(work, stop=stop)


class Workers:
    """Threads that take work in turn. They do not keep a process alive, unlike the threads of
    concurrent.futures."""

    def __init__(self, count: int, name: str) -> None:
        self._queue: queue.SimpleQueue[tuple[Future[Any], Callable[..., Any], tuple[Any, ...]] | None]
        self._queue = queue.SimpleQueue()
        self._count, self._name = count, name
        self._threads: list[threading.Thread] = []

    def submit(self, do: Callable[..., T], *arguments: Any) -> Future[T]:
        if len(self._threads) < self._count:
            self._threads.append(threading.Thread(target=self._work, name=self._name, daemon=True))
            self._threads[-1].start()
        future: Future[T] = Future()
        self._queue.put((future, do, arguments))
        return future

    def _work(self) -> None:
        while (task := self._queue.get()) is not None:
            future, do, arguments = task
            try:
                future.set_result(do(*arguments))
            except BaseException as error:  # noqa: BLE001  raised again where the result is asked for
                future.set_exception(error)
            del task, future, do, arguments  # they may hold a frame's memory

    def end(self) -> None:
        """Wait until all work is done, and end the threads. Call this within `run_bounded` if the work may
        hang."""
        threads = self._threads
        self.end_soon()
        for thread in threads:
            thread.join()

    def end_soon(self) -> None:
        """End the threads once all work is done, without waiting for this."""
        for _ in self._threads:
            self._queue.put(None)
        self._threads = []


# -- the last way out -----------------------------------------------------------------------------------------


def leave_behind(waited_for: threading.Thread | Call) -> None:
    """Note that this thread or call was given up."""
    _LEFT.append(waited_for)


def left_behind() -> bool:
    """Tell whether a thread or call that was given up still hangs."""
    return any(leftover in _UNDER_WAY if isinstance(leftover, Call) else leftover.is_alive() for leftover in _LEFT)


def leave(code: int) -> NoReturn:
    """End the process: normally if nothing was left behind, otherwise at once, after all messages that can be read
    are written."""
    if left_behind():
        saying = threading.Thread(target=_flush, daemon=True)
        saying.start()
        saying.join(_FLUSH_S)
        os._exit(code)
    sys.exit(code)


def _flush() -> None:
    for stream in (sys.stdout, sys.stderr):
        with suppress(OSError, ValueError, AttributeError):
            stream.flush()
