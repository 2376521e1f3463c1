"""Shadow rays and first hits of the simulated scene, from compiled code of several threads."""

from __future__ import annotations

from dataclasses import dataclass, field

import numba
import numpy as np
from numpy.typing import NDArray

from coupole.kernels import kernel
from coupole.kernels.embree import (
    ALL_LAYERS,
    COHERENT,
    FAR,
    FLAGS,
    GEOMETRY,
    LANES,
    MASK,
    NO_GEOMETRY,
    SCATTERED,
    TRIANGLE,
    Tree,
    address_of,
    packet,
    trace_packet,
)

_MANY = 4_000_000
"""Number of triangles above which the tree is compact: 20 % slower, but 40 million triangles fit."""
_CHUNK = 4096
OFFSET_MM = 2e-3
"""Height above its triangle, on the light's side, at which a shadow ray starts: ten times the rounding of float32
coordinates of 2 m, and a hundredth of a scanned triangle."""


@dataclass
class Obstacles:
    """Triangles that cast shadows, in Embree's tree; `corners_mm` [n, 3, 3] float32 are shared, not copied."""

    corners_mm: NDArray[np.float32]
    _tree: Tree = field(init=False, repr=False)

    def __post_init__(self) -> None:
        """Build the tree. At least 4 bytes must follow `corners_mm` in memory (`sim.scene.scene.build_scene`).
        Raises CoupoleError if Embree has too little memory."""
        self._tree = Tree(self.corners_mm, is_compact=len(self.corners_mm) > _MANY)

    def trace(
        self, sides: NDArray[np.int64], light_mm: NDArray[np.float64], first: int, bits: NDArray[np.uint8]
    ) -> None:
        """Set, from place `first` on, the bits of those sides of triangles that are reached from a light's centre.

        A side is 2 t for the front of triangle t (seen counter-clockwise), 2 t + 1 for its back. `bits` must be
        zero from that place on; the bits of sides that face away from the light stay zero.
        """
        address, scene = address_of("rtcOccluded16"), self._tree.scene
        _trace(address, scene, self.corners_mm, sides, light_mm, first, bits, COHERENT)

    def cast(
        self,
        radiance: NDArray[np.float32],
        points_mm: NDArray[np.float32],
        triangle: NDArray[np.int32],
        normals: NDArray[np.float32],
        light_mm: NDArray[np.float64],
    ) -> None:
        """Set `radiance` [n, 3] to 0 where an obstacle is between a light's centre and a point [n, 3].

        Each point is on a triangle with the flat unit normal `normals[triangle[i]]`. The normal faces the light
        wherever there is radiance."""
        address, scene = address_of("rtcOccluded16"), self._tree.scene
        _cast(address, scene, points_mm, triangle, normals, light_mm, radiance, COHERENT)

    def first_met(self, origins_mm: NDArray[np.float32], ways: NDArray[np.float32]) -> NDArray[np.int32]:
        """Return [n], the side of a triangle, as in `trace`, that rays from points [n, 3] in directions [n, 3]
        meet first, or -1."""
        sides = np.empty(len(origins_mm), np.int32)
        address, scene = address_of("rtcIntersect16"), self._tree.scene
        _meet(address, scene, self.corners_mm, origins_mm, ways, sides, SCATTERED)
        return sides


@kernel
def centroid_and_normal(corners, t, centroid, normal):  # type: ignore[no-untyped-def]
    """Fill a triangle's centroid [3] and flat unit normal [3]; the normal is zero if the triangle has no area."""
    for k in range(3):
        a, b, c = np.float64(corners[t, 0, k]), np.float64(corners[t, 1, k]), np.float64(corners[t, 2, k])
        centroid[k] = (a + b + c) / 3.0
    for k in range(3):
        i, j = (k + 1) % 3, (k + 2) % 3
        normal[k] = np.float64(corners[t, 1, i] - corners[t, 0, i]) * np.float64(
            corners[t, 2, j] - corners[t, 0, j]
        ) - np.float64(corners[t, 1, j] - corners[t, 0, j]) * np.float64(corners[t, 2, i] - corners[t, 0, i])
    length = np.sqrt(normal[0] * normal[0] + normal[1] * normal[1] + normal[2] * normal[2])
    for k in range(3):
        normal[k] = normal[k] / length if length > 0.0 else 0.0


