"""Radiance of pixels under beams, by GGX materials or by values of triangles that a slice gives.

Emitters that have a size are seen by GGX in two ways at once: by their beams, and by rays that are drawn from each
pixel's lobe and meet the emitter or not. Both are weighted by the balance heuristic (Veach, Robust Monte Carlo
methods for light transport simulation, 1997, 9.2): a sharp lobe shows the emitter itself and not its beams, a
rough one the beams and no noise. No rays are drawn for an area that is not larger than the lobe: its beams are as
close to each other in the lobe as in the area.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Iterator, Sequence
from itertools import groupby
from typing import Any

import numba
import numpy as np
from numpy.typing import NDArray

from coupole.motion.occlusion import RAY_START_MM, blocked
from coupole.reflectance.ggx import drawn, reflected, shine
from coupole.reflectance.lanes import LANES, absolute, gathered, if_less, lanes, larger, loaded, root, store, total
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


def alike(beams: Iterable[Beam]) -> Iterator[list[Beam]]:
    """Up to eight neighbouring beams of one kind, which are shaded together."""
    for _, same in groupby(beams, key=lambda beam: (beam.near, beam.exponent, beam.density > 0.0)):
        kept = list(same)
        yield from (kept[first : first + LANES] for first in range(0, len(kept), LANES))


def add_beams(
    picture: Picture, surface: Surface, coats: Coats, codes: Codes, beams: Sequence[Beam], lobe_rays: int
) -> None:
    """Add what GGX materials of the surface's triangles make of some of the `alike` beams where `codes` [8, h, w]
    say that they reach; where `lobe_rays` are drawn for their emitter, only their part."""

    def across(of: Callable[[Beam], Floats]) -> NDArray[np.float32]:
        """[..., 8]: one lane for each beam."""
        made = np.stack([of(beam) for beam in beams], axis=1)
        return np.pad(made, ((0, 0), (0, LANES - len(beams))), mode="edge").astype(np.float32, order="C")

    strengths = across(lambda beam: beam.strength)
    strengths[:, len(beams) :] = 0.0
    of_beams = (
        beams[0].near, beams[0].exponent, across(lambda beam: beam.place), across(lambda beam: beam.axis),
        strengths, across(lambda beam: np.array([beam.density])), lobe_rays if beams[0].density > 0.0 else 0,
    )  # fmt: skip
    flat = codes.reshape(LANES, -1)
    in_strips(
        len(picture),
        lambda rows: _add_beams(
            rows.start, surface.seen[rows], surface.places_mm[rows], flat, surface.camera_mm, coats, *of_beams,
            picture[rows],
        ),
    )  # fmt: skip


def add_beam(picture: Picture, surface: Surface, coats: Coats, codes: Codes, beam: Beam) -> None:
    """As `add_beams` of a single one that is no part of an emitter, where `codes` [h, w] say that it reaches."""
    single = (values.astype(np.float32) for values in (surface.camera_mm, beam.place, beam.axis, beam.strength))
    camera_mm, place, axis, strength = single
    in_strips(
        len(picture),
        lambda rows: _add_beam(
            surface.seen[rows], surface.places_mm[rows].reshape(-1, 3), codes[rows], camera_mm, coats, beam.near,
            place, axis, beam.exponent, strength, picture[rows],
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
        asking = np.zeros(seen.shape, np.bool_)
        _asking(seen, places_mm, surface.camera_mm, coats, *of_emitter[:3], emitter.density, lobe_rays, asking)
        row, column = np.nonzero(asking)
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
def _reach(near, exponent, places, axes, x, y, z):  # type: ignore[no-untyped-def]
    """As `_towards`, of eight beams: three coordinates of their directions, and cos^k / d^2."""
    dx, dy, dz = loaded(places, 0), loaded(places, 1), loaded(places, 2)
    if not near:
        return dx, dy, dz, lanes(np.float32(1.0))
    dx, dy, dz = dx - x, dy - y, dz - z
    inverse = np.float32(1.0) / root(dx * dx + dy * dy + dz * dz)
    dx, dy, dz, found = dx * inverse, dy * inverse, dz * inverse, np.float32(1e6) * inverse * inverse
    for _ in range(exponent):
        cosine = dx * loaded(axes, 0) + dy * loaded(axes, 1) + dz * loaded(axes, 2)
        found = found * larger(np.float32(-1.0) * cosine, np.float32(0.0))
    return dx, dy, dz, found


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _add_beams(  # type: ignore[no-untyped-def]
    first_row, seen, places_mm, codes, camera_mm, coats, near, exponent, places, axes, strengths, densities,
    lobe_rays, picture
):  # fmt: skip
    every, channels, half, none = np.arange(LANES), picture.shape[2], np.float32(0.5), np.float32(0.0)
    for row in range(seen.shape[0]):
        for column in range(seen.shape[1]):
            triangle = seen[row, column]
            if triangle < 0 or coats[triangle, 3] == none:
                continue
            lit = absolute(gathered(codes, every, (first_row + row) * seen.shape[1] + column) - np.float32(LIT))
            if total(if_less(lit, half, np.float32(1.0), lit * none)) == none:
                continue
            coat, place = coats[triangle], places_mm[row, column]
            n0, n1, n2, alpha = coat[0], coat[1], coat[2], coat[3]
            l0, l1, l2, reach = _reach(near, exponent, places, axes, place[0], place[1], place[2])
            nl = larger(n0 * l0 + n1 * l1 + n2 * l2, none)
            v0, v1, v2 = camera_mm[0] - place[0], camera_mm[1] - place[1], camera_mm[2] - place[2]
            length = 1.0 / math.sqrt(v0 * v0 + v1 * v1 + v2 * v2)
            v0, v1, v2 = v0 * length, v1 * length, v2 * length
            nv, lobe = n0 * v0 + n1 * v1 + n2 * v2, lanes(none)
            if nv > 0.0:
                d, b = _facets(n0, n1, n2, l0 + v0, l1 + v1, l2 + v2, nv, alpha)
                alpha2 = alpha * alpha
                lobe = d / (nl * b + nv * root(alpha2 + (np.float32(1.0) - alpha2) * nl * nl))
                if lobe_rays > 0 and _shines(coat):
                    mine = loaded(densities, 0)
                    shared = reach * mine / (mine + reach * d * (lobe_rays / (nv + b)))
                    if near:
                        least = mine * _across(places, axes, place)
                        peak = MIRROR_SHARE * lobe_rays * drawn(nv, 1.0, alpha)
                        shared = if_less(least, lanes(np.float32(peak)), shared, reach)
                    reach = shared
            reach = if_less(lit, half, reach * nl, none)
            for channel in range(channels):
                light = reach * loaded(strengths, channel)
                shining = coat[4 + channels + channel] * total(light * lobe)
                picture[row, column, channel] += coat[4 + channel] * total(light) + shining


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _add_beam(  # type: ignore[no-untyped-def]
    seen, places_mm, codes, camera_mm, coats, near, place, axis, exponent, strength, picture
):
    """Eight neighbouring pixels of a row in the lanes."""
    (height, width), channels, none, half = seen.shape, picture.shape[2], np.float32(0.0), np.float32(0.5)
    pixel, triangle = np.zeros(LANES, np.int64), np.zeros(LANES, np.int64)
    on, added = np.zeros((1, LANES), np.float32), np.empty((channels, LANES), np.float32)
    for row in range(height):
        for first in range(0, width, LANES):
            count = min(LANES, width - first)
            on[:] = none
            for k in range(count):
                mine = seen[row, first + k]
                pixel[k], triangle[k] = row * width + first + k, max(mine, 0)
                on[0, k] = mine >= 0 and codes[row, first + k] == LIT and coats[max(mine, 0), 3] > none
            if not on.any():
                continue
            lit = loaded(on, 0)
            x, y, z = gathered(places_mm, pixel, 0), gathered(places_mm, pixel, 1), gathered(places_mm, pixel, 2)
            n0, n1, n2 = gathered(coats, triangle, 0), gathered(coats, triangle, 1), gathered(coats, triangle, 2)
            l0, l1, l2, reach = _reach_from(near, place, axis, exponent, x, y, z)
            v0, v1, v2 = camera_mm[0] - x, camera_mm[1] - y, camera_mm[2] - z
            inverse = np.float32(1.0) / root(v0 * v0 + v1 * v1 + v2 * v2)
            v0, v1, v2 = v0 * inverse, v1 * inverse, v2 * inverse
            nl, nv = larger(n0 * l0 + n1 * l1 + n2 * l2, none), n0 * v0 + n1 * v1 + n2 * v2
            lobe = _lobe(n0, n1, n2, l0 + v0, l1 + v1, l2 + v2, nl, nv, gathered(coats, triangle, 3))
            reach = if_less(half, lit, reach * nl, none)
            for channel in range(channels):
                kd, ks = gathered(coats, triangle, 4 + channel), gathered(coats, triangle, 4 + channels + channel)
                store(if_less(half, lit, reach * strength[channel] * (kd + ks * lobe), none), added, channel)
            for k in range(count):
                for channel in range(channels):
                    picture[row, first + k, channel] += added[channel, k]


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _reach_from(near, place, axis, exponent, x, y, z):  # type: ignore[no-untyped-def]
    """As `_reach`, of one beam from eight places."""
    if not near:
        return lanes(place[0]), lanes(place[1]), lanes(place[2]), lanes(np.float32(1.0))
    dx, dy, dz = place[0] - x, place[1] - y, place[2] - z
    inverse = np.float32(1.0) / root(dx * dx + dy * dy + dz * dz)
    dx, dy, dz, found = dx * inverse, dy * inverse, dz * inverse, np.float32(1e6) * inverse * inverse
    for _ in range(exponent):
        found = found * larger(np.float32(-1.0) * (dx * axis[0] + dy * axis[1] + dz * axis[2]), np.float32(0.0))
    return dx, dy, dz, found


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _lobe(n0, n1, n2, h0, h1, h2, nl, nv, alpha):  # type: ignore[no-untyped-def]
    """D V of eight pixels, by `_facets`' sines; 0 where the normal looks away from the camera."""
    one, none = np.float32(1.0), np.float32(0.0)
    x, y, z = n1 * h2 - n2 * h1, n2 * h0 - n0 * h2, n0 * h1 - n1 * h0
    sin2 = (x * x + y * y + z * z) / (h0 * h0 + h1 * h1 + h2 * h2)
    alpha2 = alpha * alpha
    rest = one - alpha2
    t = alpha2 + rest * sin2
    a, b = root(alpha2 + rest * nl * nl), root(alpha2 + rest * nv * nv)
    found = np.float32(0.5 / math.pi) * alpha2 / (t * t * (nl * b + nv * a))
    return if_less(none, nv, found, none)


