"""Assignment of a mesh's triangles to the triangles of another mesh of the same surface."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from coupole.appearance.shapes.triangles import flat_normals
from coupole.heritage.restoration.painted_mesh import Floats, PaintedMesh

_CANDIDATES = 12
_CHUNK = 200_000
_SAME_SHARE = 1e-6
"""Share of the mesh's size; corners with a smaller distance count as the same."""


def nearest_faces(mesh: PaintedMesh, vertices_mm: Floats, triangles: NDArray[np.int64]) -> NDArray[np.int64]:
    """[m] number of the nearest of `triangles` [k, 3], with vertices `vertices_mm` [n, 3], for the middle of each
    triangle of `mesh`.

    Distances include the difference of unit normals, times the median edge, so that the two sides of a thin wall
    stay separate. If a mesh has the same triangles in the same order, each triangle is assigned to its
    counterpart.
    """
    corners, mesh_corners_mm = vertices_mm[triangles], mesh.corners_mm
    size_mm = float(np.ptp(mesh.vertices_mm, axis=0).max())
    if mesh_corners_mm.shape == corners.shape and np.abs(mesh_corners_mm - corners).max() <= _SAME_SHARE * size_mm:
        return np.arange(len(mesh_corners_mm))
    from scipy.spatial import cKDTree

    edge_mm = float(np.median(np.linalg.norm(corners - np.roll(corners, 1, axis=1), axis=2)))
    normals_mm = edge_mm * flat_normals(corners)
    tree = cKDTree(np.concatenate([corners.mean(axis=1), normals_mm], axis=1))
    middles, mesh_normals_mm = mesh_corners_mm.mean(axis=1), edge_mm * flat_normals(mesh_corners_mm)
    nearest = np.empty(len(mesh_corners_mm), np.int64)
    for first in range(0, len(mesh_corners_mm), _CHUNK):
        part = slice(first, first + _CHUNK)
        nearest[part] = _nearest(tree, corners, normals_mm, middles[part], mesh_normals_mm[part])
    return nearest


def _nearest(
    tree: Any, corners: Floats, scaled_normals: Floats, points: Floats, normals_of_points: Floats
) -> NDArray[np.int64]:
    """Choose among the candidates with the nearest middles, by the distances to their surfaces."""
    from trimesh.triangles import closest_point

    count = min(_CANDIDATES, len(corners))
    near = tree.query(np.concatenate([points, normals_of_points], axis=1), k=count)[1].reshape(len(points), count)
    squares = [
        ((closest_point(corners[column], points) - points) ** 2).sum(axis=1)
        + ((scaled_normals[column] - normals_of_points) ** 2).sum(axis=1)
        for column in near.T
    ]
    return np.asarray(near[np.arange(len(points)), np.stack(squares, axis=1).argmin(axis=1)])
