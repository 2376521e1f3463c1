"""Centres of the materials of a view's texels, which are the materials of its triangles; and the lights of their
fits."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from coupole.reflectance.fits import GGX_NORMAL
from coupole.reflectance.ggx import UNKNOWNS
from coupole.reflectance.material_uncertainty import groups_of_leds
from coupole.reflectance.normal_fit import LEAST_ALPHA
from coupole.reflectance.run_result import (
    VARIANCES,
    RunResult,
    ViewSamples,
)
from coupole.reflectance.texels.inter_reflection_error import covariance_of_inter_reflection
from coupole.reflectance.texels.neighbours import (
    TRIANGLES_AROUND,
    WINDOW_PX,
    lower_half,
    mean_around,
    settle_colours,
    settle_triangles,
)
from coupole.reflectance.texels.pixel_fit import LEAST_KS, LOG_ALPHA, LOG_KS, TILT, Lights, Prior
from coupole.reflectance.texels.pixel_values import PixelBlock
from coupole.reflectance.triangle_fit import LEAST_KD, TriangleMaterials, turned_normals

Floats = NDArray[np.float64]
Singles = NDArray[np.float32]
KD, KS, ALPHA = 2, 3, 4
"""Indices of the logarithms among the unknowns."""
MOST_KD = 1.0
"""Largest kd, 1/sr: three times the kd of white, to allow for strong light from other surfaces. A fit with more
has failed."""
MOST_VARIANCE = np.square([TILT, TILT, 1.0, LOG_KS, LOG_ALPHA]) * 4.0
"""Largest variances of a useful fit; they are larger than the prior's variances."""


@dataclass(frozen=True)
class Centres:
    """Centres of the materials of a view's pixels: the materials of triangles, shrunk towards each other.
    Triangles without material take the materials around them."""

    normals: Singles
    """[h, w, 3]"""
    logs: Singles
    """[h, w, 2 channels + 1] logarithms of kd, ks and alpha; NaN where nothing is known."""
    colours: Singles
    """[h, w, channels] logarithms of kd without their mean, shrunk towards the values around them."""
    covariance: Singles
    """[h, w, 15]"""

    @property
    def channels(self) -> int:
        return int(self.logs.shape[2]) // 2

    def prior(self, block: PixelBlock) -> Prior:
        """Return the centres of a block's pixels in their own channels; NaN without material."""
        at = np.unravel_index(block.pixels, self.logs.shape[:2])
        logs, rows = self.logs[at].astype(np.float64), np.arange(len(block.pixels))
        return Prior(
            self.normals[at].astype(np.float64),
            np.exp(logs[rows, block.channel]),
            np.exp(logs[rows, self.channels + block.channel]),
            np.exp(logs[:, -1]),
        )

    def grey_prior(self, places: NDArray[np.integer]) -> tuple[Prior, Floats]:
        """Return the materials at places [n], row by row, as means of the channels; and ks of each channel [n,
        channels] over this mean. NaN without material."""
        at = np.unravel_index(places, self.logs.shape[:2])
        values, channels = np.exp(self.logs[at].astype(np.float64)), self.channels
        ks = values[:, channels:-1].mean(axis=1)
        prior = Prior(self.normals[at].astype(np.float64), values[:, :channels].mean(axis=1), ks, values[:, -1])
        return prior, values[:, channels:-1] / ks[:, None]

    def of_triangles(self, triangle: NDArray[np.int32], count: int) -> Prior:
        """Return the materials of the `count` triangles of a view, as means of the channels, each where the first
        texel sees it; `triangle` [h, w] is what each texel sees. NaN without texel or material."""
        numbers, first = np.unique(triangle, return_index=True)
        at = np.full(count, -1)
        at[numbers[numbers >= 0]] = first[numbers >= 0]
        prior, _ = self.grey_prior(np.maximum(at, 0))
        for values in (prior.normals, prior.kd, prior.ks, prior.alpha):
            values[at < 0] = np.nan
        return prior


