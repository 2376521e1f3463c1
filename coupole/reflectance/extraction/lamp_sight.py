"""Which LEDs light which triangles, and how much: shadows of the object, their penumbrae, irradiance.

From a triangle's centre rays go to the centres of all LEDs, and near the edges of shadows to the LEDs' corners.
"""

from __future__ import annotations

import os
from concurrent.futures import ThreadPoolExecutor
from typing import Any

import numba
import numpy as np
from numpy.typing import NDArray

from coupole.calibration.light.irradiance import LED_SIDE_MM, led_corners_mm
from coupole.calibration.light.tile_views import Positions
from coupole.motion.occlusion import RAY_START_MM, blocked

Floats = NDArray[np.float64]

REACHED, AWAY, SHADED, PENUMBRA = range(4)
"""Codes of a triangle and an LED; AWAY: below `MOST_INCIDENCE_DEG`, or behind the LED."""
MOST_INCIDENCE_DEG = 89.0
_RAYS = 1_000_000
_LEDS = 64
"""Traced together."""
_MOST_RINGS = 8


def lamp_codes(
    scene: Any, centres_mm: Floats, normals: Floats, neighbours: NDArray[np.int64], leds: Positions
) -> NDArray[np.uint8]:
    """[triangles, leds] codes for centres and unit normals [triangles, 3]; `neighbours` [triangles, 3] are places
    in these arrays, or -1."""
    codes = np.empty((len(centres_mm), len(leds.ids)), np.uint8)
    _away(centres_mm, normals, leds.centres_mm, leds.normals, np.cos(np.radians(MOST_INCIDENCE_DEG)), codes)
    starts_mm = centres_mm + RAY_START_MM * normals
    step = max(1, _RAYS // max(1, len(centres_mm)))

    def shade(first: int) -> None:
        part = codes[:, first : first + step]
        triangle, led = np.nonzero(part == REACHED)
        hidden = blocked(scene, starts_mm[triangle], leds.centres_mm[first + led])
        part[triangle[hidden], led[hidden]] = SHADED

    with ThreadPoolExecutor(len(os.sched_getaffinity(0))) as pool:
        list(pool.map(shade, range(0, codes.shape[1], step)))
    _penumbra(scene, starts_mm, neighbours, leds, codes)
    return codes


def _penumbra(
    scene: Any, starts_mm: Floats, neighbours: NDArray[np.int64], leds: Positions, codes: NDArray[np.uint8]
) -> None:
    """Mark triangles beside a shadow, which its edge may cross, and what only a part of the LED reaches: ring by
    ring from the shadow, as long as there is some."""
    corners_mm = led_corners_mm(leds.centres_mm, leds.normals, LED_SIDE_MM)
    for first in range(0, codes.shape[1], _LEDS):
        part = codes[:, first : first + _LEDS]
        part[_beside(part == SHADED, neighbours) & (part == REACHED)] = PENUMBRA
        for _ in range(_MOST_RINGS):
            triangle, led = np.nonzero(_beside(part == PENUMBRA, neighbours) & (part == REACHED))
            partly = np.zeros(len(triangle), np.bool_)
            for corner in range(4):
                partly |= blocked(scene, starts_mm[triangle], corners_mm[first + led, corner])
            part[triangle[partly], led[partly]] = PENUMBRA
            if not partly.any():
                break


def _beside(marked: NDArray[np.bool_], neighbours: NDArray[np.int64]) -> NDArray[np.bool_]:
    """[triangles, leds] True where a neighbour is marked."""
    found = np.zeros(marked.shape, np.bool_)
    for side in range(3):
        beside = neighbours[:, side]
        found |= marked[beside] & (beside >= 0)[:, None]
    return found


@numba.njit(cache=True, nogil=True)
def _away(centres, normals, led_centres, led_normals, least_cosine, codes):  # type: ignore[no-untyped-def]
    for triangle in range(len(centres)):
        for led in range(len(led_centres)):
            x = led_centres[led, 0] - centres[triangle, 0]
            y = led_centres[led, 1] - centres[triangle, 1]
            z = led_centres[led, 2] - centres[triangle, 2]
            distance = np.sqrt(x * x + y * y + z * z)
            facing = (x * normals[triangle, 0] + y * normals[triangle, 1] + z * normals[triangle, 2]) / distance
            from_led = -(x * led_normals[led, 0] + y * led_normals[led, 1] + z * led_normals[led, 2])
            codes[triangle, led] = REACHED if facing > least_cosine and from_led > 0.0 else AWAY


@numba.njit(cache=True, nogil=True)
def lit_by(centre, led_centre, led_normal, paper, towards):  # type: ignore[no-untyped-def]
    """E / Phi in m^-2 on a surface at `centre` that faces the LED, whose direction is written to `towards` [3].

    That of a small Lambertian emitter, cos / (pi d^2): at 0.5 m, that of a square of 7 mm differs by 7e-5. `paper`
    has the emitter's cosine twice (seed 003, Eq. 2).
    """
    for k in range(3):
        towards[k] = led_centre[k] - centre[k]
    square = towards[0] * towards[0] + towards[1] * towards[1] + towards[2] * towards[2]
    distance = np.sqrt(square)
    cosine = 0.0
    for k in range(3):
        towards[k] /= distance
        cosine -= towards[k] * led_normal[k]
    lit = max(cosine, 0.0) / (np.pi * square * 1e-6)
    return lit * cosine if paper else lit


@numba.njit(cache=True, nogil=True)
def lit_on(centres, led_centres, led_normals, paper):  # type: ignore[no-untyped-def]
    """[triangles, leds] of `lit_by`."""
    lit, towards = np.empty((len(centres), len(led_centres))), np.empty(3)
    for triangle in range(len(centres)):
        for led in range(len(led_centres)):
            lit[triangle, led] = lit_by(centres[triangle], led_centres[led], led_normals[led], paper, towards)
    return lit


def neighbours_of(triangles: NDArray[np.uint32]) -> NDArray[np.int64]:
    """[m, 3] the triangle across each side of triangles [m, 3] (rows of vertices), -1 where there is none."""
    count = len(triangles)
    sides = np.sort(triangles[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2).astype(np.int64), axis=1)
    key = sides[:, 0] * (int(triangles.max()) + 1) + sides[:, 1]
    order = np.argsort(key, kind="stable")
    same = np.flatnonzero(key[order[1:]] == key[order[:-1]])
    found = np.full(3 * count, -1, np.int64)
    found[order[same]], found[order[same + 1]] = order[same + 1] // 3, order[same] // 3
    return found.reshape(count, 3)
