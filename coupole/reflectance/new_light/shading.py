"""Radiance of pixels under beams, by GGX materials or by values of triangles that a slice gives.

Emitters that have a size are seen by GGX in two ways at once: by their beams, and by rays that are drawn from each
pixel's lobe and meet the emitter or not. Both are weighted by the balance heuristic (Veach, Robust Monte Carlo
methods for light transport simulation, 1997, 9.2): a sharp lobe shows the emitter itself and not its beams, a
rough one the beams and no noise.
"""

from __future__ import annotations

import math
from typing import Any

import numba
import numpy as np
from numpy.typing import NDArray

from coupole.motion.occlusion import RAY_START_MM, blocked
from coupole.reflectance.ggx import drawn, reflected, shine
from coupole.reflectance.new_light.beams import Beam, Emitter
from coupole.reflectance.new_light.pictured_surface import Surface, in_strips
from coupole.reflectance.new_light.shadow_edges import DISTANT_MM, LIT, Codes
from coupole.reflectance.triangle_fit import TriangleMaterials

Floats = NDArray[np.float64]
Picture = NDArray[np.float32]
"""[h, w, channels]; what is added to it is radiance."""

Coats = NDArray[np.float32]
"""[triangles, 4 + 2 channels]: normal, alpha (0 for no material), kd, ks, side by side in memory."""
MIRROR_SHARE = 4
"""Rays from a lobe are one for so many beams of an emitter."""
_R2 = (0.7548776662466927, 0.5698402909980532)
"""Steps of Roberts' sequence: powers of 1 over the plastic number."""


def coats_of(materials: TriangleMaterials) -> Coats:
    """Materials as they are read pixel by pixel."""
    alpha = np.nan_to_num(materials.alpha)[:, None]
    return np.hstack([materials.normals, alpha, materials.kd, materials.ks]).astype(np.float32)


def add_beam(picture: Picture, surface: Surface, coats: Coats, codes: Codes, beam: Beam, lobe_rays: int) -> None:
    """Add what GGX materials of the surface's triangles make of a beam where `codes` say that it reaches; where
    `lobe_rays` are drawn for its emitter, only its part."""
    of_beam = beam.near, beam.place, beam.axis, beam.exponent, beam.strength, beam.density, lobe_rays
    in_strips(
        len(picture),
        lambda rows: _add_beam(
            surface.seen[rows], surface.places_mm[rows], codes[rows], surface.camera_mm, coats, *of_beam,
            picture[rows],
        ),
    )  # fmt: skip


def add_values(picture: Picture, surface: Surface, values: NDArray[np.float32], codes: Codes, beam: Beam) -> None:
    """Add the same by values [triangles, channels] of f cos_i, 1/sr, under the beam."""
    of_beam = beam.near, beam.place, beam.axis, beam.exponent, beam.strength
    in_strips(
        len(picture),
        lambda rows: _add_values(
            surface.seen[rows], surface.places_mm[rows], codes[rows], values, *of_beam, picture[rows]
        ),
    )


