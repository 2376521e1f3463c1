"""Errors that come from a limit of this machine or of this process: they are not defects."""

from __future__ import annotations

import errno
import resource
import traceback
from collections.abc import Iterator

from coupole.errors import DiskFull, ResourceShortage, StorageError

_STARTS_PROCESSES = ("subprocess.py:", "popen_fork.py:")
"""Files of Python's own that raise EAGAIN when the system refuses a process; elsewhere a socket is not ready."""
_NO_THREAD = "can't start new thread"
"""Message of the RuntimeError that Python raises when the system refuses a thread."""


def shortage_behind(error: BaseException) -> ResourceShortage | StorageError | None:
    """Return in words what ran short, if a shortage caused an error; None if no shortage is known to be the
    cause."""
    for link in _chain(error):
        words = _shortage(link)
        if words is not None:
            return words
    return None


def place_of(error: BaseException) -> str:
    """Return file and line where an error was raised, without its folder."""
    frames = traceback.extract_tb(error.__traceback__)
    return f"{frames[-1].filename.rpartition('/')[2]}:{frames[-1].lineno}" if frames else "an unknown place"


def _chain(error: BaseException | None) -> Iterator[BaseException]:
    ids: set[int] = set()
    while error is not None and id(error) not in ids:
        ids.add(id(error))
        yield error
        error = error.__cause__ or (None if error.__suppress_context__ else error.__context__)


def _shortage(error: BaseException) -> ResourceShortage | StorageError | None:
    number = error.errno if isinstance(error, OSError) else None
    if number in (errno.ENOSPC, errno.EDQUOT):
        path = getattr(error, "filename", None)
        return DiskFull(f"{f'{path}: ' if path else ''}the disk is full. Free space on it, then run this again.")
    if number == errno.EMFILE:
        limit = _limit(resource.RLIMIT_NOFILE)
        return ResourceShortage(
            f"this process may not open more files at once ({limit}). Raise the limit (`ulimit -n 1024`)."
        )
    if number == errno.ENFILE:
        return ResourceShortage("this machine may not open more files at once (fs.file-max).")
    if number == errno.ENOMEM or isinstance(error, MemoryError):
        limit = _limit(resource.RLIMIT_AS)
        return ResourceShortage(
            f"this process was given no more memory ({limit}). Free memory, or raise the limit (`ulimit -v "
            "unlimited`)."
        )
    no_process = number == errno.EAGAIN and place_of(error).startswith(_STARTS_PROCESSES)
    if no_process or (isinstance(error, RuntimeError) and _NO_THREAD in str(error)):
        limit = _limit(resource.RLIMIT_NPROC)
        return ResourceShortage(
            f"this user may not start more processes or threads ({limit}), or memory is short. Raise the limit "
            "(`ulimit -u 4096`)."
        )
    return None


def _limit(kind: int) -> str:
    soft, _ = resource.getrlimit(kind)
    if soft == resource.RLIM_INFINITY:
        return "no limit is set"
    if kind == resource.RLIMIT_AS:
        return f"its limit is {soft / 1e9:.2f} GB"
    return f"the limit is {soft}"
