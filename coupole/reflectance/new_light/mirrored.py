"""Light of emitters with a size, found by rays that are drawn from the lobes of GGX materials."""

from __future__ import annotations

import math

import numpy as np

from coupole.kernels import kernel
from coupole.motion.occlusion import RAY_START_MM
from coupole.motion.packet_rays import PacketMesh
from coupole.reflectance.ggx import lobe_density, sample_reflection, shine
from coupole.reflectance.new_light.beams import Emitter
from coupole.reflectance.new_light.pictured_surface import Surface, in_strips
from coupole.reflectance.new_light.shading import KD, KS, MIRROR_SHARE, Coats, Picture, shines
from coupole.reflectance.new_light.shadow_edges import DISTANT_MM

_R2 = (0.7548776662466927, 0.5698402909980532)
"""Steps of Roberts' sequence: powers of 1 divided by the plastic number."""


def add_mirrored(
    picture: Picture,
    surface: Surface,
    coats: Coats,
    mesh: PacketMesh,
    emitter: Emitter,
    lobe_rays: int,
) -> None:
    """Draw rays from the materials' lobes, and add the light of an emitter that these rays meet; `mesh` casts the
    shadows."""
    of_emitter = (
        emitter.near, emitter.axes, emitter.centre_mm, emitter.halves_mm, emitter.radiance, emitter.density
    )  # fmt: skip

    def add(rows: slice) -> None:
        triangles, places_mm, part = surface.triangle_of_pixel[rows], surface.places_mm[rows], picture[rows]
        asking = np.zeros(triangles.shape, np.bool_)
        _asking(
            triangles, places_mm, surface.camera_mm, coats, *of_emitter[:3], emitter.density, lobe_rays, asking
        )
        row, column = np.nonzero(asking)
        if not len(row):
            return
        pixels = np.stack([row, column], axis=1)
        starts_mm = places_mm[row, column] + RAY_START_MM * surface.normals[triangles[row, column]].astype(
            np.float32
        )
        hits, ways_mm = np.empty(len(pixels), np.int64), np.empty((len(pixels), 3), np.float32)
        gains, sums = np.empty((len(pixels), part.shape[2])), np.zeros((len(pixels), part.shape[2]), np.float32)
        for ray in range(lobe_rays):
            count = _mirror(
                pixels, rows.start, triangles, places_mm, surface.camera_mm, surface.normals, coats, *of_emitter,
                ray, lobe_rays, hits, gains, ways_mm,
            )  # fmt: skip
            free = ~mesh.blocked_along(starts_mm[hits[:count]], ways_mm[:count])
            sums[hits[:count][free]] += gains[:count][free]
        part[row, column] += sums

    in_strips(len(picture), add)


@kernel(error_model="numpy")
def _mirror(  # type: ignore[no-untyped-def]
    pixels, first_row, triangle_of_pixel, places_mm, camera_mm, faces, coats, near, axes, centre_mm,
    halves_mm, radiance, density, ray, lobe_rays, hit_pixels, gains, ways_mm
):  # fmt: skip
    """Draw ray number `ray` from each of the pixels [n, 2], and return how many of these rays point at a bright
    part of an emitter. Fill `hit_pixels` with the pixels of these rays, and `ways_mm` with the vectors to the
    emitter. Fill `gains` with the radiance that each ray adds to its pixel if nothing blocks it."""
    way, channels, count = np.empty(3), gains.shape[1], 0
    for pixel in range(len(pixels)):
        row, column = pixels[pixel]
        triangle = triangle_of_pixel[row, column]
        coat = coats[triangle]
        normal, place = coat[:3], places_mm[row, column]
        v0, v1, v2 = camera_mm[0] - place[0], camera_mm[1] - place[1], camera_mm[2] - place[2]
        length = math.sqrt(v0 * v0 + v1 * v1 + v2 * v2)
        v0, v1, v2 = v0 / length, v1 / length, v2 / length
        nv = normal[0] * v0 + normal[1] * v1 + normal[2] * v2
        first, second = _two_numbers(first_row + row, column, ray)
        nh = sample_reflection(normal, v0, v1, v2, nv, coat[3], first, second, way)
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
        share = nl / (among + lobe_rays * lobe_density(nv, nh, coat[3]))
        for channel in range(channels):
            value = coat[KD + channel] + coat[KS + channel] * lobe
            gains[count, channel] = radiance[x, y, channel] * value * share
        for k in range(3):
            ways_mm[count, k] = far_mm * way[k]
        hit_pixels[count] = pixel
        count += 1
    return count


