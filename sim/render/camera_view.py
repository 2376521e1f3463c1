"""The view from one camera pose: a triangle for each pixel, and the shading data of each triangle seen."""

from __future__ import annotations

from dataclasses import dataclass

import numba
import numpy as np
from numpy.typing import NDArray

from coupole.geometry import Transform
from sim.render.embree import centroid_and_normal
from sim.render.lens import Lens, Sight, sight
from sim.render.raster import visible_triangles
from sim.scene.scene import Scene


@dataclass(frozen=True)
class View:
    """`triangle` [h k, w k] int32: row of the tables below that a pixel (or its k x k samples) sees, or -1."""

    triangle: NDArray[np.int32]
    sides: NDArray[np.int64]
    """[seen] 2 t if the front of the scene's triangle t is seen (counter-clockwise), 2 t + 1 for its back."""
    centroids_mm: NDArray[np.float32]
    """[seen, 3] in the base frame, as all below."""
    normals: NDArray[np.float32]
    """[seen, 3] flat unit normals of the sides seen."""
    shading_normals: NDArray[np.float32]
    """[seen, 3]; the flat ones if the scene has no others."""
    towards_camera: NDArray[np.float32]
    """[seen, 3] unit."""
    diffuse: NDArray[np.float32]
    """[seen, 3] reflectance, tint included."""
    material: NDArray[np.int32]
    """[seen] row of the scene's materials."""

    def depth_mm(self, base_from_camera: Transform) -> NDArray[np.float32]:
        """[h k, w k] depth of each pixel along the optical axis; infinite where it sees nothing."""
        axis, eye = base_from_camera[:3, 2], base_from_camera[:3, 3]
        depths = np.append(self.centroids_mm @ axis - eye @ axis, np.inf).astype(np.float32)
        of_pixel: NDArray[np.float32] = depths[self.triangle]
        return of_pixel

    def empty(self, samples: int) -> NDArray[np.float32]:
        """[h, w] fraction of each pixel's `samples` x `samples` that see nothing."""
        nothing = self.triangle < 0
        if samples > 1:
            height, width = nothing.shape
            nothing = nothing.reshape(height // samples, samples, width // samples, samples)
            return np.asarray(nothing.mean(axis=(1, 3)), np.float32)
        return nothing.astype(np.float32)


class Viewer:
    """Views of one scene through one lens, from any pose; `samples` k divides pixels into k x k."""

    def __init__(self, scene: Scene, lens: Lens, samples: int = 1) -> None:
        self._scene = scene
        self._sight: Sight = sight(lens.supersampled(samples))

    def look(self, base_from_camera: Transform) -> View:
        """Rasterise from a pose."""
        scene = self._scene
        triangle, seen = visible_triangles(scene.corners_mm, self._sight, base_from_camera)
        sides = np.empty(len(seen), np.int64)
        centroids, normals, towards = (np.empty((len(seen), 3), np.float32) for _ in range(3))
        _gather(scene.corners_mm, seen, base_from_camera[:3, 3].copy(), sides, centroids, normals, towards)
        shading = normals
        if scene.normals is not None:
            shading = scene.normals[seen] * np.where(sides & 1, np.float32(-1), np.float32(1))[:, None]
        material = scene.material[seen]
        diffuse = scene.materials[material, :3].astype(np.float32)
        if scene.tint is not None:
            diffuse *= scene.tint[seen]
        return View(triangle, sides, centroids, normals, shading, towards, diffuse, material)


def tangents(through: Sight) -> NDArray[np.float64]:
    """[h, w] tangent of the angle between a pixel's ray and the optical axis."""
    lens = through.lens
    x = (np.arange(lens.width_px)[None, :] - lens.centre_px[0]) / lens.focal_px
    y = (np.arange(lens.height_px)[:, None] - lens.centre_px[1]) / lens.focal_px
    if through.shift is not None:
        x, y = x + through.shift[0, :, : lens.width_px], y + through.shift[1, :, : lens.width_px]
    return np.asarray(np.hypot(x, y))


@numba.njit(cache=True, nogil=True, parallel=True)
def _gather(corners, seen, eye, sides, centroids, normals, towards):  # type: ignore[no-untyped-def]
    chunk = 4096
    for part in numba.prange(-(-len(seen) // chunk)):
        centroid, normal = np.empty(3), np.empty(3)
        for i in range(part * chunk, min(len(seen), (part + 1) * chunk)):
            centroid_and_normal(corners, seen[i], centroid, normal)
            x, y, z = eye[0] - centroid[0], eye[1] - centroid[1], eye[2] - centroid[2]
            distance = np.sqrt(x * x + y * y + z * z)
            back = x * normal[0] + y * normal[1] + z * normal[2] < 0.0
            sides[i] = 2 * seen[i] + back
            towards[i, 0], towards[i, 1], towards[i, 2] = x / distance, y / distance, z / distance
            for k in range(3):
                centroids[i, k] = centroid[k]
                normals[i, k] = -normal[k] if back else normal[k]
