"""A result of runs for other programs."""

from __future__ import annotations

import importlib
from pathlib import Path

from coupole.errors import InputError
from coupole.exchange.formats import MAPS, Source, Writer, format_named, refuse_others_options
from coupole.exchange.of_results.measured_surface import ExportChoice, read_surface
from coupole.exchange.target_folder import writing_into

_HERE = "coupole.exchange.of_results"


def export_result(
    result: Path,
    to: str,
    folder: Path,
    *,
    fit: str | None = None,
    options: ExportChoice | None = None,
    overwrite: bool = False,
) -> list[Path]:
    """Write a result in another format into `folder`; return the files.

    Raises InputError for an unknown format, for a folder that is not empty (unless `overwrite`), for a result
    without the fit, and for maps that would be too large; DiskFull or StorageError.
    """
    export_format = format_named(to, Source.RESULT, Writer.RESULT)
    refuse_others_options(export_format, ["triangle"] if options and options.triangles else [])
    surface = read_surface(result, fit, options, takes_texels=MAPS[0] in export_format.options)
    if not overwrite and folder.is_dir() and any(folder.iterdir()):
        raise InputError(f"{folder}: has files already. Choose another --out, or give --overwrite")
    with writing_into(folder):
        paths: list[Path] = importlib.import_module(f"{_HERE}.{to}").write(surface, folder)
    return paths
