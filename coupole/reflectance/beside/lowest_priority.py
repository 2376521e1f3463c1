"""Lowest priority for a process that works beside an acquisition, and its end with whoever began it."""

from __future__ import annotations

import contextlib
import ctypes
import os
import platform
import signal
import sys
from pathlib import Path

_IOPRIO_SET = {"x86_64": 251, "aarch64": 30}
"""Number of the system call, which C's library has no name for (ioprio_set(2))."""
_IOPRIO_WHO_PROCESS, _IDLE_CLASS = 1, 3 << 13
_PR_SET_PDEATHSIG = 1


def yield_to_all_others() -> None:
    """Take processors and disk only while nobody else wants them, and be the first to die when memory is short.
    Threads that begin later inherit it. Each of the four is done where the system has it."""
    if sys.platform != "linux":
        with contextlib.suppress(OSError):
            os.setpriority(os.PRIO_PROCESS, 0, 19)
        return
    for task in Path("/proc/self/task").iterdir():  # libraries may have begun threads
        thread = int(task.name)
        with contextlib.suppress(OSError):
            os.setpriority(os.PRIO_PROCESS, thread, 19)
        with contextlib.suppress(OSError):
            os.sched_setscheduler(thread, os.SCHED_IDLE, os.sched_param(0))
        if (number := _IOPRIO_SET.get(platform.machine())) is not None:
            ctypes.CDLL(None).syscall(number, _IOPRIO_WHO_PROCESS, thread, _IDLE_CLASS)
    with contextlib.suppress(OSError):
        Path("/proc/self/oom_score_adj").write_text("1000", encoding="ascii")


def end_with(parent: int) -> None:
    """End by SIGKILL when the thread ends that has begun this process, also while this is stopped (prctl(2)).
    Where the system has no such thing, the end of its input tells."""
    if sys.platform == "linux":
        ctypes.CDLL(None).prctl(_PR_SET_PDEATHSIG, signal.SIGKILL)
        if os.getppid() != parent:  # it has died before
            os._exit(1)
