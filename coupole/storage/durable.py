"""Files and folders that are on the disk when a call returns; SHA-256 of files.

A file's own sync does not promise that its folder knows the file's name: the folder is synced too.
"""

from __future__ import annotations

import hashlib
import os
from pathlib import Path

from coupole.intake.regular_file import open_regular


def sha256(path: Path) -> str:
    """Hex digest of a file. Raises OSError."""
    with open_regular(path) as file:
        return hashlib.file_digest(file, "sha256").hexdigest()


def sync_folder(folder: Path) -> None:
    """Bring the names in a folder to the disk."""
    fd = os.open(folder, os.O_RDONLY | os.O_DIRECTORY)
    try:
        os.fsync(fd)
    finally:
        os.close(fd)


def make_folder(folder: Path) -> None:
    """Make a folder and its parents; their names are on the disk afterwards."""
    missing = [path for path in (folder, *folder.parents) if not path.exists()]
    folder.mkdir(parents=True, exist_ok=True)
    for path in reversed(missing):
        sync_folder(path.parent)


def write_synced(path: Path, content: str | bytes) -> None:
    """Write a whole file. At every moment, and after a crash, the file has either the old content or the new
    one."""
    partial = path.with_name(f".{path.name}.part")
    try:
        with partial.open("wb") as file:
            file.write(content.encode() if isinstance(content, str) else content)
            file.flush()
            os.fsync(file.fileno())
        partial.replace(path)
    finally:
        partial.unlink(missing_ok=True)
    sync_folder(path.parent)
