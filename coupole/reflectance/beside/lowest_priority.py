"""Lowest priority for a process beside an acquisition while frames come. The process ends when its parent ends."""

from __future__ import annotations

import contextlib
import ctypes
import os
import platform
import signal
import sys
import threading
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

_IOPRIO_SET = {"x86_64": 251, "aarch64": 30}
"""Number of the system call, for which the C library has no name (ioprio_set(2))."""
_IOPRIO_WHO_PROCESS, _IDLE_CLASS = 1, 3 << 13
_PR_SET_PDEATHSIG = 1
_NICE_OF_THE_END = 10


class ThreadForTheEnd:
    """A thread for the work after the last frame, for which a person waits. Only a privileged process can take
    back a low priority (setpriority(2), sched(7)). So this thread is begun before `yield_to_all_others`, and keeps
    its own priority."""

    def __init__(self) -> None:
        self._pool = ThreadPoolExecutor(1, "after the last frame")
        self.number = self._pool.submit(threading.get_native_id).result()

    def run(self, work: Callable[[], None]) -> None:
        """Do the work in this thread and in threads that it begins, as usual background work: still below an
        acquisition of another cell. Errors of the work are raised here."""
        self._pool.submit(self._run, work).result()

    def _run(self, work: Callable[[], None]) -> None:
        if sys.platform == "linux":  # elsewhere, a priority applies to the whole process
            with contextlib.suppress(OSError):
                nice = max(_NICE_OF_THE_END, os.getpriority(os.PRIO_PROCESS, self.number))
                os.setpriority(os.PRIO_PROCESS, self.number, nice)
        work()


def yield_to_all_others(but: ThreadForTheEnd) -> None:
    """Use processors and disk only while no other process wants them, and be the first to be ended if memory is
    short. Threads that begin later inherit these measures, except threads that `but` begins. Each of the four
    measures is taken if the system supports it."""
    if sys.platform != "linux":
        with contextlib.suppress(OSError):
            os.setpriority(os.PRIO_PROCESS, 0, 19)
        return
    for task in Path("/proc/self/task").iterdir():  # libraries may have begun threads
        if (thread := int(task.name)) == but.number:
            continue
        with contextlib.suppress(OSError):
            os.setpriority(os.PRIO_PROCESS, thread, 19)
        with contextlib.suppress(OSError):
            os.sched_setscheduler(thread, os.SCHED_IDLE, os.sched_param(0))
        if (number := _IOPRIO_SET.get(platform.machine())) is not None:
            ctypes.CDLL(None).syscall(number, _IOPRIO_WHO_PROCESS, thread, _IDLE_CLASS)
    with contextlib.suppress(OSError):
        Path("/proc/self/oom_score_adj").write_text("1000", encoding="ascii")


def end_with(parent: int) -> None:
    """Let the system end this process by SIGKILL when the thread that began it ends, even while it is stopped
    (prctl(2)). On systems without this call, the process learns of this from the end of its input."""
    if sys.platform == "linux":
        ctypes.CDLL(None).prctl(_PR_SET_PDEATHSIG, signal.SIGKILL)
        if os.getppid() != parent:  # it has died before
            os._exit(1)
