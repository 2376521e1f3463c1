"""Export of a hand-held laser scanner (Creaform VXelements): the object's mesh and its positioning targets.

An STL of VXelements is named so in its header and has attribute bytes, which are ignored. All lengths are
converted to mm; the frame is the scanner's.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from coupole.errors import InputError
from coupole.scan import mesh_defects, mesh_files, targets
from coupole.scan.mesh import Mesh
from coupole.scan.mesh_defects import Defects
from coupole.scan.targets import Targets

MM_PER_UNIT = {"mm": 1.0, "cm": 10.0, "m": 1000.0, "um": 1e-3, "in": 25.4}
PLAUSIBLE_MM = (2.0, 3000.0)
"""Smallest and largest diagonal of an object's bounding box; the support is 1.48 m wide."""
_TARGETS_BEYOND = 3.0
"""Greatest distance of targets from the object, relative to its size."""

Progress = Callable[[str], None]


@dataclass(frozen=True)
class Scan:
    """A scanned object, in mm and in the scanner's frame."""

    mesh: Mesh
    targets_mm: NDArray[np.float64]
    """[n, 3] centres; none without a table."""
    target_normals: NDArray[np.float64] | None
    target_names: tuple[str, ...]
    defects: Defects


def read_scan(
    mesh_path: Path,
    targets_path: Path | None = None,
    *,
    unit: str = "mm",
    targets_unit: str | None = None,
    accept_defects: bool = False,
    progress: Progress = lambda what: None,
) -> Scan:
    """Read mesh and targets and check them.

    `unit` is the unit of the mesh (mm, cm, m, um, in). `targets_unit` is the unit of the table; by default it is
    the unit named in the table, or the unit of the mesh. With `accept_defects`, a mesh is accepted although some
    edges have more than two triangles or opposite orientations; these are counted, not repaired. Raises
    InputError.
    """
    progress("reading the mesh")
    raw = mesh_files.read_mesh(mesh_path)
    mesh = Mesh((raw.vertices * np.float32(MM_PER_UNIT[unit])), raw.triangles)
    _expect_plausible(mesh_path, mesh, unit)
    progress("checking its edges")
    defects = mesh_defects.find_defects(mesh)
    _refuse(mesh_path, mesh, defects, accept_defects=accept_defects)
    if targets_path is None:
        return Scan(mesh, np.zeros((0, 3)), None, (), defects)
    progress("reading the targets")
    table = targets.read_targets(targets_path)
    centers_mm = table.centers * MM_PER_UNIT[_targets_unit(targets_path, table, targets_unit, unit)]
    _expect_together(mesh_path, mesh, targets_path, centers_mm)
    return Scan(mesh, centers_mm, table.normals, table.names, defects)


def _expect_plausible(path: Path, mesh: Mesh, unit: str) -> None:
    size_mm = float(np.linalg.norm(np.ptp(mesh.vertices, axis=0)))
    low_mm, high_mm = PLAUSIBLE_MM
    if low_mm <= size_mm <= high_mm:
        return
    fitting = [u for u, mm in MM_PER_UNIT.items() if low_mm <= size_mm / MM_PER_UNIT[unit] * mm <= high_mm]
    hint = f"; in {' or '.join(fitting)} it would fit: give its unit with --unit" if fitting else ""
    raise InputError(
        f"{path}: the mesh is {size_mm:.4g} mm in size if it is in {unit}; expected {low_mm:g} to {high_mm:g} mm"
        f"{hint}"
    )


def _refuse(path: Path, mesh: Mesh, defects: Defects, *, accept_defects: bool) -> None:
    def at(triangle: int) -> str:
        x, y, z = mesh.vertices[mesh.triangles[triangle]].mean(axis=0)
        return f"the first is at triangle {triangle}, ({x:.2f}, {y:.2f}, {z:.2f}) mm"

    if defects.odd_scale >= 0:
        edge_mm = float(mesh_defects.longest_edges(mesh, mesh.triangles[[defects.odd_scale]])[0])
        raise InputError(
            f"{path}: mixed units? Triangle {defects.odd_scale} has an edge of {edge_mm:.3g} mm, more than "
            f"{mesh_defects.OUT_OF_PROPORTION:g} times out of proportion to most others"
        )
    if accept_defects:
        return
    if defects.non_manifold_edges:
        raise InputError(
            f"{path}: not a surface: {defects.non_manifold_edges} edges have three triangles or more; "
            f"{at(defects.first_non_manifold)}. Repair it in the scanner's software, or give --accept-defects"
        )
    if defects.flipped_edges:
        raise InputError(
            f"{path}: {defects.flipped_edges} edges are between triangles of opposite orientation; "
            f"{at(defects.first_flipped)}. Repair the normals, or accept it with --accept-defects"
        )


def _targets_unit(path: Path, table: Targets, stated_unit: str | None, mesh_unit: str) -> str:
    if stated_unit and table.unit and stated_unit != table.unit:
        raise InputError(
            f"{path}: the unit in the table is {table.unit}, the unit of --targets-unit is {stated_unit}"
        )
    return stated_unit or table.unit or mesh_unit


def _expect_together(mesh_path: Path, mesh: Mesh, path: Path, centers_mm: NDArray[np.float64]) -> None:
    low, high = mesh.vertices.min(axis=0).astype(np.float64), mesh.vertices.max(axis=0).astype(np.float64)
    size_mm = float(np.linalg.norm(high - low))
    beyond_mm = np.linalg.norm(np.maximum(0, np.maximum(low - centers_mm, centers_mm - high)), axis=1)
    spread_mm = float(np.linalg.norm(np.ptp(centers_mm, axis=0)))
    if len(centers_mm) > 1 and spread_mm < size_mm / mesh_defects.OUT_OF_PROPORTION:
        raise InputError(
            f"{path}: mixed units? The targets lie within {spread_mm:.3g} mm, the mesh of {mesh_path.name} is "
            f"{size_mm:.4g} mm in size; give the table's unit with --targets-unit"
        )
    far = int(np.argmax(beyond_mm))
    if beyond_mm[far] > _TARGETS_BEYOND * size_mm:
        raise InputError(
            f"{path}: target {far + 1} is {beyond_mm[far]:.4g} mm away from the mesh of {mesh_path.name}, "
            f"which is {size_mm:.4g} mm in size: another unit, frame or object?"
        )
