"""States of an object as files: a mesh or points, with or without colours of its vertices."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from coupole.errors import InputError
from coupole.scan.registration.prepared_scan import spacing, vertex_normals
from coupole.scan.registration.scan_files import read_points

Floats = NDArray[np.float64]
_HEADER_BYTES = 65536


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
    mesh = read_points(path, unit)
    spacing_mm = spacing(mesh.vertices)
    if spacing_mm == 0:
        raise InputError(f"{path}: all its points lie in one place")
    return State(
        path.name,
        mesh.vertices.astype(np.float64),
        mesh.triangles.astype(np.int64),
        vertex_normals(mesh),
        _colours(path, len(mesh.vertices)),
        spacing_mm,
    )


def _colours(path: Path, count: int) -> NDArray[np.uint8] | None:
    """[n, 3] `red`, `green` and `blue` of a PLY's vertices, 8 bit; None without them."""
    if path.suffix.lower() != ".ply":
        return None
    with path.open("rb") as file:
        head = file.read(_HEADER_BYTES).split(b"end_header")[0]
    if b" red" not in head or b" blue" not in head:
        return None
    import trimesh

    loaded: Any = trimesh.load(path, process=False)
    colours = getattr(loaded, "colors", None)
    if colours is None:
        colours = loaded.visual.vertex_colors
    colours = np.asarray(colours)
    if len(colours) != count or colours.dtype != np.uint8:
        raise InputError(f"{path}: expected colours of {count} vertices, 8 bit; found {len(colours)}")
    return np.asarray(colours[:, :3])
