"""Becomes a command that the kernel interrupts, as Ctrl-C does, when the thread ends that has begun it.

Run by its path, with the number of the process that begins it before the command: not between fork and exec of
that process, whose other threads may hold any lock. prctl(2), PR_SET_PDEATHSIG; it outlives execve(2).
"""

from __future__ import annotations

import ctypes
import os
import signal
import sys

_PR_SET_PDEATHSIG = 1


def main() -> None:
    """Raises OSError: there is no such command."""
    begun_by, *command = sys.argv[1:]
    ctypes.CDLL(None).prctl(_PR_SET_PDEATHSIG, signal.SIGINT)
    if os.getppid() != int(begun_by):  # it has died before
        sys.exit(130)
    os.execv(command[0], command)


if __name__ == "__main__":
    main()
