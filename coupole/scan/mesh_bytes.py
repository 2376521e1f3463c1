"""The file of a mesh as input of its readers: on the disk, or as bytes that were read before."""

from __future__ import annotations

import io
import mmap
from dataclasses import dataclass
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np
from numpy.typing import NDArray


@dataclass(frozen=True)
class MeshFile:
    """A file of a mesh. `path` is its name in messages; with `data` nothing is read from the disk."""

    path: Path
    data: bytes | None = None

    @property
    def size_bytes(self) -> int:
        return self.path.stat().st_size if self.data is None else len(self.data)

    def open_file(self) -> BinaryIO:
        return self.path.open("rb") if self.data is None else io.BytesIO(self.data)

    def mapped_bytes(self) -> NDArray[np.uint8]:
        """Bytes of the file; a file on the disk is mapped into memory, not loaded."""
        if self.data is not None or self.size_bytes == 0:
            return np.frombuffer(self.data or b"", np.uint8)
        with self.path.open("rb") as file:
            return np.frombuffer(mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_READ), np.uint8)


def read_records(file: BinaryIO, record: np.dtype[np.void], count: int) -> NDArray[Any]:
    """Return the next `count` records, or all remaining ones if there are fewer."""
    if isinstance(file, io.BytesIO):
        data = file.read(count * record.itemsize)
        return np.frombuffer(data, record, len(data) // record.itemsize)
    return np.fromfile(file, record, count)
