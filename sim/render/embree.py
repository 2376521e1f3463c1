"""Embree's shadow rays, called from compiled code.

embreex contains the Embree 4 library, but its Python functions trace rays one at a time. Embree's C functions,
found through the extension module that is linked to it, take packets of 16 rays from numba threads.
"""

from __future__ import annotations

import ctypes
from dataclasses import dataclass, field
from typing import Any

import numba
import numpy as np
from llvmlite import ir
from numba import types
from numba.extending import intrinsic
from numpy.typing import NDArray

from coupole.errors import CoupoleError
from coupole.kernels import kernel

_TRIANGLES, _INDEX, _VERTEX, _UINT3, _FLOAT3 = 0, 0, 1, 0x5003, 0x9003
_COMPACT, _ROBUST = 1 << 1, 1 << 2
_MANY = 4_000_000
_PACKET = 16
_CHUNK = 4096
_COHERENT, _ALL_FEATURES = 1 << 16, 0xFFFFFFFF
_ARGUMENTS = np.array([_ALL_FEATURES << 32 | _COHERENT, 0, 0, 0, 0, 0], np.uint64)
"""RTCOccludedArguments: flags and features; no context, filter or function. Rays from neighbouring triangles to
one light are coherent, which means that they take similar ways through the tree."""
_SCATTERED = np.array([_ALL_FEATURES << 32, 0, 0, 0, 0, 0], np.uint64)
"""RTCIntersectArguments, for rays in all directions."""
_HIT_ROWS = 9
"""Rows of RTCHit16 after those of the rays: normal xyz, u, v, triangle, geometry, instance, its part."""
OFFSET_MM = 2e-3
"""Height above its triangle, on the light's side, at which a shadow ray starts: ten times the rounding of float32
coordinates of 2 m, and a hundredth of a scanned triangle."""


class _Library:
    """The C functions with their types, loaded once."""

    def __init__(self) -> None:
        import embreex.rtcore_scene as linked_to_embree

        self._library = ctypes.CDLL(linked_to_embree.__file__)
        pointer, number, size = ctypes.c_void_p, ctypes.c_uint, ctypes.c_size_t
        self.new_device = self._bind("rtcNewDevice", pointer, ctypes.c_char_p)
        self.device_error = self._bind("rtcGetDeviceError", number, pointer)
        self.new_scene = self._bind("rtcNewScene", pointer, pointer)
        self.set_scene_flags = self._bind("rtcSetSceneFlags", None, pointer, number)
        self.new_geometry = self._bind("rtcNewGeometry", pointer, pointer, number)
        self.set_buffer = self._bind(
            "rtcSetSharedGeometryBuffer", None, pointer, number, number, number, pointer, size, size, size
        )
        self.commit_geometry = self._bind("rtcCommitGeometry", None, pointer)
        self.attach = self._bind("rtcAttachGeometry", number, pointer, pointer)
        self.release_geometry = self._bind("rtcReleaseGeometry", None, pointer)
        self.commit_scene = self._bind("rtcCommitScene", None, pointer)
        self.release_scene = self._bind("rtcReleaseScene", None, pointer)
        self.release_device = self._bind("rtcReleaseDevice", None, pointer)
        self.occluded = np.uint64(ctypes.cast(self._library.rtcOccluded16, pointer).value or 0)
        self.intersect = np.uint64(ctypes.cast(self._library.rtcIntersect16, pointer).value or 0)

    def _bind(self, name: str, result: Any, *arguments: Any) -> Any:
        function = getattr(self._library, name)
        function.restype, function.argtypes = result, arguments
        return function


