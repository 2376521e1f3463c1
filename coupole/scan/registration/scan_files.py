"""Scans as files: meshes or clouds of points, read one at a time and checked before they are registered."""

from __future__ import annotations

import hashlib
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from coupole.errors import InputError, reason
from coupole.scan.mesh import Mesh, expect_finite
from coupole.scan.mesh_files import read_mesh
from coupole.scan.mesh_ply import read_ply
from coupole.scan.scanner_export import MM_PER_UNIT

TEXT_SUFFIXES = (".xyz", ".txt", ".asc")
SUFFIXES = (".ply", ".stl", ".obj", *TEXT_SUFFIXES)
LEAST_POINTS = 200
"""Of a scan: with fewer no shape can be recognized."""
PLAUSIBLE_SIZE_MM = (2.0, 1e6)
"""Diagonal of a scan's bounding box: from a coin to a cathedral."""


def read_points(path: Path, unit: str) -> Mesh:
    """A mesh, or points without triangles, in mm: PLY, STL, OBJ, or text with x, y and z first in each line.

    Raises InputError with the place of the error.
    """
    suffix = path.suffix.lower()
    if suffix not in SUFFIXES:
        raise InputError(f"{path}: expected a scan with the ending {', '.join(SUFFIXES)}")
    if not path.is_file():
        raise InputError(f"{path}: expected a scan; there is no such file")
    if path.stat().st_size == 0:
        raise InputError(f"{path}: expected a scan; the file is empty")
    if suffix == ".ply":
        found = read_ply(path)
    elif suffix in TEXT_SUFFIXES:
        found = Mesh(_read_text(path), np.zeros((0, 3), np.uint32))
    else:
        found = read_mesh(path)
    if len(found.vertices) < LEAST_POINTS:
        raise InputError(f"{path}: expected {LEAST_POINTS} points or more, found {len(found.vertices)}")
    mesh = Mesh(found.vertices * np.float32(MM_PER_UNIT[unit]), found.triangles)
    _expect_plausible(path, mesh, unit)
    return mesh


def _read_text(path: Path) -> NDArray[np.float32]:
    try:
        points = np.loadtxt(path, dtype=np.float32, usecols=(0, 1, 2), comments=("#", "//"), ndmin=2)
    except (ValueError, UnicodeDecodeError, OSError) as error:
        raise InputError(
            f"{path}: expected x, y and z first in each line, separated by blanks; {reason(error)}"
        ) from error
    expect_finite(path, points, "point {}")
    return points


def _expect_plausible(path: Path, mesh: Mesh, unit: str) -> None:
    size_mm = float(np.linalg.norm(np.ptp(mesh.vertices, axis=0).astype(np.float64)))
    low_mm, high_mm = PLAUSIBLE_SIZE_MM
    if low_mm <= size_mm <= high_mm:
        return
    fitting = [u for u, mm in MM_PER_UNIT.items() if low_mm <= size_mm / MM_PER_UNIT[unit] * mm <= high_mm]
    hint = f": is it in {' or '.join(fitting)}? Give its unit with --unit" if fitting and size_mm > 0 else ""
    raise InputError(
        f"{path}: the scan is {size_mm:.3g} mm in size if it is in {unit}; expected {low_mm:g} to {high_mm:g} mm"
        f"{hint}"
    )


def expect_different(paths: Sequence[Path]) -> None:
    """Raise InputError if two files hold the same bytes, or one is named twice."""
    seen: dict[str, Path] = {}
    for path in paths:
        try:
            with path.open("rb") as file:
                digest = hashlib.file_digest(file, "sha256").hexdigest()
        except OSError as error:
            raise InputError(f"{path}: expected a scan; {reason(error)}") from error
        if digest in seen:
            again = "is named twice" if seen[digest] == path else f"holds the same bytes as {seen[digest]}"
            raise InputError(f"{path}: {again}; name each scan once")
        seen[digest] = path


def names_of(paths: Sequence[Path]) -> list[str]:
    """The scans' names: those of their files, or paths where two files have the same name."""
    short = [path.name for path in paths]
    return short if len(set(short)) == len(short) else [str(path) for path in paths]
