"""Masks of the parts of a surface where a layer is worn off, by fields in space, without texture coordinates.

A field is a number for each point of a surface and its normal. The layer is missing where this number is below a
level. Triangles are divided where the level may cross them, until they are as small as the pattern needs.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from coupole.appearance.spectra.grid import Array
from coupole.errors import InputError

Field = Callable[[Array, Array], Array]
"""Function of points [n, 3] in mm and normals [n, 3]. It returns numbers [n] in mm, which change by no more than
the distance between points."""
SAMPLES = 40_000
"""Number of points by which the level of a share is found."""
MOST_TRIANGLES = 2_000_000


@dataclass(frozen=True, eq=False)
class Divided:
    """Triangles with a mask."""

    corners_mm: Array
    """[n, 3, 3]"""
    normals: Array
    """[n, 3, 3] normals at the corners."""
    off: NDArray[np.bool_]
    """[n] True for triangles without the layer."""

    @property
    def share(self) -> float:
        """Share of the area without the layer."""
        areas = _areas(self.corners_mm)
        return float(areas[self.off].sum() / areas.sum())


def cracks(points_mm: Array, cell_mm: float, seed: int) -> Field:
    """Return a field: the distance to the nearest face between Voronoi cells. The cells belong to jittered points
    of a grid of `cell_mm`, around a surface that is given by its points [n, 3]."""
    from scipy.spatial import KDTree

    near = np.array([[x, y, z] for x in range(-2, 3) for y in range(-2, 3) for z in range(-2, 3)])
    own_cells = np.unique(np.floor(points_mm / cell_mm).astype(np.int64), axis=0)
    cells = np.unique((own_cells[:, None] + near).reshape(-1, 3), axis=0)
    seeds = (cells + np.random.default_rng(seed).random(cells.shape)) * cell_mm
    tree = KDTree(seeds)

    def distance(points: Array, normals: Array) -> Array:
        _, nearest = tree.query(points, 6)
        first, other_seeds = seeds[nearest[:, 0]], seeds[nearest[:, 1:]]
        between = other_seeds - first[:, None]
        to_middle = 0.5 * (other_seeds + first[:, None]) - points[:, None]
        return np.asarray((np.sum(to_middle * between, -1) / np.linalg.norm(between, axis=-1)).min(axis=1))

    return distance


def edges(points_mm: Array, normals: Array, reach_mm: float) -> Field:
    """Return a field that is lower on edges and convex places: minus the height over the mean of the surface
    within about `reach_mm`."""
    from scipy.spatial import KDTree

    tree = KDTree(points_mm)
    far, around = tree.query(points_mm, 48, distance_upper_bound=reach_mm)
    weight = np.isfinite(far).astype(float)
    mean = (np.where(weight[..., None] > 0.0, points_mm[np.minimum(around, len(points_mm) - 1)], 0.0)).sum(axis=1)
    height = np.sum((points_mm - mean / weight.sum(axis=1, keepdims=True)) * normals, axis=1)

    def depth(points: Array, _: Array) -> Array:
        away, at = tree.query(points, 6)
        closer = 1.0 / np.maximum(away, 1e-6)
        return -np.asarray((closer * height[at]).sum(axis=1) / closer.sum(axis=1))

    return depth


def spread_points(corners_mm: Array, normals: Array, seed: int, count: int = SAMPLES) -> tuple[Array, Array]:
    """Return points [n, 3] spread evenly over the area of triangles, and their normals."""
    random = np.random.default_rng(seed)
    areas = _areas(corners_mm)
    triangles = np.searchsorted(np.cumsum(areas) / areas.sum(), random.random(count)).clip(0, len(areas) - 1)
    root, v = np.sqrt(random.random(count)), random.random(count)
    weights = np.stack([1.0 - root, root * (1.0 - v), root * v], axis=1)[..., None]
    return (corners_mm[triangles] * weights).sum(axis=1), _unit((normals[triangles] * weights).sum(axis=1))


def level_of(field: Field, share: float, points_mm: Array, normals: Array) -> float:
    """Return the level below which a share of the points lies."""
    return float(np.quantile(field(points_mm, normals), share))


def divide_triangles(
    corners_mm: Array, normals: Array, field: Field, level_mm: float, finest_mm: float, share: float | None = None
) -> Divided:
    """Halve triangles at their longest edges where the level may cross them, until edges are at most `finest_mm`
    long.

    With a `share`, the level is moved a little so that this share of the area is below it. Raises InputError for
    more than `MOST_TRIANGLES`.
    """
    finished_parts: list[tuple[Array, Array]] = []
    corners, ways = np.asarray(corners_mm, dtype=float), np.asarray(normals, dtype=float)
    count = 0
    while len(corners):
        middle = corners.mean(axis=1)
        radius = np.linalg.norm(corners - middle[:, None], axis=-1).max(axis=1)
        sides = np.linalg.norm(corners - corners[:, [1, 2, 0]], axis=-1)
        is_crossed = np.abs(field(middle, _unit(ways.mean(axis=1))) - level_mm) < radius
        again = is_crossed & (sides.max(axis=1) > finest_mm)
        finished_parts.append((corners[~again], ways[~again]))
        count += int((~again).sum())
        if count + 2 * again.sum() > MOST_TRIANGLES:
            raise InputError(
                f"worn: a pattern of {finest_mm:.2g} mm needs more than {MOST_TRIANGLES} triangles; "
                "take larger cells, wider cracks or a smaller object"
            )
        edge = sides[again].argmax(axis=1)
        corners, ways = _halved_triangles(corners[again], edge), _halved_triangles(ways[again], edge)
    corners = np.concatenate([part for part, _ in finished_parts])
    ways = _unit(np.concatenate([part for _, part in finished_parts]))
    values = field(corners.mean(axis=1), _unit(ways.mean(axis=1)))
    if share is not None:
        order = np.argsort(values)
        areas = np.cumsum(_areas(corners)[order])
        level_mm = float(values[order][np.searchsorted(areas, share * areas[-1]).clip(0, len(order) - 1)])
    return Divided(corners, ways, values < level_mm)


def _halved_triangles(corners: Array, edge: NDArray[np.int64]) -> Array:
    """[2n, 3, 3] halves of triangles [n, 3, 3], divided at the middle of the edge that begins at the corner `edge`
    [n]."""
    rows = np.arange(len(corners))
    begin, end, apex = (corners[rows, (edge + step) % 3] for step in range(3))
    middle = 0.5 * (begin + end)
    return np.concatenate([np.stack([begin, middle, apex], axis=1), np.stack([middle, end, apex], axis=1)])


def _areas(corners: Array) -> Array:
    across = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    return np.asarray(0.5 * np.linalg.norm(across, axis=1))


def _unit(ways: Array) -> Array:
    return np.asarray(ways / np.maximum(np.linalg.norm(ways, axis=-1, keepdims=True), 1e-300))
