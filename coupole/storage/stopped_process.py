"""Processes of this machine, from Linux's `/proc`: the process that has locked a file, whether a process is
stopped, and its CPU time."""

from __future__ import annotations

import fcntl
import os
from pathlib import Path

_LOCKS = Path("/proc/locks")


def is_stopped(pid: int) -> bool:
    """Tell whether a process is stopped by Ctrl-Z or SIGSTOP; false too if there is no such process."""
    try:
        state = (
            Path(f"/proc/{pid}/stat").read_text(encoding="utf-8", errors="replace").rpartition(")")[2].split()[0]
        )
    except (OSError, IndexError):
        return False
    return state in ("T", "t")


def cpu_time_s(pid: int) -> float:
    """Return the CPU time of a process, s; 0 if it is not known."""
    try:
        words = Path(f"/proc/{pid}/stat").read_text(encoding="utf-8", errors="replace").rpartition(")")[2].split()
        return (int(words[11]) + int(words[12])) / os.sysconf("SC_CLK_TCK")
    except (OSError, ValueError, IndexError):
        return 0.0


def is_locked(file: Path) -> bool:
    """True while a process holds the exclusive lock of a file (flock). Raises OSError if it cannot be opened."""
    fd = os.open(file, os.O_RDONLY | os.O_CLOEXEC)
    try:
        fcntl.flock(fd, fcntl.LOCK_SH | fcntl.LOCK_NB)
    except OSError:
        return True
    finally:
        os.close(fd)
    return False


def holder_of(file: Path) -> int | None:
    """Return the process that holds the exclusive lock of a file (flock), without taking a lock. None if there is
    none, or if it cannot be found.
    """
    try:
        inode = file.stat().st_ino
        lines = _LOCKS.read_text(encoding="ascii").splitlines()
    except OSError:
        return None
    for line in lines:  # 1: FLOCK  ADVISORY  WRITE 4711 08:01:131 0 EOF
        words = line.split()
        if words[1] == "FLOCK" and words[3] == "WRITE" and words[5].rpartition(":")[2] == str(inode):
            return int(words[4])
    return None
