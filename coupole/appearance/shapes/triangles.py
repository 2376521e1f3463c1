"""Sheets, disks and bodies of triangles: corners [n, 3, 3], mm, z up, counter-clockwise seen from outside."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from coupole.errors import InputError

Array = NDArray[np.float64]


def flat_normals(corners_mm: Array) -> Array:
    """[triangles, 3] unit normals; zero for a triangle without area."""
    cross = np.cross(corners_mm[:, 1] - corners_mm[:, 0], corners_mm[:, 2] - corners_mm[:, 0])
    length = np.linalg.norm(cross, axis=1, keepdims=True)
    return np.asarray(np.divide(cross, length, out=np.zeros_like(cross), where=length > 0))


def grid_faces(rows: int, columns: int) -> NDArray[np.int64]:
    """[2 rows columns, 3] corners of a grid of `rows` by `columns` cells, with points numbered row by row.

    The two triangles of a cell follow each other. Rows go along y and columns along x: seen from above they are
    counter-clockwise.
    """
    index = np.arange((rows + 1) * (columns + 1)).reshape(rows + 1, columns + 1)
    a, b, c, d = index[:-1, :-1], index[:-1, 1:], index[1:, 1:], index[1:, :-1]
    return np.stack([np.stack([a, b, c], -1), np.stack([a, c, d], -1)], axis=2).reshape(-1, 3)


def rectangle(width_mm: float, depth_mm: float, columns: int = 1, rows: int = 1, *, z_mm: float = 0.0) -> Array:
    """Return corners of a flat sheet of cells around the z axis, facing up."""
    return heightfield(width_mm, depth_mm, columns, rows, lambda x, _: np.full_like(x, z_mm))


def heightfield(
    width_mm: float, depth_mm: float, columns: int, rows: int, height_mm: Callable[[Array, Array], Array]
) -> Array:
    """Corners [2 rows columns, 3, 3] of z = `height_mm`(x, y) over a rectangle about the origin."""
    if columns < 1 or rows < 1:
        raise InputError(
            f"object: expected at least one cell each way, found {columns} x {rows}; ask for more triangles"
        )
    x, y = np.meshgrid(
        np.linspace(-width_mm / 2, width_mm / 2, columns + 1), np.linspace(-depth_mm / 2, depth_mm / 2, rows + 1)
    )
    points = np.stack([x, y, height_mm(x, y)], axis=-1).reshape(-1, 3)
    return np.asarray(points[grid_faces(rows, columns)])


def cells_for(triangles: int, width_mm: float, depth_mm: float) -> tuple[int, int]:
    """Return the number of columns and rows of nearly square cells that have at most about `triangles`
    triangles."""
    columns = max(1, round(np.sqrt(triangles / 2 * width_mm / depth_mm)))
    return columns, max(1, int(triangles / 2 / columns))


def slab(width_mm: float, depth_mm: float, thickness_mm: float) -> Array:
    """Corners of a closed box that rests on z = 0 about the origin; the first two triangles are its top."""
    lid = rectangle(width_mm, depth_mm, z_mm=thickness_mm)
    return np.concatenate([lid, skirt(lid)])


def skirt(top: Array, bottom_mm: float = 0.0) -> Array:
    """Corners of the walls from a sheet's rim down to z = `bottom_mm`, and of the bottom, to make a closed body.

    The rim consists of the edges with one triangle only. The bottom is a fan about the rim's centre, from
    which all of the rim must be visible.
    """
    points, faces = weld_corners(top)
    edges = np.concatenate([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]])
    _, place, count = np.unique(np.sort(edges, axis=1), axis=0, return_index=True, return_counts=True)
    rim = points[edges[place[count == 1]]]
    start, end = rim[:, 0], rim[:, 1]
    foot, next_foot = (p * [1.0, 1.0, 0.0] + [0.0, 0.0, bottom_mm] for p in (start, end))
    middle = np.broadcast_to([*foot[:, :2].mean(axis=0), bottom_mm], foot.shape)
    walls = [(start, foot, next_foot), (start, next_foot, end), (middle, next_foot, foot)]
    return np.concatenate([np.stack(corners, axis=1) for corners in walls])


def weld_corners(corners_mm: Array) -> tuple[Array, NDArray[np.int64]]:
    """Return points [n, 3] and triangles [m, 3] from corners; points that are equal to the nanometre are
    merged."""
    keys, faces = np.unique(np.round(corners_mm.reshape(-1, 3), 6) + 0.0, axis=0, return_inverse=True)
    return keys, faces.reshape(-1, 3)


def disk(radius_mm: float, segments: int, *, inner_mm: float = 0.0, z_mm: float = 0.0) -> Array:
    """Corners of a flat disk about the z axis facing up, or of a ring from `inner_mm` outwards."""
    angle = np.arange(segments + 1) * 2.0 * np.pi / segments
    rim = np.stack([np.cos(angle), np.sin(angle), 0.0 * angle], axis=1)
    rim[-1] = rim[0]
    lift = np.array([0.0, 0.0, z_mm])
    outer, inner = radius_mm * rim + lift, inner_mm * rim + lift
    outside = np.stack([inner[:-1], outer[:-1], outer[1:]], axis=1)
    if inner_mm == 0.0:
        return outside
    return np.concatenate([outside, np.stack([inner[:-1], outer[1:], inner[1:]], axis=1)])
