"""Defects of a scanned mesh whose file is valid: their numbers and places."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from coupole.kernels import kernel
from coupole.scan.mesh import Mesh

OUT_OF_PROPORTION = 200.0
"""An edge that is longer or shorter than the median edge by this factor has another scale (mm and m differ by
1000)."""
_ODD_SHARE = 1e-3
_SAMPLE = 1_000_000


@dataclass(frozen=True)
class Defects:
    """Counts, and the number of the first triangle with each defect, or -1."""

    non_manifold_edges: int
    first_non_manifold: int
    """Edges with three triangles or more."""
    flipped_edges: int
    first_flipped: int
    """Edges whose two triangles have opposite orientations, so that one of them shows its inside."""
    open_edges: int
    """Edges with only one triangle: rims of holes."""
    degenerate: int
    first_degenerate: int
    """Triangles without area."""
    odd_scale: int
    """Number of a triangle with another scale than the others, if there are more than a few such triangles;
    otherwise -1."""


def find_defects(mesh: Mesh) -> Defects:
    """Check all edges and triangles. This needs 24 bytes per triangle in addition to the mesh."""
    degenerate, first_degenerate = _degenerate(mesh.vertices, mesh.triangles)
    keys = np.empty(3 * len(mesh.triangles), np.uint64)
    _fill_edge_keys(mesh.triangles, keys)
    keys.sort()
    open_edges, (non_manifold, crowded_edge), (flipped_count, turned_edge) = _count_edges(keys)
    return Defects(
        non_manifold,
        _triangle_with(mesh.triangles, crowded_edge) if non_manifold else -1,
        flipped_count,
        _triangle_with(mesh.triangles, turned_edge) if flipped_count else -1,
        open_edges,
        degenerate,
        first_degenerate,
        _odd_scale(mesh),
    )


def longest_edges(mesh: Mesh, triangles: NDArray[np.uint32]) -> NDArray[np.float64]:
    """[n] longest edge of each of the triangles [n, 3], in the mesh's unit."""
    corners = mesh.vertices[triangles].astype(np.float64)
    edges: NDArray[np.float64] = np.linalg.norm(corners - np.roll(corners, 1, axis=1), axis=2).max(axis=1)
    return edges


def _odd_scale(mesh: Mesh) -> int:
    every = max(1, len(mesh.triangles) // _SAMPLE)
    longest = longest_edges(mesh, mesh.triangles[::every])
    median = np.median(longest)
    odd = (longest > OUT_OF_PROPORTION * median) | ((longest < median / OUT_OF_PROPORTION) & (longest > 0))
    return int(np.flatnonzero(odd)[0]) * every if odd.mean() > _ODD_SHARE else -1


@kernel
def _degenerate(vertices, triangles):  # type: ignore[no-untyped-def]
    """Number of triangles without area, in float64, and the first of them."""
    count, first = 0, -1
    u, v = np.empty(3), np.empty(3)
    for t in range(len(triangles)):
        for k in range(3):
            origin = np.float64(vertices[triangles[t, 0], k])
            u[k] = np.float64(vertices[triangles[t, 1], k]) - origin
            v[k] = np.float64(vertices[triangles[t, 2], k]) - origin
        x, y, z = u[1] * v[2] - u[2] * v[1], u[2] * v[0] - u[0] * v[2], u[0] * v[1] - u[1] * v[0]
        if x == 0.0 and y == 0.0 and z == 0.0:
            first = t if count == 0 else first
            count += 1
    return count, first


@kernel
def _fill_edge_keys(triangles, keys):  # type: ignore[no-untyped-def]
    """Fill keys with the lower vertex, the higher vertex and, in the last bit, the orientation of the triangle."""
    for t in range(len(triangles)):
        for k in range(3):
            a, b = np.uint64(triangles[t, k]), np.uint64(triangles[t, (k + 1) % 3])
            if a < b:
                keys[3 * t + k] = a << np.uint64(33) | b << np.uint64(1)
            else:
                keys[3 * t + k] = b << np.uint64(33) | a << np.uint64(1) | np.uint64(1)


@kernel
def _count_edges(keys):  # type: ignore[no-untyped-def]
    """Return the number of open edges; number and first key of edges with more than two triangles; and number and
    first key of flipped edges."""
    none = np.uint64(0)
    open_edges, crowded_count, turned_count, first_crowded, first_turned = 0, 0, 0, none, none
    at = 0
    while at < len(keys):
        end = at + 1
        while end < len(keys) and keys[end] >> np.uint64(1) == keys[at] >> np.uint64(1):
            end += 1
        if end - at == 1:
            open_edges += 1
        elif end - at > 2:
            first_crowded = keys[at] if crowded_count == 0 else first_crowded
            crowded_count += 1
        elif keys[at] == keys[at + 1]:
            first_turned = keys[at] if turned_count == 0 else first_turned
            turned_count += 1
        at = end
    return open_edges, (crowded_count, first_crowded), (turned_count, first_turned)


@kernel
def _triangle_with(triangles, key):  # type: ignore[no-untyped-def]
    """Return the first triangle that has this edge."""
    low, high = key >> np.uint64(33), (key >> np.uint64(1)) & np.uint64(0xFFFFFFFF)
    for t in range(len(triangles)):
        for k in range(3):
            a, b = np.uint64(triangles[t, k]), np.uint64(triangles[t, (k + 1) % 3])
            if min(a, b) == low and max(a, b) == high:
                return t
    return -1