@kernel(parallel=True)
def _trace(occlusion_test, scene, corners, sides, light, first, bits, arguments):  # type: ignore[no-untyped-def]
    chunks = -(-len(sides) // _CHUNK)
    start = first // _CHUNK
    for chunk in numba.prange(start, chunks):
        rays, words, valid = packet()
        place_of_lane = np.empty(LANES, np.int64)
        centroid, normal = np.empty(3), np.empty(3)
        lane = 0
        last = min(len(sides), (chunk + 1) * _CHUNK)
        for place in range(max(first, chunk * _CHUNK), last):
            centroid_and_normal(corners, sides[place] >> 1, centroid, normal)
            lift = -OFFSET_MM if sides[place] & 1 else OFFSET_MM
            facing = 0.0
            for k in range(3):
                origin = np.float32(centroid[k] + lift * normal[k])
                rays[k, lane], rays[4 + k, lane] = origin, np.float32(light[k] - origin)
                facing += lift * normal[k] * (light[k] - centroid[k])
            if facing > 0.0:
                rays[3, lane], rays[FAR, lane] = 0.0, 1.0
                words[MASK, lane], words[FLAGS, lane] = np.uint32(ALL_LAYERS), np.uint32(0)
                valid[lane], place_of_lane[lane] = -1, place
                lane += 1
            if lane == LANES or (place == last - 1 and lane > 0):
                valid[lane:] = 0
                trace_packet(occlusion_test, scene, rays, valid, arguments)
                for k in range(lane):
                    if rays[FAR, k] >= 0.0:  # Embree sets tfar of a ray that hit something to minus infinity
                        bits[place_of_lane[k] >> 3] |= np.uint8(1 << (place_of_lane[k] & 7))
                lane = 0


@kernel(parallel=True)
def _cast(occlusion_test, scene, points, triangle, normals, light, radiance, arguments):  # type: ignore[no-untyped-def]
    for chunk in numba.prange(-(-len(points) // _CHUNK)):
        rays, words, valid = packet()
        site_of_lane = np.empty(LANES, np.int64)
        lane = 0
        last = min(len(points), (chunk + 1) * _CHUNK)
        for i in range(chunk * _CHUNK, last):
            if radiance[i, 0] != 0.0 or radiance[i, 1] != 0.0 or radiance[i, 2] != 0.0:
                for k in range(3):
                    origin = np.float32(np.float64(points[i, k]) + OFFSET_MM * np.float64(normals[triangle[i], k]))
                    rays[k, lane], rays[4 + k, lane] = origin, np.float32(light[k] - origin)
                rays[3, lane], rays[FAR, lane] = 0.0, 1.0
                words[MASK, lane], words[FLAGS, lane] = np.uint32(ALL_LAYERS), np.uint32(0)
                valid[lane], site_of_lane[lane] = -1, i
                lane += 1
            if lane == LANES or (i == last - 1 and lane > 0):
                valid[lane:] = 0
                trace_packet(occlusion_test, scene, rays, valid, arguments)
                for k in range(lane):
                    if rays[FAR, k] < 0.0:
                        radiance[site_of_lane[k], :] = 0.0
                lane = 0


@kernel(parallel=True)
def _meet(intersect, scene, corners, origins, ways, hit_triangles, arguments):  # type: ignore[no-untyped-def]
    for chunk in numba.prange(-(-len(hit_triangles) // _CHUNK)):
        rays, words, valid = packet()
        centroid, normal = np.empty(3), np.empty(3)
        last = min(len(hit_triangles), (chunk + 1) * _CHUNK)
        for first in range(chunk * _CHUNK, last, LANES):
            count = min(LANES, last - first)
            valid[:count], valid[count:] = -1, 0
            for lane in range(count):
                for k in range(3):
                    rays[k, lane], rays[4 + k, lane] = origins[first + lane, k], ways[first + lane, k]
            rays[3, :], rays[FAR, :] = 0.0, np.inf
            words[MASK, :], words[FLAGS, :] = np.uint32(ALL_LAYERS), np.uint32(0)
            words[GEOMETRY, :] = np.uint32(NO_GEOMETRY)  # no geometry met
            trace_packet(intersect, scene, rays, valid, arguments)
            for lane in range(count):
                hit_triangles[first + lane] = -1
                if words[GEOMETRY, lane] != np.uint32(NO_GEOMETRY):
                    triangle, facing = np.int64(words[TRIANGLE, lane]), 0.0
                    centroid_and_normal(corners, triangle, centroid, normal)
                    for k in range(3):
                        facing += ways[first + lane, k] * normal[k]
                    hit_triangles[first + lane] = 2 * triangle + (facing > 0.0)
