"""Traces rays in packets of 16, or one by one, from compiled code. It is made for hundreds of millions of rays.

embreex contains the library Embree 4, but passes it one ray after the other. The C functions of Embree are found
through the extension module that is linked to it (https://github.com/RenderKit/embree, the manual's API
reference).
"""

from __future__ import annotations

import ctypes
from dataclasses import dataclass, field
from functools import cache
from typing import Any

import numpy as np
from llvmlite import ir
from numba import types
from numba.extending import intrinsic
from numpy.typing import NDArray

from coupole.errors import CoupoleError
from coupole.kernels import kernel

_TRIANGLES, _INDEX, _VERTEX, _UINT3, _FLOAT3 = 0, 0, 1, 0x5003, 0x9003
_COMPACT, _ROBUST = 1 << 1, 1 << 2
_COHERENT, _EVERY_FEATURE = 1 << 16, 0xFFFFFFFF
ARGUMENTS = np.array([_EVERY_FEATURE << 32 | _COHERENT, 0, 0, 0, 0, 0], np.uint64)
LANES = 16
FAR, _MASK, _FLAGS, _NUMBER, _GEOMETRY = 8, 9, 11, 17, 18
"""Rows of a packet, after the origin (0 to 2), the nearest distance (3) and the way (4 to 6)."""
_ROWS = 24
_NONE = 0xFFFFFFFF


@dataclass
class PacketMesh:
    """Triangles [n, 3, 3] in Embree's tree. It is exact at edges: no ray passes between two neighbouring
    triangles."""

    corners_mm: NDArray[Any]
    compact: bool = True
    """True for a tree that needs less memory, but in which rays take 1.2 to 1.7 times as long."""
    scene: np.uint64 = field(init=False)
    """Scene in the form that `blocked16` takes in compiled code."""

    def __post_init__(self) -> None:
        """Raises CoupoleError if Embree has too little memory."""
        call, count = _library(), len(self.corners_mm)
        self._padded = np.zeros(9 * count + 4, np.float32)  # Embree reads 16 bytes for the last corner's 12
        self._padded[: 9 * count] = self.corners_mm.reshape(-1)
        self._indices = np.arange(3 * count, dtype=np.uint32)
        self._device = call.rtcNewDevice(b"")
        tree = call.rtcNewScene(self._device)
        self.scene = np.uint64(tree)
        call.rtcSetSceneFlags(tree, (_COMPACT if self.compact else 0) | _ROBUST)
        geometry = call.rtcNewGeometry(self._device, _TRIANGLES)
        set_buffer = call.rtcSetSharedGeometryBuffer
        set_buffer(geometry, _VERTEX, 0, _FLOAT3, self._padded.ctypes.data, 0, 12, 3 * count)
        set_buffer(geometry, _INDEX, 0, _UINT3, self._indices.ctypes.data, 0, 12, count)
        call.rtcCommitGeometry(geometry)
        call.rtcAttachGeometry(tree, geometry)
        call.rtcReleaseGeometry(geometry)
        call.rtcCommitScene(tree)
        if error := call.rtcGetDeviceError(self._device):
            raise CoupoleError(
                f"expected Embree to build its tree of {count} triangles, got its error {error}. If memory is "
                "short, close other programs, or take a coarser mesh"
            )

    def __del__(self) -> None:
        if hasattr(self, "scene"):
            _library().rtcReleaseScene(int(self.scene))
            _library().rtcReleaseDevice(self._device)

    def first_met(
        self, start_mm: NDArray[np.float64], ways: NDArray[np.float32]
    ) -> tuple[NDArray[np.int32], NDArray[np.float32]]:
        """Return the numbers of the triangles that rays from one place along `ways` [n, 3] meet first, and the
        distances in lengths of the ways. A ray that meets nothing has -1 and NaN."""
        number, distance = np.empty(len(ways), np.int32), np.empty(len(ways), np.float32)
        _first_met(_address("rtcIntersect16"), self.scene, start_mm, ways, ARGUMENTS, number, distance)
        return number, distance

    def blocked_rays(
        self, starts_mm: NDArray[np.float32], start_rows: NDArray[np.int64], end_mm: NDArray[np.float64]
    ) -> NDArray[np.bool_]:
        """Return [start_rows], True where a triangle lies between a start, given by its row in `starts_mm` [n, 3],
        and the end."""
        are_blocked = np.empty(len(start_rows), np.bool_)
        _fill_blocked(blocked16(), self.scene, starts_mm, start_rows, end_mm, ARGUMENTS, are_blocked)
        return are_blocked

    def blocked_along(self, starts_mm: NDArray[np.float32], ways_mm: NDArray[np.float32]) -> NDArray[np.bool_]:
        """Return [n], True where a way from a start [n, 3] to its end meets a triangle. There is one way for each
        start [n, 3], or one for all [1, 3]. The rays are traced one by one, because packets are slower for ways in
        all directions."""
        are_blocked = np.empty(len(starts_mm), np.bool_)
        _blocked_one_by_one(_address("rtcOccluded1"), self.scene, starts_mm, ways_mm, ARGUMENTS, are_blocked)
        return are_blocked


def blocked16() -> np.uint64:
    """Return the address of the function that tells which rays of a packet are blocked."""
    return _address("rtcOccluded16")


