"""Errors of the operating system on a disk with runs or results, in words for the operator."""

from __future__ import annotations

import errno
from pathlib import Path

from coupole.errors import DiskFull, StorageError


def disk_error(path: Path, error: OSError) -> StorageError:
    """Return the error to raise when a file cannot be written. It is DiskFull if there is no space or quota
    left."""
    if error.errno in (errno.ENOSPC, errno.EDQUOT):
        return DiskFull(
            f"{path}: the disk is full. Free space on it, then resume the run, or run the command again."
        )
    if error.errno == errno.EFBIG:
        return StorageError(
            f"{path}: a file would be longer than this process or its file system allows. Raise the limit "
            "(`ulimit -f`), or store on another file system."
        )
    if error.errno in (errno.EMFILE, errno.ENFILE):
        return StorageError(
            f"{path}: no more files may be open at once. Raise the limit (`ulimit -n 1024`), then resume the run, "
            "or run the command again."
        )
    return StorageError(
        f"{path}: {error.strerror or error}. Check the disk, then resume the run, or run the command again."
    )
