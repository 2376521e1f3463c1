"""Blur of the image by the lens, before the sensor samples it: lateral colour, defocus and diffraction.

Only the channel that a pixel's Bayer filter passes is computed. The image is processed in tiles, each with those
layers of blur that its own depths need.
"""

from __future__ import annotations

import numba
import numpy as np
from numpy.typing import NDArray

from coupole.kernels import kernel
from sim.optics.objective import CHANNEL_UM, Objective, defocus_px, diffraction_px

Image = NDArray[np.float32]

_STEP = 1.25
"""Ratio of the standard deviations of neighbouring layers."""
_SHARP_PX = 0.2
"""Blur below this has no visible effect on a pixel."""
_ROWS, _COLUMNS = 64, 256
"""Size of a tile; even numbers, because of the Bayer pattern."""


def through(
    objective: Objective, image: Image, disk_px: Image, channels: NDArray[np.int64], *, pixel_pitch_um: float
) -> Image:
    """Return [h, w] for an `image` [h, w, 3] (mean electrons in all channels) with lateral colour, defocus and
    diffraction, after the Bayer filter. `channels` [2, 2] are those of `SensorModel.channels`.

    `disk_px` [h, w] is the standard deviation of the blur by defocus (`defocus_blur_px`). Each pixel is blurred by
    the curve of its own depth. This is right on surfaces, but wrong at the edge of an unsharp object in front of a
    sharp one.
    """
    out = np.empty(image.shape[:2], np.float32)
    for channel in np.unique(channels):
        channel_image = _magnify(image[..., channel], 1.0 + objective.lateral_colour[channel])
        spread_px = float(diffraction_px(objective, CHANNEL_UM[channel], pixel_pitch_um))
        _blur(channel_image, disk_px, spread_px, channels == channel, out)
    return out


def defocus_blur_px(objective: Objective, depth_mm: Image, pixel_pitch_um: float) -> Image:
    """Return the standard deviation per axis, pixels, of the blur by defocus at depths along the optical axis. It
    is a quarter of the disk's diameter. At an infinite depth, where nothing is seen, it is the blur of 1 km."""
    return np.asarray(0.25 * defocus_px(objective, np.minimum(depth_mm, 1e6), pixel_pitch_um), np.float32)


def _blur(image: Image, sigma_px: Image, more_px: float, cell_mask: NDArray[np.bool_], out: Image) -> None:
    """Fill the pixels of `out` at the places `cell_mask` [2, 2] of the Bayer cell. The blur's variance is the sum
    of the variances of `sigma_px` [h, w] and `more_px`."""
    low, high = (float(np.hypot(edge, more_px)) for edge in (sigma_px.min(), sigma_px.max()))
    layers = _layers(max(low, _SHARP_PX), high) if high > _SHARP_PX else []
    if low <= _SHARP_PX:
        layers = [0.0, *layers]  # the image as it is
    curves = [_curve(sigma) for sigma in layers]
    reach = max(len(curve) for curve in curves) - 1
    table = np.zeros((len(curves), reach + 1), np.float32)
    for row, curve in zip(table, curves, strict=True):
        row[: len(curve)] = curve
    lengths = np.array([len(curve) - 1 for curve in curves])
    variances = np.square(np.array(layers, np.float32))
    _blur_tiles(image, sigma_px, np.float32(more_px**2), variances, table, lengths, cell_mask, out)


def _curve(sigma_px: float) -> NDArray[np.float32]:
    """One side, from the middle on, of Lindeberg's discrete normal distribution, exp(-t) I_n(t) with t = sigma^2.

    IEEE PAMI 12, 234 (1990). Its variance is t exactly; samples of a continuous curve narrower than a pixel
    lose up to half of it.
    """
    from scipy.special import ive

    if sigma_px == 0.0:
        return np.ones(1, np.float32)
    half = ive(np.arange(int(np.ceil(4.5 * sigma_px + 2.0)) + 1), sigma_px**2)
    return np.asarray(half / (2.0 * half.sum() - half[0]), np.float32)


def _layers(low: float, high: float) -> list[float]:
    """Standard deviations from `low` to `high` in equal ratios of at most `_STEP`."""
    count = int(np.ceil(np.log(high / low) / np.log(_STEP))) if high > low else 0
    return [float(v) for v in np.geomspace(low, high, count + 1)]


def _magnify(image: Image, scale: float) -> Image:
    """The image magnified by `scale` about its middle."""
    if scale == 1.0:
        return image
    from scipy.ndimage import affine_transform

    middle = 0.5 * (np.array(image.shape) - 1.0)
    magnified_image: Image = affine_transform(
        image, np.full(2, 1.0 / scale), middle * (1.0 - 1.0 / scale), order=3, mode="nearest"
    )
    return magnified_image


