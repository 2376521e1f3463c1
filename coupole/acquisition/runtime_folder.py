"""The folder of one user on one machine for what holds while processes run: sockets, locks of opened devices."""

from __future__ import annotations

import contextlib
import fcntl
import hashlib
import os
import stat
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from coupole.errors import InputError

_BASE = Path("/tmp")
"""A user's own runtime folder would be gone after the last log-out, a run is not."""


def runtime_folder() -> Path:
    """The folder, made if it is missing. Raises InputError: another user owns it or may enter it; OSError."""
    folder = _BASE / f"coupole-{os.getuid()}"
    folder.mkdir(mode=0o700, exist_ok=True)
    found = folder.stat(follow_symlinks=False)
    if not stat.S_ISDIR(found.st_mode) or found.st_uid != os.getuid() or found.st_mode & 0o077:
        raise InputError(f"{folder}: expected a folder of this user that nobody else may enter (mode 0700)")
    return folder


def named_after(path: Path, kind: str) -> Path:
    """A file in the folder for something with this path, short enough for a socket."""
    return runtime_folder() / f"{hashlib.sha256(os.fsencode(path.resolve())).hexdigest()[:24]}.{kind}"


@contextmanager
def in_use(state_folder: Path) -> Iterator[None]:
    """While the context lasts `is_in_use` is true of the cell with this state folder; several may use it at once.
    A machine on which that is not possible keeps nobody from working."""
    with contextlib.ExitStack() as stack:
        with contextlib.suppress(OSError, InputError):
            file = stack.enter_context(named_after(state_folder, "in-use").open("ab"))
            fcntl.flock(file, fcntl.LOCK_SH | fcntl.LOCK_NB)
        yield


def is_in_use(state_folder: Path) -> bool:
    """Whether a process of this user on this machine has the devices of a cell open."""
    try:
        with named_after(state_folder, "in-use").open("rb") as file:
            fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError:
        return True
    except OSError:  # nobody has ever opened them
        return False
    return False
