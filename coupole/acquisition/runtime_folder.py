"""The folder of one user on one machine for files that live as long as processes: sockets, and locks of opened
devices."""

from __future__ import annotations

import hashlib
import os
import stat
from pathlib import Path

from coupole.errors import InputError

_BASE = Path("/tmp")
"""A user's usual runtime folder is removed after the last log-out, but a run goes on."""


def runtime_folder() -> Path:
    """Return the folder; make it if it is missing. Raises InputError if another user owns it or may enter it;
    OSError."""
    folder = _BASE / f"coupole-{os.getuid()}"
    folder.mkdir(mode=0o700, exist_ok=True)
    status = folder.stat(follow_symlinks=False)
    if not stat.S_ISDIR(status.st_mode) or status.st_uid != os.getuid() or status.st_mode & 0o077:
        raise InputError(f"{folder}: expected a folder of this user that nobody else may enter (mode 0700)")
    return folder


def named_after(path: Path, kind: str) -> Path:
    """Return a file in the folder for the thing at this path. Its name is short enough for a socket."""
    return runtime_folder() / f"{hashlib.sha256(os.fsencode(path.resolve())).hexdigest()[:24]}.{kind}"
