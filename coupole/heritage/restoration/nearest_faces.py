"""Which triangle of another mesh of the same surface each triangle lies on."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from coupole.appearance.shapes.triangles import flat_normals
from coupole.heritage.restoration.painted_mesh import Floats, PaintedMesh

_CANDIDATES = 12
_CHUNK = 200_000
_SAME_SHARE = 1e-6
"""Of the mesh's size: corners that differ by less are the same."""


def nearest_faces(mesh: PaintedMesh, vertices_mm: Floats, triangles: NDArray[np.int64]) -> NDArray[np.int64]:
    """[m] for each triangle of `mesh` the nearest of `triangles` [k, 3] of `vertices_mm` [n, 3], by its middle.

    Among the twelve with the nearest middles, and first among those that face the same way, so that a thin wall
    keeps two sides. A mesh with the same triangles in the same order is taken one by one.
    """
    corners = vertices_mm[triangles]
    own = mesh.corners_mm
    size_mm = float(np.ptp(mesh.vertices_mm, axis=0).max())
    if own.shape == corners.shape and np.abs(own - corners).max() <= _SAME_SHARE * size_mm:
        return np.arange(len(own))
    from scipy.spatial import cKDTree

    tree = cKDTree(corners.mean(axis=1))
    middles, normals, others = own.mean(axis=1), flat_normals(own), flat_normals(corners)
    found = np.empty(len(own), np.int64)
    for first in range(0, len(own), _CHUNK):
        part = slice(first, first + _CHUNK)
        found[part] = _nearest(tree, corners, others, middles[part], normals[part])
    return found


def _nearest(tree: Any, corners: Floats, others: Floats, points: Floats, normals: Floats) -> NDArray[np.int64]:
    from trimesh.triangles import closest_point

    count = min(_CANDIDATES, len(corners))
    near = tree.query(points, k=count)[1].reshape(len(points), count)
    distance = np.stack(
        [np.linalg.norm(closest_point(corners[column], points) - points, axis=1) for column in near.T], axis=1
    )
    turned = np.einsum("nkc,nc->nk", others[near], normals) <= 0.0
    distance += np.where(turned, 1.0 + distance.max(), 0.0)
    return np.asarray(near[np.arange(len(points)), distance.argmin(axis=1)])
