"""Places on the mesh that a view's blocks of 2 x 2 pixels show, and the block that shows a place."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from coupole.calibration import optics
from coupole.calibration.multi_view import unproject
from coupole.calibration.optics import Intrinsics
from coupole.geometry import apply, inverse
from coupole.motion.packet_rays import PacketMesh
from coupole.reflectance.extraction.seen_surface import directions_of_rows, seen_surface

Floats = NDArray[np.float64]
_SAME_PLACE = 3.0
"""Largest distance, in blocks, between a place and the surface that a view sees there. Up to this distance, the
view sees the place."""


def block_lens(lens: Intrinsics) -> Intrinsics:
    """The lens in blocks of 2 x 2 pixels: the middle of block c is pixel 2 c + 1/2."""
    return replace(lens, fx=lens.fx / 2, fy=lens.fy / 2, cx=(lens.cx - 0.5) / 2, cy=(lens.cy - 0.5) / 2)


@dataclass(frozen=True)
class ViewSurface:
    """A view's picture, and the place on the mesh that each of its blocks shows."""

    picture: NDArray[np.float32]
    """[h, w] signal of the blocks; NaN where it is clipped."""
    points_mm: NDArray[np.float32]
    """[h, w, 3] places in the base frame; NaN beside the object, at silhouettes, at grazing angles, and where the
    picture is clipped."""
    base_from_camera: Floats
    lens: Intrinsics
    """Lens in units of blocks."""

    def project(self, points_mm: Floats) -> Floats:
        """[n, 2] blocks that show the places [n, 3]."""
        inside = apply(inverse(self.base_from_camera), points_mm)
        blocks: Floats = optics.project(inside, self.lens.vector()).pixels
        return blocks

    def rays(self, blocks: Floats) -> Floats:
        """[n, 3] unit directions in the base frame of blocks [n, 2]."""
        directions: Floats = unproject(blocks, self.lens) @ self.base_from_camera[:3, :3].T
        return directions

    def detail(self, points_mm: Floats, normals: Floats) -> Floats:
        """[n] blocks per square millimetre of the surface at places; 0 for places that the view does not see."""
        height, width = self.picture.shape
        way = points_mm - self.base_from_camera[:3, 3]
        distance = np.linalg.norm(way, axis=1)
        cosine = -np.sum(way * normals, axis=1) / distance
        density = self.lens.fx * self.lens.fy * np.maximum(cosine, 0.0) / distance**2
        ahead = way @ self.base_from_camera[:3, 2] > 0
        blocks = np.full((len(points_mm), 2), -1.0)
        blocks[ahead] = self.project(points_mm[ahead])
        place = np.round(blocks).astype(int)
        inside = ahead & (place >= 0).all(axis=1) & (place < (width, height)).all(axis=1)
        column, row = np.where(inside[:, None], place, 0).T
        off = np.linalg.norm(self.points_mm[row, column] - points_mm, axis=1)
        in_view = inside & (off < _SAME_PLACE / np.sqrt(np.maximum(density, 1e-12)))  # also if off is NaN
        return np.asarray(np.where(in_view, density, 0.0))


def view_surface(
    picture: NDArray[np.float32],
    mesh: PacketMesh,
    normals: Floats,
    lens: Intrinsics,
    base_from_camera: Floats,
    threads: int,
) -> ViewSurface:
    """Return the surface that a view sees, by rays to a mesh with triangle `normals` [n, 3]; `lens` is in
    pixels."""
    height, width = picture.shape
    blocks = block_lens(lens)
    surface = seen_surface(mesh, normals, blocks, base_from_camera, (width, height), threads=threads)
    in_use = (surface.places >= 0) & np.isfinite(picture)
    triangle = surface.triangles[surface.places[in_use]]
    ways = directions_of_rows(blocks, width, 0, height)[in_use] @ base_from_camera[:3, :3].T
    eye = base_from_camera[:3, 3]
    corners = np.asarray(mesh.corners_mm)[triangle, 0]
    far = np.sum((corners - eye) * normals[triangle], axis=1) / np.sum(ways * normals[triangle], axis=1)
    points = np.full((height, width, 3), np.nan, np.float32)
    points[in_use] = eye + far[:, None] * ways
    return ViewSurface(picture, points, base_from_camera, blocks)
