"""The folder that an export writes into."""

from __future__ import annotations

import errno
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, suppress
from pathlib import Path

from coupole.errors import DiskFull, InputError, StorageError


def refuse_standing(paths: Sequence[Path]) -> None:
    """Raise InputError if one of the files that would be written exists already."""
    if standing := [path for path in paths if path.exists()]:
        raise InputError(
            f"{standing[0]}: exists already ({len(standing)} such files). Choose another name or folder, or give "
            "--overwrite."
        )


@contextmanager
def writing_into(folder: Path) -> Iterator[None]:
    """Make the folder. An error of the operating system becomes DiskFull or StorageError; a file in the folder's
    place becomes InputError. If the export fails, folders that were made for it and are empty are removed."""
    made_folders = [path for path in (folder, *folder.parents) if not path.exists()]
    try:
        with _removed_if_empty(made_folders):
            folder.mkdir(parents=True, exist_ok=True)
            yield
    except OSError as error:
        if files := [path for path in (folder, *folder.parents) if path.is_file()]:
            raise InputError(f"--out: {files[0]} is a file; expected a folder, or a name that is free") from error
        if error.errno in (errno.ENOSPC, errno.EDQUOT):
            raise DiskFull(f"{folder}: the disk is full. Free space on it, then export again.") from error
        raise StorageError(f"{folder}: {error.strerror or error}. Check the disk, then export again.") from error


@contextmanager
def _removed_if_empty(folders: Sequence[Path]) -> Iterator[None]:
    """Remove these folders, the innermost first, if an error is raised; a folder that is not empty stays."""
    try:
        yield
    except BaseException:
        for folder in folders:
            with suppress(OSError):
                folder.rmdir()
        raise
