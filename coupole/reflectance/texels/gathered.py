"""Materials of places on the object, gathered from the pixels of all views that show them.

A place is looked up in each view by its direction. Materials are interpolated between the four pixels around it
(normals as vectors, the other values as logarithms). Views are weighted by the certainty of their materials.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from coupole.kernels import kernel
from coupole.reflectance.new_light.pictured_surface import Surface, pixels_of_places, surface_of_view
from coupole.reflectance.parts_in_threads import in_threads
from coupole.reflectance.run_result import VARIANCES, RunResult, ViewSamples
from coupole.reflectance.texels.pixel_file import (
    ViewTexels,
    texel_uncertainty,
    views_with_texels,
)
from coupole.reflectance.triangle_fit import TriangleMaterials

Floats = NDArray[np.float64]

_REACH = 3.0
"""Largest distance of a place from the place that a neighbouring pixel sees, relative to the median distance of
neighbouring pixels. Beyond it, the pixel sees something in front of the place."""
_BLOCK, _PART = 1 << 20, 1 << 15
"""Number of places that are looked up together, and number in one part for a thread."""


@dataclass(frozen=True)
class Gathered:
    """Materials of n places; roughness is 0 where no view shows a place."""

    materials: TriangleMaterials
    covariance: NDArray[np.float32]
    """[n, 15] lower halves, as in files; views are taken as independent."""


@dataclass(frozen=True)
class TexelView:
    """A view with texels, open for look-ups."""

    texels: ViewTexels
    surface: Surface
    texel_of_pixel: NDArray[np.int32]
    """[h, w] number of a pixel's texel, -1 for none."""
    step_mm: float
    """Median distance between the places that neighbouring pixels see."""
    texel_mm: float
    """Width of its texels on the surface."""
    u_common: float
    """Relative standard uncertainty of kd and ks that is not in the covariances: of responses, and of the LEDs'
    power."""


def open_views(result: RunResult, read_view: Callable[[RunResult, ViewSamples], ViewTexels]) -> list[TexelView]:
    """Open the views that have texels; `read_view` reads those of a view. Raises InputError if
    no view has texels."""
    return [_open_view(result, view, read_view(result, view)) for view in views_with_texels(result)]


def gather(views: Sequence[TexelView], places_mm: NDArray[np.floating]) -> Gathered:
    """Gather the materials of places [n, 3] of the base frame."""
    count, channels = len(places_mm), views[0].texels.kd.shape[1]
    normals, logs = np.zeros((count, 3)), np.zeros((count, 2 * channels + 1))
    information = np.zeros((count, len(VARIANCES)))
    for view in views:
        for first in range(0, count, _BLOCK):
            part = slice(first, min(first + _BLOCK, count))
            _add_view(view, places_mm[part], normals[part], logs[part], information[part])
    is_known = information[:, 0] > 0.0
    weights = np.where(is_known[:, None], information, 1.0)
    normals /= np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-300)
    logs /= _by_columns(weights[:, 2:], channels)
    values = np.where(is_known[:, None], np.exp(logs), 0.0)
    covariance = np.zeros((count, 15), np.float32)
    covariance[:, VARIANCES] = np.where(is_known[:, None], 1.0 / weights, 0.0)
    materials = TriangleMaterials(
        normals, values[:, :channels], values[:, channels:-1], values[:, -1], np.zeros(count)
    )
    return Gathered(materials, covariance)


def _open_view(result: RunResult, view: ViewSamples, texels: ViewTexels) -> TexelView:
    surface = surface_of_view(result, view)
    texel_of_pixel = texels.in_picture(surface.triangle_of_pixel.shape)
    steps = np.linalg.norm(surface.places_mm[:, 1:] - surface.places_mm[:, :-1], axis=2)
    u_common = math.hypot(*texel_uncertainty(result, view))
    step_mm = float(np.nanmedian(steps))
    return TexelView(texels, surface, texel_of_pixel, step_mm, step_mm * texels.side_px, u_common)


