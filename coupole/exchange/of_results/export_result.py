"""A result of runs for other programs."""

from __future__ import annotations

import importlib
from dataclasses import replace
from pathlib import Path

from coupole.errors import InputError
from coupole.exchange.formats import Source, Writer, format_named, refuse_others_options
from coupole.exchange.of_results.measured_surface import read_surface
from coupole.exchange.target_folder import writing_into

_HERE = "coupole.exchange.of_results"


def export_result(
    result: Path,
    to: str,
    folder: Path,
    *,
    fit: str | None = None,
    triangles: tuple[int, ...] = (),
    most_error: float | None = None,
    overwrite: bool = False,
) -> list[Path]:
    """Write a result in another format into `folder`; the files. `most_error` asks tables of `bsdf` to adapt.

    Raises InputError for a format that there is none of, a folder that has files (unless `overwrite`), a result
    without the fit; DiskFull or StorageError.
    """
    refuse_others_options(format_named(to, Source.RESULT, Writer.RESULT), ["triangle"] if triangles else [])
    surface = replace(read_surface(result, fit, triangles), most_error=most_error)
    if not overwrite and folder.is_dir() and any(folder.iterdir()):
        raise InputError(f"{folder}: has files already. Choose another --out, or give --overwrite")
    with writing_into(folder):
        paths: list[Path] = importlib.import_module(f"{_HERE}.{to}").write(surface, folder)
    return paths
