"""Embree's tree of triangles, and calls of its C functions from compiled code.

embreex contains the library Embree 4, but its Python functions trace rays one at a time. Embree's C functions are
found through the extension module that is linked to it. They take packets of 16 rays, or single rays
(https://github.com/RenderKit/embree, the manual's API reference).
"""

from __future__ import annotations

import ctypes
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
COHERENT = np.array([_EVERY_FEATURE << 32 | _COHERENT, 0, 0, 0, 0, 0], np.uint64)
"""Arguments (RTCIntersectArguments, RTCOccludedArguments) for rays that take similar ways through the tree: flags
and features; no context, filter or function."""
SCATTERED = np.array([_EVERY_FEATURE << 32, 0, 0, 0, 0, 0], np.uint64)
"""Arguments for rays in all directions."""
LANES = 16
FAR, MASK, FLAGS, TRIANGLE, GEOMETRY = 8, 9, 11, 17, 18
"""Rows of a packet (RTCRayHit16), after the origin (0 to 2), the nearest distance (3) and the way (4 to 6)."""
NO_GEOMETRY = ALL_LAYERS = 0xFFFFFFFF
_ROWS = 24


class Tree:
    """Embree's tree of n triangles. It is exact at edges: no ray passes between two neighbouring triangles."""

    def __init__(self, corners: NDArray[np.float32], *, is_compact: bool) -> None:
        """Build the tree. `corners` has 9 n contiguous numbers, and is shared, not copied. At least 4 bytes must
        follow them in memory, because Embree reads 16 bytes for the last corner's 12. A compact tree needs less
        memory, but rays take 1.2 to 1.7 times as long in it. Raises CoupoleError if Embree has too little
        memory."""
        call, count = _library(), corners.size // 9
        self._corners, self._indices = corners, np.arange(3 * count, dtype=np.uint32)
        self._device = call.rtcNewDevice(b"")
        tree = call.rtcNewScene(self._device)
        self.scene = np.uint64(tree)
        """The tree in the form that compiled code passes on."""
        call.rtcSetSceneFlags(tree, (_COMPACT if is_compact else 0) | _ROBUST)
        geometry = call.rtcNewGeometry(self._device, _TRIANGLES)
        set_buffer = call.rtcSetSharedGeometryBuffer
        set_buffer(geometry, _VERTEX, 0, _FLOAT3, self._corners.ctypes.data, 0, 12, 3 * count)
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


@cache
def address_of(name: str) -> np.uint64:
    """Return the address of one of Embree's functions, such as `rtcOccluded16`."""
    return np.uint64(ctypes.cast(getattr(_library(), name), ctypes.c_void_p).value or 0)


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
call_for_ray: Any = intrinsic(_call_for_ray)
"""Call a function at an address for one ray: (address, scene, address of the ray, address of the arguments)."""


@kernel
def packet():  # type: ignore[no-untyped-def]
    """Return the rows of a packet of rays and hits, as float32 and as uint32, and the mask of its lanes, aligned
    to 64 bytes."""
    memory = np.zeros((_ROWS + 1) * LANES + LANES, np.float32)
    skip = np.int64((-np.int64(memory.ctypes.data) // 4) % LANES)
    rows = memory[skip : skip + (_ROWS + 1) * LANES].reshape(_ROWS + 1, LANES)
    return rows[:_ROWS], rows[:_ROWS].view(np.uint32), rows[_ROWS].view(np.int32)


@kernel
def trace_packet(address, scene, rays, valid, arguments):  # type: ignore[no-untyped-def]
    """Trace the valid rays of a `packet` by the function at an address."""
    _call_embree(
        address,
        np.uint64(valid.ctypes.data),
        scene,
        np.uint64(rays.ctypes.data),
        np.uint64(arguments.ctypes.data),
    )
