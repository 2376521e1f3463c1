"""Materials of texels of several pixels: one fit for each, to the means of its channels, as for triangles.

Normal, lightness, ks and roughness are fitted to the mean of the channels. The prior is the material of the
triangle that most of a texel's pixels see. Neighbouring texels are taken into account as neighbouring pixels are.
All channels of a texel are measured. They give its colour, together with the channels of neighbouring texels.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import gaussian_filter

from coupole.kernels import kernel
from coupole.reflectance.ggx import lobe
from coupole.reflectance.normal_fit import colour_weight
from coupole.reflectance.parts_in_threads import in_threads
from coupole.reflectance.run_result import VARIANCES
from coupole.reflectance.texels.pixel_file import ViewTexels
from coupole.reflectance.texels.pixel_fit import Lights, PixelMaterials, fit_pixels
from coupole.reflectance.texels.texel_grid import TexelSquares
from coupole.reflectance.texels.texel_values import TexelBlock
from coupole.reflectance.texels.view_centres import ALPHA, KD, KS, FitStart
from coupole.reflectance.texels.view_texels import Fitted, view_texels
from coupole.reflectance.triangle_fit import between, towards

Floats = NDArray[np.float64]
Singles = NDArray[np.float32]

_TOGETHER = 1 << 16
"""Number of texels that are fitted together."""
_PART = 1 << 12
_MOST_WIDER = 4.0
"""Largest factor by which kd's variance is enlarged."""
_ALIKE = 2.0
"""Number of neighbouring texels whose false colours are alike, because paint changes little between them."""
_MOST_MORE = 1.0
"""Largest logarithm by which the paint of a channel's pixels may differ from the texel's."""
_SPREAD_PX, _LEAST_SPREAD = 2.5, 1.0
"""Standard deviation of the weights of surrounding texels in a colour, px, and its least value, in texels."""


def texels_of_grid(
    start: FitStart, squares: TexelSquares, blocks: Iterable[TexelBlock], threads: int
) -> ViewTexels:
    """Fit the texels of a view, block by block."""
    grid, centres, lights = squares.grid, start.centres, start.lights
    channels, fits = centres.channels, Fitted.empty(grid.triangle.shape)
    colours = np.zeros((grid.triangle.size, channels), np.float32)
    u_colours = np.zeros(grid.triangle.size, np.float32)
    for block in blocks:
        for first in range(0, len(block.texels), _TOGETHER):
            some = slice(first, min(first + _TOGETHER, len(block.texels)))
            part = TexelBlock(block.texels[some], block.places_mm[some], block.values[some])
            prior, shine = centres.grey_prior(part.texels)
            values = part.values.astype(np.float32)
            fit = fit_pixels(values.mean(axis=1), part.places_mm, lights, prior, threads)
            fits.add(part.texels, prior, fit)
            of_fits = colours_of(values, part.places_mm, lights, fit, shine, threads)
            colours[part.texels], u_colours[part.texels] = of_fits
    of_grid = colours.reshape(*grid.triangle.shape, channels), u_colours.reshape(grid.triangle.shape)
    fits.is_fitted[...] &= np.isfinite(of_grid[0]).all(axis=-1)
    is_fitted = fits.is_fitted
    lightness = np.log(np.exp(centres.logs[..., :channels]).mean(axis=-1)) + fits.deviation[..., KD]
    level_colours = without_slopes(of_grid[0], lightness, is_fitted, squares.channel_offsets)
    whole_colours, u_whole = colours_around(level_colours, of_grid[1], centres.colours, is_fitted, grid.side_px)
    normals = fits.settle(start)
    fits.covariance[is_fitted, VARIANCES[KD]] *= _wider(whole_colours[is_fitted])
    fits.covariance[is_fitted, VARIANCES[KD]] += u_whole[is_fitted] ** 2
    fits.covariance[is_fitted, :3:2] += squares.bend[is_fitted, None]
    logs = centres.logs[is_fitted].astype(np.float64)
    deviation = fits.deviation[is_fitted]
    grey = np.log(np.exp(logs[:, :channels]).mean(axis=1)) + deviation[:, KD]
    grey += of_all_pixels(of_grid[0][is_fitted], whole_colours[is_fitted], squares.channel_shares)
    logs[:, :channels] = grey[:, None] + whole_colours[is_fitted]
    logs[:, channels:-1] += deviation[:, KS, None]
    logs[:, -1] += deviation[:, ALPHA]
    first_pixels, number_of_pixel = _pixels_of(grid.texel_of_pixel, np.flatnonzero(is_fitted))
    return replace(
        view_texels(first_pixels, normals, logs, fits.covariance[is_fitted]),
        texel_of_pixel=number_of_pixel,
        side_px=grid.side_px,
    )


