"""Materials of all pixels of a view: those of its triangles first, then fits of single pixels about them, what
neighbours say, and colours between the pixels of the pattern."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import h5py
import numpy as np
from numpy.typing import NDArray

from coupole.reflectance.fits import GGX_NORMAL
from coupole.reflectance.ggx import UNKNOWNS
from coupole.reflectance.material_uncertainty import groups_of_leds
from coupole.reflectance.normal_fit import LEAST_ALPHA
from coupole.reflectance.run_result import INTER_REFLECTION, RunResult, ViewSamples, u_inter_reflection
from coupole.reflectance.texels.mosaic import all_channels
from coupole.reflectance.texels.neighbours import (
    TRIANGLES_AROUND,
    VARIANCES,
    WINDOW_PX,
    lower_half,
    settle,
    settle_triangles,
    tilts_from,
)
from coupole.reflectance.texels.pixel_file import ViewTexels
from coupole.reflectance.texels.pixel_fit import LEAST_KS, Lights, Prior, fit_pixels
from coupole.reflectance.texels.pixel_values import PixelBlock, PixelReader
from coupole.reflectance.triangle_fit import LEAST_KD, MOST_KS, turned_normals

Floats = NDArray[np.float64]
Singles = NDArray[np.float32]
Say = Callable[[int, int], None]
_KD, _KS, _ALPHA = 2, 3, 4
_ROWS = 1 << 14
"""Triangles whose inter-reflection is read together."""


def texels_of_view(
    result: RunResult,
    view: ViewSamples,
    reader: PixelReader,
    left_out: Sequence[int],
    memory_bytes: int,
    threads: int,
    say: Say,
) -> ViewTexels:
    """Fit all pixels of a view, under its LEDs but those `left_out`; frames are read once for each part of the
    pixels whose values fit into the memory. Raises StorageError for a damaged frame."""
    centres, lights = _centres_of(result, view, reader.triangle_of_pixel), _lights(result, view, left_out)
    shape = reader.triangle_of_pixel.shape
    channel = np.zeros(shape, np.int8)
    normals = np.full((*shape, 3), np.nan, np.float32)
    deviation, covariance = np.full((*shape, UNKNOWNS), np.nan, np.float32), np.empty_like(centres.covariance)
    is_fitted, count = np.zeros(shape, np.bool_), 0
    for rows in reader.blocks(memory_bytes):
        block = reader.read_block(rows, threads)
        prior = centres.prior(block)
        fit = fit_pixels(block.values, block.places_mm, lights, prior, threads)
        off = np.empty((len(block.pixels), UNKNOWNS))
        tilts_from(fit.normals, prior.normals, off[:, :2])
        off[:, 2:] = fit.logs - np.log(np.stack([prior.kd, prior.ks, prior.alpha], axis=1))
        at = np.unravel_index(block.pixels, shape)
        channel[at], normals[at], deviation[at] = block.channel, fit.normals, off
        covariance[at] = lower_half(fit.covariance)
        is_fitted[at] = np.isfinite(off).all(axis=1) & np.isfinite(covariance[at]).all(axis=1)
        count += len(block.pixels)
        say(count, reader.count)
    before = deviation[is_fitted][:, :2]
    settle(deviation, covariance, is_fitted, centres.covariance)
    of_triangle = reader.triangle_of_pixel[is_fitted]
    covariance[is_fitted, VARIANCES[_KD]] += _u_inter_reflection(view)[of_triangle] ** 2
    texel_normals = turned_normals(normals[is_fitted].astype(np.float64), deviation[is_fitted][:, :2] - before)
    kd, ks, alpha = centres.logs_of(is_fitted)
    kd += all_channels(deviation[..., _KD], channel, is_fitted, result.channels)[is_fitted]
    ks += all_channels(deviation[..., _KS], channel, is_fitted, result.channels)[is_fitted]
    return ViewTexels(
        np.flatnonzero(is_fitted).astype(np.int32),
        texel_normals.astype(np.float32),
        np.exp(kd).astype(np.float32),
        np.minimum(np.exp(ks), MOST_KS).astype(np.float32),
        np.clip(np.exp(alpha + deviation[is_fitted][:, _ALPHA]), LEAST_ALPHA, 1.0).astype(np.float32),
        covariance[is_fitted],
    )


@dataclass(frozen=True)
class _Centres:
    """Materials about which those of a view's pixels lie: those of triangles, drawn to each other."""

    triangle_of_pixel: NDArray[np.int32]
    """[h, w] -1 for none."""
    normals: Floats
    """[triangles, 3]"""
    kd: Floats
    """[triangles, channels] logarithms."""
    ks: Floats
    alpha: Floats
    """[triangles]"""
    step: Singles
    """[h, w, 5] from the triangles' own materials: tilts, logarithms."""
    covariance: Singles
    """[h, w, 15] of what lies at the end of the step."""

    def prior(self, block: PixelBlock) -> Prior:
        """Materials of a block's pixels in their own channels; NaN without any."""
        at, triangle = np.unravel_index(block.pixels, self.triangle_of_pixel.shape), block.triangle
        step = self.step[at].astype(np.float64)
        return Prior(
            turned_normals(self.normals[triangle], step[:, :2]),
            np.exp(self.kd[triangle, block.channel] + step[:, _KD]),
            np.exp(self.ks[triangle, block.channel] + step[:, _KS]),
            np.clip(np.exp(self.alpha[triangle] + step[:, _ALPHA]), LEAST_ALPHA, 1.0),
        )

    def logs_of(self, pixels: NDArray[np.bool_]) -> tuple[Floats, Floats, Floats]:
        """Logarithms of kd and ks [n, channels], and of alpha [n], of some pixels [h, w]."""
        triangle, step = self.triangle_of_pixel[pixels], self.step[pixels].astype(np.float64)
        return (
            self.kd[triangle] + step[:, _KD, None],
            self.ks[triangle] + step[:, _KS, None],
            np.clip(self.alpha[triangle] + step[:, _ALPHA], math.log(LEAST_ALPHA), 0.0),
        )