@kernel(error_model="numpy")
def _asking(triangle_of_pixel, places_mm, camera_mm, coats, near, axes, centre_mm, density, lobe_rays, asking):  # type: ignore[no-untyped-def]
    """Mark the pixels for which rays are drawn. No rays are drawn if the area is at most as large as the lobe:
    the largest solid angle of the area at its distance, times the largest density of the lobe's rays, is then at
    most 1.
    """
    for row in range(triangle_of_pixel.shape[0]):
        for column in range(triangle_of_pixel.shape[1]):
            coat, place = coats[max(triangle_of_pixel[row, column], 0)], places_mm[row, column]
            if triangle_of_pixel[row, column] < 0 or coat[3] == 0.0 or not shines(coat):
                continue
            square, nv, above = 0.0, 0.0, 0.0
            for k in range(3):
                view = camera_mm[k] - place[k]
                square += view * view
                nv += coat[k] * view
                above += (centre_mm[k] - place[k]) * axes[2, k]
            nv /= math.sqrt(square)
            peak = MIRROR_SHARE * lobe_rays * lobe_density(nv, 1.0, coat[3])
            asking[row, column] = nv > 0.0 and not (near and density * above * above * 1e-6 >= peak)


@kernel
def _two_numbers(row, column, ray):  # type: ignore[no-untyped-def]
    """Return two numbers from 0 to 1: element `ray` of a sequence, shifted for each pixel (Wang's hash)."""
    seed = np.uint32(row * 65536 + column)
    seed = (seed ^ np.uint32(61)) ^ (seed >> np.uint32(16))
    seed = np.uint32(seed * np.uint32(9))
    seed = seed ^ (seed >> np.uint32(4))
    seed = np.uint32(seed * np.uint32(0x27D4EB2D))
    seed = seed ^ (seed >> np.uint32(15))
    first = (float(seed & np.uint32(0xFFFF)) + 0.5) / 65536.0
    second = (float((seed >> np.uint32(16)) & np.uint32(0xFFFF)) + 0.5) / 65536.0
    return (first + ray * _R2[0]) % 1.0, (second + ray * _R2[1]) % 1.0


@kernel(error_model="numpy")
def _on_area(place, way, axes, centre_mm, halves_mm, density):  # type: ignore[no-untyped-def]
    """Return the distance to the area along a direction, the beams per sr there, and the area's pixel. The beams
    are 0 if the direction does not meet the area's bright side."""
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


@kernel(error_model="numpy")
def _in_environment(way, axes, radiance, density):  # type: ignore[no-untyped-def]
    """Return the distance up to which objects cast shadows of an environment, its beams per sr in a direction, and
    its pixel there."""
    height, width, channels = radiance.shape
    middle, leftward, up = 0.0, 0.0, 0.0
    for k in range(3):
        middle += way[k] * axes[0, k]
        leftward += way[k] * axes[1, k]
        up += way[k] * axes[2, k]
    row = min(int(math.acos(min(1.0, max(-1.0, up))) / math.pi * height), height - 1)
    column = min(int((0.5 - math.atan2(leftward, middle) / (2.0 * math.pi)) * width), width - 1)
    mean = 0.0
    for channel in range(channels):
        mean += radiance[row, column, channel] / channels
    return DISTANT_MM, density * mean, row, column
