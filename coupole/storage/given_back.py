"""Gives the disk space of parts of a file back, in place (fallocate(2)). The file's size and all other bytes
stay."""

from __future__ import annotations

import ctypes
import errno
import os
import sys
import tempfile
from collections.abc import Iterable
from pathlib import Path

_KEEP_SIZE, _PUNCH_HOLE = 1, 2
_TRIAL_BYTES = 2**20


def give_back(fd: int, parts: Iterable[tuple[int, int]]) -> None:
    """Give back parts of an open file, (offset, length) in bytes each; they read as zeros afterwards. A block of
    the file system that is only partly covered is overwritten by zeros in the covered part. A second call changes
    nothing. The change is on the disk when this returns. Raises OSError."""
    libc = ctypes.CDLL(None, use_errno=True)
    for offset, length in parts:
        mode = _KEEP_SIZE | _PUNCH_HOLE
        while libc.fallocate(fd, mode, ctypes.c_int64(offset), ctypes.c_int64(length)):
            if (number := ctypes.get_errno()) != errno.EINTR:
                raise OSError(number, os.strerror(number))
    os.fsync(fd)


def is_blank(fd: int, parts: Iterable[tuple[int, int]]) -> bool:
    """Tell whether parts of an open file, (offset, length) in bytes each, read as zeros. Holes are skipped. Raises
    OSError."""
    for start, length in parts:
        offset, end = start, start + length
        while (offset := _next_data(fd, offset)) < end:
            if not (chunk := os.pread(fd, min(end - offset, _TRIAL_BYTES), offset)):
                break
            if chunk.count(0) < len(chunk):
                return False
            offset += len(chunk)
    return True


def _next_data(fd: int, offset: int) -> int:
    """Return the place of the next byte of a file that is not in a hole. If there is no such place, a place
    beyond the end of every file is returned.
    """
    try:
        return os.lseek(fd, offset, os.SEEK_DATA)
    except OSError as error:
        if error.errno != errno.ENXIO:
            raise
        return sys.maxsize


def why_not(folder: Path) -> str:
    """Return why space cannot be given back in this existing folder, found by a test; empty if it can."""
    if sys.platform != "linux":
        return "this system cannot give back a part of a file"
    try:
        with tempfile.TemporaryFile(dir=folder) as file:
            file.write(b"\1" * _TRIAL_BYTES)
            file.flush()
            os.fsync(file.fileno())
            before = os.fstat(file.fileno()).st_blocks
            give_back(file.fileno(), [(0, _TRIAL_BYTES // 2)])
            if os.fstat(file.fileno()).st_blocks >= before:
                return "its file system did not free the part of a file that was given back"
    except OSError as error:
        return f"its file system cannot give back a part of a file ({error.strerror})"
    return ""
