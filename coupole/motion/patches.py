"""Patches: an object's surface divided into parts of about the same area, each represented by a point."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

PATCHES = 400
_PIECE_EDGE, _LEAST_EDGE = 0.5, 1e-3
"""Longest edge of the pieces of patches, as a share of a patch's width; and a lower bound of this edge, as a
share of the object's size. Without the bound, slivers of a mesh would be split without end.
"""
_TURN_WIDTHS = 2.0
"""Weight of normals in clustering: a difference of 1 in the normals counts like this many patch widths."""


@dataclass(frozen=True)
class Patches:
    """Parts of an object's surface, each of about the same area, in the support frame."""

    points_mm: NDArray[np.float64]
    """[n, 3] a point on the surface that represents the patch."""
    normals: NDArray[np.float64]
    """[n, 3] unit, outwards: the mean over the patch."""
    areas_mm2: NDArray[np.float64]
    """[n]; 1 each without a mesh."""
    piece_patch: NDArray[np.int64]
    """[pieces] the patch that each piece of a triangle belongs to."""
    piece_triangle: NDArray[np.int64]
    """[pieces] the mesh's triangle from which each piece was cut."""

    def of_triangles(self, triangles: int) -> NDArray[np.int64]:
        """Return a patch for each of a mesh's triangles [triangles]: the patch of one of its pieces, or -1 for a
        triangle without area."""
        patch_of_triangle = np.full(triangles, -1)
        patch_of_triangle[self.piece_triangle] = self.piece_patch
        return patch_of_triangle


def patches_of(corners_mm: NDArray[np.float64], count: int = PATCHES) -> Patches:
    """Divide a mesh [triangles, 3, 3], corners counter-clockwise seen from outside, into about `count` patches.

    Triangles are split into pieces smaller than a patch. The set of pieces is repeatedly divided into halves of
    equal area, across the direction of position and normal with the largest spread. The same mesh gives the same
    patches; a mesh without area gives none.
    """
    width_mm = float(np.sqrt(_areas_and_normals(corners_mm)[0].sum() / count))
    if width_mm == 0.0:
        return patches_at([])
    size_mm = float(np.ptp(corners_mm, axis=(0, 1)).max())
    pieces_mm, triangle = _cut_triangles(corners_mm, max(_PIECE_EDGE * width_mm, _LEAST_EDGE * size_mm))
    areas_mm2, normals = _areas_and_normals(pieces_mm)
    real = areas_mm2 > 0
    pieces_mm, triangle, areas_mm2, normals = pieces_mm[real], triangle[real], areas_mm2[real], normals[real]
    centers_mm = pieces_mm.mean(axis=1)
    traits = np.hstack([centers_mm, _TURN_WIDTHS * width_mm * normals])
    patch = np.zeros(len(pieces_mm), np.int64)
    representatives = []
    for number, members in enumerate(_equal_groups(traits, areas_mm2, min(count, len(pieces_mm)))):
        patch[members] = number
        mean = _mean(traits[members], areas_mm2[members])
        representatives.append(members[np.argmin(np.linalg.norm(traits[members] - mean, axis=1))])
    total_mm2 = np.bincount(patch, areas_mm2).astype(np.float64)
    mean_normals = np.stack([np.bincount(patch, areas_mm2 * component) for component in normals.T], axis=1)
    length = np.linalg.norm(mean_normals, axis=1, keepdims=True)
    # The normals of a patch around a thin edge may cancel: then the normal of its point is used.
    unit = np.where(
        length > 1e-6 * total_mm2[:, None], mean_normals / np.maximum(length, 1e-300), normals[representatives]
    )
    return Patches(centers_mm[representatives], unit, total_mm2, patch, triangle)


def patches_at(points_mm: ArrayLike) -> Patches:
    """Return points [n, 3] in place of an object without a mesh, as patches of equal weight that face up."""
    points = np.asarray(points_mm, dtype=np.float64).reshape(-1, 3)
    nothing = np.zeros(0, np.int64)
    return Patches(points, np.tile((0.0, 0.0, 1.0), (len(points), 1)), np.ones(len(points)), nothing, nothing)


def _areas_and_normals(corners_mm: NDArray[np.float64]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return areas [n] and unit normals [n, 3] of triangles [n, 3, 3]; zeros for triangles without area."""
    across = np.cross(corners_mm[:, 1] - corners_mm[:, 0], corners_mm[:, 2] - corners_mm[:, 0])
    length = np.linalg.norm(across, axis=1)
    return length / 2, across / np.where(length > 0, length, 1.0)[:, None]


def _cut_triangles(
    corners_mm: NDArray[np.float64], edge_mm: float
) -> tuple[NDArray[np.float64], NDArray[np.int64]]:
    """Halve triangles across their longest edge until no edge is longer than `edge_mm`. Return the pieces, and for
    each piece the triangle that it comes from."""
    done_mm, done_of = [], []
    pieces_mm, of = corners_mm, np.arange(len(corners_mm))
    while len(pieces_mm):
        edges = np.linalg.norm(pieces_mm - np.roll(pieces_mm, -1, axis=1), axis=2)
        fine = edges.max(axis=1) <= edge_mm
        done_mm.append(pieces_mm[fine])
        done_of.append(of[fine])
        rest = np.flatnonzero(~fine)
        turn = (edges[rest].argmax(axis=1)[:, None] + np.arange(3)) % 3  # the longest edge first
        a, b, c = np.moveaxis(np.take_along_axis(pieces_mm[rest], turn[:, :, None], axis=1), 1, 0)
        middle = (a + b) / 2
        pieces_mm = np.concatenate([np.stack((a, middle, c), axis=1), np.stack((middle, b, c), axis=1)])
        of = np.tile(of[rest], 2)
    return np.concatenate(done_mm or [corners_mm]), np.concatenate(done_of or [of])


def _mean(values: NDArray[np.float64], weights: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the mean [k] of values [n, k]. `np.average` takes five times as long for a few of them."""
    return np.asarray(weights @ values / weights.sum())


def _equal_groups(
    traits: NDArray[np.float64], weights: NDArray[np.float64], count: int
) -> list[NDArray[np.int64]]:
    """Divide items with traits [n, k] into `count` groups of about equal weight with similar members."""
    groups, open_groups = [], [(np.arange(len(traits)), count)]
    while open_groups:
        members, parts = open_groups.pop()
        if parts <= 1:
            groups += [members] * parts
            continue
        deviations = traits[members] - _mean(traits[members], weights[members])
        widest = int(np.argmax(weights[members] @ deviations**2))
        members = members[np.argsort(traits[members, widest], kind="stable")]
        first_parts = parts // 2
        cumulative_weights = np.cumsum(weights[members])
        split = int(np.searchsorted(cumulative_weights, cumulative_weights[-1] * first_parts / parts))
        split = min(max(split, first_parts), len(members) - (parts - first_parts))
        open_groups += [(members[split:], parts - first_parts), (members[:split], first_parts)]
    return groups
