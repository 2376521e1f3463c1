"""Building blocks of reliefs: profiles, noise, and distances in the plane, for arrays of places in mm."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]
Place = tuple[float, float]

_NOISE_CELLS = 128
NOISE_SPREAD = 0.87
"""Standard deviation of `noise`."""


def smooth_step(t: Array) -> Array:
    """0 below 0, 1 above 1, and 3 t^2 - 2 t^3 between."""
    t = np.clip(t, 0.0, 1.0)
    return t * t * (3.0 - 2.0 * t)


def half_round(offset: Array) -> Array:
    """Return the height of a half circle of radius 1 over the offset from its axis; 0 beside it."""
    return np.sqrt(np.maximum(0.0, 1.0 - offset**2))


def noise(x: Array, y: Array, period_mm: float, seed: int) -> Array:
    """Smooth random values [...] of mean 0 and standard deviation `NOISE_SPREAD`; they repeat after 128 periods.

    Random values at the nodes of a grid of `period_mm`, interpolated by a cubic spline.
    """
    from scipy.ndimage import map_coordinates, spline_filter

    nodes = np.random.default_rng((seed, _NOISE_CELLS)).standard_normal((_NOISE_CELLS, _NOISE_CELLS))
    coefficients = spline_filter(nodes, order=3, mode="grid-wrap")
    places = [np.asarray(y) / period_mm, np.asarray(x) / period_mm]
    return np.asarray(map_coordinates(coefficients, places, order=3, mode="grid-wrap", prefilter=False))


def distance_to_line(x: Array, y: Array, points: Sequence[Place]) -> tuple[Array, Array]:
    """Return the distance [...] of places to a line through `points`, and the place of its nearest point, 0 to 1
    along the line."""
    nearest, along = np.full(x.shape, np.inf), np.zeros(x.shape)
    pieces = len(points) - 1
    for piece, ((ax, ay), (bx, by)) in enumerate(pairwise(points)):
        dx, dy = bx - ax, by - ay
        share = np.clip(((x - ax) * dx + (y - ay) * dy) / (dx * dx + dy * dy), 0.0, 1.0)
        distance = np.hypot(x - ax - share * dx, y - ay - share * dy)
        along = np.where(distance < nearest, (piece + share) / pieces, along)
        nearest = np.minimum(nearest, distance)
    return nearest, along


def curve(points: Sequence[Place], pieces: int = 24) -> list[Place]:
    """Points of a smooth curve through `points` (Catmull-Rom)."""
    knots = np.array([points[0], *points, points[-1]])
    parts = len(points) - 1
    places = []
    for share in np.linspace(0.0, parts, pieces + 1):
        first = min(int(share), parts - 1)
        t = share - first
        a, b, c, d = knots[first : first + 4]
        point = 0.5 * (2 * b + (c - a) * t + (2 * a - 5 * b + 4 * c - d) * t**2 + (3 * (b - c) + d - a) * t**3)
        places.append((float(point[0]), float(point[1])))
    return places
