"""Closed bodies: sphere, carved relief."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from coupole.appearance.shapes.triangles import Array, cells_for, heightfield, skirt


def unit_sphere(n: int) -> Array:
    """Return corners [20 n^2, 3, 3] on the unit sphere around the origin, counter-clockwise seen from outside."""
    points, faces = _icosahedron()
    a, b, c = (points[faces[:, k]][:, None, :] for k in range(3))
    # Steps (i, j) towards b and c on the flat face, then lifted onto the sphere.
    i, j = np.meshgrid(np.arange(n + 1), np.arange(n + 1), indexing="ij")
    inside = (i + j) <= n
    index = np.full((n + 1, n + 1), -1)
    index[inside] = np.arange(inside.sum())
    i, j = i[inside][:, None], j[inside][:, None]
    net = (a * (n - i - j) + b * i + c * j) / n
    net = net / np.linalg.norm(net, axis=-1, keepdims=True)
    upright_faces = [(index[p, q], index[p + 1, q], index[p, q + 1]) for p in range(n) for q in range(n - p)]
    inverted_faces = [
        (index[p + 1, q], index[p + 1, q + 1], index[p, q + 1]) for p in range(n) for q in range(n - p - 1)
    ]
    return np.asarray(net[:, np.array(upright_faces + inverted_faces)]).reshape(-1, 3, 3)


def relief(size_mm: float, triangles: int, depth_mm: float, seed: int) -> Array:
    """Return corners of a closed, carved square tile that rests on z = 0: a boss of petals in a frame, and tool
    marks.

    The tile has about `triangles` triangles, most of them in the carved top. Each seed gives a different tile.
    """
    columns, rows = cells_for(triangles, size_mm, size_mm)
    random = np.random.default_rng(seed)
    petals = int(random.integers(7, 12))
    turn, lean = random.uniform(0.0, 2.0 * np.pi, 2)
    marks = random.uniform(0.0, 2.0 * np.pi, (6, 2))

    def height_mm(x: Array, y: Array) -> Array:
        u, v = 2.0 * x / size_mm, 2.0 * y / size_mm
        r, phi = np.hypot(u, v), np.arctan2(v, u)
        swirl = np.cos(petals * phi + turn + 3.0 * r) * _smooth(r / 0.3)
        bloom = np.exp(-((r / 0.55) ** 4)) * (0.55 + 0.45 * np.sqrt(0.5 + 0.5 * swirl))
        heart = np.sqrt(np.clip(1.0 - (r / 0.18) ** 2, 0.0, None))
        frame = 0.45 * _smooth((np.maximum(np.abs(u), np.abs(v)) - 0.86) / 0.06)
        chisel = sum(
            0.01 * np.cos(24.0 * (u * np.cos(a) + v * np.sin(a)) + b) * np.cos(9.0 * u + lean) for a, b in marks
        )
        return np.asarray(
            0.25 * depth_mm + 0.6 * depth_mm * np.maximum(bloom * 0.8 + 0.25 * heart, frame) + depth_mm * chisel
        )

    top = heightfield(size_mm, size_mm, columns, rows, height_mm)
    return np.concatenate([top, skirt(top)])


def _smooth(t: Array) -> Array:
    """0 below 0, 1 above 1, and 3 t^2 - 2 t^3 between."""
    t = np.clip(t, 0.0, 1.0)
    return t * t * (3.0 - 2.0 * t)


def _icosahedron() -> tuple[Array, NDArray[np.int64]]:
    """Return points [12, 3] on the unit sphere and faces [20, 3], counter-clockwise seen from outside."""
    latitude = np.arctan(0.5)
    ring = np.arange(5) * 0.4 * np.pi
    flat, up = np.cos(latitude), np.sin(latitude)
    upper = np.stack([flat * np.cos(ring), flat * np.sin(ring), np.full(5, up)], axis=1)
    lower = np.stack(
        [flat * np.cos(ring + 0.2 * np.pi), flat * np.sin(ring + 0.2 * np.pi), np.full(5, -up)], axis=1
    )
    k = np.arange(5)
    after = (k + 1) % 5
    faces = [
        np.stack([0 * k, 1 + k, 1 + after], 1),
        np.stack([1 + k, 6 + k, 1 + after], 1),
        np.stack([1 + after, 6 + k, 6 + after], 1),
        np.stack([0 * k + 11, 6 + after, 6 + k], 1),
    ]
    points = np.concatenate([[[0.0, 0.0, 1.0]], upper, lower, [[0.0, 0.0, -1.0]]])
    return points, np.concatenate(faces)
