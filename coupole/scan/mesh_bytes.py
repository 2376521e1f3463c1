"""A mesh's file as its readers need it: on the disk, or as bytes that were read before."""

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
    """`path` is its name in messages; with `data` nothing is read from the disk."""

    path: Path
    data: bytes | None = None

    @property
    def size_bytes(self) -> int:
        return self.path.stat().st_size if self.data is None else len(self.data)

    def open_file(self) -> BinaryIO:
        return self.path.open("rb") if self.data is None else io.BytesIO(self.data)

    def mapped_bytes(self) -> NDArray[np.uint8]:
        """Its bytes; a file's are mapped into memory, not loaded."""
        if self.data is not None or self.size_bytes == 0:
            return np.frombuffer(self.data or b"", np.uint8)
        with self.path.open("rb") as file:
            return np.frombuffer(mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_READ), np.uint8)


def read_records(file: BinaryIO, record: np.dtype[np.void], count: int) -> NDArray[Any]:
    """The next `count` records, or as many as are there."""
    if isinstance(file, io.BytesIO):
        data = file.read(count * record.itemsize)
        return np.frombuffer(data, record, len(data) // record.itemsize)
    return np.fromfile(file, record, count)
