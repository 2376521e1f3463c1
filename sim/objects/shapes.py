"""Shapes for analytic checks and for looks: plane, sphere, sculpted relief."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from coupole.errors import InputError
from sim.objects import appearance
from sim.objects.patchwork import Array, cells_for, disk, heightfield, of_material, rectangle, skirt
from sim.scene.surface import Material, Surface

_ICOSAHEDRON_FACES = 20


def plane(
    width_mm: float, depth_mm: float, *, triangles: int = 2, material: Material = appearance.SPECTRALON
) -> Surface:
    """A flat sheet in z = 0 about the origin, facing up, of at most about `triangles` triangles."""
    columns, rows = cells_for(triangles, width_mm, depth_mm)
    return of_material(rectangle(width_mm, depth_mm, columns, rows), material)


def sphere(radius_mm: float, *, triangles: int = 20_000, material: Material = appearance.SPECTRALON) -> Surface:
    """A closed sphere that stands on z = 0: its centre is (0, 0, `radius_mm`). All corners lie on the sphere.

    An icosahedron whose faces are divided into n x n: 20 n^2 triangles, the number nearest to `triangles`.
    """
    if triangles < _ICOSAHEDRON_FACES:
        raise InputError(
            f"sphere: expected at least {_ICOSAHEDRON_FACES} triangles, found {triangles}; ask for more"
        )
    n = round(np.sqrt(triangles / _ICOSAHEDRON_FACES))
    return of_material(radius_mm * unit_sphere(n) + [0.0, 0.0, radius_mm], material)


def glossy_sphere(radius_mm: float, *, triangles: int = 20_000, roughness: float = 0.1) -> Surface:
    """A red sphere under a clear coat, standing on z = 0."""
    material = appearance.glossy("red under a clear coat", (0.45, 0.06, 0.05), roughness)
    return sphere(radius_mm, triangles=triangles, material=material)


def unit_sphere(n: int) -> Array:
    """Corners [20 n^2, 3, 3] on the unit sphere about the origin, outwards counter-clockwise."""
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
    upright = [(index[p, q], index[p + 1, q], index[p, q + 1]) for p in range(n) for q in range(n - p)]
    inverted = [
        (index[p + 1, q], index[p + 1, q + 1], index[p, q + 1]) for p in range(n) for q in range(n - p - 1)
    ]
    return np.asarray(net[:, np.array(upright + inverted)]).reshape(-1, 3, 3)


def sculpted_relief(
    size_mm: float = 120.0,
    *,
    triangles: int = 100_000,
    depth_mm: float = 18.0,
    seed: int = 1,
    material: Material = appearance.STONE,
) -> Surface:
    """A carved square tile that stands on z = 0: a boss of petals in a frame, and tool marks, as a closed body.

    About `triangles` triangles, of which the carved top has nearly all. Each seed carves another tile.
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
    return of_material(np.concatenate([top, skirt(top)]), material)


def cylinder(radius_mm: float, height_mm: float, segments: int) -> Array:
    """Corners of a closed upright cylinder that stands on z = 0."""
    top = disk(radius_mm, segments, z_mm=height_mm)
    return np.concatenate([top, skirt(top)])


def _smooth(t: Array) -> Array:
    """0 below 0, 1 above 1, and 3 t^2 - 2 t^3 between."""
    t = np.clip(t, 0.0, 1.0)
    return t * t * (3.0 - 2.0 * t)


def _icosahedron() -> tuple[Array, NDArray[np.int64]]:
    """Points [12, 3] on the unit sphere and faces [20, 3], outwards counter-clockwise."""
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