def _wider(colours: Singles) -> Singles:
    """[n] factors of kd's variance for colours [n, channels]: the factors of the darkest channel, because all
    channels have one uncertainty. If the lobe has another form, the error of kd is as large in a dark channel as
    in a light one."""
    factors: Singles = np.clip(np.exp(-2.0 * colours).max(axis=1), 1.0, _MOST_WIDER)
    return factors


def without_slopes(
    colours: Singles, lightness: Singles, is_fitted: NDArray[np.bool_], channel_offsets: Singles
) -> Singles:
    """Return colours of texels [h, w, channels] without what only looks like a colour: paint gets lighter across a
    texel, and the channels' pixels are at different places (`TexelSquares`). `lightness` [h, w] is
    the logarithm of kd; its slope is found from the texels on both sides."""
    known_lightness = np.where(is_fitted, lightness, np.float32(np.nan))
    framed_lightness = np.pad(known_lightness, 1, constant_values=np.nan)
    slopes = np.stack(
        [
            framed_lightness[1:-1, 2:] - framed_lightness[1:-1, :-2],
            framed_lightness[2:, 1:-1] - framed_lightness[:-2, 1:-1],
        ],
        axis=-1,
    )
    slopes = np.clip(np.nan_to_num(0.5 * slopes), -_MOST_MORE, _MOST_MORE)
    level = colours - np.einsum("hwck,hwk->hwc", channel_offsets, slopes)
    level -= np.log(np.exp(level).mean(axis=-1, keepdims=True))
    return np.asarray(level, np.float32)


def of_all_pixels(colours: Singles, whole_colours: Singles, shares: Floats) -> Floats:
    """[n] logarithms of the mean paint of texels, divided by the paint that the mean of their channels shows.

    A channel shows the paint at its own pixels: its colour without the colour around. The mean of the channels
    gives each channel the same weight, but channels have different shares [channels] of the pixels: in a Bayer
    pattern green has half."""
    more = np.clip(colours.astype(np.float64) - whole_colours, -_MOST_MORE, _MOST_MORE)
    return np.asarray(np.log(np.exp(more) @ shares))


def colours_around(
    colours: Singles, u_colours: Singles, of_triangles: Singles, is_fitted: NDArray[np.bool_], side_px: int
) -> tuple[Singles, Singles]:
    """Return colours of texels [h, w, channels], averaged with the texels around them, and their standard
    uncertainty [h, w]. A colour is the logarithm of kd over the channels' mean.

    A texel's red and blue pixels are at different places, so a change of the paint between them looks like a
    colour. So the difference of a texel's colour from its triangle's is averaged with the differences of the
    texels around, within some pixels. The spread that the mean removes gives its uncertainty. The mean of the
    logarithms over the channels is 0, so kd's mean over the channels stays as it was fitted.
    """
    width = max(_SPREAD_PX / side_px, _LEAST_SPREAD)
    weight = is_fitted.astype(np.float32)
    around = np.maximum(gaussian_filter(weight, width, mode="mirror"), 1e-6)
    triangle_colours = of_triangles - np.log(np.exp(of_triangles).mean(axis=-1, keepdims=True))
    more = np.where(is_fitted[..., None], colours - triangle_colours, np.float32(0.0))
    smooth = np.stack(
        [gaussian_filter(plane, width, mode="mirror") / around for plane in np.moveaxis(more, -1, 0)], axis=-1
    )
    lost_variance = np.where(is_fitted, np.square(more - smooth).mean(axis=-1), np.float32(0.0))
    lost_variance = gaussian_filter(lost_variance, 2.0 * width, mode="mirror") / np.maximum(
        gaussian_filter(weight, 2.0 * width, mode="mirror"), 1e-6
    )
    kept_share = 1.0 / (4.0 * np.pi * width**2)  # of the variance of what is different from texel to texel
    whole = triangle_colours + smooth
    whole -= np.log(np.exp(whole).mean(axis=-1, keepdims=True))
    own_variance = np.square(np.where(is_fitted, u_colours, np.float32(0.0)))
    u_whole = np.sqrt(kept_share * (own_variance + _ALIKE * lost_variance / (1.0 - kept_share)))
    return whole.astype(np.float32), u_whole.astype(np.float32)


