"""The run's diary: one JSON object a line, appended, never changed.

A `frame` line stands for a proven shot whose bytes are on disk. So lines are kept back until `commit()`, which
the caller calls after it has synced the frames; then lines are written and synced too.
"""

from __future__ import annotations

import contextlib
import errno
import json
import os
from collections.abc import Iterator
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

from coupole.errors import DiskFull, StorageError


def utc_now() -> str:
    """Now, ISO 8601 with milliseconds, UTC."""
    return datetime.now(UTC).isoformat(timespec="milliseconds").replace("+00:00", "Z")


class Journal:
    """Append events; `commit()` makes them last."""

    def __init__(self, path: Path) -> None:
        self._path = path
        self._lines: list[str] = []
        try:
            self._fd = os.open(path, os.O_RDWR | os.O_CREAT | os.O_APPEND, 0o644)
            self._end_torn_line()
        except OSError as error:
            raise _storage_error(path, error) from error

    def _end_torn_line(self) -> None:
        """After a crash the last line may be half written: close it, so that the next one is whole."""
        size = os.fstat(self._fd).st_size
        if size and os.pread(self._fd, 1, size - 1) != b"\n":
            os.write(self._fd, b"\n")

    def write(self, event: str, **fields: Any) -> None:
        """Note an event; it reaches the disk with the next `commit()`."""
        self._lines.append(json.dumps({"event": event, "t": utc_now(), **fields}, separators=(",", ":")) + "\n")

    def take(self) -> list[str]:
        """The lines noted since the last time; they are the caller's now, to be handed to `append`."""
        lines, self._lines = self._lines, []
        return lines

    def commit(self) -> None:
        """Write and sync what was noted. Raises DiskFull or StorageError; then nothing of it counts."""
        self.append(self.take())

    def append(self, lines: list[str]) -> None:
        """Write and sync lines that were taken; may run on another thread than `write` and `take`."""
        if not lines:
            return
        data = "".join(lines).encode()
        start = os.fstat(self._fd).st_size
        try:
            view = memoryview(data)
            while view:
                view = view[os.write(self._fd, view) :]
            os.fdatasync(self._fd)
        except OSError as error:
            with contextlib.suppress(OSError):
                os.ftruncate(self._fd, start)
            raise _storage_error(self._path, error) from error

    def close(self) -> None:
        os.close(self._fd)


def _storage_error(path: Path, error: OSError) -> StorageError:
    if error.errno in (errno.ENOSPC, errno.EDQUOT):
        return DiskFull(f"{path}: the disk is full. Free space on it, then resume the run.")
    return StorageError(f"{path}: {error.strerror}. Check the disk, then resume the run.")


def read(path: Path) -> Iterator[dict[str, Any]]:
    """Events of a journal. A line torn by a crash is passed over: what it said did not count yet."""
    try:
        with path.open("rb") as file:
            for line in file:
                with contextlib.suppress(json.JSONDecodeError, UnicodeDecodeError):
                    event = json.loads(line)
                    if isinstance(event, dict) and "event" in event:
                        yield event
    except OSError as error:
        raise StorageError(f"{path}: cannot read the journal: {error.strerror}") from error


def tail(path: Path, most_bytes: int) -> list[dict[str, Any]]:
    """The last events of a journal, as far as they lie in its last `most_bytes`."""
    try:
        with path.open("rb") as file:
            file.seek(max(0, path.stat().st_size - most_bytes))
            lines = file.read(most_bytes).splitlines()
    except OSError as error:
        raise StorageError(f"{path}: cannot read the journal: {error.strerror}") from error
    found = []
    for line in lines:
        with contextlib.suppress(json.JSONDecodeError, UnicodeDecodeError):
            event = json.loads(line)
            if isinstance(event, dict) and "event" in event:
                found.append(event)
    return found
