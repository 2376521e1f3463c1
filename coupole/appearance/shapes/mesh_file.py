"""Triangles of mesh files."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from coupole.appearance.shapes.triangles import Array
from coupole.errors import InputError

_UNIT_MM = {"mm": 1.0, "m": 1000.0, "um": 1e-3}


def mesh_corners(path: Path, unit: str) -> Array:
    """Return the corners [triangles, 3, 3], in mm, of any mesh that trimesh reads; no vertices are merged. Raises
    InputError."""
    mesh = _load_mesh(path)
    corners: Array = np.asarray(mesh.vertices)[np.asarray(mesh.faces)] * _UNIT_MM[unit]
    return corners


def mesh_and_uv(path: Path, unit: str) -> tuple[Array, Array]:
    """Return corners as `mesh_corners` does, and their texture coordinates [triangles, 3, 2]. Raises
    InputError."""
    mesh = _load_mesh(path)
    uv = getattr(mesh.visual, "uv", None)
    if uv is None or len(uv) != len(mesh.vertices):
        raise InputError(f"{path}: expected a mesh with texture coordinates (OBJ, glTF); found none")
    faces = np.asarray(mesh.faces)
    return np.asarray(mesh.vertices)[faces] * _UNIT_MM[unit], np.asarray(uv, dtype=float)[faces]


def _load_mesh(path: Path) -> Any:
    import trimesh

    try:
        mesh: Any = trimesh.load(path, process=False, force="mesh")
    except (OSError, ValueError) as error:
        raise InputError(f"{path}: expected a mesh of triangles (PLY, STL, OBJ); {error}") from error
    if len(mesh.faces) == 0:
        raise InputError(f"{path}: expected a mesh of triangles; found none")
    return mesh