def _pixels_of(
    texel_of_pixel: NDArray[np.int32], texels: NDArray[np.int64]
) -> tuple[NDArray[np.int64], NDArray[np.int32]]:
    """Return the first pixel of each of the `texels` [n], row by row in the picture; and the number of each
    pixel's texel [h, w], -1 for none."""
    number = np.full(int(texel_of_pixel.max(initial=0)) + 2, -1, np.int32)
    number[texels] = np.arange(len(texels))
    number_of_pixel = number[texel_of_pixel]  # -1, for no texel, takes the last
    pixels = np.flatnonzero(number_of_pixel.reshape(-1) >= 0)
    _, first = np.unique(number_of_pixel.reshape(-1)[pixels], return_index=True)
    return pixels[first], number_of_pixel


def colours_of(
    values: Singles, places_mm: Singles, lights: Lights, fit: PixelMaterials, shine: Floats, threads: int | None
) -> tuple[Floats, Floats]:
    """[n, channels] logarithms of kd relative to the mean of the channels, for texels with fits, and their
    standard uncertainty [n], mean of channels. `values` are [n, channels, leds of the view]; `shine` [n, channels]
    is ks over the channels' mean. NaN without a fit."""
    count, channels = values.shape[:2]
    kd, u_kd = np.full((count, channels), np.nan), np.full((count, channels), np.nan)
    grey = np.exp(fit.logs)

    def fill(first: int) -> None:
        some = slice(first, min(first + _PART, count))
        of_lights = np.ascontiguousarray(values[some][:, :, lights.columns])
        _colours(
            of_lights, places_mm[some], lights.places_mm, lights.camera_mm, fit.normals[some], grey[some],
            shine[some], kd[some], u_kd[some],
        )  # fmt: skip

    in_threads(fill, count, part=_PART, threads=threads)
    mean = kd.mean(axis=1, keepdims=True)
    with np.errstate(divide="ignore", invalid="ignore"):
        return np.log(kd / mean), np.sqrt(np.mean((u_kd / kd) ** 2, axis=1))


@kernel(error_model="numpy")
def _colours(values, places_mm, led_mm, camera_mm, normals, grey, shine, kd, u_kd):  # type: ignore[no-untyped-def]
    """Fill `kd` with each channel's kd by least squares, and `u_kd` with its uncertainty from the residuals. The
    fit uses the difference of a channel's values from their mean over the channels, because the error of a lobe
    with another form cancels in it."""
    channels, leds = values.shape[1:]
    cosines, lobes, weights = np.empty(leds), np.empty(leds), np.empty(leds)
    for texel in range(len(values)):
        if not grey[texel, 2] > 0.0:
            continue
        sample = values[texel]
        _weigh(sample, places_mm[texel], led_mm, camera_mm, normals[texel], grey[texel], cosines, lobes, weights)
        total = np.sum(weights * cosines * cosines)
        if not total > 0.0:
            continue
        for channel in range(channels):
            more, square, more_shine = 0.0, 0.0, shine[texel, channel] - 1.0
            for led in np.flatnonzero(weights):
                difference = sample[channel, led] - sample[:, led].mean() - lobes[led] * more_shine
                more += weights[led] * cosines[led] * difference / total
            for led in np.flatnonzero(weights):
                difference = sample[channel, led] - sample[:, led].mean() - lobes[led] * more_shine
                square += (weights[led] * cosines[led] * (difference - cosines[led] * more) / total) ** 2
            kd[texel, channel], u_kd[texel, channel] = grey[texel, 0] + more, np.sqrt(square)
        if not kd[texel].min() > 0.0:
            kd[texel] = np.nan


@kernel(error_model="numpy")
def _weigh(sample, place_mm, led_mm, camera_mm, normal, grey, cosines, lobes, weights):  # type: ignore[no-untyped-def]
    """Fill, for each LED, the cosine of incidence, the value of the mean's lobe, and the weight of its values
    [channels, leds]. The weight is 0 if one of them is missing or the LED is behind the surface."""
    light, half, view = np.empty(3), np.empty(3), np.empty(3)
    towards(place_mm, camera_mm, view)
    nv = max(normal[0] * view[0] + normal[1] * view[1] + normal[2] * view[2], 1e-3)
    for led in range(len(led_mm)):
        towards(place_mm, led_mm[led], light)
        between(light, view, half)
        nl = normal[0] * light[0] + normal[1] * light[1] + normal[2] * light[2]
        nh = normal[0] * half[0] + normal[1] * half[1] + normal[2] * half[2]
        weights[led] = cosines[led] = lobes[led] = 0.0
        if nl > 0.0 and np.isfinite(sample[:, led].sum()):
            cosines[led], lobes[led] = nl, nl * grey[1] * lobe(nl, nv, nh, grey[2])[0]
            weights[led] = colour_weight(nl * grey[0] + lobes[led], sample[:, led], grey[0])
