"""Traces rays in packets of 16, or one by one, from compiled code. It is made for hundreds of millions of rays."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

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
    TRIANGLE,
    Tree,
    address_of,
    call_for_ray,
    packet,
    trace_packet,
)


@dataclass
class PacketMesh:
    """Triangles [n, 3, 3] in Embree's tree."""

    corners_mm: NDArray[Any]
    compact: bool = True
    """True for a tree that needs less memory, but in which rays take 1.2 to 1.7 times as long."""
    scene: np.uint64 = field(init=False)
    """Scene in the form that `blocked16` takes in compiled code."""

    def __post_init__(self) -> None:
        """Raises CoupoleError if Embree has too little memory."""
        corners = np.zeros(9 * len(self.corners_mm) + 4, np.float32)
        corners[:-4] = self.corners_mm.reshape(-1)
        self._tree = Tree(corners[:-4], is_compact=self.compact)
        self.scene = self._tree.scene

    def first_met(
        self, start_mm: NDArray[np.float64], ways: NDArray[np.float32]
    ) -> tuple[NDArray[np.int32], NDArray[np.float32]]:
        """Return the numbers of the triangles that rays from one place along `ways` [n, 3] meet first, and the
        distances in lengths of the ways. A ray that meets nothing has -1 and NaN."""
        number, distance = np.empty(len(ways), np.int32), np.empty(len(ways), np.float32)
        _first_met(address_of("rtcIntersect16"), self.scene, start_mm, ways, COHERENT, number, distance)
        return number, distance

    def blocked_rays(
        self, starts_mm: NDArray[np.float32], start_rows: NDArray[np.int64], end_mm: NDArray[np.float64]
    ) -> NDArray[np.bool_]:
        """Return [start_rows], True where a triangle lies between a start, given by its row in `starts_mm` [n, 3],
        and the end."""
        are_blocked = np.empty(len(start_rows), np.bool_)
        _fill_blocked(blocked16(), self.scene, starts_mm, start_rows, end_mm, COHERENT, are_blocked)
        return are_blocked

    def blocked_along(self, starts_mm: NDArray[np.float32], ways_mm: NDArray[np.float32]) -> NDArray[np.bool_]:
        """Return [n], True where a way from a start [n, 3] to its end meets a triangle. There is one way for each
        start [n, 3], or one for all [1, 3]. The rays are traced one by one, because packets are slower for ways in
        all directions."""
        are_blocked = np.empty(len(starts_mm), np.bool_)
        _blocked_one_by_one(address_of("rtcOccluded1"), self.scene, starts_mm, ways_mm, COHERENT, are_blocked)
        return are_blocked


def blocked16() -> np.uint64:
    """Return the address of the function that tells which rays of a packet are blocked."""
    return address_of("rtcOccluded16")


@kernel
def trace(function, scene, rays, words, valid, lanes, far, arguments):  # type: ignore[no-untyped-def]
    """Trace the first `lanes` rays of a `packet` as far as `far`, in lengths of their ways, by the function at an
    address (`blocked16`). Afterwards a blocked ray has minus infinity in row `FAR`."""
    for lane in range(LANES):
        valid[lane] = -1 if lane < lanes else 0
        rays[3, lane], rays[FAR, lane] = 0.0, far
        words[MASK, lane], words[FLAGS, lane], words[GEOMETRY, lane] = ALL_LAYERS, 0, NO_GEOMETRY
    trace_packet(function, scene, rays, valid, arguments)


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
    word[MASK] = ALL_LAYERS
    for n in range(len(starts)):
        for k in range(3):
            ray[k], ray[4 + k] = starts[n, k], ways[min(n, len(ways) - 1), k]
        ray[FAR] = 1.0
        call_for_ray(function, scene, address, more)
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
            is_hit = words[GEOMETRY, lane] != NO_GEOMETRY
            number[first + lane] = np.int32(words[TRIANGLE, lane]) if is_hit else -1
            distance[first + lane] = rays[FAR, lane] if is_hit else np.nan