@dataclass
class Obstacles:
    """Triangles that cast shadows, in Embree's tree; `corners_mm` [n, 3, 3] float32 are shared, not copied."""

    corners_mm: NDArray[np.float32]
    _library: _Library = field(default_factory=_Library, repr=False)
    _indices: NDArray[np.uint32] = field(init=False, repr=False)
    _device: int = field(init=False, repr=False)
    _scene: int = field(init=False, repr=False)

    def __post_init__(self) -> None:
        """Build the tree. At least 4 bytes must follow `corners_mm` in memory (`sim.scene.scene.build_scene`)."""
        call, count = self._library, len(self.corners_mm)
        self._indices = np.arange(3 * count, dtype=np.uint32)
        self._device = call.new_device(b"")
        self._scene = call.new_scene(self._device)
        # Compact: 20 % slower, but 40 million triangles fit; robust: no ray passes through a common edge.
        call.set_scene_flags(self._scene, (_COMPACT if count > _MANY else 0) | _ROBUST)
        geometry = call.new_geometry(self._device, _TRIANGLES)
        call.set_buffer(geometry, _VERTEX, 0, _FLOAT3, self.corners_mm.ctypes.data, 0, 12, 3 * count)
        call.set_buffer(geometry, _INDEX, 0, _UINT3, self._indices.ctypes.data, 0, 12, count)
        call.commit_geometry(geometry)
        call.attach(self._scene, geometry)
        call.release_geometry(geometry)
        call.commit_scene(self._scene)
        if error := call.device_error(self._device):
            raise CoupoleError(
                f"simulated scene: expected Embree to build its tree of {count} triangles; rtcGetDeviceError says "
                f"{error}. If memory is short, simulate a coarser mesh"
            )

    def trace(
        self, sides: NDArray[np.int64], light_mm: NDArray[np.float64], first: int, bits: NDArray[np.uint8]
    ) -> None:
        """Set, from place `first` on, the bits of those sides of triangles that are reached from a light's centre.

        A side is 2 t for the front of triangle t (seen counter-clockwise), 2 t + 1 for its back. `bits` must be
        zero from that place on; the bits of sides that face away from the light stay zero.
        """
        address, scene = self._library.occluded, np.uint64(self._scene)
        _trace(address, scene, self.corners_mm, sides, light_mm, first, bits, _ARGUMENTS)

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
        address, scene = self._library.occluded, np.uint64(self._scene)
        _cast(address, scene, points_mm, triangle, normals, light_mm, radiance, _ARGUMENTS)

    def first_met(self, origins_mm: NDArray[np.float32], ways: NDArray[np.float32]) -> NDArray[np.int32]:
        """Return [n], the side of a triangle, as in `trace`, that rays from points [n, 3] in directions [n, 3]
        meet first, or -1."""
        sides = np.empty(len(origins_mm), np.int32)
        address, scene = self._library.intersect, np.uint64(self._scene)
        _meet(address, scene, self.corners_mm, origins_mm, ways, sides, _SCATTERED)
        return sides

    def __del__(self) -> None:
        if hasattr(self, "_scene"):
            self._library.release_scene(self._scene)
            self._library.release_device(self._device)


def _packet_call(_context, _address, _valid, _scene, _rays, _arguments):  # type: ignore[no-untyped-def]
    """`rtcOccluded16` or `rtcIntersect16` (valid, scene, rays, arguments). Its address is an argument, so that
    this code can be cached."""

    def generate(context, builder, _signature, values):  # type: ignore[no-untyped-def]
        word = ir.IntType(64)
        kind = ir.FunctionType(ir.VoidType(), [word] * 4)
        function = builder.inttoptr(values[0], kind.as_pointer())
        builder.call(function, values[1:])
        return context.get_dummy_value()

    return types.void(types.uint64, types.uint64, types.uint64, types.uint64, types.uint64), generate


_call_embree: Any = intrinsic(_packet_call)


@kernel
def _trace_packet(function, valid, scene, rays, arguments):  # type: ignore[no-untyped-def]
    """Trace the valid rays of a packet by the function at an address."""
    _call_embree(
        function,
        np.uint64(valid.ctypes.data),
        scene,
        np.uint64(rays.ctypes.data),
        np.uint64(arguments.ctypes.data),
    )


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
        rays, words, valid = _packet()
        place_of_lane = np.empty(_PACKET, np.int64)
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
                rays[3, lane], rays[8, lane] = 0.0, 1.0
                words[9, lane], words[11, lane] = np.uint32(0xFFFFFFFF), np.uint32(0)
                valid[lane], place_of_lane[lane] = -1, place
                lane += 1
            if lane == _PACKET or (place == last - 1 and lane > 0):
                valid[lane:] = 0
                _trace_packet(occlusion_test, valid, scene, rays, arguments)
                for k in range(lane):
                    if rays[8, k] >= 0.0:  # Embree sets tfar of a ray that hit something to minus infinity
                        bits[place_of_lane[k] >> 3] |= np.uint8(1 << (place_of_lane[k] & 7))
                lane = 0


