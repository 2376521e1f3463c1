"""The object on the support: its triangles, and the points on it where the light dose is computed."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from coupole.errors import InputError
from coupole.geometry import apply
from coupole.plan.plan import MeasuredObject
from coupole.plan.reading import PlanFiles

MM_PER_UNIT = {"mm": 1.0, "m": 1000.0, "um": 1e-3}


@dataclass(frozen=True)
class ObjectShape:
    """In the support frame, mm."""

    mesh_path: Path | None
    corners_mm: NDArray[np.float64]
    """[triangles, 3, 3]; none of them without a mesh."""
    dose_points_mm: NDArray[np.float64]
    """[n, 3] corners and centre of the bounding box; without a mesh, the views' targets."""


def read_object(files: PlanFiles) -> ObjectShape:
    """Raises InputError with the line in the plan if its mesh cannot be read."""
    corners = np.zeros((0, 3, 3))
    if files.mesh_path is not None:
        assert files.plan.object is not None
        try:
            corners = load_corners(files.mesh_path, files.plan.object)
        except Exception as error:  # any exception of trimesh means that the file is not a readable mesh
            message = f"cannot read the mesh {files.mesh_path}: {error}"
            raise InputError([files.document.problem(("object", "mesh"), message)]) from error
    targets = [view.target_mm for view in files.plan.views if hasattr(view, "target_mm")]
    return ObjectShape(files.mesh_path, corners, _dose_points(corners, targets))


def load_corners(mesh_path: Path, measured: MeasuredObject) -> NDArray[np.float64]:
    """Triangles [n, 3, 3] of a mesh file in the support frame, mm. Raises trimesh's exceptions."""
    import trimesh

    loaded: Any = trimesh.load(mesh_path, process=False, force="mesh")
    if len(loaded.faces) == 0:
        raise ValueError("it has no triangles")
    corners = np.asarray(loaded.vertices)[np.asarray(loaded.faces)] * MM_PER_UNIT[measured.mesh_unit]
    if not np.isfinite(corners).all():
        raise ValueError("it has vertices that are no finite numbers")
    return apply(measured.support_from_object.matrix(), corners)


def _dose_points(corners: NDArray[np.float64], targets_mm: list[Any]) -> NDArray[np.float64]:
    if len(corners) == 0:
        return np.array(targets_mm or [(0.0, 0.0, 0.0)])
    low, high = corners.min(axis=(0, 1)), corners.max(axis=(0, 1))
    box = [[x, y, z] for x in (low[0], high[0]) for y in (low[1], high[1]) for z in (low[2], high[2])]
    return np.concatenate([box, [(low + high) / 2]])
