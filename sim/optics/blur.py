"""Blur of the image by the lens, before the sensor samples it: an optional stage, off in most runs.

It takes seconds at full size, where a frame without it takes hundredths.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from sim.optics.objective import Objective, blur_px

Image = NDArray[np.float32]

_STEP = 1.25
"""Ratio of the standard deviations of neighbouring layers."""
_SHARP_PX = 0.2
"""Blur below this has no visible effect on a pixel."""


def through(objective: Objective, image: Image, depth_mm: Image, *, pixel_pitch_um: float) -> Image:
    """`image` [h, w, 3] (mean electrons in all channels) with lateral colour, defocus and diffraction.

    `depth_mm` [h, w] is along the optical axis, infinite where nothing is seen. Each pixel is blurred by the
    curve of its own depth: right on surfaces, wrong at the edge of an unsharp object in front of a sharp one.
    """
    out = np.empty_like(image)
    for channel in range(3):
        magnified = _magnified(image[..., channel], 1.0 + objective.lateral_colour[channel])
        sigma_px = blur_px(objective, np.minimum(depth_mm, 1e6), channel, pixel_pitch_um)
        out[..., channel] = blurred(magnified, sigma_px.astype(np.float32))
    return out


def blurred(image: Image, sigma_px: Image) -> Image:
    """`image` [h, w] blurred at each pixel by a normal distribution of its own standard deviation [h, w].

    Layers blurred by a few standard deviations are mixed so that the variance is right. The image is continued
    beyond its border by reflection.
    """
    low, high = float(sigma_px.min()), float(sigma_px.max())
    if high <= _SHARP_PX:
        return image
    layers = _layers(max(low, _SHARP_PX), high)
    sharper = _evenly(image, layers[0]) if low > _SHARP_PX else image
    sharper_variance = layers[0] ** 2 if low > _SHARP_PX else 0.0
    out = sharper.copy()
    variance = sigma_px**2
    for sigma in layers if low <= _SHARP_PX else layers[1:]:
        softer = _evenly(image, sigma)
        share = (variance - sharper_variance) / (sigma**2 - sharper_variance)
        out = np.where(share > 0.0, sharper + np.minimum(share, 1.0) * (softer - sharper), out)
        sharper, sharper_variance = softer, sigma**2
    blurred_image: Image = out.astype(np.float32)
    return blurred_image


def _evenly(image: Image, sigma_px: float) -> Image:
    """The image blurred by Lindeberg's discrete normal distribution, exp(-t) I_n(t) with t = sigma^2.

    IEEE PAMI 12, 234 (1990). Its variance is t exactly; samples of a continuous curve narrower than a pixel
    lose up to half of it.
    """
    from scipy.ndimage import correlate1d
    from scipy.special import ive

    reach = int(np.ceil(5.0 * sigma_px + 3.0))
    curve = ive(np.abs(np.arange(-reach, reach + 1)), sigma_px**2)
    curve /= curve.sum()
    for axis in (0, 1):
        image = correlate1d(image, curve, axis=axis, mode="reflect")
    return image


def _layers(low: float, high: float) -> list[float]:
    """Standard deviations from `low` to `high` in equal ratios of at most `_STEP`."""
    count = int(np.ceil(np.log(high / low) / np.log(_STEP))) if high > low else 0
    return [float(v) for v in np.geomspace(low, high, count + 1)]


def _magnified(image: Image, scale: float) -> Image:
    """The image magnified by `scale` about its middle."""
    if scale == 1.0:
        return image
    from scipy.ndimage import affine_transform

    middle = 0.5 * (np.array(image.shape) - 1.0)
    enlarged: Image = affine_transform(
        image, np.full(2, 1.0 / scale), middle * (1.0 - 1.0 / scale), order=3, mode="nearest"
    )
    return enlarged
