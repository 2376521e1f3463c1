"""Measures the speed at which a disk takes frames."""

from __future__ import annotations

import errno
import mmap
import os
import time
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

from coupole.storage.disk_errors import disk_error
from coupole.storage.view_writer import WRITERS

_BLOCK_BYTES, _RANDOM_BYTES = 8 * 2**20, 2**20
"""A block repeats the same random bytes. File systems compress less than this length at once, so they gain
nothing."""
_LEAST_BLOCKS, _MOST_BLOCKS, _FRAMES = 8, 16, 20


def measure_write_speed(folder: Path, *, frame_bytes: int = 0, room_bytes: int) -> float:
    """Measure the write speed of a folder's disk, bytes per second, in the way frames are written: with O_DIRECT
    if possible, several at a time, into allocated space, synced.

    The measurement writes 64 MiB, or 128 MiB for large frames, into a file without a name, which disappears with
    this process. Returns 0 if there is not enough room. Raises StorageError if nothing can be written.
    """
    blocks = min(max(_LEAST_BLOCKS, _FRAMES * frame_bytes // _BLOCK_BYTES), _MOST_BLOCKS)
    total_bytes = blocks * _BLOCK_BYTES
    if total_bytes > room_bytes:
        return 0.0
    path = folder / f".speed-{os.getpid()}"
    block = mmap.mmap(-1, _BLOCK_BYTES)
    block.write(os.urandom(_RANDOM_BYTES) * (_BLOCK_BYTES // _RANDOM_BYTES))
    try:
        try:
            fd = os.open(path, os.O_WRONLY | os.O_CREAT | os.O_DIRECT, 0o600)
        except OSError:
            fd = os.open(path, os.O_WRONLY | os.O_CREAT, 0o600)
        path.unlink()
        try:
            os.posix_fallocate(fd, 0, total_bytes)
            with ThreadPoolExecutor(WRITERS) as pool:
                start = time.perf_counter()
                for written_bytes in pool.map(
                    lambda offset: os.pwrite(fd, block, offset), range(0, total_bytes, _BLOCK_BYTES)
                ):
                    if written_bytes < _BLOCK_BYTES:
                        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
                os.fdatasync(fd)
                return total_bytes / (time.perf_counter() - start)
        finally:
            os.close(fd)
    except OSError as error:
        raise disk_error(folder, error) from error
