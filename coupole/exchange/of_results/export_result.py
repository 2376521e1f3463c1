"""A result of runs for other programs."""

from __future__ import annotations

import errno
import importlib
from pathlib import Path

from coupole.errors import DiskFull, InputError, StorageError
from coupole.exchange.of_results import FORMATS
from coupole.exchange.of_results.measured_surface import read_surface

_HERE = "coupole.exchange.of_results"


def export_result(
    result: Path,
    to: str,
    folder: Path,
    *,
    fit: str | None = None,
    triangles: tuple[int, ...] = (),
    overwrite: bool,
) -> list[Path]:
    """Write a result in another format into `folder`; the files.

    Raises InputError for a format that there is none of, a folder that has files (unless `overwrite`), a result
    without the fit; DiskFull or StorageError.
    """
    if to not in FORMATS:
        raise InputError(f"--to: expected one of {', '.join(FORMATS)} for a result; found {to}")
    surface = read_surface(result, fit, triangles)
    if not overwrite and folder.is_dir() and any(folder.iterdir()):
        raise InputError(f"{folder}: has files already. Choose another --out, or give --overwrite")
    try:
        folder.mkdir(parents=True, exist_ok=True)
        written: list[Path] = importlib.import_module(f"{_HERE}.{to}").write(surface, folder)
    except OSError as error:
        if error.errno in (errno.ENOSPC, errno.EDQUOT):
            raise DiskFull(f"{folder}: the disk is full. Free space on it, then export again.") from error
        raise StorageError(f"{folder}: {error.strerror or error}. Check the disk, then export again.") from error
    return written
