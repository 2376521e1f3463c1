"""Materials of all pixels of a view, in four steps: materials of its triangles, fits of single pixels around them,
shrinkage by neighbours, and colours between the pixels of the pattern."""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from coupole.reflectance.ggx import UNKNOWNS
from coupole.reflectance.normal_fit import LEAST_ALPHA
from coupole.reflectance.run_result import VARIANCES
from coupole.reflectance.texels.mosaic import all_channels
from coupole.reflectance.texels.neighbours import bend_around, lower_half, settle, tilts_from
from coupole.reflectance.texels.pixel_file import ViewTexels
from coupole.reflectance.texels.pixel_fit import PixelMaterials, Prior, fit_pixels
from coupole.reflectance.texels.pixel_values import PixelBlock
from coupole.reflectance.texels.view_centres import ALPHA, KD, KS, MOST_KD, MOST_VARIANCE, FitStart
from coupole.reflectance.triangle_fit import MOST_KS, turned_normals

Floats = NDArray[np.float64]
Singles = NDArray[np.float32]
MOST_OFF = 5.0
"""Largest deviation of logarithms from a triangle; fits that are farther away have failed."""
_ALIKE = 1e-3
"""Variance of logarithms below which pixels have equal weight for colours."""


@dataclass(frozen=True)
class Fitted:
    """Fits of a view's texels [h, w], collected block by block."""

    normals: Singles
    """[h, w, 3]"""
    deviation: Singles
    """[h, w, 5] deviations from the centres: two tilts of the normal, and the logarithms of kd, ks and alpha."""
    covariance: Singles
    """[h, w, 15]"""
    is_fitted: NDArray[np.bool_]

    @classmethod
    def empty(cls, shape: tuple[int, ...]) -> Fitted:
        normals = np.full((*shape, 3), np.nan, np.float32)
        deviation = np.full((*shape, UNKNOWNS), np.nan, np.float32)
        return cls(normals, deviation, np.empty((*shape, 15), np.float32), np.zeros(shape, np.bool_))

    def add(self, places: NDArray[np.integer], prior: Prior, fit: PixelMaterials) -> None:
        """Take the fits at places [n], row by row, which began at `prior`; failed fits are not used."""
        off = np.empty((len(places), UNKNOWNS))
        tilts_from(fit.normals, prior.normals, off[:, :2])
        off[:, 2:] = fit.logs - np.log(np.stack([prior.kd, prior.ks, prior.alpha], axis=1))
        at = np.unravel_index(places, self.is_fitted.shape)
        self.normals[at], self.deviation[at] = fit.normals, off
        self.covariance[at] = lower_half(fit.covariance)
        self.is_fitted[at] = (
            (np.abs(off) < MOST_OFF).all(axis=1)
            & (fit.logs[:, 0] < math.log(MOST_KD))
            & (self.covariance[at][:, VARIANCES] < MOST_VARIANCE).all(axis=1)
        )

    def settle(self, start: FitStart) -> Singles:
        """Take the neighbours into account, and add the uncertainty from inter-reflection. Return the normals
        [fitted, 3] of the fitted texels."""
        is_fitted = self.is_fitted
        before = self.deviation[is_fitted][:, :2]
        bend = bend_around(start.centres.normals, is_fitted)
        settle(self.deviation, self.covariance, is_fitted, start.centres.covariance, bend)
        self.covariance[is_fitted] += start.inter_reflection[start.triangle[is_fitted]]
        normals = turned_normals(
            self.normals[is_fitted].astype(np.float64), self.deviation[is_fitted][:, :2] - before
        )
        return np.asarray(normals, np.float32)


def texels_of_view(start: FitStart, blocks: Iterable[PixelBlock], threads: int) -> ViewTexels:
    """Fit the pixels of a view, block by block."""
    centres, shape = start.centres, start.triangle.shape
    channel, fits = np.zeros(shape, np.int8), Fitted.empty(shape)
    for block in blocks:
        prior = centres.prior(block)
        fits.add(block.pixels, prior, fit_pixels(block.values, block.places_mm, start.lights, prior, threads))
        channel[np.unravel_index(block.pixels, shape)] = block.channel
    is_fitted, channels = fits.is_fitted, centres.channels
    texel_normals = fits.settle(start)
    logs = centres.logs[is_fitted].astype(np.float64)
    logs[:, :channels] = _with_colours(logs[:, :channels], centres.colours[is_fitted], channel[is_fitted])
    for first, unknown in ((0, KD), (channels, KS)):
        variance = fits.covariance[..., VARIANCES[unknown]]
        certainty = np.where(is_fitted, 1.0 / (variance + _ALIKE), 0.0).astype(np.float32)
        plane = all_channels(fits.deviation[..., unknown], certainty, channel, channels)
        logs[:, first : first + channels] += plane[is_fitted]
    logs[:, -1] += fits.deviation[is_fitted][:, ALPHA]
    return view_texels(np.flatnonzero(is_fitted), texel_normals, logs, fits.covariance[is_fitted])


def view_texels(places: NDArray[np.integer], normals: Singles, logs: Floats, covariance: Singles) -> ViewTexels:
    """Return texels at places [n] of a picture, from the logarithms [n, 2 channels + 1] of kd, ks and alpha, which
    are limited to possible values."""
    channels = logs.shape[1] // 2
    return ViewTexels(
        places.astype(np.int32),
        normals,
        np.minimum(np.exp(logs[:, :channels]), MOST_KD).astype(np.float32),
        np.minimum(np.exp(logs[:, channels:-1]), MOST_KS).astype(np.float32),
        np.clip(np.exp(logs[:, -1]), LEAST_ALPHA, 1.0).astype(np.float32),
        covariance,
    )


def _with_colours(logs: Floats, colours: Singles, channel: NDArray[np.int8]) -> Floats:
    """Return logarithms of kd [n, channels]. The values of the pixels' own `channel` [n] stay; the other channels
    differ from these values as in `colours`.
    """
    column = channel[:, None].astype(np.int64)
    own_logs, own_colour = np.take_along_axis(logs, column, 1), np.take_along_axis(colours, column, 1)
    return np.asarray(own_logs + colours - own_colour)
