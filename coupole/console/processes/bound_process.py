"""Runs a command that the kernel interrupts, as by Ctrl-C, when the thread that began it ends.

Call this file by its path, with the id of the beginning process and then the command. The signal is not set
between fork and exec of the beginning process, because its other threads may hold any lock then. The setting is
PR_SET_PDEATHSIG of prctl(2); it survives execve(2).
"""

from __future__ import annotations

import ctypes
import os
import signal
import sys

_PR_SET_PDEATHSIG = 1


def main() -> None:
    """Raises OSError if there is no such command."""
    begun_by, *command = sys.argv[1:]
    ctypes.CDLL(None).prctl(_PR_SET_PDEATHSIG, signal.SIGINT)
    if os.getppid() != int(begun_by):  # the beginning process has died before
        sys.exit(130)
    os.execv(command[0], command)


if __name__ == "__main__":
    main()
