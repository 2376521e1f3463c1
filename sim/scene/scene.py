"""The simulated scene: the support disk and the objects on it, and their materials.

Everything is in the robot's base frame, in mm; fluxes in lm.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from coupole.errors import InputError
from coupole.geometry import Transform
from sim.scene.brdf_table import NODES
from sim.scene.surface import Layer, Material, Surface

STONE = Material("warm stone", (0.62, 0.55, 0.42))
"""Material of an object for which neither file nor rig gives one (assumed)."""
PAINTED = Material("as coloured in its file", (1.0, 1.0, 1.0))
DIBOND = Material("black anodised Dibond", (0.04, 0.04, 0.045))
"""The support (assumed)."""
_UNIT_MM = {"mm": 1.0, "m": 1000.0, "um": 1e-3}
SUPPORT_CELL_MM = 5.0
"""Edge length of the support's triangles, which is the resolution of shadows on it."""
_CHUNK = 1 << 18


@dataclass(frozen=True)
class Waves:
    """The waves from `Layer.waves` of all materials, in the base frame."""

    table: NDArray[np.float64]
    """[waves, 6]."""
    first: NDArray[np.int64]
    """[materials + 1] the first wave of each material, and at the end the number of all waves."""


@dataclass(frozen=True)
class Scene:
    """All triangles in the base frame, and their materials; at least 40 bytes per triangle."""

    corners_mm: NDArray[np.float32]
    """[triangles, 3, 3]; at least 4 bytes follow in memory, which Embree may read."""
    material: NDArray[np.int32]
    """[triangles] row of `materials`."""
    materials: NDArray[np.float64]
    """[materials, 8] red, green, blue diffuse reflectance; red, green, blue f0; roughness; row of `tables`
    or -1."""
    tables: NDArray[np.float32]
    """[tables, theta_h, theta_d, phi_d, 3] tables of the materials that have one (`sim.scene.brdf_table`)."""
    tint: NDArray[np.float32] | None
    """[triangles, 3] factor of the diffuse reflectance."""
    normals: NDArray[np.float32] | None
    """[triangles, 3] unit normals for shading; None for flat ones."""
    waves: Waves | None = None
    """Detail finer than triangles; None if no surface has any."""


def load_surface(
    path: Path,
    unit: str,
    material: Material | None = None,
    detail: tuple[Layer, ...] = (),
    pictures_beside: Path | None = None,
) -> Surface:
    """Any mesh that trimesh reads (PLY, STL, OBJ, ...), in mm; no vertex is merged or dropped.

    Colours of vertices or faces, or a texture (at triangles' centroids), become the tint; they are sRGB. Without
    `material`, a coloured mesh reflects diffusely by its colours, and any other mesh has the material `STONE`.
    `detail` is added to it. Raises InputError.
    """
    import trimesh
    from trimesh.resolvers import FilePathResolver

    try:
        beside = FilePathResolver(str(pictures_beside or path))
        mesh: Any = trimesh.load(path, process=False, force="mesh", resolver=beside)
    except (OSError, ValueError) as error:
        raise InputError(f"{path}: expected a mesh of triangles (PLY, STL, OBJ); {error}") from error
    faces = np.asarray(mesh.faces)
    if len(faces) == 0:
        raise InputError(f"{path}: expected a mesh of triangles; found none")
    tint = _tint(mesh)
    plain = PAINTED if tint is not None else STONE
    corners = np.asarray(mesh.vertices)[faces]
    corners *= _UNIT_MM[unit]
    final_material = replace(material or plain, detail=detail)
    brightest = max(final_material.diffuse) * (1.0 if tint is None else float(tint.max()))
    texture = sum(layer.texture for layer in detail)
    if texture > 1.0 or texture * brightest > max(0.0, 1.0 - brightest):
        raise InputError(
            f"{path}: expected textures in `detail` that keep its diffuse reflectance of up to {brightest:.2f} "
            f"between 0 and 1; found changes of {texture:g} in all; make them weaker, or the material darker"
        )
    return Surface(corners, (final_material,), np.zeros(len(faces), np.int32), tint)


def _tint(mesh: Any) -> NDArray[np.float32] | None:
    """[triangles, 3] linear colours of a mesh; None if it has none."""
    kind, faces = mesh.visual.kind, np.asarray(mesh.faces)
    if kind == "face":
        srgb = np.asarray(mesh.visual.face_colors)[:, :3] / 255.0
    elif kind == "vertex":
        srgb = np.asarray(mesh.visual.vertex_colors)[faces][:, :, :3].mean(axis=1) / 255.0
    elif kind == "texture" and mesh.visual.uv is not None and _picture(mesh) is not None:
        picture = np.asarray(_picture(mesh).convert("RGB"))
        u, v = (np.asarray(mesh.visual.uv)[faces].mean(axis=1) % 1.0).T
        rows = ((1.0 - v) * len(picture)).astype(int).clip(0, len(picture) - 1)
        columns = (u * picture.shape[1]).astype(int).clip(0, picture.shape[1] - 1)
        srgb = picture[rows, columns] / 255.0
    else:
        return None
    # IEC 61966-2-1
    linear = np.where(srgb <= 0.04045, srgb / 12.92, ((srgb + 0.055) / 1.055) ** 2.4)
    return linear.astype(np.float32)