def add_mirrored(
    picture: Picture,
    surface: Surface,
    coats: Coats,
    rays: Any,
    emitter: Emitter,
    lobe_rays: int,
) -> None:
    """Add what rays drawn from the materials' lobes meet of an emitter; `rays` is the mesh's `ray_mesh`."""
    of_emitter = (
        emitter.near, emitter.axes, emitter.centre_mm, emitter.halves_mm, emitter.radiance, emitter.density
    )  # fmt: skip

    def add(rows: slice) -> None:
        seen, places_mm, part = surface.seen[rows], surface.places_mm[rows], picture[rows]
        row, column = np.nonzero(seen >= 0)
        if not len(row):
            return
        pixels = np.stack([row, column], axis=1)
        starts_mm = places_mm[row, column] + RAY_START_MM * surface.normals[seen[row, column]]
        met, ways_mm = np.empty(len(pixels), np.int64), np.empty((len(pixels), 3))
        gains, sums = np.empty((len(pixels), part.shape[2])), np.zeros((len(pixels), part.shape[2]), np.float32)
        for ray in range(lobe_rays):
            count = _mirror(
                pixels, rows.start, seen, places_mm, surface.camera_mm, surface.normals, coats, *of_emitter, ray,
                lobe_rays, met, gains, ways_mm,
            )  # fmt: skip
            starts = starts_mm[met[:count]]
            free = ~blocked(rays, starts, starts + ways_mm[:count])
            sums[met[:count][free]] += gains[:count][free]
        part[row, column] += sums

    in_strips(len(picture), add)


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _towards(near, place, axis, exponent, x, y, z, way):  # type: ignore[no-untyped-def]
    """Into `way` [3] the direction from a pixel's place to a beam's; cos^k / d^2 in m^-2, 1 of distant light."""
    if not near:
        way[0], way[1], way[2] = place[0], place[1], place[2]
        return 1.0
    dx, dy, dz = place[0] - x, place[1] - y, place[2] - z
    square = dx * dx + dy * dy + dz * dz
    distance = math.sqrt(square)
    way[0], way[1], way[2] = dx / distance, dy / distance, dz / distance
    found = 1e6 / square
    if exponent > 0:
        cosine = max(-(way[0] * axis[0] + way[1] * axis[1] + way[2] * axis[2]), 0.0)
        found *= cosine if exponent == 1 else cosine * cosine
    return found


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _add_beam(  # type: ignore[no-untyped-def]
    seen, places_mm, codes, camera_mm, coats, near, place, axis, exponent, strength, density,
    lobe_rays, picture
):  # fmt: skip
    way = np.empty(3)
    channels = picture.shape[2]
    for row in range(seen.shape[0]):
        for column in range(seen.shape[1]):
            if codes[row, column] != LIT:
                continue
            triangle = seen[row, column]
            alpha = coats[triangle, 3]
            if alpha == 0.0:
                continue
            x, y, z = places_mm[row, column, 0], places_mm[row, column, 1], places_mm[row, column, 2]
            reach = _towards(near, place, axis, exponent, x, y, z, way)
            n0, n1, n2 = coats[triangle, 0], coats[triangle, 1], coats[triangle, 2]
            nl = n0 * way[0] + n1 * way[1] + n2 * way[2]
            if not nl > 0.0:
                continue
            v0, v1, v2 = camera_mm[0] - x, camera_mm[1] - y, camera_mm[2] - z
            length = 1.0 / math.sqrt(v0 * v0 + v1 * v1 + v2 * v2)
            v0, v1, v2 = v0 * length, v1 * length, v2 * length
            nv = n0 * v0 + n1 * v1 + n2 * v2
            lobe = 0.0
            if nv > 0.0:
                h0, h1, h2 = v0 + way[0], v1 + way[1], v2 + way[2]
                nh = (nl + nv) / math.sqrt(h0 * h0 + h1 * h1 + h2 * h2)
                lobe = shine(nl, nv, nh, alpha)
                if lobe_rays > 0 and density > 0.0 and _shines(coats[triangle]):
                    mine = density / reach
                    reach *= mine / (mine + lobe_rays * drawn(nv, nh, alpha))
            for channel in range(channels):
                value = coats[triangle, 4 + channel] + coats[triangle, 4 + channels + channel] * lobe
                picture[row, column, channel] += strength[channel] * reach * nl * value


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _add_values(seen, places_mm, codes, values, near, place, axis, exponent, strength, picture):  # type: ignore[no-untyped-def]
    way = np.empty(3)
    for row in range(seen.shape[0]):
        for column in range(seen.shape[1]):
            if codes[row, column] != LIT:
                continue
            x, y, z = places_mm[row, column, 0], places_mm[row, column, 1], places_mm[row, column, 2]
            reach = _towards(near, place, axis, exponent, x, y, z, way)
            for channel in range(picture.shape[2]):
                picture[row, column, channel] += strength[channel] * reach * values[seen[row, column], channel]


