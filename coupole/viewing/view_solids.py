"""Shapes to draw: closed meshes of capsules, disks, boxes and spheres."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from numpy.typing import ArrayLike, NDArray

from coupole.scan.simplify import simplified_mesh

Points = NDArray[np.float64]


@dataclass(frozen=True)
class Solid:
    """A named body: vertices [n, 3] in mm and faces [m, 3], which run counter-clockwise as seen from outside."""

    name: str
    vertices_mm: Points
    faces: NDArray[np.int64]

    @property
    def corners_mm(self) -> Points:
        """[m, 3, 3]."""
        return self.vertices_mm[self.faces]


def join_solids(name: str, solids: Sequence[Solid]) -> Solid:
    """Several solids as one."""
    before = np.cumsum([0] + [len(solid.vertices_mm) for solid in solids])
    return Solid(
        name,
        np.concatenate([np.zeros((0, 3)), *(solid.vertices_mm for solid in solids)]),
        np.concatenate([np.zeros((0, 3), np.int64), *(s.faces + k for s, k in zip(solids, before, strict=False))]),
    )


def capsule(name: str, start_mm: ArrayLike, end_mm: ArrayLike, radius_mm: float, around: int = 24) -> Solid:
    """Return the body of all points within a radius of a segment. Its circles have `around` edges."""
    start, end = np.asarray(start_mm, np.float64), np.asarray(end_mm, np.float64)
    length = float(np.linalg.norm(end - start))
    z = (end - start) / length if length > 0 else np.array((0.0, 0.0, 1.0))
    x = np.cross(z, (1.0, 0.0, 0.0) if abs(z[0]) < 0.9 else (0.0, 1.0, 0.0))
    x /= np.linalg.norm(x)
    unit, faces, at_end = _ball(around)
    vertices = radius_mm * unit @ np.array((x, np.cross(z, x), z))
    return Solid(name, vertices + np.where(at_end[:, None], end, start), faces)


def sphere(name: str, center_mm: ArrayLike, radius_mm: float, around: int = 24) -> Solid:
    return capsule(name, center_mm, center_mm, radius_mm, around)


def box(name: str, low_mm: ArrayLike, high_mm: ArrayLike) -> Solid:
    """Return a box parallel to the axes."""
    corners = np.stack(np.meshgrid([0, 1], [0, 1], [0, 1], indexing="ij"), axis=-1).reshape(-1, 3)
    low, high = np.asarray(low_mm, np.float64), np.asarray(high_mm, np.float64)
    faces = [(0, 1, 3, 2), (4, 6, 7, 5), (0, 4, 5, 1), (2, 3, 7, 6), (0, 2, 6, 4), (1, 5, 7, 3)]
    return Solid(
        name, low + corners * (high - low), np.array([t for a, b, c, d in faces for t in ((a, b, c), (a, c, d))])
    )


def disk(name: str, radius_mm: float, thickness_mm: float, around: int = 96) -> Solid:
    """Return a disk around the origin, with its top at z = 0."""
    angle = np.linspace(0, 2 * np.pi, around, endpoint=False)
    rim = radius_mm * np.stack([np.cos(angle), np.sin(angle), 0 * angle], axis=1)
    low = np.array((0, 0, -thickness_mm))
    vertices = np.concatenate([rim, rim + low, np.zeros((1, 3)), low[None]])
    here = np.arange(around)
    there = (here + 1) % around
    top, bottom = np.full(around, 2 * around), np.full(around, 2 * around + 1)
    faces = [
        (here, there, top),
        (there + around, here + around, bottom),
        (here, here + around, there),
        (there, here + around, there + around),
    ]
    return Solid(name, vertices, np.concatenate([np.stack(f, axis=1) for f in faces]))


def with_fewer_faces(solid: Solid, faces_at_most: int) -> Solid:
    """Return about the same shape with fewer faces, for drawing."""
    return Solid(solid.name, *simplified_mesh(solid.vertices_mm, solid.faces, faces_at_most))


@lru_cache(maxsize=8)
def _ball(around: int) -> tuple[Points, NDArray[np.int64], NDArray[np.bool_]]:
    """Return a unit sphere with two equators, so that its halves can be moved apart to make a capsule. It has
    vertices, faces, and for each vertex whether it belongs to the upper half."""
    rings = max(2, around // 4)
    below = np.linspace(-np.pi / 2, 0, rings + 1)
    latitude = np.concatenate([below, -below[::-1]])
    longitude = np.linspace(0, 2 * np.pi, around, endpoint=False)
    lat, lon = (grid.ravel() for grid in np.meshgrid(latitude, longitude, indexing="ij"))
    vertices = np.stack([np.cos(lat) * np.cos(lon), np.cos(lat) * np.sin(lon), np.sin(lat)], axis=1)
    ring, step = (
        grid.ravel() for grid in np.meshgrid(np.arange(len(latitude) - 1), np.arange(around), indexing="ij")
    )
    a, b = ring * around + step, ring * around + (step + 1) % around
    faces = np.concatenate([np.stack((a, b, b + around), axis=1), np.stack((a, b + around, a + around), axis=1)])
    return vertices, faces, np.repeat(np.arange(len(latitude)) > rings, around)
