"""A file that exists in memory only, until its space on the disk is allocated.

HDF5 crashes the process if the disk is full when it closes a file. So it lays a file out here, and its bytes reach
the disk by other means, once there is room for all of them."""

from __future__ import annotations

import io
import os
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from typing_extensions import Buffer

_PART = 65536
"""Bytes that are kept together."""


class UnwrittenFile(io.RawIOBase):
    """Binary file in memory. Parts to which nothing was written take no memory, and read as zeros."""

    def __init__(self) -> None:
        super().__init__()
        self._parts: dict[int, bytearray] = {}
        self._position, self._size = 0, 0

    def readable(self) -> bool:
        return True

    def writable(self) -> bool:
        return True

    def tell(self) -> int:
        return self._position

    def seek(self, offset: int, whence: int = os.SEEK_SET) -> int:
        self._position = offset + {os.SEEK_SET: 0, os.SEEK_CUR: self._position, os.SEEK_END: self._size}[whence]
        return self._position

    def truncate(self, size: int | None = None) -> int:
        """Set the size. Only growing is supported, which is all that HDF5 needs for a new file."""
        self._size = max(self._size, self._position if size is None else size)
        return self._size

    def readinto(self, buffer: Buffer) -> int:
        into = memoryview(buffer).cast("B")
        count = max(0, min(len(into), self._size - self._position))
        for number, begin, end, offset in self._pieces(count):
            part = self._parts.get(number)
            into[offset : offset + end - begin] = bytes(end - begin) if part is None else part[begin:end]
        self._position += count
        return count

    def write(self, data: Buffer) -> int:
        view = memoryview(data).cast("B")
        for number, begin, end, offset in self._pieces(len(view)):
            part = self._parts.setdefault(number, bytearray(_PART))
            part[begin:end] = view[offset : offset + end - begin]
        self._position += len(view)
        self._size = max(self._size, self._position)
        return len(view)

    def _pieces(self, count: int) -> list[tuple[int, int, int, int]]:
        """Return number of the part, begin and end in it, and offset from the position, of the next bytes."""
        pieces, offset = [], 0
        while offset < count:
            number, begin = divmod(self._position + offset, _PART)
            end = min(_PART, begin + count - offset)
            pieces.append((number, begin, end, offset))
            offset += end - begin
        return pieces

    def write_to(self, file: int) -> None:
        """Allocate the space of an open, empty file on the disk, then write all bytes. Raises OSError, before
        anything is written if there is not enough space."""
        os.posix_fallocate(file, 0, self._size)
        for number, part in sorted(self._parts.items()):
            begin = number * _PART
            data = memoryview(part)[: self._size - begin]
            written = 0
            while written < len(data):
                written += os.pwrite(file, data[written:], begin + written)
