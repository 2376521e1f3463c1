"""The skin of a body: points with normals, used to coat the body, to scatter things over it, and to draw on it."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from coupole.appearance.shapes.triangles import Array, flat_normals, weld_corners
from coupole.errors import InputError


@dataclass(frozen=True)
class Skin:
    """Triangles with a normal at each point."""

    points_mm: Array
    """[n, 3]."""
    faces: NDArray[np.int64]
    """[m, 3] faces, counter-clockwise seen from outside."""
    normals: Array
    """[n, 3] unit normals, outwards."""

    @property
    def corners_mm(self) -> Array:
        """[m, 3, 3]."""
        return np.asarray(self.points_mm[self.faces])

    def areas_mm2(self) -> Array:
        """[m]."""
        a, b, c = np.moveaxis(self.corners_mm, 1, 0)
        return np.asarray(0.5 * np.linalg.norm(np.cross(b - a, c - a), axis=1))


def skin_of(corners_mm: Array) -> Skin:
    """Return the skin of corners [m, 3, 3]. A point's normal is the mean of its triangles' normals, weighted by
    their angles (Thuermer 1998)."""
    points, faces = weld_corners(corners_mm)
    sides = corners_mm[:, [1, 2, 0]] - corners_mm
    length = np.maximum(np.linalg.norm(sides, axis=2, keepdims=True), 1e-300)
    unit = sides / length
    angle = np.arccos(np.clip(-np.sum(unit * unit[:, [2, 0, 1]], axis=2), -1.0, 1.0))
    flat = flat_normals(corners_mm)
    sums = np.zeros_like(points)
    for corner in range(3):
        np.add.at(sums, faces[:, corner], angle[:, corner, None] * flat)
    size = np.linalg.norm(sums, axis=1, keepdims=True)
    return Skin(points, faces, sums / np.maximum(size, 1e-300))


def grown(skin: Skin, by_mm: float) -> Skin:
    """Return the skin moved outwards along its normals. Raises InputError if it would fold."""
    grown_skin = Skin(skin.points_mm + by_mm * skin.normals, skin.faces, skin.normals)
    facing = np.sum(flat_normals(grown_skin.corners_mm) * flat_normals(skin.corners_mm), axis=1)
    if folds := int(np.count_nonzero((facing < 0.0) & (skin.areas_mm2() > 1e-9))):
        raise InputError(
            f"coat: expected a surface whose hollows are wider than the coat of {by_mm:g} mm; {folds} triangles "
            "would fold; make the coat thinner, or the hollows rounder"
        )
    return grown_skin


def scatter_points(skin: Skin, count: int, random: np.random.Generator) -> tuple[Array, Array]:
    """Return `count` points [count, 3], evenly by area, and the frames [count, 3, 3] there. Their third columns
    are normals; their first columns are arbitrary directions in the surface."""
    areas = skin.areas_mm2()
    triangles = random.choice(len(areas), count, p=areas / areas.sum())
    root, second = np.sqrt(random.random(count)), random.random(count)
    share = np.stack([1.0 - root, root * (1.0 - second), root * second], axis=1)
    places = np.einsum("nk,nkj->nj", share, skin.points_mm[skin.faces[triangles]])
    normals = np.einsum("nk,nkj->nj", share, skin.normals[skin.faces[triangles]])
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    least = np.eye(3)[np.argmin(np.abs(normals), axis=1)]
    along = np.cross(least, normals)
    along /= np.linalg.norm(along, axis=1, keepdims=True)
    return places, np.stack([along, np.cross(normals, along), normals], axis=2)
