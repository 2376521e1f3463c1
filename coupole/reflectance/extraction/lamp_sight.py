"""The LEDs that light each triangle, and its irradiance from them: shadows of the object, penumbrae, irradiance.

Rays go from a triangle's centre to the centres of all LEDs. Near the edges of shadows rays also go to the LEDs'
corners.
"""

from __future__ import annotations

from collections.abc import Sequence
from concurrent.futures import Executor
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from coupole.calibration.light.irradiance import LED_SIDE_MM, led_corners_mm
from coupole.calibration.light.tile_views import Positions
from coupole.kernels import kernel
from coupole.motion.occlusion import RAY_START_MM
from coupole.motion.packet_rays import PacketMesh
from coupole.reflectance.extraction.sample_codes import AWAY, PENUMBRA, REACHED, SHADED
from coupole.reflectance.parts_in_threads import first_alone

Floats = NDArray[np.float64]

MOST_INCIDENCE_DEG = 89.0
_MOST_RINGS = 8


@dataclass(frozen=True)
class Facets:
    """Triangles of an object that a view sees."""

    centres_mm: Floats
    """[n, 3]"""
    normals: Floats
    """[n, 3] unit, outward."""
    neighbours: NDArray[np.int64]
    """[n, 3] places of the neighbours in these arrays, or -1."""

    @cached_property
    def ray_starts_mm(self) -> NDArray[np.float32]:
        """[n, 3]"""
        starts: NDArray[np.float32] = (self.centres_mm + RAY_START_MM * self.normals).astype(np.float32)
        return starts


class CodesAhead:
    """Codes that were found before a view's frames were complete. The codes depend only on object, pose and LEDs.
    The codes of one view are kept, up to a limit of memory.
    """

    def __init__(self, most_bytes: int = 500_000_000) -> None:
        self._most_bytes = most_bytes
        self._sight = ""
        self._codes: dict[bytes, NDArray[np.uint8]] = {}

    def begin(self, sight: str) -> None:
        """Keep the codes of this view; the codes of another view are forgotten. `sight` identifies what the view
        sees."""
        if sight != self._sight:
            self._sight, self._codes = sight, {}

    def keep(self, leds: Positions, codes: NDArray[np.uint8]) -> bool:
        """Keep the codes [leds, triangles] of some LEDs; False if they are too large to keep."""
        if (len(self._codes) + len(codes)) * codes.shape[1] > self._most_bytes:
            return False
        self._codes |= zip(_keys_of(leds), codes, strict=True)
        return True

    def codes(self, sight: str, leds: Positions) -> NDArray[np.uint8] | None:
        """[leds, triangles] codes that were kept; None if one of them was not."""
        found = [self._codes.get(key) for key in _keys_of(leds)] if sight == self._sight else []
        known = [codes for codes in found if codes is not None]
        return np.stack(known) if len(known) == len(leds.ids) else None


def _keys_of(leds: Positions) -> Sequence[bytes]:
    return [row.tobytes() for row in np.hstack([leds.centres_mm, leds.normals])]


def lamp_codes(mesh: PacketMesh, facets: Facets, leds: Positions, pool: Executor) -> NDArray[np.uint8]:
    """[leds, triangles] codes, computed LED by LED in the threads of a pool; `mesh` casts the shadows."""
    facets.ray_starts_mm  # noqa: B018  made once, before threads want it
    rows = pool.map(first_alone(lambda led: _codes_of_led(mesh, facets, leds, led)), range(len(leds.ids)))
    return np.stack(list(rows))