def centres_of(
    materials: TriangleMaterials, of_triangles: Floats, triangle_of_pixel: NDArray[np.int32], mesh_normals: Floats
) -> Centres:
    """Return the centres of pixels from the materials of triangles and their covariances [triangles, 5, 5];
    `mesh_normals` [triangles, 3] are used for triangles without a fit."""
    kd, alpha = np.maximum(materials.kd, LEAST_KD), materials.alpha
    triangle_logs = np.log(np.column_stack([kd, np.maximum(materials.ks, LEAST_KS * kd), alpha]))
    has_fit = np.isfinite(triangle_logs).all(axis=1) & np.isfinite(of_triangles).all(axis=(1, 2))
    has_fit &= (triangle_logs[:, : kd.shape[1]] < math.log(MOST_KD)).all(axis=1)
    has_fit &= (np.einsum("nii->ni", of_triangles)[:, :3] < MOST_VARIANCE[:3]).all(axis=1)
    is_seen = triangle_of_pixel >= 0
    is_known = is_seen & np.append(has_fit, False)[triangle_of_pixel]
    triangle, channels = triangle_of_pixel[is_known], kd.shape[1]
    covariance = np.zeros((*is_seen.shape, UNKNOWNS * (UNKNOWNS + 1) // 2), np.float32)
    covariance[is_known] = lower_half(of_triangles)[triangle]
    logs = np.full((*is_seen.shape, 2 * channels + 1), np.nan, np.float32)
    logs[is_known] = triangle_logs[triangle]
    side_px = _window_px(triangle)
    shine = np.stack([logs[..., channels:-1].mean(axis=-1), logs[..., -1]], axis=-1)
    step = settle_triangles(shine, covariance, is_known, side_px)
    logs += np.repeat(step[..., KD:], [channels, channels, 1], axis=-1)
    logs[..., -1] = np.clip(logs[..., -1], math.log(LEAST_ALPHA), 0.0)
    normals = np.zeros((*is_seen.shape, 3), np.float32)
    normals[is_known] = turned_normals(materials.normals[triangle], step[is_known][:, :2].astype(np.float64))
    is_missing = is_seen & ~is_known
    normals[is_missing] = mesh_normals[triangle_of_pixel[is_missing]]
    logs[is_missing] = mean_around(logs, is_known, side_px, default=np.nan)[is_missing]
    colours = logs[..., :channels] - logs[..., :channels].mean(axis=-1, keepdims=True)
    colours = settle_colours(colours, covariance[..., VARIANCES[KD]], is_known, side_px)
    covariance[is_missing] = lower_half(np.diag(np.square([TILT, TILT, 1.0, LOG_KS, LOG_ALPHA])))
    return Centres(normals, logs, colours, covariance)


def _window_px(triangle_of_pixel: NDArray[np.int32]) -> int:
    """Return the side of a window with enough triangles to determine their spread."""
    counts = np.bincount(triangle_of_pixel)
    side_px = math.sqrt(TRIANGLES_AROUND * float(np.median(counts[counts > 0]))) if len(counts) else 0.0
    return max(WINDOW_PX, 2 * round(side_px / 2) + 1)


def lights_of(result: RunResult, view: ViewSamples, left_out: Sequence[int]) -> Lights:
    group = groups_of_leds(view.led_mm, result.middle_mm)
    columns = np.flatnonzero(~np.isin(view.leds, left_out))
    columns = columns[np.argsort(group[columns], kind="stable")]
    return Lights(columns, view.led_mm[columns], group[columns], view.camera_mm)


@dataclass(frozen=True)
class FitStart:
    """Start of the fits of a view's texels."""

    triangle: NDArray[np.int32]
    """[h, w] for each texel the triangle that it sees, -1 for none."""
    centres: Centres
    lights: Lights
    inter_reflection: Singles
    """[triangles, 15] covariance from the inter-reflection that was subtracted."""


def start_of(
    result: RunResult,
    view: ViewSamples,
    triangle: NDArray[np.int32],
    mesh_normals: Floats,
    left_out: Sequence[int],
) -> FitStart:
    """Return the start of the fits of a view under its LEDs except those `left_out`. `triangle` [h, w] is the row
    of the view's file that each texel sees."""
    places = np.searchsorted(result.triangles, view.triangles)
    materials = result.materials(GGX_NORMAL.name, places)
    of_triangles = result.material_covariances(GGX_NORMAL.name, places)
    centres = centres_of(materials, of_triangles, triangle, mesh_normals)
    lights = lights_of(result, view, left_out)
    start_materials = centres.of_triangles(triangle, len(view.triangles))
    inter_reflection = lower_half(covariance_of_inter_reflection(view, start_materials, lights))
    return FitStart(triangle, centres, lights, inter_reflection)
