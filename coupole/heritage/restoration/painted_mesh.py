"""A mesh with data that may define its parts: colours of its vertices, or a picture and the places of the corners
in it."""

from __future__ import annotations

import hashlib
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from coupole.errors import InputError
from coupole.scan.scanner_export import MM_PER_UNIT

SUFFIXES = (".ply", ".obj", ".stl", ".glb", ".gltf", ".off")
Floats = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class PaintedMesh:
    """Triangles in the file's own frame, in mm."""

    path: Path
    vertices_mm: Floats
    """[n, 3]"""
    triangles: NDArray[np.int64]
    """[m, 3] for each triangle the rows of its vertices."""
    srgb: NDArray[np.uint8] | None = None
    """[n, 3] colours of the vertices; None without them."""
    uv: Floats | None = None
    """[n, 2] places in the picture, v upwards; None without them."""
    texture: NDArray[np.uint8] | None = None
    """[h, w, 3] the picture named in the file."""

    @property
    def corners_mm(self) -> Floats:
        """[m, 3, 3]"""
        return np.asarray(self.vertices_mm[self.triangles])

    @property
    def middles_mm(self) -> Floats:
        """[m, 3] middles of the triangles."""
        return np.asarray(self.corners_mm.mean(axis=1))

    def digest(self) -> str:
        """Return the digest of the mesh's shape, without its colours."""
        hasher = hashlib.sha256(np.ascontiguousarray(self.vertices_mm).tobytes())
        hasher.update(np.ascontiguousarray(self.triangles).tobytes())
        return hasher.hexdigest()


def read_painted(path: Path, unit: str = "mm") -> PaintedMesh:
    """Read PLY, OBJ, STL, GLB, glTF or OFF by trimesh, without merging vertices, with colours and texture if the
    file has them.

    Raises InputError for a missing file, for a file without triangles, for coordinates that are not finite, and
    for an unknown unit.
    """
    import trimesh

    if unit not in MM_PER_UNIT:
        raise InputError(f"--unit {unit}: expected one of {', '.join(MM_PER_UNIT)}")
    if path.suffix.lower() not in SUFFIXES:
        raise InputError(f"{path}: expected a mesh with the ending {', '.join(SUFFIXES)}")
    if not path.is_file():
        raise InputError(f"{path}: expected a mesh file; there is none")
    try:
        mesh: Any = trimesh.load(path, process=False, force="mesh", maintain_order=True)
        triangles = np.asarray(mesh.faces, np.int64)
    except Exception as error:  # trimesh's readers raise what they meet: KeyError, struct.error, IndexError
        raise InputError(f"{path}: expected a mesh of triangles; {type(error).__name__}: {error}") from error
    if len(triangles) == 0:
        raise InputError(f"{path}: expected a mesh of triangles; found none")
    vertices_mm = np.asarray(mesh.vertices, np.float64) * MM_PER_UNIT[unit]
    if not np.isfinite(vertices_mm).all():
        bad = int(np.flatnonzero(~np.isfinite(vertices_mm).all(axis=1))[0])
        raise InputError(f"{path}: vertex {bad}: expected finite coordinates; mend the mesh")
    return PaintedMesh(path, vertices_mm, triangles, *_colours(mesh.visual, len(vertices_mm)))


def _colours(visual: Any, count: int) -> tuple[NDArray[np.uint8] | None, Floats | None, NDArray[np.uint8] | None]:
    """Return the colours of vertices, the places in the picture, and the picture; None for each that is
    missing."""
    srgb = uv = texture = None
    if visual.kind == "vertex":
        srgb = np.asarray(visual.vertex_colors)[:, :3].astype(np.uint8)
    elif visual.kind == "texture":
        if visual.uv is not None and len(visual.uv) == count:
            uv = np.asarray(visual.uv, np.float64)
        image = getattr(visual.material, "image", None) or getattr(visual.material, "baseColorTexture", None)
        texture = None if image is None else np.asarray(image.convert("RGB"))
        vertex_colours = visual.vertex_attributes.get("color") if hasattr(visual, "vertex_attributes") else None
        if vertex_colours is not None and len(vertex_colours) == count:
            srgb = _eight_bit(np.asarray(vertex_colours))[:, :3]
    return srgb, uv, texture


def _eight_bit(colours: NDArray[Any]) -> NDArray[np.uint8]:
    if colours.dtype == np.uint8:
        return colours
    full = 255.0 if np.issubdtype(colours.dtype, np.floating) else 255.0 / np.iinfo(colours.dtype).max
    return np.rint(np.clip(colours * full, 0, 255)).astype(np.uint8)
