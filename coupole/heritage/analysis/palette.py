"""Paints for mixtures: paint files of `coupole layer`, and libraries of K and S."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import combinations
from pathlib import Path

import numpy as np

from coupole.appearance.matter.paint_file import ENDING, read_paint
from coupole.appearance.spectra import resampling
from coupole.appearance.spectra.grid import WAVELENGTHS_NM, Array
from coupole.appearance.spectra.measured import Measured
from coupole.appearance.spectra.spectra_library import LibrarySpectrum, read_library
from coupole.errors import InputError

_LIBRARIES = {".rs", ".tsv"}
_ALIKE = 1e-3
"""Relative difference of K and S below which two paints count as the same."""
_RELATIVE = "relative"


@dataclass(frozen=True, eq=False)
class Paint:
    """One paint; arrays are [81], NaN in bands where the paint is not known."""

    name: str
    source: str
    """File, with the line if it has several paints."""
    unit: str
    absorption: Array
    scattering: Array
    u_absorption: Array
    u_scattering: Array


def read_palette(sources: Sequence[Path]) -> tuple[Paint, ...]:
    """Read all paints of files and folders. Raises InputError for paints that cannot be mixed: duplicates,
    different units."""
    paints: list[Paint] = []
    for source in sources:
        for path in _files(source):
            paints += [_of_file(path)] if path.name.endswith(ENDING) else _of_library(path)
    for a, b in combinations(paints, 2):
        if a.name == b.name:
            raise InputError(
                f"{a.source} and {b.source}: two paints are named {a.name!r}; leave one out, or rename it"
            )
        if _is_same(a, b):
            raise InputError(
                f"{a.source} and {b.source}: {a.name!r} and {b.name!r} have the same K and S; their shares "
                "cannot be distinguished: leave one out"
            )
        if a.unit != b.unit:
            raise InputError(
                f"{a.source} is {a.unit}, {b.source} is {b.unit}: paints of different units cannot be mixed; "
                "measure all of them with their thickness"
            )
    if "per layer" in {paint.unit for paint in paints} and len(paints) > 1:
        raise InputError(
            f"{paints[0].source}: K and S are of a layer of unknown thickness, so this paint cannot be mixed "
            f"with others; measure it with its thickness"
        )
    if not paints:
        raise InputError(f"{', '.join(map(str, sources))}: expected paints ({ENDING}, or a library); found none")
    return tuple(paints)


def _files(source: Path) -> list[Path]:
    if not source.exists():
        raise InputError(f"{source}: no such file or folder; expected a palette")
    if not source.is_dir():
        return [source]
    paths = [p for p in source.iterdir() if p.name.endswith(ENDING) or p.suffix.lower() in _LIBRARIES]
    return sorted(paths)


def _of_file(path: Path) -> Paint:
    paint = read_paint(path)
    pigment = paint.on_grid()
    u_k, u_s = paint.uncertainties_on_grid()
    is_covered = paint.covered_bands()
    k, s = (np.where(is_covered, values, np.nan) for values in (pigment.absorption, pigment.scattering))
    return Paint(paint.name, str(path), paint.unit, k, s, u_k, u_s)


def _of_library(path: Path) -> list[Paint]:
    spectra = read_library(path)
    if all(spectrum.absorption is None for spectrum in spectra):
        raise InputError(
            f"{path}: expected K and S of each paint, found reflectances, from which mixtures cannot be computed"
        )
    return [_of_row(spectrum) for spectrum in spectra]


def _of_row(row: LibrarySpectrum) -> Paint:
    """Return the paint of a library's row. It is not known in bands with K below 0 or S not above 0."""
    place = f"{row.file}:{row.line}"
    if row.absorption is None or row.scattering is None:
        raise InputError(f"{place}: {row.name}: expected K and S, found a reflectance; leave the row out")
    on_grid = []
    is_known = (row.absorption >= 0.0) & (row.scattering > 0.0)
    for values in (row.absorption, row.scattering):
        curve = resampling.on_grid(Measured(row.name, row.wavelengths_nm, values, ()))
        near = np.interp(WAVELENGTHS_NM, row.wavelengths_nm, is_known.astype(float))
        on_grid.append(np.where((near > 0.999) & (curve.values >= 0.0), curve.values, np.nan))
    k, s = on_grid
    nothing = np.zeros(len(WAVELENGTHS_NM))
    return Paint(row.name, place, _RELATIVE, k, np.where(s > 0.0, s, np.nan), nothing, nothing)


def _is_same(a: Paint, b: Paint) -> bool:
    in_both = np.isfinite(a.absorption + b.absorption + a.scattering + b.scattering)
    if not in_both.any():
        return False
    return all(
        bool(np.allclose(x[in_both], y[in_both], rtol=_ALIKE, atol=_ALIKE * float(np.nanmax(y))))
        for x, y in ((a.absorption, b.absorption), (a.scattering, b.scattering))
    )
