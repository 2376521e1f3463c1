"""File to which a process prints. It is read while it grows; each time, only the new part is read."""

from __future__ import annotations

import os
import threading
from pathlib import Path


class GrowingFile:
    """The end of a file to which another process appends; usable by any thread."""

    def __init__(self, path: Path, most_bytes: int) -> None:
        self._path, self._most, self._lock = path, most_bytes, threading.Lock()
        self._read_to, self._end = 0, b""

    @property
    def text(self) -> str:
        """Return the last `most_bytes` of the file; empty while there is no file."""
        with self._lock:
            try:
                with self._path.open("rb") as file:
                    size = os.fstat(file.fileno()).st_size
                    if size < self._read_to:
                        self._read_to, self._end = 0, b""
                    if size > self._read_to:
                        file.seek(max(self._read_to, size - self._most))
                        new = file.read()
                        self._end, self._read_to = (self._end + new)[-self._most :], file.tell()
            except OSError:
                return ""
            return self._end.decode(errors="replace")


def end_of_file(path: Path, most_bytes: int) -> str:
    """The last bytes of a file as text; empty if it cannot be read."""
    return GrowingFile(path, most_bytes).text
