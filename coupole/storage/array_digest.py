"""Digest of the arrays of an HDF5 file: taken as they are written, and again from the disk.

The digest does not depend on where HDF5 puts what, but on each array's type, shape and bytes, chunk by chunk where
an array is written in chunks, and on the attributes of the file.
"""

from __future__ import annotations

import hashlib
import os
from collections.abc import Callable
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import xxhash
from numpy.typing import NDArray

from coupole.storage.frame_file import open_view


class ArrayDigest:
    """Collects what is written."""

    def __init__(self) -> None:
        self._lines: dict[str, str] = {}

    def add(self, name: str, values: NDArray[Any], first: tuple[int, ...] = ()) -> None:
        """Add an array, or the chunk of it that begins at `first`."""
        values = np.ascontiguousarray(values)
        content = xxhash.xxh3_128_hexdigest(values.tobytes())
        self._lines[f"{name} {first}"] = f"{values.dtype.str} {values.shape} {content}"

    def add_attributes(self, file: h5py.File) -> None:
        """Add the attributes of the file."""
        attributes = {name: np.asarray(value).tolist() for name, value in file.attrs.items()}
        self._lines["attributes"] = repr(sorted(attributes.items()))

    @property
    def sha256(self) -> str:
        """The digest of all that was added, in any order."""
        lines = (f"{name}: {content}\n" for name, content in sorted(self._lines.items()))
        return hashlib.sha256("".join(lines).encode()).hexdigest()


def is_in_chunks(data: h5py.Dataset) -> bool:
    """Tell whether an array counts chunk by chunk; one that HDF5 compresses counts as a whole."""
    return data.chunks is not None and data.compression is None


def digest_on_disk(path: Path, on_read: Callable[[], None] = lambda: None) -> str:
    """The digest of a file, synced and then read from the disk, not from memory, where the system can do that;
    `on_read` is called after each piece. Raises StorageError for a file that cannot be read, OSError."""
    with path.open("rb") as on_disk:
        os.fsync(on_disk.fileno())
        os.posix_fadvise(on_disk.fileno(), 0, 0, os.POSIX_FADV_DONTNEED)
    digest = ArrayDigest()
    with open_view(path) as file:
        digest.add_attributes(file)
        for name, data in file.items():
            if not is_in_chunks(data):
                digest.add(name, data[()])
                on_read()
                continue
            for chunk in data.iter_chunks():
                digest.add(name, data[chunk], tuple(part.start for part in chunk))
                on_read()
    return digest.sha256