@kernel(parallel=True)
def _blur_tiles(image, sigma, more, variances, curves, lengths, cell_mask, out):  # type: ignore[no-untyped-def]
    height, width = image.shape
    across = -(-width // _COLUMNS)
    for tile in numba.prange(across * -(-height // _ROWS)):
        top, first_column = tile // across * _ROWS, tile % across * _COLUMNS
        bottom, right = min(height, top + _ROWS), min(width, first_column + _COLUMNS)
        first, last = _layers_between(sigma[top:bottom, first_column:right], more, variances)
        reach = lengths[last]
        source = np.empty((bottom - top + 2 * reach, right - first_column + 2 * reach), np.float32)
        dark = _copy(image, top - reach, first_column - reach, source) == 0.0
        columns, sums = np.empty(source.shape[1], np.float32), np.empty(source.shape[1], np.float32)
        halves = np.empty((2, source.shape[1] // 2 + 1), np.float32)
        for row in range(top, bottom):
            if dark:
                for col in range(first_column, right):
                    if cell_mask[row & 1, col & 1]:
                        out[row, col] = 0.0
            elif cell_mask[row & 1, 0] or cell_mask[row & 1, 1]:
                for layer in range(first, last + 1):
                    _down(source, row - top + reach, curves[layer], lengths[layer], columns, halves)
                    for parity in range(2):
                        if cell_mask[row & 1, parity]:  # tiles begin at even columns
                            _along(halves, reach + parity, curves[layer], lengths[layer], sums)
                            before = np.float32(-1.0) if layer == first else variances[layer - 1]
                            pixels, spread_variance = (
                                out[row, first_column + parity : right : 2],
                                sigma[row, first_column + parity : right : 2],
                            )
                            _mix(pixels, sums, spread_variance, more, before, variances[layer])


@kernel
def _layers_between(sigma, more, variances):  # type: ignore[no-untyped-def]
    """Return first and last of the layers that the variances `sigma`^2 + `more` need."""
    low, high = np.float32(np.inf), np.float32(0.0)
    for row in range(sigma.shape[0]):
        for col in range(sigma.shape[1]):
            low, high = min(low, sigma[row, col]), max(high, sigma[row, col])
    first, last = 0, len(variances) - 1
    while first < last and variances[first + 1] <= low * low + more:
        first += 1
    while last > first and variances[last - 1] >= high * high + more:
        last -= 1
    return first, last


@kernel
def _mix(pixels, layer, sigma, more, before, variance):  # type: ignore[no-untyped-def]
    """Bring pixels towards a layer of `variance`, as far as their own variance needs. These pixels now have at
    most the variance `before` (below 0: no blur yet).
    """
    for k in range(len(pixels)):
        share = np.float32(1.0)
        if before >= 0.0:
            share = (sigma[k] * sigma[k] + more - before) / (variance - before)
        if share >= np.float32(1.0):
            pixels[k] = layer[k]
        elif share > np.float32(0.0):
            pixels[k] += share * (layer[k] - pixels[k])


@kernel
def _copy(image, top, left_px, source):  # type: ignore[no-untyped-def]
    """Fill `source` from the image, which is continued by reflection; return its greatest value."""
    height, width = image.shape
    brightest = np.float32(0.0)
    for y in range(source.shape[0]):
        row = _mirrored_index(top + y, height)
        for x in range(source.shape[1]):
            value = image[row, _mirrored_index(left_px + x, width)]
            source[y, x] = value
            brightest = max(brightest, value)
    return brightest


@kernel
def _mirrored_index(place, count):  # type: ignore[no-untyped-def]
    """Return the index of a place on an axis of `count` pixels that is continued by reflection; the edge pixels
    are repeated."""
    if 0 <= place < count:
        return place
    place %= 2 * count
    return place if place < count else 2 * count - 1 - place


@kernel
def _down(source, row, curve, length, sums, halves):  # type: ignore[no-untyped-def]
    """Compute weighted sums of the rows around one row. `halves` get the even and the odd columns, so that
    `_along` reads its values in sequence."""
    for x in range(len(sums)):
        sums[x] = curve[0] * source[row, x]
    for step in range(1, length + 1):
        weight = curve[step]
        above, below = source[row - step], source[row + step]
        for x in range(len(sums)):
            sums[x] += weight * (above[x] + below[x])
    for k in range(len(sums) >> 1):
        halves[0, k], halves[1, k] = sums[2 * k], sums[2 * k + 1]
    if len(sums) & 1:
        halves[0, len(sums) >> 1] = sums[-1]


@kernel
def _along(halves, first, curve, length, out):  # type: ignore[no-untyped-def]
    """Weighted sums around every second column from `first` on."""
    middle = halves[first & 1, first >> 1 :]
    count = halves.shape[1] - ((first + length + 1) >> 1)
    for k in range(count):
        out[k] = curve[0] * middle[k]
    for step in range(1, length + 1):
        weight = curve[step]
        before = halves[(first - step) & 1, (first - step) >> 1 :]
        after = halves[(first + step) & 1, (first + step) >> 1 :]
        for k in range(count):
            out[k] += weight * (before[k] + after[k])
