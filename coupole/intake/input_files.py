"""The files that a job depends on, each read once.

Plan, rig, LED table, mesh, records and the files beside them are read into memory by the first reader, and hashed.
A second caller gets the same bytes. Therefore the bytes that are checked, run and kept in `inputs/` cannot differ,
whatever happens to a file on the disk meanwhile. `changes` says what did.
"""

from __future__ import annotations

import hashlib
import os
import stat
from dataclasses import dataclass
from pathlib import Path

from coupole.errors import reason


@dataclass(frozen=True)
class _Read:
    data: bytes
    sha256: str
    stamp: tuple[int, ...]


class InputFiles:
    """Bytes of files by path; a path is taken as it is written, so that a link that moves changes nothing."""

    def __init__(self) -> None:
        self._read: dict[Path, _Read] = {}
        self._told: set[str] = set()

    def __contains__(self, path: Path) -> bool:
        return path.absolute() in self._read

    def read_bytes(self, path: Path) -> bytes:
        """All bytes of a file, as they were when it was first read. Raises OSError if that fails."""
        return self._once(path).data

    def sha256(self, path: Path) -> str:
        """Hex digest of these bytes."""
        return self._once(path).sha256

    def there(self, path: Path) -> bool:
        """True if the file was read, or is there to be read."""
        return path in self or path.is_file()

    def _once(self, path: Path) -> _Read:
        key = path.absolute()
        if key not in self._read:
            self._read[key] = _read_file(key)
        return self._read[key]

    def changes(self) -> list[str]:
        """List in one sentence each what happened on the disk to files since they were read; each change is
        listed once.
        """
        sentences = [f"{path} {how}" for path, state in self._read.items() if (how := _change(path, state))]
        new = [sentence for sentence in sentences if sentence not in self._told]
        self._told |= set(new)
        return new


def _read_file(path: Path) -> _Read:
    about = path.stat()
    if not stat.S_ISREG(about.st_mode):
        raise OSError(0, "it is a folder or a device, not a file", str(path))
    with path.open("rb") as file:
        stamp = _stamp(os.fstat(file.fileno()))
        data = file.read()
    return _Read(data, hashlib.sha256(data).hexdigest(), stamp)


def _stamp(about: os.stat_result) -> tuple[int, ...]:
    return about.st_dev, about.st_ino, about.st_size, about.st_mtime_ns, about.st_ctime_ns


def _change(path: Path, earlier_read: _Read) -> str:
    """Return what is different now; empty if nothing is different, or if only the file's times are."""
    try:
        about = path.stat()
        if _stamp(about) == earlier_read.stamp:
            return ""
        if not stat.S_ISREG(about.st_mode):
            return "is not a file any more"
        if about.st_size == earlier_read.stamp[2]:
            with path.open("rb") as file:
                same = hashlib.file_digest(file, "sha256").hexdigest() == earlier_read.sha256
        else:
            same = False
    except FileNotFoundError:
        return "does not exist any more"
    except OSError as error:
        return f"cannot be read any more ({reason(error)})"
    return "" if same else "was changed"
