"""Paint and bumps of the relief of `relief_cells.DETAIL`, as pixels and texels of its views see them: the rig's
waves, told by the simulator's own layers."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from relief_cells import DETAIL

from coupole.reflectance.new_light.pictured_surface import surface_of_view
from coupole.reflectance.run_result import RunResult, ViewSamples
from coupole.reflectance.texels.pixel_file import ViewTexels
from sim.scene.surface import Layer

FOCUS_MM = 335.0
FOCAL_PX = 35.0 * FOCUS_MM / (FOCUS_MM - 35.0) / 0.044
"""Of a lens of 35 mm, focused there, with pixels of 44 um."""
BLUR_PX = 35.0 / 8.0 * 35.0 / (FOCUS_MM - 35.0) / 0.044
"""Diameter of the circle of confusion at f/8, for a departure of all of the distance."""


def truth_at(result: RunResult, places_mm: np.ndarray, normals: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Factor of the paint [n], and normals [n, 3] of the bumps, at places of the base frame: the rig's waves."""
    waves = np.concatenate([Layer(**layer).waves() for layer in DETAIL])
    vectors, phase, paint, height = waves[:, :3], *waves[:, 3:].T
    base_from_support = result.base_from_support
    local = (places_mm - base_from_support[:3, 3]) @ base_from_support[:3, :3]
    angle = local @ vectors.T + phase
    slope = -(np.sin(angle) * height) @ vectors @ base_from_support[:3, :3].T
    bumpy = normals - slope + np.einsum("nk,nk->n", slope, normals)[:, None] * normals
    return 1 + np.cos(angle) @ paint, bumpy / np.linalg.norm(bumpy, axis=1, keepdims=True)


@dataclass(frozen=True)
class Seen:
    """What pixels of a view see: places and normals [n, 3] of the mesh, triangles, paint and normals that are
    there, means over a pixel and the circle of confusion; and pixels whose neighbours see the same triangle."""

    places_mm: np.ndarray
    normals: np.ndarray
    triangle: np.ndarray
    paint: np.ndarray
    bumpy: np.ndarray
    inner: np.ndarray


def seen_by(result: RunResult, view: ViewSamples, pixels: np.ndarray) -> Seen:
    """Of pixels of a view, by their places in the picture."""
    surface = surface_of_view(result, view)
    row, column = np.divmod(pixels, surface.triangle_of_pixel.shape[1])
    place, triangle = (image[row, column] for image in (surface.places_mm, surface.triangle_of_pixel))
    normals = surface.normals[triangle]
    inner = np.ones(len(row), bool)
    for down, right in ((0, 1), (1, 0), (0, -1), (-1, 0)):
        inner &= surface.triangle_of_pixel[row + down, column + right] == triangle
    away = place - view.camera_mm
    distance = np.linalg.norm(away, axis=1)
    pixel_mm = distance / FOCAL_PX
    steps = []
    for axis in range(2):  # along the surface, one pixel to the right and one down
        beside = surface.places_mm[row + axis, column + 1 - axis] - place
        across = beside - np.einsum("nk,nk->n", beside, normals)[:, None] * normals
        steps.append(
            np.nan_to_num(across * (pixel_mm / np.maximum(np.linalg.norm(across, axis=1), 1e-9))[:, None])
        )
    blur_px = np.abs(distance - FOCUS_MM) / distance * BLUR_PX
    random, paint, bumpy = np.random.default_rng(1), np.zeros(len(row)), np.zeros((len(row), 3))
    for _ in range(32):
        angle, radius = (
            random.uniform(0, 2 * np.pi, len(row)),
            np.sqrt(random.uniform(size=len(row))) * blur_px / 2,
        )
        x, y = random.uniform(-0.5, 0.5, (2, len(row))) + radius * np.stack([np.cos(angle), np.sin(angle)])
        some = truth_at(result, place + x[:, None] * steps[0] + y[:, None] * steps[1], normals)
        paint, bumpy = paint + some[0] / 32, bumpy + some[1] / 32
    bumpy /= np.linalg.norm(bumpy, axis=1, keepdims=True)
    return Seen(place.astype(float), normals, triangle, paint, bumpy, inner)


@dataclass(frozen=True)
class SeenByTexels:
    """Means over the pixels of each texel: paint [n], and normals [n, 3] that are there."""

    paint: np.ndarray
    bumpy: np.ndarray


def seen_by_texels(result: RunResult, view: ViewSamples, texels: ViewTexels) -> SeenByTexels:
    with_texel = surface_of_view(result, view).triangle_of_pixel.shape
    number = texels.in_picture(with_texel).reshape(-1)
    pixels = np.flatnonzero(number >= 0)
    seen = seen_by(result, view, pixels)
    counts = np.bincount(number[pixels])
    paint = np.bincount(number[pixels], seen.paint) / counts
    bumpy = np.stack([np.bincount(number[pixels], column) for column in seen.bumpy.T], axis=1)
    return SeenByTexels(paint, bumpy / np.linalg.norm(bumpy, axis=1, keepdims=True))
