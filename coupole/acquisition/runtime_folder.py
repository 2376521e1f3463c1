"""The folder of one user on one machine for files that live as long as processes: sockets, and locks of opened
devices."""

from __future__ import annotations

import hashlib
import os
import stat
from contextlib import suppress
from pathlib import Path

from coupole.errors import InputError

_BASE = Path("/tmp")
"""A user's usual runtime folder is removed after the last log-out, but a run goes on."""
_MOST_TAKEN = 10


def runtime_folder() -> Path:
    """Return the folder; make it if it is missing. If another user has taken its name, the folder is the next one
    that is this user's or free, so that all processes of a user find the same. Raises InputError if others may
    enter it, or if all names are taken; OSError."""
    names = [f"coupole-{os.getuid()}", *(f"coupole-{os.getuid()}-{number}" for number in range(1, _MOST_TAKEN))]
    folders = [_BASE / name for name in names]
    for folder in folders:
        if _owner(folder) == os.getuid():
            return _refuse_open(folder)
    for folder in folders:
        with suppress(FileExistsError):  # also what another user has put there that is no folder
            folder.mkdir(mode=0o700)
        if _owner(folder) == os.getuid():
            return _refuse_open(folder)
    raise InputError(f"{folders[0]}: other users have taken this name and the next {_MOST_TAKEN - 1}")


def _owner(folder: Path) -> int | None:
    try:
        return folder.stat(follow_symlinks=False).st_uid
    except FileNotFoundError:
        return None


def _refuse_open(folder: Path) -> Path:
    status = folder.stat(follow_symlinks=False)
    if not stat.S_ISDIR(status.st_mode) or status.st_mode & 0o077:
        raise InputError(f"{folder}: expected a folder of this user that nobody else may enter (mode 0700)")
    return folder


def named_after(path: Path, kind: str) -> Path:
    """Return a file in the folder for the thing at this path. Its name is short enough for a socket."""
    return runtime_folder() / f"{hashlib.sha256(os.fsencode(path.resolve())).hexdigest()[:24]}.{kind}"