@kernel(parallel=True)
def _cast(occlusion_test, scene, points, triangle, normals, light, radiance, arguments):  # type: ignore[no-untyped-def]
    for chunk in numba.prange(-(-len(points) // _CHUNK)):
        rays, words, valid = _packet()
        site_of_lane = np.empty(_PACKET, np.int64)
        lane = 0
        last = min(len(points), (chunk + 1) * _CHUNK)
        for i in range(chunk * _CHUNK, last):
            if radiance[i, 0] != 0.0 or radiance[i, 1] != 0.0 or radiance[i, 2] != 0.0:
                for k in range(3):
                    origin = np.float32(np.float64(points[i, k]) + OFFSET_MM * np.float64(normals[triangle[i], k]))
                    rays[k, lane], rays[4 + k, lane] = origin, np.float32(light[k] - origin)
                rays[3, lane], rays[8, lane] = 0.0, 1.0
                words[9, lane], words[11, lane] = np.uint32(0xFFFFFFFF), np.uint32(0)
                valid[lane], site_of_lane[lane] = -1, i
                lane += 1
            if lane == _PACKET or (i == last - 1 and lane > 0):
                valid[lane:] = 0
                _trace_packet(occlusion_test, valid, scene, rays, arguments)
                for k in range(lane):
                    if rays[8, k] < 0.0:
                        radiance[site_of_lane[k], :] = 0.0
                lane = 0


@kernel(parallel=True)
def _meet(intersect, scene, corners, origins, ways, hit_triangles, arguments):  # type: ignore[no-untyped-def]
    for chunk in numba.prange(-(-len(hit_triangles) // _CHUNK)):
        rays, words, valid = _packet()
        centroid, normal = np.empty(3), np.empty(3)
        last = min(len(hit_triangles), (chunk + 1) * _CHUNK)
        for first in range(chunk * _CHUNK, last, _PACKET):
            count = min(_PACKET, last - first)
            valid[:count], valid[count:] = -1, 0
            for lane in range(count):
                for k in range(3):
                    rays[k, lane], rays[4 + k, lane] = origins[first + lane, k], ways[first + lane, k]
            rays[3, :], rays[8, :] = 0.0, np.inf
            words[9, :], words[11, :] = np.uint32(0xFFFFFFFF), np.uint32(0)
            words[18, :] = np.uint32(0xFFFFFFFF)  # no geometry met
            _trace_packet(intersect, valid, scene, rays, arguments)
            for lane in range(count):
                hit_triangles[first + lane] = -1
                if words[18, lane] != np.uint32(0xFFFFFFFF):
                    triangle, facing = np.int64(words[17, lane]), 0.0
                    centroid_and_normal(corners, triangle, centroid, normal)
                    for k in range(3):
                        facing += ways[first + lane, k] * normal[k]
                    hit_triangles[first + lane] = 2 * triangle + (facing > 0.0)


@kernel
def _packet():  # type: ignore[no-untyped-def]
    """Return the memory of one RTCRayHit16, aligned to 64 bytes. It has 12 rows of 16 for the rays (org xyz,
    tnear, dir xyz, time, tfar, mask, id, flags) and the rows of the hits, as float32 and as uint32. Also return
    the valid mask of the 16 lanes."""
    rows = 12 + _HIT_ROWS
    memory = np.zeros((rows + 1) * _PACKET + 16, np.float32)
    skip = np.int64((-np.int64(memory.ctypes.data) // 4) % 16)
    rays = memory[skip : skip + rows * _PACKET].reshape(rows, _PACKET)
    valid = memory[skip + rows * _PACKET : skip + (rows + 1) * _PACKET].view(np.int32)
    return rays, rays.view(np.uint32), valid