@cache
def _library() -> Any:
    """Return the C functions with their types."""
    import embreex.rtcore_scene as linked_to_embree

    library = ctypes.CDLL(linked_to_embree.__file__)
    pointer, number, size = ctypes.c_void_p, ctypes.c_uint, ctypes.c_size_t
    kinds: dict[str, tuple[Any, ...]] = {
        "rtcNewDevice": (pointer, ctypes.c_char_p),
        "rtcGetDeviceError": (number, pointer),
        "rtcReleaseDevice": (None, pointer),
        "rtcNewScene": (pointer, pointer),
        "rtcSetSceneFlags": (None, pointer, number),
        "rtcCommitScene": (None, pointer),
        "rtcReleaseScene": (None, pointer),
        "rtcNewGeometry": (pointer, pointer, number),
        "rtcSetSharedGeometryBuffer": (None, pointer, number, number, number, pointer, size, size, size),
        "rtcCommitGeometry": (None, pointer),
        "rtcAttachGeometry": (number, pointer, pointer),
        "rtcReleaseGeometry": (None, pointer),
    }
    for name, (result, *arguments) in kinds.items():
        function = getattr(library, name)
        function.restype, function.argtypes = result, arguments
    return library


def _address(name: str) -> np.uint64:
    return np.uint64(ctypes.cast(getattr(_library(), name), ctypes.c_void_p).value or 0)


def _call(words: int) -> Any:
    """Return the kind of a call of an Embree function with this number of words, and the function that makes its
    code."""

    def generate(context, builder, _signature, values):  # type: ignore[no-untyped-def]
        kind = ir.FunctionType(ir.VoidType(), [ir.IntType(64)] * words)
        builder.call(builder.inttoptr(values[0], kind.as_pointer()), values[1:])
        return context.get_dummy_value()

    return types.void(*[types.uint64] * (1 + words)), generate


def _call_for_packet(_context, _address, _valid, _scene, _rays, _arguments):  # type: ignore[no-untyped-def]
    """A call of a function for packets. Its address is an argument, so that the calling code can be cached."""
    return _call(4)


def _call_for_ray(_context, _address, _scene, _ray, _arguments):  # type: ignore[no-untyped-def]
    """A call of a function for a single ray."""
    return _call(3)


_call_embree: Any = intrinsic(_call_for_packet)
_call_embree_of_one: Any = intrinsic(_call_for_ray)


@kernel
def packet():  # type: ignore[no-untyped-def]
    """Return the rows of a packet of rays and hits, as float32 and as uint32, and the mask of its lanes, aligned
    to 64 bytes."""
    memory = np.zeros((_ROWS + 1) * LANES + LANES, np.float32)
    skip = np.int64((-np.int64(memory.ctypes.data) // 4) % LANES)
    rows = memory[skip : skip + (_ROWS + 1) * LANES].reshape(_ROWS + 1, LANES)
    return rows[:_ROWS], rows[:_ROWS].view(np.uint32), rows[_ROWS].view(np.int32)


@kernel
def trace(function, scene, rays, words, valid, lanes, far, arguments):  # type: ignore[no-untyped-def]
    """Trace the first `lanes` rays of a `packet` as far as `far`, in lengths of their ways, by the function at an
    address (`blocked16`). Afterwards a blocked ray has minus infinity in row `FAR`."""
    for lane in range(LANES):
        valid[lane] = -1 if lane < lanes else 0
        rays[3, lane], rays[FAR, lane] = 0.0, far
        words[_MASK, lane], words[_FLAGS, lane], words[_GEOMETRY, lane] = _NONE, 0, _NONE
    _call_embree(
        function,
        np.uint64(valid.ctypes.data),
        scene,
        np.uint64(rays.ctypes.data),
        np.uint64(arguments.ctypes.data),
    )


@kernel
def _fill_blocked(function, scene, starts, start_rows, end, arguments, are_blocked):  # type: ignore[no-untyped-def]
    rays, words, valid = packet()
    for first in range(0, len(start_rows), LANES):
        lanes = min(LANES, len(start_rows) - first)
        for lane in range(lanes):
            start = starts[start_rows[first + lane]]
            for k in range(3):
                rays[k, lane], rays[4 + k, lane] = start[k], np.float32(end[k] - start[k])
        trace(function, scene, rays, words, valid, lanes, np.float32(1.0), arguments)
        for lane in range(lanes):
            are_blocked[first + lane] = rays[FAR, lane] < 0.0


@kernel
def _blocked_one_by_one(function, scene, starts, ways, arguments, are_blocked):  # type: ignore[no-untyped-def]
    """Trace rays one by one. The numbers of a ray lie one behind the other, like the rows of a packet."""
    rays, words, _ = packet()
    ray, word = rays[0], words[0]
    address, more = np.uint64(ray.ctypes.data), np.uint64(arguments.ctypes.data)
    word[_MASK] = _NONE
    for n in range(len(starts)):
        for k in range(3):
            ray[k], ray[4 + k] = starts[n, k], ways[min(n, len(ways) - 1), k]
        ray[FAR] = 1.0
        _call_embree_of_one(function, scene, address, more)
        are_blocked[n] = ray[FAR] < 0.0


@kernel
def _first_met(function, scene, start, ways, arguments, number, distance):  # type: ignore[no-untyped-def]
    rays, words, valid = packet()
    for first in range(0, len(ways), LANES):
        lanes = min(LANES, len(ways) - first)
        for lane in range(lanes):
            for k in range(3):
                rays[k, lane], rays[4 + k, lane] = np.float32(start[k]), ways[first + lane, k]
        trace(function, scene, rays, words, valid, lanes, np.float32(np.inf), arguments)
        for lane in range(lanes):
            is_hit = words[_GEOMETRY, lane] != _NONE
            number[first + lane] = np.int32(words[_NUMBER, lane]) if is_hit else -1
            distance[first + lane] = rays[FAR, lane] if is_hit else np.nan
