"""Errors of the operating system on a run's disk, in the operator's words."""

from __future__ import annotations

import errno
from pathlib import Path

from coupole.errors import DiskFull, StorageError


def disk_error(path: Path, error: OSError) -> StorageError:
    """The error to raise when a run's file cannot be written: DiskFull if there is no space or quota left."""
    if error.errno in (errno.ENOSPC, errno.EDQUOT):
        return DiskFull(f"{path}: the disk is full. Free space on it, then resume the run.")
    if error.errno == errno.EFBIG:
        return StorageError(
            f"{path}: a file would be longer than this process or its file system allows. Raise the limit "
            "(`ulimit -f`), or store on another file system."
        )
    return StorageError(f"{path}: {error.strerror or error}. Check the disk, then resume the run.")