def _picture(mesh: Any) -> Any:
    material = mesh.visual.material
    return getattr(material, "image", None) or getattr(material, "baseColorTexture", None)


def support_disk(diameter_mm: float, cell_mm: float = SUPPORT_CELL_MM) -> Surface:
    """The support in its own frame, z up: rings of nearly equilateral triangles, 6 i points on ring i."""
    rings = max(1, round(0.5 * diameter_mm / cell_mm))
    parts = []
    inner = np.zeros((1, 3))
    for ring in range(1, rings + 1):
        angle = 2 * np.pi * np.arange(6 * ring) / (6 * ring)
        outer = 0.5 * diameter_mm * ring / rings * np.stack([np.cos(angle), np.sin(angle), 0 * angle], axis=1)
        sector, step = np.divmod(np.arange(6 * ring), ring)
        within = sector * (ring - 1) + step
        next_out = np.roll(outer, -1, axis=0)
        parts.append(np.stack([inner[within % len(inner)], outer, next_out], axis=1))
        gap = step < ring - 1
        ends = inner[(within[gap] + 1) % len(inner)]
        parts.append(np.stack([inner[within[gap]], next_out[gap], ends], axis=1))
        inner = outer
    corners = np.concatenate(parts)
    return Surface(corners, (DIBOND,), np.zeros(len(corners), np.int32))


def build_scene(things: Sequence[tuple[Surface, Transform]]) -> Scene:
    """Scene from surfaces, each with its `base_from_surface`."""
    counts = [len(surface.corners_mm) for surface, _ in things]
    total = sum(counts)
    # Embree reads vertices in units of 16 bytes: one float more than the last corner's three.
    corners = np.zeros(9 * total + 1, np.float32)[:-1].reshape(total, 3, 3)
    material = np.empty(total, np.int32)
    tint = np.ones((total, 3), np.float32) if any(s.tint is not None for s, _ in things) else None
    has_normals = any(surface.normals is not None for surface, _ in things)
    normals = np.empty((total, 3), np.float32) if has_normals else None
    materials: list[Material] = []
    waves: list[NDArray[np.float64]] = []
    first = 0
    for (surface, base_from_surface), count in zip(things, counts, strict=True):
        part = slice(first, first + count)
        # In chunks: a scan of 40 million triangles must not be in memory twice in float64.
        for start in range(0, count, _CHUNK):
            piece = surface.corners_mm[start : start + _CHUNK]
            points_in_base = piece.reshape(-1, 3) @ base_from_surface[:3, :3].T + base_from_surface[:3, 3]
            corners[first + start : first + start + len(piece)] = points_in_base.reshape(-1, 3, 3)
        material[part] = surface.material + len(materials)
        materials += surface.materials
        waves += [_waves(surface_material, base_from_surface) for surface_material in surface.materials]
        if tint is not None and surface.tint is not None:
            tint[part] = surface.tint
        if normals is not None:
            surface_normals = surface.normals if surface.normals is not None else _flat_normals(surface.corners_mm)
            normals[part] = surface_normals @ base_from_surface[:3, :3].T
        first += count
    table, tables = _packed_materials(materials)
    firsts = np.cumsum([0, *(len(surface_normals) for surface_normals in waves)])
    fine = Waves(np.concatenate(waves), firsts) if firsts[-1] else None
    return Scene(corners, material, table, tables, tint, normals, fine)


def _packed_materials(materials: Sequence[Material]) -> tuple[NDArray[np.float64], NDArray[np.float32]]:
    """`materials` and `tables` of a scene."""
    tables = [m.table for m in materials if m.table is not None]
    rows = np.cumsum([m.table is not None for m in materials]) - 1
    row_of = [-1 if m.table is None else row for m, row in zip(materials, rows, strict=True)]
    table = np.array([[*m.diffuse, *m.f0, m.roughness, row] for m, row in zip(materials, row_of, strict=True)])
    table = table.astype(np.float64).reshape(-1, 8)
    return table, np.stack(tables) if tables else np.empty((0, *NODES, 3), np.float32)


def _waves(material: Material, base_from_surface: Transform) -> NDArray[np.float64]:
    """[waves, 6] of a material's detail, as functions of the place in the base frame."""
    table = np.concatenate([np.empty((0, 6)), *(layer.waves() for layer in material.detail)])
    table[:, :3] = table[:, :3] @ base_from_surface[:3, :3].T
    table[:, 3] -= table[:, :3] @ base_from_surface[:3, 3]
    return table


def _flat_normals(corners_mm: NDArray[np.float64]) -> NDArray[np.float64]:
    cross = np.cross(corners_mm[:, 1] - corners_mm[:, 0], corners_mm[:, 2] - corners_mm[:, 0])
    length = np.linalg.norm(cross, axis=1, keepdims=True)
    flat: NDArray[np.float64] = np.divide(cross, length, out=np.zeros_like(cross), where=length > 0)
    return flat
