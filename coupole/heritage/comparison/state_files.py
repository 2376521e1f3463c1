"""States of an object as files: a mesh or points, with or without colours of its vertices."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from coupole.errors import InputError
from coupole.scan.registration.prepared_scan import spacing, vertex_normals
from coupole.scan.registration.scan_files import read_scan, sources_of

Floats = NDArray[np.float64]


@dataclass(frozen=True)
class State:
    """An object at some time."""

    name: str
    points_mm: Floats
    """[n, 3]"""
    triangles: NDArray[np.int64]
    """[m, 3], none of a cloud."""
    outward: Floats | None
    """[n, 3] normals by the triangles."""
    srgb: NDArray[np.uint8] | None
    """[n, 3] colours of the vertices."""
    spacing_mm: float

    @property
    def size_mm(self) -> float:
        """Diagonal of the bounding box."""
        return float(np.linalg.norm(np.ptp(self.points_mm, axis=0)))


def read_state(path: Path, unit: str) -> State:
    """PLY (its colours too), STL, OBJ or text. Raises InputError."""
    sources = sources_of([path])
    if len(sources) != 1:
        raise InputError(
            f"{path}: expected one state; the file holds {len(sources)} scans: register and merge them"
        )
    content = read_scan(sources[0], unit, colours=True)
    mesh, srgb = content.mesh, None
    if content.srgba is not None and np.all(content.srgba[:, 3] == 255):
        srgb = content.srgba[:, :3]
    spacing_mm = spacing(mesh.vertices)
    if spacing_mm == 0:
        raise InputError(f"{path}: all its points lie in one place")
    return State(
        path.name,
        mesh.vertices.astype(np.float64),
        mesh.triangles.astype(np.int64),
        vertex_normals(mesh),
        srgb,
        spacing_mm,
    )
