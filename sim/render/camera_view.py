"""The view from one camera pose: the surface at each pixel, and the sites at which the light on it is computed.

With `flat` shading, the sites are the centroids of the visible triangles, so each triangle has one radiance. With
shading by `pixel`, each pixel has its own sites. Each triangle that the pixel's rays meet gives one site: the
mean of the points where the rays meet this triangle.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numba
import numpy as np
from numpy.typing import NDArray

from coupole.geometry import Transform
from coupole.kernels import kernel
from sim.render.embree import centroid_and_normal
from sim.render.fine_surface import Fine, fine_surface
from sim.render.lens import Lens, Sight, sight
from sim.render.pixel_sites import pixel_sites
from sim.render.raster import visible_triangles
from sim.scene.scene import Scene

Shading = Literal["pixel", "flat"]


@dataclass(frozen=True)
class View:
    """Tables of the triangles seen, and of the sites on them; all in the base frame."""

    site: NDArray[np.int32]
    """[h k, w k] row of the tables of sites that a pixel (or each of its k x k rays) sees, or -1."""
    points_mm: NDArray[np.float32]
    """[sites, 3]."""
    triangle: NDArray[np.int32]
    """[sites] row of the tables of triangles."""
    fine: Fine | None
    """Detail of the sites' surface beyond its triangles; None: there is none."""
    eye_mm: NDArray[np.float64]
    """[3] the projection centre."""
    sides: NDArray[np.int64]
    """[seen] 2 t if the front of the scene's triangle t is seen (counter-clockwise), 2 t + 1 for its back."""
    normals: NDArray[np.float32]
    """[seen, 3] flat unit normals of the sides seen."""
    shading_normals: NDArray[np.float32]
    """[seen, 3]; the flat ones if the scene has no others."""
    diffuse: NDArray[np.float32]
    """[seen, 3] reflectance, tint included."""
    material: NDArray[np.int32]
    """[seen] row of the scene's materials."""

    def depth_mm(self, base_from_camera: Transform, samples: int) -> NDArray[np.float32]:
        """Return [h, w], the depth along the optical axis of the surface that the ray in the middle of each
        pixel's `samples` x `samples` meets; infinite if it meets nothing."""
        axis, eye = base_from_camera[:3, 2], base_from_camera[:3, 3]
        depths = np.append(self.points_mm @ axis.astype(np.float32) - np.float32(eye @ axis), np.float32(np.inf))
        of_pixel: NDArray[np.float32] = depths[self.site[samples // 2 :: samples, samples // 2 :: samples]]
        return of_pixel

    def empty(self, samples: int) -> NDArray[np.float32]:
        """[h, w] fraction of each pixel's `samples` x `samples` that see nothing."""
        nothing = self.site < 0
        if samples > 1:
            height, width = nothing.shape
            nothing = nothing.reshape(height // samples, samples, width // samples, samples)
            return np.asarray(nothing.mean(axis=(1, 3)), np.float32)
        return nothing.astype(np.float32)


class Viewer:
    """Views of one scene through one lens, from any pose; `samples` k divides pixels into k x k."""

    def __init__(self, scene: Scene, lens: Lens, samples: int = 1, shading: Shading = "flat") -> None:
        self._scene = scene
        self._sight: Sight = sight(lens.with_supersampling(samples))
        self._shading = shading

    def look(self, base_from_camera: Transform) -> View:
        """Rasterise from a pose."""
        scene = self._scene
        site, triangles = visible_triangles(scene.corners_mm, self._sight, base_from_camera)
        eye = base_from_camera[:3, 3].copy()
        sides, triangle, fine = np.empty(len(triangles), np.int64), np.arange(len(triangles), dtype=np.int32), None
        points, normals = (np.empty((len(triangles), 3), np.float32) for _ in range(2))
        _gather(scene.corners_mm, triangles, eye, sides, points, normals)
        shading = normals
        if scene.normals is not None:
            shading = scene.normals[triangles] * np.where(sides & 1, np.float32(-1), np.float32(1))[:, None]
        material = scene.material[triangles]
        if self._shading == "pixel":
            points, triangle = pixel_sites(site, points, normals, self._sight, base_from_camera)
            fine = fine_surface(scene.waves, points, triangle, shading, material, sides)
        diffuse = scene.materials[material, :3].astype(np.float32)
        if scene.tint is not None:
            diffuse *= scene.tint[triangles]
        return View(site, points, triangle, fine, eye, sides, normals, shading, diffuse, material)


def slopes(through: Sight) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """[h, w] x and y of each pixel's ray at a depth of 1."""
    lens = through.lens
    x = (np.arange(lens.width_px)[None, :] - lens.centre_px[0]) / lens.focal_px
    y = (np.arange(lens.height_px)[:, None] - lens.centre_px[1]) / lens.focal_px
    if through.shift is not None:
        x, y = x + through.shift[0, :, : lens.width_px], y + through.shift[1, :, : lens.width_px]
    pair = np.array(np.broadcast_arrays(x, y))
    return pair[0], pair[1]


@kernel(parallel=True)
def _gather(corners, triangles, eye, sides, centroids, normals):  # type: ignore[no-untyped-def]
    chunk = 4096
    for part in numba.prange(-(-len(triangles) // chunk)):
        centroid, normal = np.empty(3), np.empty(3)
        for i in range(part * chunk, min(len(triangles), (part + 1) * chunk)):
            centroid_and_normal(corners, triangles[i], centroid, normal)
            back = 0.0
            for k in range(3):
                back += (eye[k] - centroid[k]) * normal[k]
            sides[i] = 2 * triangles[i] + (back < 0.0)
            for k in range(3):
                centroids[i, k] = centroid[k]
                normals[i, k] = -normal[k] if back < 0.0 else normal[k]
