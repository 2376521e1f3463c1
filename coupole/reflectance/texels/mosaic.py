"""Colours between the pixels of a Bayer pattern, from the one channel that each pixel measures.

Detail of surfaces is mostly lightness, which is alike in all channels and is present in each pixel. Colours change
less from pixel to pixel. So the deviation of a missing channel is the deviation of the pixel's own channel from
its triangle, plus the mean difference of the channels around the pixel. The pixel's own channel stays as it was
fitted.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import gaussian_filter

Singles = NDArray[np.float32]

_SPREAD_PX = 2.5
"""Standard deviation of the weights of neighbours, px. Stripes of five pixels nearly disappear in a mean, so that
they do not look like colours."""
_LEAST_SHARE = 1e-2
"""Least share that a channel must have in the certainty around a pixel."""
_MOST_CHANGE = 1.0
"""Largest accepted difference of channels' logarithms; failed fits differ more."""


def all_channels(deviation: Singles, certainty: Singles, channel: NDArray[np.int8], channels: int) -> Singles:
    """[h, w, channels] deviations of all channels, from deviations [h, w] of pixels in their own `channel` [h,
    w], weighted by their `certainty` [h, w]. The deviations are 0 where the certainty is 0, because nothing is
    fitted there.
    """
    is_fitted = certainty > 0.0
    if channels == 1:
        return np.where(is_fitted, deviation, np.float32(0.0))[..., None]
    around = _spread(certainty)
    means = []
    for number in range(channels):
        here = np.where(channel == number, certainty, np.float32(0.0))
        weight = _spread(here)
        total = _spread(np.where(here > 0.0, here * deviation, np.float32(0.0)))
        is_enough = weight > _LEAST_SHARE * around
        means.append(np.where(is_enough, total / np.where(is_enough, weight, np.float32(1.0)), np.nan))
    colour = np.stack(means, axis=-1)
    has_all = is_fitted & np.isfinite(colour).all(axis=-1)
    own_colour = np.take_along_axis(colour, channel[..., None].astype(np.int64), axis=-1)
    change = np.clip(
        np.where(has_all[..., None], colour - own_colour, np.float32(0.0)), -_MOST_CHANGE, _MOST_CHANGE
    )
    result: Singles = np.where(is_fitted[..., None], deviation[..., None] + change, np.float32(0.0)).astype(
        np.float32
    )
    return result


def _spread(picture: Singles) -> Singles:
    """[h, w] weighted sums around each pixel; mirrored at the edges."""
    return np.asarray(gaussian_filter(picture, _SPREAD_PX, mode="mirror"), np.float32)
