"""The object on the support: its triangles, and the points on it where the light dose is computed."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from coupole.errors import InputError, reason
from coupole.geometry import apply
from coupole.intake.input_files import InputFiles
from coupole.plan.plan import MeasuredObject
from coupole.plan.reading import PlanFiles
from coupole.scan.mesh_files import read_mesh

MM_PER_UNIT = {"mm": 1.0, "m": 1000.0, "um": 1e-3}
_LARGEST = 2.0
"""Largest side of an object, in diameters of the support."""
_SMALLEST_MM = 1.0
_DOUBTFUL_MM = 10.0
"""Objects smaller than this are measured, but wrong units are more likely."""
_LARGEST_AREA_MM2 = 1e8
"""Largest area of all triangles together. Above it, they cannot be the surface of an object."""


@dataclass(frozen=True)
class ObjectShape:
    """Shape of the object in the support frame, mm."""

    mesh_path: Path | None
    corners_mm: NDArray[np.float64]
    """[triangles, 3, 3]; no triangles without a mesh."""
    dose_points_mm: NDArray[np.float64]
    """[n, 3] corners and centre of the bounding box; without a mesh, the views' targets."""
    remarks: tuple[str, ...] = ()
    """Warnings about a valid mesh."""


def read_object(files: PlanFiles) -> ObjectShape:
    """Read the object. Raises InputError with the line in the plan if its mesh cannot be read, or if an object on
    this support cannot have its size."""
    corners, remarks = np.zeros((0, 3, 3)), []
    if files.mesh_path is not None:
        assert files.plan.object is not None
        try:
            corners = load_corners(files.mesh_path, files.plan.object, files.cell.files)
        except InputError as error:
            message = f"cannot read the mesh {error}"
            raise InputError([files.document.problem(("object", "mesh"), message)]) from error
        size_mm = float(np.ptp(corners, axis=(0, 1)).max())
        unit, diameter_mm = files.plan.object.mesh_unit, files.cell.rig.support.diameter_mm
        if problem := _impossible_size(corners, size_mm, unit, diameter_mm):
            raise InputError([files.document.problem(("object", "mesh_unit"), problem)])
        if size_mm < _DOUBTFUL_MM and (better := _other_unit(size_mm, unit, diameter_mm)):
            remarks.append(f"object {files.plan.object.id}: it is {size_mm:.3g} mm large. {better}")
    targets = [view.target_mm for view in files.plan.view_entries if hasattr(view, "target_mm")]
    return ObjectShape(files.mesh_path, corners, _dose_points(corners, targets), tuple(remarks))


def load_corners(mesh_path: Path, measured_object: MeasuredObject, files: InputFiles) -> NDArray[np.float64]:
    """Return triangles [n, 3, 3] of a mesh file in the support frame, mm. Raises InputError with the place in the
    file."""
    try:
        data = files.read_bytes(mesh_path)
    except OSError as error:
        raise InputError(f"{mesh_path}: {reason(error)}") from error
    except MemoryError as error:
        raise InputError(f"{mesh_path}: it does not fit into this machine's memory") from error
    mesh = read_mesh(mesh_path, data)
    corners = mesh.vertices.astype(np.float64)[mesh.triangles] * MM_PER_UNIT[measured_object.mesh_unit]
    return apply(measured_object.support_from_object.matrix(), corners)


def _impossible_size(corners: NDArray[np.float64], size_mm: float, unit: str, diameter_mm: float) -> str:
    """Return why a mesh cannot be an object on a support of this diameter; empty if it can."""
    if not _SMALLEST_MM <= size_mm <= _LARGEST * diameter_mm:
        return (
            f"read in {unit} the object is {size_mm:.3g} mm large; expected {_SMALLEST_MM:g} to "
            f"{_LARGEST * diameter_mm:g} mm. {_other_unit(size_mm, unit, diameter_mm)}".rstrip()
        )
    edges = corners[:, 1:] - corners[:, :1]
    area_mm2 = float(np.linalg.norm(np.cross(edges[:, 0], edges[:, 1]), axis=1).sum()) / 2.0
    if area_mm2 > _LARGEST_AREA_MM2:
        return f"its triangles have {area_mm2 / 1e6:.3g} m2 together; expected the surface of one object"
    return ""


def _other_unit(size_mm: float, unit: str, diameter_mm: float) -> str:
    """Return a sentence with the units in which the object would have an ordinary size; empty if there are
    none."""
    raw = size_mm / MM_PER_UNIT[unit]
    fitting = {
        other_unit: raw * mm
        for other_unit, mm in MM_PER_UNIT.items()
        if other_unit != unit and _DOUBTFUL_MM <= raw * mm <= diameter_mm
    }
    choices = [f"`mesh_unit: {other_unit}` makes it {other_mm:.4g} mm" for other_unit, other_mm in fitting.items()]
    return f"Is its unit right? {'; '.join(choices)}." if choices else ""


def _dose_points(
    corners: NDArray[np.float64], targets_mm: list[tuple[float, float, float]]
) -> NDArray[np.float64]:
    if len(corners) == 0:
        return np.array(targets_mm or [(0.0, 0.0, 0.0)])
    low, high = corners.min(axis=(0, 1)), corners.max(axis=(0, 1))
    box = [[x, y, z] for x in (low[0], high[0]) for y in (low[1], high[1]) for z in (low[2], high[2])]
    return np.concatenate([box, [(low + high) / 2]])
