"""A file of lines to which complete lines are appended; they are on disk when `append` returns."""

from __future__ import annotations

import contextlib
import os
from collections.abc import Sequence
from datetime import UTC, datetime
from pathlib import Path

from coupole.errors import StorageError
from coupole.storage.disk_errors import disk_error
from coupole.storage.durable import sync_folder


def utc_now() -> str:
    """Return the present time, ISO 8601 with milliseconds, UTC."""
    return utc_text(datetime.now(UTC))


def utc_text(time: datetime) -> str:
    """Return a time in UTC, ISO 8601 with milliseconds."""
    return time.isoformat(timespec="milliseconds").replace("+00:00", "Z")


class LineFile:
    """A file opened for appending. After DiskFull or StorageError, none of the lines is appended."""

    def __init__(self, path: Path) -> None:
        self._path = path
        try:
            self._fd = os.open(path, os.O_RDWR | os.O_CREAT | os.O_APPEND, 0o644)
            self.was_empty = os.fstat(self._fd).st_size == 0
            if self.was_empty:  # perhaps made just now
                sync_folder(path.parent)
            self._end_torn_line()
            self._end_bytes = os.fstat(self._fd).st_size
        except OSError as error:
            raise disk_error(path, error) from error

    def _end_torn_line(self) -> None:
        """End the last line, which a crash may have cut, so that the next line is separate."""
        size = os.fstat(self._fd).st_size
        if size and os.pread(self._fd, 1, size - 1) != b"\n":
            os.write(self._fd, b"\n")

    def append(self, lines: Sequence[str]) -> None:
        """Write lines, each with its newline, and sync them."""
        if not lines:
            return
        data = "".join(lines).encode()
        start = os.fstat(self._fd).st_size
        if start < self._end_bytes:
            raise StorageError(
                f"{self._path}: was cut to {start} bytes while lines were appended; it had {self._end_bytes}. "
                "Find out which program did that, and restore the lost lines, if there is a copy."
            )
        try:
            view = memoryview(data)
            while view:
                view = view[os.write(self._fd, view) :]
            os.fdatasync(self._fd)
        except OSError as error:
            with contextlib.suppress(OSError):
                os.ftruncate(self._fd, start)
            raise disk_error(self._path, error) from error
        self._end_bytes = start + len(data)

    @property
    def is_at_its_path(self) -> bool:
        """False if the file was moved, removed or replaced since it was opened."""
        try:
            return os.path.samestat(os.fstat(self._fd), self._path.stat())
        except OSError:
            return False

    @property
    def place(self) -> Path | None:
        """Path where the file is now, from the kernel (proc(5)); None if it was removed, or if the path cannot be
        found."""
        try:
            path = Path(f"/proc/self/fd/{self._fd}").readlink()
            return path if os.path.samestat(os.fstat(self._fd), path.stat()) else None
        except OSError:
            return None

    def close(self) -> None:
        os.close(self._fd)
