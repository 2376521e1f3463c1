"""Radiance of pixels under beams, by GGX materials or by the values of slices for triangles.

For GGX, the light of an emitter with a size is found in two ways at once: by its beams, and by rays that are drawn
from each pixel's lobe and may meet the emitter (`mirrored`). Both are weighted by the balance heuristic (Veach,
Robust Monte Carlo methods for light transport simulation, 1997, 9.2). So a sharp lobe shows the emitter itself and
not its beams, and a rough lobe shows the beams without noise. No rays are drawn for an area that is not larger
than the lobe, because its beams are as dense in the lobe as in the area.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Iterator, Sequence
from itertools import groupby
from typing import Any

import numpy as np
from numpy.typing import NDArray

from coupole.kernels import kernel
from coupole.kernels.lanes import (
    LANES,
    absolute,
    add_in_turns,
    four_gathered,
    gather_lanes,
    if_less,
    in_turns,
    lanes,
    larger,
    load_row,
    root,
    store,
    total,
)
from coupole.reflectance.ggx import lobe_density
from coupole.reflectance.new_light.beams import Beam
from coupole.reflectance.new_light.pictured_surface import Surface, in_strips
from coupole.reflectance.new_light.shadow_edges import LIT, Codes
from coupole.reflectance.triangle_fit import TriangleMaterials

Floats = NDArray[np.float64]
Picture = NDArray[np.float32]
"""[h, w, channels] radiance, to which light is added."""

Coats = NDArray[np.float32]
"""[triangles, 12], in groups of four: normal and alpha (0 for no material), then `KD`, then `KS`; numbers after
the last channel are 0."""
KD, KS = 4, 8
MIRROR_SHARE = 4
"""Number of an emitter's beams for each ray that is drawn from a lobe."""


def coats_of(materials: TriangleMaterials) -> Coats:
    """Return materials in the form in which they are read for each pixel."""
    coats = np.zeros((len(materials.alpha), 12), np.float32)
    coats[:, :3], coats[:, 3] = materials.normals, np.nan_to_num(materials.alpha)
    for first, part in ((KD, materials.kd), (KS, materials.ks)):
        coats[:, first : first + part.shape[1]] = part
    return coats


def alike(beams: Iterable[Beam]) -> Iterator[list[Beam]]:
    """Yield groups of up to eight neighbouring beams of one kind, which are shaded together."""
    for _, same in groupby(beams, key=lambda beam: (beam.near, beam.exponent, beam.density > 0.0)):
        beams_alike = list(same)
        yield from (beams_alike[first : first + LANES] for first in range(0, len(beams_alike), LANES))


def add_beams(
    picture: Picture, surface: Surface, coats: Coats, codes: Codes, beams: Sequence[Beam], lobe_rays: int
) -> None:
    """Add the light that GGX materials of the surface's triangles reflect from some of the `alike` beams, where
    `codes` [8, h, w] say that they reach. If `lobe_rays` are drawn for the emitter of these beams, add only the
    part that the beams contribute."""

    def across(of: Callable[[Beam], Floats]) -> NDArray[np.float32]:
        """[..., 8]: one lane for each beam."""
        columns = np.stack([of(beam) for beam in beams], axis=1)
        return np.pad(columns, ((0, 0), (0, LANES - len(beams))), mode="edge").astype(np.float32, order="C")

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
            rows.start, surface.triangle_of_pixel[rows], surface.places_mm[rows], flat, surface.camera_mm,
            coats, *of_beams,
            picture[rows],
        ),
    )  # fmt: skip


