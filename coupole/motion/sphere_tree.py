"""Shapes as trees of spheres, the common representation for distances.

A capsule is a chain of spheres; a mesh has a sphere about each of many points of its surface. Both enclose the
real shape, so a distance between spheres is never more than the true one. The root of a tree bounds the whole
shape, and each level halves it, down to single spheres (Quinlan, "Efficient Distance Computation between
Non-Convex Objects", 1994).
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from coupole.motion.remembered import Remembered

Floats = NDArray[np.float64]

MESH_STEP_MM = 6.0
"""Spacing of the points on an object's surface."""
_CHAIN_EXCESS_MM = 1.0
"""Largest excess of a chain of spheres over the capsule that it covers."""
_TREES: Remembered[Floats] = Remembered(most=64)


class Spheres(NamedTuple):
    """Centres [n, 3] and radii [n], mm."""

    centers_mm: Floats
    radii_mm: Floats


class SphereTrees(NamedTuple):
    """Trees of spheres, concatenated. There are only two arrays, because numba's compile time grows with their
    number."""

    nodes: Floats
    """[m, 4] centre and radius of each node's sphere, mm. The sphere of a node bounds all its descendants; a leaf
    is a sphere of the shape."""
    trees: NDArray[np.int64]
    """[k, 2] for each tree the index of its first node, and its first leaf. Nodes are numbered like a heap: the
    root is 1, the children of i are 2 i and 2 i + 1."""


def spheres_of(segments_mm: Floats, radii_mm: Floats) -> Spheres:
    """Return chains of spheres that cover capsules, which are all points within `radii_mm` [n] of segments [n, 2,
    3].

    The first and last sphere are at the ends. Between them, if a point of the capsule is at an axial distance of
    at most h from the centre of a sphere, its distance from the centre is at most sqrt(r^2 + h^2).
    """
    centers, radii = [], []
    for (start, end), radius in zip(segments_mm, radii_mm, strict=True):
        length = float(np.linalg.norm(end - start))
        longest_half_step = np.sqrt((radius + _CHAIN_EXCESS_MM) ** 2 - radius**2)
        count = max(1, int(np.ceil(length / (2.0 * longest_half_step))))
        centers.append(np.linspace(start, end, count + 1))
        radii.append(np.full(count + 1, np.hypot(radius, length / (2.0 * count))))
    return Spheres(np.concatenate(centers), np.concatenate(radii))


def surface_points(corners_mm: Floats, step_mm: float = MESH_STEP_MM) -> Floats:
    """Return points [n, 3] on a mesh of corners [triangles, 3, 3]. No point of the surface is farther than
    `step_mm` from one of them.

    Each triangle is divided into similar ones with edges of at most e. Then each of their points is at most e /
    sqrt(3) from a corner. In each cubic cell of edge c, one corner is kept; it is at most c sqrt(3) from the
    others.
    """
    edge_mm = 0.6 * step_mm
    cell_mm = (step_mm - edge_mm / np.sqrt(3)) / np.sqrt(3)
    longest_mm = np.linalg.norm(corners_mm - np.roll(corners_mm, 1, axis=1), axis=2).max(axis=1, initial=0.0)
    parts = np.maximum(1, np.ceil(longest_mm / edge_mm)).astype(np.int64)
    point_sets_mm = [np.zeros((0, 3))]
    for count in np.unique(parts):
        first, second = np.indices((count + 1, count + 1)).reshape(2, -1)
        shares = np.stack([count - first - second, first, second], axis=1)[first + second <= count] / count
        point_sets_mm.append(_one_per_cell((shares @ corners_mm[parts == count]).reshape(-1, 3), cell_mm))
    return _one_per_cell(np.concatenate(point_sets_mm), cell_mm)


def _one_per_cell(points: Floats, cell_mm: float) -> Floats:
    cells = np.floor(points / cell_mm).astype(np.int64) + 2**20
    _, first = np.unique((cells[:, 0] << 42) | (cells[:, 1] << 21) | cells[:, 2], return_index=True)
    cell_points: Floats = points[first]
    return cell_points


def sphere_trees_of(shapes: Sequence[Spheres]) -> SphereTrees:
    """Return trees over shapes, in their order. Each shape has at least one sphere."""
    trees = [_TREES.result((*shape,), lambda shape=shape: _tree(shape)) for shape in shapes]  # type: ignore[misc]
    sizes = [len(nodes) for nodes in trees]
    return SphereTrees(
        np.concatenate(trees), np.column_stack([np.cumsum([0, *sizes[:-1]]), [size // 2 for size in sizes]])
    )


def _tree(shape: Spheres) -> Floats:
    """Return [m, 4] nodes of a tree that halves a shape across its longest side; index 0 is unused, and the last
    sphere is repeated to fill the leaves."""
    spheres = np.column_stack([shape.centers_mm, shape.radii_mm])
    depth = int(np.ceil(np.log2(len(spheres))))
    spheres = spheres[np.minimum(np.arange(1 << depth), len(spheres) - 1)]
    levels = [np.zeros((1, 4))]
    for level in range(depth):
        groups = spheres.reshape(1 << level, -1, 4)
        low, high = groups[..., :3].min(axis=1), groups[..., :3].max(axis=1)
        middles = (low + high) / 2
        radii = (np.linalg.norm(groups[..., :3] - middles[:, None], axis=2) + groups[..., 3]).max(axis=1)
        levels.append(np.column_stack([middles, radii]))
        longest = np.argmax(high - low, axis=1)[:, None, None]
        along = np.take_along_axis(groups[..., :3], longest, axis=2)[..., 0]
        spheres = np.take_along_axis(groups, np.argsort(along, axis=1)[..., None], axis=1)
    return np.concatenate([*levels, spheres.reshape(-1, 4)])
