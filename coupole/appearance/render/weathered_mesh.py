"""Meshes with two numbers at each vertex: how much of a layer is worn off, and how much dust lies there."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from coupole.appearance.render.materials.weathering import (
    DUSTY,
    WORN,
    Cracks,
    Dusty,
    Edges,
    Uniform,
    Weathered,
    Worn,
)
from coupole.appearance.shapes import solid_masks
from coupole.appearance.shapes.solid_masks import Divided
from coupole.appearance.shapes.triangles import flat_normals, weld_corners
from coupole.appearance.spectra.grid import Array
from coupole.errors import InputError

_FINE = 2.0
"""Number of triangles across the width of a crack."""
_FINE_EDGE = 5.0
"""Number of triangles across the `reach_mm` of a worn edge."""
_MOST_OFF = 0.01


def write(corners_mm: Array, material: Weathered, path: Path, *, smooth: bool) -> None:
    """Write triangles [n, 3, 3] as a PLY file for Mitsuba. Raises InputError for an impossible share."""
    mesh = weathered_triangles(corners_mm, material, smooth=smooth)
    numbers = {WORN: np.repeat(mesh.off.astype(float), 3)}
    if isinstance(material, Dusty):
        numbers[DUSTY] = material.covered_share(mesh.normals[..., 2].ravel())
    _write_ply(mesh, numbers, path)


def weathered_triangles(corners_mm: Array, material: Weathered, *, smooth: bool) -> Divided:
    """Return triangles, divided as finely as the pattern needs, with its mask. Raises InputError."""
    normals = _corner_normals(corners_mm, smooth=smooth)
    wear = material.over if isinstance(material, Dusty) else material
    if not isinstance(wear, Worn) or isinstance(wear.pattern, Uniform):
        return Divided(corners_mm, normals, np.zeros(len(corners_mm), bool))
    pattern, share = wear.pattern, wear.share
    points, ways = solid_masks.spread_points(corners_mm, normals, pattern.seed)
    if isinstance(pattern, Cracks):
        field = solid_masks.cracks(points, pattern.cell_mm, pattern.seed)
    else:
        field = solid_masks.edges(points, ways, pattern.reach_mm)
    if share is None:
        assert isinstance(pattern, Cracks)
        assert pattern.width_mm is not None
        level_mm = 0.5 * pattern.width_mm
    else:
        level_mm = solid_masks.level_of(field, share, points, ways)
    finest_mm = pattern.reach_mm / _FINE_EDGE if isinstance(pattern, Edges) else 2.0 * level_mm / _FINE
    mesh = solid_masks.divide_triangles(corners_mm, normals, field, level_mm, max(finest_mm, 1e-4), share)
    if share is not None and abs(mesh.share - share) > _MOST_OFF:
        raise InputError(
            f"worn: expected a share of {share:g} by {pattern.kind}, found {mesh.share:.3f} on this surface; take "
            "another share or pattern (a flat sheet has no edges)"
        )
    return mesh


def _corner_normals(corners_mm: Array, *, smooth: bool) -> Array:
    """[n, 3, 3] normals; smooth normals are means over the triangles at a point, weighted by area."""
    flat = flat_normals(corners_mm)
    if not smooth:
        return np.repeat(flat[:, None], 3, axis=1)
    points, faces = weld_corners(corners_mm)
    across = np.cross(corners_mm[:, 1] - corners_mm[:, 0], corners_mm[:, 2] - corners_mm[:, 0])
    total = np.zeros_like(points)
    for corner in range(3):
        np.add.at(total, faces[:, corner], across)
    total /= np.maximum(np.linalg.norm(total, axis=1, keepdims=True), 1e-300)
    return np.asarray(total[faces])


def _write_ply(divided_mesh: Divided, numbers: dict[str, Array], path: Path) -> None:
    """Write a binary file with three vertices for each triangle. Mitsuba reads the vertex property `worn_0` as
    `vertex_worn`."""
    names = ["x", "y", "z", "nx", "ny", "nz", *(f"{name}_0" for name in numbers)]
    columns = [divided_mesh.corners_mm.reshape(-1, 3), divided_mesh.normals.reshape(-1, 3)]
    vertices = np.concatenate([*columns, *(column[:, None] for column in numbers.values())], axis=1).astype("<f4")
    faces = np.empty(len(divided_mesh.off), [("count", "u1"), ("rows", "<i4", 3)])
    faces["count"], faces["rows"] = 3, np.arange(3 * len(divided_mesh.off)).reshape(-1, 3)
    head = ["ply", "format binary_little_endian 1.0", f"element vertex {len(vertices)}"]
    head += [*(f"property float {name}" for name in names), f"element face {len(faces)}"]
    head += ["property list uchar int vertex_indices", "end_header", ""]
    path.write_bytes("\n".join(head).encode() + vertices.tobytes() + faces.tobytes())
