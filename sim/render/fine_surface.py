"""Detail of the surface at each site, finer than the mesh: texture, and normals turned by the slope of bumps.

Let h be the height along the normal n of a surface. The normal of the bumpy surface is n minus the part of grad h
across n, scaled to a unit vector (Blinn, Simulation of wrinkled surfaces, 1978, to first order in h).
"""

from __future__ import annotations

from dataclasses import dataclass

import numba
import numpy as np
from numpy.typing import NDArray

from coupole.kernels import kernel
from sim.scene.scene import Waves

_CHUNK = 4096


@dataclass(frozen=True)
class Fine:
    """Detail by site."""

    texture: NDArray[np.float32]
    """[sites] factor of the diffuse reflectance."""
    normals: NDArray[np.float32]
    """[sites, 3] unit normals for shading."""


def fine_surface(
    waves: Waves | None,
    points_mm: NDArray[np.float32],
    triangle: NDArray[np.int32],
    shading_normals: NDArray[np.float32],
    material: NDArray[np.int32],
    sides: NDArray[np.int64],
) -> Fine | None:
    """Detail at points [sites, 3] in the base frame on the seen triangles `triangle` [sites], whose normals,
    materials and sides are given [seen]; None if the scene has no detail."""
    if waves is None:
        return None
    fine = Fine(np.empty(len(points_mm), np.float32), np.empty((len(points_mm), 3), np.float32))
    _look_closer(
        waves.table, waves.first, points_mm, triangle, shading_normals, material, sides, fine.texture, fine.normals
    )
    return fine


@kernel(parallel=True)
def _look_closer(  # type: ignore[no-untyped-def]
    waves, first, points, triangle, normals, material, sides, texture, turned_normals
):
    for chunk in numba.prange(-(-len(points) // _CHUNK)):
        slope = np.empty(3)
        for i in range(chunk * _CHUNK, min(len(points), (chunk + 1) * _CHUNK)):
            site_triangle = triangle[i]
            nx, ny, nz = (
                np.float64(normals[site_triangle, 0]),
                np.float64(normals[site_triangle, 1]),
                np.float64(normals[site_triangle, 2]),
            )
            factor = 1.0
            slope[:] = 0.0
            for w in range(first[material[site_triangle]], first[material[site_triangle] + 1]):
                kx, ky, kz = waves[w, 0], waves[w, 1], waves[w, 2]
                phase = kx * points[i, 0] + ky * points[i, 1] + kz * points[i, 2] + waves[w, 3]
                factor += waves[w, 4] * np.cos(phase)
                if waves[w, 5] != 0.0:
                    steep = -waves[w, 5] * np.sin(phase)
                    slope[0], slope[1], slope[2] = (
                        slope[0] + steep * kx,
                        slope[1] + steep * ky,
                        slope[2] + steep * kz,
                    )
            out = -1.0 if sides[site_triangle] & 1 else 1.0  # heights are above the front
            along = slope[0] * nx + slope[1] * ny + slope[2] * nz
            nx, ny, nz = (
                nx - out * (slope[0] - along * nx),
                ny - out * (slope[1] - along * ny),
                nz - out * (slope[2] - along * nz),
            )
            length = np.sqrt(nx * nx + ny * ny + nz * nz)
            texture[i] = factor
            turned_normals[i, 0], turned_normals[i, 1], turned_normals[i, 2] = (
                nx / length,
                ny / length,
                nz / length,
            )
