"""Digest of the arrays of an HDF5 file: computed when they are written, and again when they are read from the
disk.

The digest depends on each array's type, shape and bytes, and on the attributes of the file. An array that is
written in chunks counts chunk by chunk. The places of the arrays in the file do not matter.
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
    """Collects the arrays and attributes that are written."""

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
        """Return the digest of everything that was added, in any order."""
        lines = (f"{name}: {content}\n" for name, content in sorted(self._lines.items()))
        return hashlib.sha256("".join(lines).encode()).hexdigest()


def is_in_chunks(data: h5py.Dataset) -> bool:
    """Tell whether an array counts chunk by chunk. An array that HDF5 compresses counts as a whole."""
    return data.chunks is not None and data.compression is None


def digest_on_disk(path: Path, on_read: Callable[[], None] = lambda: None) -> str:
    """Return the digest of a file. The file is synced, and read from the disk instead of memory if the system can
    do that. `on_read` is called after each piece. Raises StorageError if the file cannot be read, and OSError."""
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