def add_beam(picture: Picture, surface: Surface, coats: Coats, codes: Codes, beam: Beam) -> None:
    """Add the light of a single beam that is not part of an emitter, as `add_beams` does, where `codes` [h, w] say
    that the beam reaches. The picture must be in C order."""
    three = np.resize(beam.strength, 3)
    single = (values.astype(np.float32) for values in (surface.camera_mm, beam.place, beam.axis, three))
    camera_mm, place, axis, strength = single
    flat = [
        pixel_array.reshape(codes.size, -1)
        for pixel_array in (surface.triangle_of_pixel, surface.places_mm, codes, picture)
    ]

    def add(pixels: list[NDArray[Any]]) -> None:
        triangles, places_mm, here, part = (
            pixel_array.reshape(len(pixel_array) // LANES, -1) for pixel_array in pixels
        )
        _add_beam(
            triangles, places_mm, here, coats, camera_mm, beam.near, place, axis, beam.exponent, strength, part
        )

    eights, rest = divmod(codes.size, LANES)
    in_strips(
        eights, lambda part: add([pixel_array[part.start * LANES : part.stop * LANES] for pixel_array in flat])
    )
    if rest:
        last = [np.resize(pixel_array[-rest:], (LANES, pixel_array.shape[1])) for pixel_array in flat]
        add(last)
        flat[-1][-rest:] = last[-1][:rest]


def add_values(picture: Picture, surface: Surface, values: NDArray[np.float32], codes: Codes, beam: Beam) -> None:
    """Add the light of a beam by values [triangles, channels] of f cos_i, 1/sr."""
    of_beam = beam.near, beam.place, beam.axis, beam.exponent, beam.strength
    in_strips(
        len(picture),
        lambda rows: _add_values(
            surface.triangle_of_pixel[rows], surface.places_mm[rows], codes[rows], values, *of_beam, picture[rows]
        ),
    )


@kernel(error_model="numpy")
def _towards(near, place, axis, exponent, x, y, z, way):  # type: ignore[no-untyped-def]
    """Fill `way` [3] with the direction from a pixel's place to the beam's place. Return cos^k / d^2 in m^-2, or 1
    for distant light."""
    if not near:
        way[0], way[1], way[2] = place[0], place[1], place[2]
        return 1.0
    dx, dy, dz = place[0] - x, place[1] - y, place[2] - z
    square = dx * dx + dy * dy + dz * dz
    distance = math.sqrt(square)
    way[0], way[1], way[2] = dx / distance, dy / distance, dz / distance
    reach = 1e6 / square
    if exponent > 0:
        cosine = max(-(way[0] * axis[0] + way[1] * axis[1] + way[2] * axis[2]), 0.0)
        reach *= cosine if exponent == 1 else cosine * cosine
    return reach


@kernel(error_model="numpy")
def _reach(near, exponent, places, axes, x, y, z):  # type: ignore[no-untyped-def]
    """Do the same as `_towards` for eight beams: return three coordinates of their directions, and cos^k / d^2."""
    dx, dy, dz = load_row(places, 0), load_row(places, 1), load_row(places, 2)
    if not near:
        return dx, dy, dz, lanes(np.float32(1.0))
    dx, dy, dz = dx - x, dy - y, dz - z
    inverse = np.float32(1.0) / root(dx * dx + dy * dy + dz * dz)
    dx, dy, dz, reach = dx * inverse, dy * inverse, dz * inverse, np.float32(1e6) * inverse * inverse
    for _ in range(exponent):
        cosine = dx * load_row(axes, 0) + dy * load_row(axes, 1) + dz * load_row(axes, 2)
        reach = reach * larger(np.float32(-1.0) * cosine, np.float32(0.0))
    return dx, dy, dz, reach


@kernel(error_model="numpy")
def _add_beams(  # type: ignore[no-untyped-def]
    first_row, triangle_of_pixel, places_mm, codes, camera_mm, coats, near, exponent, places, axes, strengths,
    densities,
    lobe_rays, picture
):  # fmt: skip
    every, channels, half, none = np.arange(LANES), picture.shape[2], np.float32(0.5), np.float32(0.0)
    for row in range(triangle_of_pixel.shape[0]):
        for column in range(triangle_of_pixel.shape[1]):
            triangle = triangle_of_pixel[row, column]
            if triangle < 0 or coats[triangle, 3] == none:
                continue
            lit = absolute(
                gather_lanes(codes, every, (first_row + row) * triangle_of_pixel.shape[1] + column)
                - np.float32(LIT)
            )
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
                if lobe_rays > 0 and shines(coat):
                    ray_densities = load_row(densities, 0)
                    shared_reach = reach * ray_densities / (ray_densities + reach * d * (lobe_rays / (nv + b)))
                    if near:
                        least = ray_densities * _across(places, axes, place)
                        peak = MIRROR_SHARE * lobe_rays * lobe_density(nv, 1.0, alpha)
                        shared_reach = if_less(least, lanes(np.float32(peak)), shared_reach, reach)
                    reach = shared_reach
            reach = if_less(lit, half, reach * nl, none)
            for channel in range(channels):
                light = reach * load_row(strengths, channel)
                shining = coat[KS + channel] * total(light * lobe)
                picture[row, column, channel] += coat[KD + channel] * total(light) + shining


@kernel(error_model="numpy")
def _add_beam(  # type: ignore[no-untyped-def]
    triangle_of_pixel, places_mm, codes, coats, camera_mm, near, place, axis, exponent, strength, picture
):
    """Add a beam's light for eight neighbouring pixels in the lanes: arrays [n, 8], [n, 8 coordinates], [n, 8
    channels]."""
    triangle, unity, none, half = np.zeros(LANES, np.int64), np.float32(1.0), np.float32(0.0), np.float32(0.5)
    for eight in range(len(triangle_of_pixel)):
        lit = if_less(absolute(load_row(codes, eight) - np.float32(LIT)), half, unity, none)
        if total(lit) == none:
            continue
        for k in range(LANES):
            triangle[k] = max(triangle_of_pixel[eight, k], 0)
        n0, n1, n2, alpha = four_gathered(coats, triangle, 0)
        lit = if_less(none, alpha, lit, none)
        x, y, z = in_turns(places_mm, eight)
        l0, l1, l2, reach = _reach_from(near, place, axis, exponent, x, y, z)
        v0, v1, v2 = camera_mm[0] - x, camera_mm[1] - y, camera_mm[2] - z
        inverse = unity / root(v0 * v0 + v1 * v1 + v2 * v2)
        v0, v1, v2 = v0 * inverse, v1 * inverse, v2 * inverse
        nl, nv = larger(n0 * l0 + n1 * l1 + n2 * l2, none), n0 * v0 + n1 * v1 + n2 * v2
        lobe = _lobe(n0, n1, n2, l0 + v0, l1 + v1, l2 + v2, nl, nv, alpha)
        reach = if_less(half, lit, reach * nl, none)
        d0, d1, d2, _ = four_gathered(coats, triangle, KD)
        s0, s1, s2, _ = four_gathered(coats, triangle, KS)
        first = if_less(half, lit, reach * strength[0] * (d0 + s0 * lobe), none)
        if picture.shape[1] == LANES:
            store(load_row(picture, eight) + first, picture, eight)
        else:
            second = if_less(half, lit, reach * strength[1] * (d1 + s1 * lobe), none)
            third = if_less(half, lit, reach * strength[2] * (d2 + s2 * lobe), none)
            add_in_turns(first, second, third, picture, eight)


@kernel(error_model="numpy")
def _reach_from(near, place, axis, exponent, x, y, z):  # type: ignore[no-untyped-def]
    """Do the same as `_reach`, for one beam and eight places at once."""
    if not near:
        return lanes(place[0]), lanes(place[1]), lanes(place[2]), lanes(np.float32(1.0))
    dx, dy, dz = place[0] - x, place[1] - y, place[2] - z
    inverse = np.float32(1.0) / root(dx * dx + dy * dy + dz * dz)
    dx, dy, dz, reach = dx * inverse, dy * inverse, dz * inverse, np.float32(1e6) * inverse * inverse
    for _ in range(exponent):
        reach = reach * larger(np.float32(-1.0) * (dx * axis[0] + dy * axis[1] + dz * axis[2]), np.float32(0.0))
    return dx, dy, dz, reach


@kernel(error_model="numpy")
def _lobe(n0, n1, n2, h0, h1, h2, nl, nv, alpha):  # type: ignore[no-untyped-def]
    """Return D V of eight pixels, by the sines of `_facets`; 0 where the normal points away from the camera."""
    unity, none = np.float32(1.0), np.float32(0.0)
    x, y, z = n1 * h2 - n2 * h1, n2 * h0 - n0 * h2, n0 * h1 - n1 * h0
    sin2 = (x * x + y * y + z * z) / (h0 * h0 + h1 * h1 + h2 * h2)
    alpha2 = alpha * alpha
    rest = unity - alpha2
    t = alpha2 + rest * sin2
    a, b = root(alpha2 + rest * nl * nl), root(alpha2 + rest * nv * nv)
    lobe = np.float32(0.5 / math.pi) * alpha2 / (t * t * (nl * b + nv * a))
    return if_less(none, nv, lobe, none)


@kernel
def _across(places, axes, place):  # type: ignore[no-untyped-def]
    """Return the squared distances, m^2, of a pixel's place from the planes of eight emitters."""
    above = (load_row(places, 0) - place[0]) * load_row(axes, 0) + (load_row(places, 1) - place[1]) * load_row(
        axes, 1
    )
    above = above + (load_row(places, 2) - place[2]) * load_row(axes, 2)
    return np.float32(1e-6) * above * above


@kernel(error_model="numpy")
def _facets(n0, n1, n2, h0, h1, h2, nv, alpha):  # type: ignore[no-untyped-def]
    """Return GGX's distribution divided by 2 for eight half vectors of any length, and the view's part of the
    masking. Both are computed from sines, because the cosine of a small angle is inexact in single precision."""
    x, y, z = n1 * h2 - n2 * h1, n2 * h0 - n0 * h2, n0 * h1 - n1 * h0
    sin2 = (x * x + y * y + z * z) / (h0 * h0 + h1 * h1 + h2 * h2)
    alpha2 = alpha * alpha
    t = alpha2 + (np.float32(1.0) - alpha2) * sin2
    return (0.5 / math.pi * alpha2) / (t * t), math.sqrt(alpha2 + (1.0 - alpha2) * nv * nv)


@kernel(error_model="numpy")
def _add_values(triangle_of_pixel, places_mm, codes, values, near, place, axis, exponent, strength, picture):  # type: ignore[no-untyped-def]
    way = np.empty(3)
    for row in range(triangle_of_pixel.shape[0]):
        for column in range(triangle_of_pixel.shape[1]):
            if codes[row, column] != LIT:
                continue
            x, y, z = places_mm[row, column, 0], places_mm[row, column, 1], places_mm[row, column, 2]
            reach = _towards(near, place, axis, exponent, x, y, z, way)
            for channel in range(picture.shape[2]):
                picture[row, column, channel] += (
                    strength[channel] * reach * values[triangle_of_pixel[row, column], channel]
                )


@kernel
def shines(coat):  # type: ignore[no-untyped-def]
    """Tell whether a material has a lobe."""
    any_coat = False
    for number in range(KS, len(coat)):
        any_coat |= coat[number] > 0.0
    return any_coat
