"""HDF5 files that are written to a disk which may be full.

HDF5 crashes the process if it cannot write when it closes a file or a dataset. So Python writes the bytes here.
After an error it writes nothing more, and HDF5 does not notice; the error is raised when the file is closed, or
earlier by `raise_error`."""

from __future__ import annotations

import io
import os
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

import h5py

if TYPE_CHECKING:
    from typing_extensions import Buffer


class Hdf5File(h5py.File):  # type: ignore[misc]
    """HDF5 file that is open for writing."""

    def __init__(self, disk_file: _DiskFile, mode: str, **options: Any) -> None:
        super().__init__(disk_file, mode, **options)
        self._disk_file = disk_file

    def raise_error(self) -> None:
        """Raise the OSError of an earlier write, if there was one. Long work asks now and then, so that it does
        not go on in vain."""
        if self._disk_file.error is not None:
            raise self._disk_file.error

    def sync(self) -> None:
        """Bring all that was written to the disk. Raises OSError."""
        self.flush()
        self.raise_error()
        self._disk_file.sync()


@contextmanager
def hdf5_file(path: Path, mode: Literal["w", "r+"], **options: Any) -> Iterator[Hdf5File]:
    """Open an HDF5 file for writing; `options` are those of `h5py.File`. Raises OSError, at the latest when the
    file is closed. The content is lost then."""
    with path.open("w+b" if mode == "w" else "r+b", buffering=0) as raw:
        disk_file = _DiskFile(raw)
        try:
            with Hdf5File(disk_file, mode, **options) as file:
                yield file
        except Exception as error:
            if disk_file.error is None or error is disk_file.error:
                raise
            raise disk_file.error from error
        if disk_file.error is not None:
            raise disk_file.error


class _DiskFile(io.RawIOBase):
    """File on the disk that keeps the first error of writing, instead of raising it."""

    def __init__(self, raw: io.FileIO) -> None:
        super().__init__()
        self._raw = raw
        self.error: OSError | None = None

    def sync(self) -> None:
        """Bring all bytes to the disk. Raises OSError."""
        os.fsync(self._raw.fileno())

    def readable(self) -> bool:
        return True

    def writable(self) -> bool:
        return True

    def tell(self) -> int:
        return self._raw.tell()

    def seek(self, offset: int, whence: int = io.SEEK_SET) -> int:
        return self._raw.seek(offset, whence)

    def readinto(self, buffer: Buffer) -> int | None:
        return self._raw.readinto(buffer)

    def truncate(self, size: int | None = None) -> int:
        try:
            return self._raw.truncate(size)
        except OSError as error:
            self.error = self.error or error
        return self._raw.tell() if size is None else size

    def write(self, data: Buffer) -> int:
        view = memoryview(data).cast("B")
        written = 0
        try:
            while written < len(view) and self.error is None:
                written += self._raw.write(view[written:]) or 0
        except OSError as error:
            self.error = error
        return len(view)