def _by_columns(of_unknowns: Floats, channels: int) -> Floats:
    """[n, 2 channels + 1] columns for each channel, from values of kd, ks and alpha [n, 3]."""
    return np.repeat(of_unknowns, [channels, channels, 1], axis=1)


def _add_view(
    view: TexelView, places_mm: NDArray[np.floating], normals: Floats, logs: Floats, information: Floats
) -> None:
    """Add the materials of places [n, 3] in a view, times its weights, to sums."""
    pixels = pixels_of_places(view.surface, places_mm)
    if pixels is None:
        return
    texels = view.texels

    def look(first: int) -> None:
        part = slice(first, first + _PART)
        _look_up(
            pixels[part], places_mm[part], view.texel_of_pixel, view.surface.places_mm, _REACH * view.step_mm,
            texels.normals, texels.kd, texels.ks, texels.alpha, texels.covariance, normals[part], logs[part],
            information[part],
        )  # fmt: skip

    in_threads(look, len(places_mm), part=_PART)


@kernel(error_model="numpy")
def _look_up(  # type: ignore[no-untyped-def]
    pixels, places_mm, texel_of_pixel, seen_mm, reach_mm, texel_normals, kd, ks, alpha, covariance, normals, logs,
    information
):  # fmt: skip
    channels = kd.shape[1]
    means, variances = np.empty(4 + 2 * channels), np.empty(5)
    texels, weights = np.empty(4, np.int64), np.empty(4)
    for n in range(len(places_mm)):
        if not _corners(pixels[n], places_mm[n], texel_of_pixel, seen_mm, reach_mm, texels, weights):
            continue
        means[:], variances[:] = 0.0, 0.0
        for corner in range(4):
            texel, weight = texels[corner], weights[corner]
            if weight == 0.0:
                continue
            for k in range(3):
                means[k] += weight * texel_normals[texel, k]
            for channel in range(channels):
                means[3 + channel] += weight * math.log(kd[texel, channel])
                means[3 + channels + channel] += weight * math.log(ks[texel, channel])
            means[3 + 2 * channels] += weight * math.log(alpha[texel])
            for unknown in range(5):
                variances[unknown] += weight * covariance[texel, unknown * (unknown + 3) // 2]
        for unknown in range(5):
            variances[unknown] = 1.0 / max(variances[unknown], 1e-8)
            information[n, unknown] += variances[unknown]
        for k in range(3):
            normals[n, k] += 0.5 * (variances[0] + variances[1]) * means[k]
        for number in range(2 * channels + 1):
            logs[n, number] += variances[2 + min(number // channels, 2)] * means[3 + number]


@kernel(error_model="numpy")
def _corners(pixel, place_mm, texel_of_pixel, seen_mm, reach_mm, texels, weights):  # type: ignore[no-untyped-def]
    """Fill the texels [4] around a pixel's place and their weights, which sum to 1. Return whether enough of
    these texels see the place.
    """
    height, width = texel_of_pixel.shape
    x, y, total = pixel[0], pixel[1], 0.0
    if not (x > -1.0 and y > -1.0 and x < width and y < height):
        return False
    first_column, first_row = math.floor(x), math.floor(y)
    for corner in range(4):
        column, row = first_column + corner % 2, first_row + corner // 2
        weights[corner] = 0.0
        if not (0 <= column < width and 0 <= row < height) or texel_of_pixel[row, column] < 0:
            continue
        square = 0.0
        for k in range(3):
            square += (seen_mm[row, column, k] - place_mm[k]) ** 2
        if square < reach_mm * reach_mm:
            texels[corner] = texel_of_pixel[row, column]
            weights[corner] = (1.0 - abs(x - column)) * (1.0 - abs(y - row))
            total += weights[corner]
    for corner in range(4):
        weights[corner] /= max(total, 1e-9)
    return total >= 0.5
