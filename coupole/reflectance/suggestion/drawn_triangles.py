"""Triangles of a mesh, drawn at random, and what the pixels on them see if the pose of a view has an error."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from coupole.reflectance.suggestion.supposed_signal import LEAST_COSINE, SeenParts, Surface

Floats = NDArray[np.float64]

_NEIGHBOURS = 12
PLACES = 4
"""Number of places on a triangle that stand for its pixels in a view, at most."""


@dataclass(frozen=True)
class MeshParts:
    """A mesh's triangles, each in one part of a surface."""

    corners_mm: Floats
    """[triangles, 3, 3] support frame."""
    part_of_triangle: NDArray[np.int64]
    """[triangles] -1 for a triangle without area."""

    @cached_property
    def centres_mm(self) -> Floats:
        """[triangles, 3]"""
        centres_mm: Floats = self.corners_mm.mean(axis=1, dtype=np.float64)
        return centres_mm

    @cached_property
    def _crosses_mm2(self) -> Floats:
        corners_mm = np.asarray(self.corners_mm, np.float64)
        first_mm = corners_mm[:, 0]
        crosses_mm2: Floats = np.cross(corners_mm[:, 1] - first_mm, corners_mm[:, 2] - first_mm)
        return crosses_mm2

    @cached_property
    def areas_mm2(self) -> Floats:
        """[triangles]"""
        areas_mm2: Floats = 0.5 * np.linalg.norm(self._crosses_mm2, axis=1)
        return areas_mm2

    @cached_property
    def normals(self) -> Floats:
        """[triangles, 3] unit."""
        normals: Floats = 0.5 * self._crosses_mm2 / np.maximum(self.areas_mm2, 1e-30)[:, None]
        return normals

    @cached_property
    def tree(self) -> cKDTree:
        """The triangles' centres."""
        return cKDTree(self.centres_mm)

    def triangles_at(self, places_mm: Floats) -> NDArray[np.int64]:
        """[n] for places [n, 3] near the surface the triangle above or below which each lies: of the nearest ones,
        by their centres, the first that contains it, or else the nearest."""
        count = min(_NEIGHBOURS, len(self.corners_mm))
        near = self.tree.query(places_mm, k=count)[1].reshape(-1, count)
        contain = _are_inside(places_mm[:, None], np.asarray(self.corners_mm[near], np.float64))
        triangles: NDArray[np.int64] = np.take_along_axis(near, contain.argmax(axis=1)[:, None], axis=1)[:, 0]
        return triangles

    def drawn(self, most: int, random: np.random.Generator) -> DrawnTriangles:
        """Draw at most so many triangles, each with the same chance. Those without area are left out."""
        numbers = np.flatnonzero(self.part_of_triangle >= 0)
        if len(numbers) > most:
            numbers = np.sort(random.choice(numbers, most, replace=False))
        return DrawnTriangles(self, numbers)


