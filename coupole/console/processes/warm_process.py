"""A separate process for computations, forked from a process that has already imported the modules that plans
need.

The process and its loaded kernels stay for the next job. It ends with the console, also if the console is killed.
"""

from __future__ import annotations

import contextlib
import multiprocessing
import os
import signal
import threading
from collections.abc import Callable
from concurrent.futures import CancelledError, Future, ProcessPoolExecutor
from concurrent.futures.process import BrokenProcessPool
from multiprocessing.sharedctypes import RawArray
from typing import Any, ParamSpec, TypeVar

from coupole.errors import InputError

P = ParamSpec("P")
T = TypeVar("T")
_IMPORTED = [
    "coupole.preflight.checking",
    "coupole.viewing.preflight_table",
    "coupole.viewing.terminal",
    "coupole.scan.mesh",
    "scipy.spatial",
]
_LONGEST_STEP = 200
_steps: list[Any] = []
"""Memory in which a worker reports its step; empty outside a worker."""


def say(step: str) -> None:
    """Report the present step to the waiting process; no effect outside a worker."""
    for place in _steps:
        place.value = step.encode()[: _LONGEST_STEP - 1]


def _begin(step: Any, niceness: int) -> None:
    """Prepare a worker: it ends with the console, and it ignores Ctrl-C, which is for the console."""
    threading.Thread(target=_end_with_console, daemon=True).start()
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    os.nice(niceness)
    _steps.append(step)


def _end_with_console() -> None:
    console = multiprocessing.parent_process()
    assert console is not None
    console.join()
    os.kill(os.getpid(), signal.SIGKILL)


class WarmProcess:
    """One process, which does one job after the other. If it dies or is ended, a new one is begun."""

    def __init__(self, activity: str) -> None:
        """`activity` describes the process in messages, such as `reads plans`."""
        self._what, self._lock = activity, threading.Lock()
        self._context = multiprocessing.get_context("forkserver")
        self._context.set_forkserver_preload(_IMPORTED)
        self._step = RawArray("c", _LONGEST_STEP)
        self._pool: ProcessPoolExecutor | None = None
        self._niceness = 0

    @property
    def step(self) -> str:
        """The last step that the process has reported."""
        return bytes(self._step.value).decode(errors="replace")

    def run(
        self, work: Callable[P, T], within_s: float, niceness: int = 0, *args: P.args, **kwargs: P.kwargs
    ) -> T:
        """Run work in the process and return its result. Raises InputError if it takes too long, or if the process
        dies or is ended; otherwise the errors of the work."""
        self._step.value = b""
        pool, future = self._submit(niceness, work, *args, **kwargs)
        try:
            return future.result(within_s)
        except TimeoutError as error:
            if future.done():
                raise
            self.end()
            raise InputError(
                f"the process that {self._what} was not done within {within_s:g} s, and was ended"
            ) from error
        except (BrokenProcessPool, CancelledError) as error:
            if self._pool is not pool:
                raise InputError(f"the process that {self._what} was ended") from error
            self.end()
            raise InputError(
                f"the process that {self._what} died while it worked on this plan: is the mesh too large?"
            ) from error

    def _submit(
        self, niceness: int, work: Callable[P, T], *args: P.args, **kwargs: P.kwargs
    ) -> tuple[ProcessPoolExecutor, Future[T]]:
        if self._niceness != niceness:  # only root can lower the niceness again
            self.end()
        with self._lock:
            if self._pool is not None:
                with contextlib.suppress(BrokenProcessPool):  # it died while it was idle
                    return self._pool, self._pool.submit(work, *args, **kwargs)
            self._niceness = niceness
            self._pool = ProcessPoolExecutor(1, self._context, initializer=_begin, initargs=(self._step, niceness))
            return self._pool, self._pool.submit(work, *args, **kwargs)

    def end(self) -> None:
        """End the process and its present work."""
        with self._lock:
            pool, self._pool = self._pool, None
        if pool is not None:
            for process in list((pool._processes or {}).values()):
                process.kill()
            pool.shutdown(wait=False, cancel_futures=True)
