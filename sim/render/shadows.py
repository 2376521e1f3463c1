"""Table of the LEDs that reach each triangle, kept from view to view.

LEDs, support and object are fixed in the base frame. So whether an LED reaches a side of a triangle has the same
answer in every view. One ray is traced from the triangle's centroid, raised by `embree.OFFSET_MM`, to the
emitter's centre. So shadows are hard and follow triangles' edges. For moving bodies see `sim.render.arm_shadow`.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from sim.render.embree import Obstacles

_Bits = NDArray[np.uint8]


class Shadows:
    """Table of bits [LED, side of a triangle], filled as views and LEDs require.

    Sides get their places in the table when a view first shows them. Bits beyond `memory_bytes` are not kept:
    first sides of earlier views are dropped, then LEDs that come late.
    """

    def __init__(self, obstacles: Obstacles, leds_mm: NDArray[np.float64], memory_bytes: int) -> None:
        self._obstacles = obstacles
        self._leds_mm = leds_mm
        self._memory_bytes = memory_bytes
        self._place_of_side = np.full(2 * len(obstacles.corners_mm), -1, np.int32)
        self._side_of_place = np.empty(0, np.int64)
        self._kept: dict[int, tuple[int, _Bits]] = {}
        """Number of places traced for each LED, and their bits."""

    def places(self, sides: NDArray[np.int64]) -> NDArray[np.int32]:
        """[n] places of the sides that a view shows (numbered as in `Obstacles.trace`), all different."""
        new = self._place_of_side[sides] < 0
        places = len(self._side_of_place) + int(new.sum())
        if places > len(sides) and places // 8 * len(self._leds_mm) > self._memory_bytes:
            self._place_of_side[self._side_of_place] = -1
            self._side_of_place = np.empty(0, np.int64)
            self._kept.clear()
            new[:] = True
        first = len(self._side_of_place)
        self._side_of_place = np.concatenate([self._side_of_place, sides[new]])
        self._place_of_side[sides[new]] = np.arange(first, len(self._side_of_place), dtype=np.int32)
        return self._place_of_side[sides]

    def reached_bits(self, led: int) -> _Bits:
        """Bit p % 8 of byte p // 8 is 1 if the LED in row `led` reaches the side in place p."""
        places = len(self._side_of_place)
        known_places, bits = self._kept.get(led, (0, np.empty(0, np.uint8)))
        if known_places < places:
            bits = np.concatenate([bits, np.zeros((places + 7) // 8 - len(bits), np.uint8)])
            self._obstacles.trace(self._side_of_place, self._leds_mm[led], known_places, bits)
            if led in self._kept or (len(self._kept) + 1) * len(bits) <= self._memory_bytes:
                self._kept[led] = places, bits
        return bits