@numba.njit(cache=True, nogil=True)
def _shines(coat):  # type: ignore[no-untyped-def]
    """Whether a material has a lobe at all."""
    found = False
    for number in range(4 + (len(coat) - 4) // 2, len(coat)):
        found |= coat[number] > 0.0
    return found


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _mirror(  # type: ignore[no-untyped-def]
    pixels, first_row, seen, places_mm, camera_mm, faces, coats, near, axes, centre_mm,
    halves_mm, radiance, density, ray, lobe_rays, met, gains, ways_mm
):  # fmt: skip
    """How many of the rays of this number from pixels [n, 2] point at a bright part of an emitter: into `met`
    which, into `gains` what they bring if nothing is in their way, into `ways_mm` how they get there."""
    way, channels, count = np.empty(3), gains.shape[1], 0
    for pixel in range(len(pixels)):
        row, column = pixels[pixel]
        triangle = seen[row, column]
        coat = coats[triangle]
        if coat[3] == 0.0 or not _shines(coat):
            continue
        normal, place = coat[:3], places_mm[row, column]
        v0, v1, v2 = camera_mm[0] - place[0], camera_mm[1] - place[1], camera_mm[2] - place[2]
        length = math.sqrt(v0 * v0 + v1 * v1 + v2 * v2)
        v0, v1, v2 = v0 / length, v1 / length, v2 / length
        nv = normal[0] * v0 + normal[1] * v1 + normal[2] * v2
        if not nv > 0.0:
            continue
        first, second = _two_numbers(first_row + row, column, ray)
        nh = reflected(normal, v0, v1, v2, nv, coat[3], first, second, way)
        nl = normal[0] * way[0] + normal[1] * way[1] + normal[2] * way[2]
        face = faces[triangle]
        if not nl > 0.0 or not way[0] * face[0] + way[1] * face[1] + way[2] * face[2] > 0.0:
            continue
        if near:
            far_mm, among, x, y = _on_area(place, way, axes, centre_mm, halves_mm, density)
        else:
            far_mm, among, x, y = _in_environment(way, axes, radiance, density)
        if not among > 0.0:
            continue
        lobe = shine(nl, nv, nh, coat[3])
        share = nl / (among + lobe_rays * drawn(nv, nh, coat[3]))
        for channel in range(channels):
            value = coat[4 + channel] + coat[4 + channels + channel] * lobe
            gains[count, channel] = radiance[x, y, channel] * value * share
        for k in range(3):
            ways_mm[count, k] = far_mm * way[k]
        met[count] = pixel
        count += 1
    return count


@numba.njit(cache=True, nogil=True)
def _two_numbers(row, column, ray):  # type: ignore[no-untyped-def]
    """From 0 to 1: those of this number in a sequence, shifted for each pixel (Wang's hash)."""
    seed = np.uint32(row * 65536 + column)
    seed = (seed ^ np.uint32(61)) ^ (seed >> np.uint32(16))
    seed = np.uint32(seed * np.uint32(9))
    seed = seed ^ (seed >> np.uint32(4))
    seed = np.uint32(seed * np.uint32(0x27D4EB2D))
    seed = seed ^ (seed >> np.uint32(15))
    first = (float(seed & np.uint32(0xFFFF)) + 0.5) / 65536.0
    second = (float((seed >> np.uint32(16)) & np.uint32(0xFFFF)) + 0.5) / 65536.0
    return (first + ray * _R2[0]) % 1.0, (second + ray * _R2[1]) % 1.0


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _on_area(place, way, axes, centre_mm, halves_mm, density):  # type: ignore[no-untyped-def]
    """Distance to the area along a direction; beams per sr there, 0 if it is not met from its bright side; its
    pixel."""
    above, slope = 0.0, 0.0
    for k in range(3):
        above += (centre_mm[k] - place[k]) * axes[2, k]
        slope += way[k] * axes[2, k]
    if slope >= 0.0 or above >= 0.0:
        return 0.0, 0.0, 0, 0
    far_mm = above / slope
    for side in range(2):
        at = 0.0
        for k in range(3):
            at += (place[k] + far_mm * way[k] - centre_mm[k]) * axes[side, k]
        if abs(at) > halves_mm[side]:
            return 0.0, 0.0, 0, 0
    return far_mm, density * far_mm * far_mm * 1e-6 / -slope, 0, 0


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _in_environment(way, axes, radiance, density):  # type: ignore[no-untyped-def]
    """How far shadows of an environment reach; its beams per sr in a direction; its pixel there."""
    height, width, channels = radiance.shape
    middle, left, up = 0.0, 0.0, 0.0
    for k in range(3):
        middle += way[k] * axes[0, k]
        left += way[k] * axes[1, k]
        up += way[k] * axes[2, k]
    row = min(int(math.acos(min(1.0, max(-1.0, up))) / math.pi * height), height - 1)
    column = min(int((0.5 - math.atan2(left, middle) / (2.0 * math.pi)) * width), width - 1)
    mean = 0.0
    for channel in range(channels):
        mean += radiance[row, column, channel] / channels
    return DISTANT_MM, density * mean, row, column
