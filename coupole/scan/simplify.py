"""Simplification of large meshes."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray


def simplified_mesh(
    vertices_mm: NDArray[np.float64], faces: NDArray[np.int64], faces_at_most: int
) -> tuple[NDArray[np.float64], NDArray[np.int64]]:
    """Return vertices [n, 3] and faces [m, 3] of about the same shape with fewer faces: the vertices in each cell
    of a grid are merged. The cells are as large as necessary."""
    size_mm = float(np.ptp(vertices_mm, axis=0).max(initial=0.0))
    cells, surface = 512, (vertices_mm, faces)
    while len(surface[1]) > faces_at_most:
        places = np.floor((vertices_mm - vertices_mm.min(axis=0)) * (cells / size_mm)).astype(np.int64)
        _, cell_of, count = np.unique(places, axis=0, return_inverse=True, return_counts=True)
        cell_of = cell_of.reshape(-1)
        means = np.stack([np.bincount(cell_of, column) / count for column in vertices_mm.T], axis=1)
        a, b, c = cell_of[faces].T
        surface = means, cell_of[faces][(a != b) & (b != c) & (c != a)]
        cells = cells * 3 // 4
    return surface