def _codes_of_led(mesh: PacketMesh, facets: Facets, leds: Positions, led: int) -> NDArray[np.uint8]:
    """[triangles] codes, found in three steps: first the shadow of the LED's centre; then the triangles beside it,
    which the shadow's edge may cross; then, ring by ring, the triangles that only a part of the LED reaches, until
    a ring has none."""
    centre_mm, normal = leds.centres_mm[led], leds.normals[led]
    codes = np.empty(len(facets.centres_mm), np.uint8)
    _away(facets.centres_mm, facets.normals, centre_mm, normal, np.cos(np.radians(MOST_INCIDENCE_DEG)), codes)
    starts_mm, lit = facets.ray_starts_mm, np.flatnonzero(codes == REACHED)
    shaded_triangles = lit[mesh.blocked_rays(starts_mm, lit, centre_mm)]
    codes[shaded_triangles] = SHADED
    edge = _darken_beside(shaded_triangles, facets.neighbours, codes)
    corners_mm = led_corners_mm(centre_mm[None], normal[None], LED_SIDE_MM)[0]
    for _ in range(_MOST_RINGS):
        candidates = _darken_beside(edge, facets.neighbours, codes)
        partly = np.zeros(len(candidates), np.bool_)
        for corner_mm in corners_mm:
            partly |= mesh.blocked_rays(starts_mm, candidates, corner_mm)
        codes[candidates[~partly]] = REACHED
        edge = candidates[partly]
        if not len(edge):
            break
    return codes


@kernel
def _darken_beside(triangles, neighbours, codes):  # type: ignore[no-untyped-def]
    """Give the lit neighbours of some triangles the code of a penumbra, and return these neighbours."""
    dark_neighbours = np.empty(3 * len(triangles), np.int64)
    count = 0
    for triangle in triangles:
        for beside in neighbours[triangle]:
            if beside >= 0 and codes[beside] == REACHED:
                codes[beside] = PENUMBRA
                dark_neighbours[count] = beside
                count += 1
    return dark_neighbours[:count]


@kernel
def _away(centres, normals, led_centre, led_normal, least_cosine, codes):  # type: ignore[no-untyped-def]
    for triangle in range(len(centres)):
        x = led_centre[0] - centres[triangle, 0]
        y = led_centre[1] - centres[triangle, 1]
        z = led_centre[2] - centres[triangle, 2]
        distance = np.sqrt(x * x + y * y + z * z)
        facing = (x * normals[triangle, 0] + y * normals[triangle, 1] + z * normals[triangle, 2]) / distance
        from_led = -(x * led_normal[0] + y * led_normal[1] + z * led_normal[2])
        codes[triangle] = REACHED if facing > least_cosine and from_led > 0.0 else AWAY


@kernel
def lit_by(centre, led_centre, led_normal, paper, towards):  # type: ignore[no-untyped-def]
    """Return E / Phi, m^-2, on a surface at `centre` that faces the LED. The direction to the LED is written to
    `towards` [3].

    The LED is a small Lambertian emitter, cos / (pi d^2). At 0.5 m, the irradiance from a square of 7 mm differs
    from this by 7e-5. With `paper` the emitter's cosine counts twice (Lucat et al. 2025, Eq. 2).
    """
    for k in range(3):
        towards[k] = led_centre[k] - centre[k]
    square = towards[0] * towards[0] + towards[1] * towards[1] + towards[2] * towards[2]
    inverse = 1.0 / np.sqrt(square)
    cosine = 0.0
    for k in range(3):
        towards[k] *= inverse
        cosine -= towards[k] * led_normal[k]
    lit = max(cosine, 0.0) * inverse * inverse * (1e6 / np.pi)
    return lit * cosine if paper else lit


@kernel
def lit_on(centres, led_centres, led_normals, paper):  # type: ignore[no-untyped-def]
    """[triangles, leds] values of `lit_by`."""
    lit, towards = np.empty((len(centres), len(led_centres))), np.empty(3)
    for triangle in range(len(centres)):
        for led in range(len(led_centres)):
            lit[triangle, led] = lit_by(centres[triangle], led_centres[led], led_normals[led], paper, towards)
    return lit


def neighbours_of(triangles: NDArray[np.uint32]) -> NDArray[np.int64]:
    """[m, 3] the neighbour across each side of triangles [m, 3] (rows of vertices), -1 where there is none."""
    count = len(triangles)
    sides = np.sort(triangles[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2).astype(np.int64), axis=1)
    key = sides[:, 0] * (int(triangles.max()) + 1) + sides[:, 1]
    order = np.argsort(key, kind="stable")
    same = np.flatnonzero(key[order[1:]] == key[order[:-1]])
    neighbours = np.full(3 * count, -1, np.int64)
    neighbours[order[same]], neighbours[order[same + 1]] = order[same + 1] // 3, order[same] // 3
    return neighbours.reshape(count, 3)