@dataclass(frozen=True)
class DrawnTriangles:
    """n triangles of a mesh."""

    mesh: MeshParts
    numbers: NDArray[np.int64]
    """[n]"""

    @property
    def parts(self) -> NDArray[np.int64]:
        """[n] numbers of their parts."""
        parts: NDArray[np.int64] = self.mesh.part_of_triangle[self.numbers]
        return parts

    @cached_property
    def points_mm(self) -> Floats:
        """[n, 3] their centres."""
        points_mm: Floats = self.mesh.centres_mm[self.numbers]
        return points_mm

    @cached_property
    def normals(self) -> Floats:
        """[n, 3] unit."""
        normals: Floats = self.mesh.normals[self.numbers]
        return normals

    @cached_property
    def areas_mm2(self) -> Floats:
        """[n]"""
        areas_mm2: Floats = self.mesh.areas_mm2[self.numbers]
        return areas_mm2

    def only(self, rows: NDArray[np.int64]) -> DrawnTriangles:
        """Return some of the triangles, by their rows."""
        return DrawnTriangles(self.mesh, self.numbers[rows])

    def pixels(self, surface: Surface, view: SeenParts) -> Floats:
        """[n] pixels of the triangles in a view, on average. A triangle is seen if its part is."""
        ways = view.camera_mm - surface.points_mm
        ways /= np.linalg.norm(ways, axis=1)[:, None]
        part_cosines = np.sum(ways * surface.normals, axis=1)
        with np.errstate(divide="ignore", invalid="ignore"):
            per_mm2 = np.where(view.pixels > 0.0, view.pixels / (surface.triangle_areas_mm2 * part_cosines), 0.0)
        cosines = np.sum(self._to(view.camera_mm) * self.normals, axis=1)
        return np.where(cosines > LEAST_COSINE, per_mm2[self.parts] * self.areas_mm2 * cosines, 0.0)

    def seen_normals(
        self, view: SeenParts, pixels: NDArray[np.int64], shift_mm: Floats, random: np.random.Generator
    ) -> Floats:
        """[n, PLACES, 3] unit normals at the places that a triangle's pixels really see. The pose of the view is
        wrong: a triangle lies `shift_mm` [n, 2] beside its supposed place, across the line of sight. So some
        pixels see a neighbouring triangle. `pixels` [n] is the number of pixels; one pixel has one place."""
        count = len(self.numbers)
        shares = random.dirichlet(np.ones(3), (count, PLACES))
        place_of = np.arange(PLACES)[None] % np.clip(pixels, 1, PLACES)[:, None]
        shares = np.take_along_axis(shares, place_of[:, :, None], axis=1)
        corners_mm = np.asarray(self.mesh.corners_mm[self.numbers], np.float64)
        places_mm = np.einsum("npc,nck->npk", shares, corners_mm)
        ways = self._to(view.camera_mm)
        across, along = _axes_across(ways.mean(axis=0))
        shift = shift_mm @ np.stack([across, along])
        steep = np.sum(ways * self.normals, axis=1)
        steep = np.where(np.abs(steep) > LEAST_COSINE, steep, LEAST_COSINE)
        places_mm += (shift - ways * (np.sum(self.normals * shift, axis=1) / steep)[:, None])[:, None]
        numbers = np.repeat(self.numbers[:, None], PLACES, axis=1)
        is_outside = ~_are_inside(places_mm, corners_mm[:, None])
        if is_outside.any():
            numbers[is_outside] = self.mesh.triangles_at(places_mm[is_outside])
        normals: Floats = self.mesh.normals[numbers]
        return normals

    def _to(self, camera_mm: Floats) -> Floats:
        """[n, 3] unit vectors from the triangles to a camera."""
        ways = camera_mm - self.points_mm
        ways /= np.linalg.norm(ways, axis=1)[:, None]
        return ways


def _axes_across(way: Floats) -> tuple[Floats, Floats]:
    """Return two unit vectors at right angles to a way and to each other."""
    other = np.eye(3)[np.argmin(np.abs(way))]
    across = np.cross(way, other)
    across /= np.linalg.norm(across)
    along = np.cross(way / np.linalg.norm(way), across)
    return across, along


def _are_inside(places_mm: Floats, corners_mm: Floats) -> NDArray[np.bool_]:
    """[...] Tell whether places [..., 3] lie within triangles [..., 3, 3], seen along the triangles' normals."""
    first, second = corners_mm[..., 1, :] - corners_mm[..., 0, :], corners_mm[..., 2, :] - corners_mm[..., 0, :]
    rest = places_mm - corners_mm[..., 0, :]
    aa, ab, bb = np.sum(first * first, -1), np.sum(first * second, -1), np.sum(second * second, -1)
    ra, rb = np.sum(rest * first, -1), np.sum(rest * second, -1)
    determinant = np.maximum(aa * bb - ab**2, 1e-30)
    u, v = (bb * ra - ab * rb) / determinant, (aa * rb - ab * ra) / determinant
    is_inside: NDArray[np.bool_] = (u >= 0.0) & (v >= 0.0) & (u + v <= 1.0)
    return is_inside