@numba.njit(cache=True, nogil=True)
def _across(places, axes, place):  # type: ignore[no-untyped-def]
    """Squares of the distances, m^2, of a pixel's place from the planes of eight emitters."""
    above = (loaded(places, 0) - place[0]) * loaded(axes, 0) + (loaded(places, 1) - place[1]) * loaded(axes, 1)
    above = above + (loaded(places, 2) - place[2]) * loaded(axes, 2)
    return np.float32(1e-6) * above * above


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _facets(n0, n1, n2, h0, h1, h2, nv, alpha):  # type: ignore[no-untyped-def]
    """GGX's distribution over 2 for eight half vectors of any length, and the view's part of the masking. From
    sines, since single precision has no cosine of a small angle."""
    x, y, z = n1 * h2 - n2 * h1, n2 * h0 - n0 * h2, n0 * h1 - n1 * h0
    sin2 = (x * x + y * y + z * z) / (h0 * h0 + h1 * h1 + h2 * h2)
    alpha2 = alpha * alpha
    t = alpha2 + (np.float32(1.0) - alpha2) * sin2
    return (0.5 / math.pi * alpha2) / (t * t), math.sqrt(alpha2 + (1.0 - alpha2) * nv * nv)


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
        normal, place = coat[:3], places_mm[row, column]
        v0, v1, v2 = camera_mm[0] - place[0], camera_mm[1] - place[1], camera_mm[2] - place[2]
        length = math.sqrt(v0 * v0 + v1 * v1 + v2 * v2)
        v0, v1, v2 = v0 / length, v1 / length, v2 / length
        nv = normal[0] * v0 + normal[1] * v1 + normal[2] * v2
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


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _asking(seen, places_mm, camera_mm, coats, near, axes, centre_mm, density, lobe_rays, asking):  # type: ignore[no-untyped-def]
    """Mark the pixels for which rays are drawn. Not for an area that is at most as large as their lobe: the solid
    angle that it could have at its distance, times how dense the lobe's rays can be, is at most 1."""
    for row in range(seen.shape[0]):
        for column in range(seen.shape[1]):
            coat, place = coats[max(seen[row, column], 0)], places_mm[row, column]
            if seen[row, column] < 0 or coat[3] == 0.0 or not _shines(coat):
                continue
            square, nv, above = 0.0, 0.0, 0.0
            for k in range(3):
                view = camera_mm[k] - place[k]
                square += view * view
                nv += coat[k] * view
                above += (centre_mm[k] - place[k]) * axes[2, k]
            nv /= math.sqrt(square)
            peak = MIRROR_SHARE * lobe_rays * drawn(nv, 1.0, coat[3])
            asking[row, column] = nv > 0.0 and not (near and density * above * above * 1e-6 >= peak)


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
