"""Colours of points for the merged surface, averaged in linear light, where averaging is correct."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from coupole.scan.registration.viewpoint import Floats

NO_COLOUR = (0, 0, 0)
"""Colour of vertices without a coloured point nearby, as in PTX."""
_NEIGHBOURS = 8


def linear_light(srgba: NDArray[np.uint8]) -> Floats:
    """[n, 4] red, green and blue of 0 to 1 in linear light, multiplied by the weight; and the weight, which is 0
    for a point without a colour (IEC 61966-2-1)."""
    srgb = srgba[:, :3] / 255.0
    linear = np.where(srgb <= 0.04045, srgb / 12.92, ((srgb + 0.055) / 1.055) ** 2.4)
    weight = (srgba[:, 3:] > 0).astype(np.float64)
    return np.hstack([linear * weight, weight])


def encode_srgb(weighted_sums: Floats) -> NDArray[np.uint8]:
    """[n, 3] sRGB, 8 bits, from sums of weighted linear light [n, 4]."""
    weight = weighted_sums[:, 3:]
    linear = np.clip(weighted_sums[:, :3] / np.where(weight > 0, weight, 1.0), 0.0, 1.0)
    srgb = np.where(linear <= 0.0031308, 12.92 * linear, 1.055 * linear ** (1 / 2.4) - 0.055)
    return np.where(weight > 0, np.round(255 * srgb), NO_COLOUR).astype(np.uint8)


def around(points: Floats, linear: Floats, places: Floats, reach: float, width: float) -> Floats:
    """[m, 4] sums of the linear light [n, 4] of the nearest points [n, 3] at places [m, 3], weighted by a Gaussian
    of `width`."""
    away, nearest = cKDTree(points).query(places, min(_NEIGHBOURS, len(points)), distance_upper_bound=reach)
    away, nearest = away.reshape(len(places), -1), nearest.reshape(len(places), -1)
    there = np.isfinite(away)
    kernel = np.where(there, np.exp(-((away / width) ** 2)), 0.0)
    return np.asarray(np.einsum("mk,mkc->mc", kernel, linear[np.where(there, nearest, 0)]))