def _centres_of(result: RunResult, view: ViewSamples, triangle_of_pixel: NDArray[np.int32]) -> _Centres:
    places = np.searchsorted(result.triangles, view.triangles)
    materials, of_triangles = (
        result.materials(GGX_NORMAL.name, places),
        result.material_covariances(GGX_NORMAL.name, places),
    )
    kd = np.maximum(materials.kd, LEAST_KD)
    kd, ks, alpha = np.log(kd), np.log(np.maximum(materials.ks, LEAST_KS * kd)), np.log(materials.alpha)
    is_known = np.isfinite(alpha) & np.isfinite(of_triangles).all(axis=(1, 2))
    is_seen = (triangle_of_pixel >= 0) & np.append(is_known, False)[triangle_of_pixel]
    covariance = np.zeros((*is_seen.shape, UNKNOWNS * (UNKNOWNS + 1) // 2), np.float32)
    logs, triangle = np.zeros((*is_seen.shape, 2), np.float32), triangle_of_pixel[is_seen]
    covariance[is_seen] = lower_half(of_triangles)[triangle]
    logs[is_seen] = np.stack([ks.mean(axis=1), alpha], axis=1)[triangle]
    step = settle_triangles(logs, covariance, is_seen, _window_px(triangle))
    return _Centres(triangle_of_pixel, materials.normals, kd, ks, alpha, step, covariance)


def _window_px(triangle_of_pixel: NDArray[np.int32]) -> int:
    """Side of a window that holds enough triangles to say how they spread."""
    counts = np.bincount(triangle_of_pixel)
    side_px = math.sqrt(TRIANGLES_AROUND * float(np.median(counts[counts > 0]))) if len(counts) else 0.0
    return max(WINDOW_PX, 2 * round(side_px / 2) + 1)


def _u_inter_reflection(view: ViewSamples) -> Floats:
    """[triangles] relative standard uncertainty of kd, of the inter-reflection that was taken off its samples,
    which is off alike under all LEDs."""
    with h5py.File(view.path, "r") as file:
        if INTER_REFLECTION not in file:
            return np.zeros(len(view.triangles))
        data = file[INTER_REFLECTION]
        parts = [u_inter_reflection(data[first : first + _ROWS]) for first in range(0, len(data), _ROWS)]
    sums = [np.where(np.isfinite(part), part, 0.0).sum(axis=(1, 2)) for part in parts]
    count = [np.isfinite(part).sum(axis=(1, 2)) for part in parts]
    mean: Floats = np.concatenate(sums) / np.maximum(np.concatenate(count), 1)
    return mean


def _lights(result: RunResult, view: ViewSamples, left_out: Sequence[int]) -> Lights:
    group = groups_of_leds(view.led_mm, result.middle_mm)
    columns = np.flatnonzero(~np.isin(view.leds, left_out))
    columns = columns[np.argsort(group[columns], kind="stable")]
    return Lights(columns, view.led_mm[columns], group[columns], view.camera_mm)
