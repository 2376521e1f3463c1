"""Converts spectra to a camera's channel values, normalised by a white tile as in the instrument.

The true value of a frame's channel c is f_c = integral(E S_c f)/integral(E S_c), with the light's spectrum E and
the camera's sensitivity S_c: a weighted mean of the BRDF, not a colorimetric value.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike

from coupole.appearance.spectra.grid import Array
from coupole.errors import InputError


def channel_weights(power: ArrayLike, sensitivities: ArrayLike) -> Array:
    """[channels, 81], each row summing to 1, from a light's spectral power [81] and sensitivities [channels,
    81]."""
    weights = np.asarray(power, dtype=float) * np.asarray(sensitivities, dtype=float)
    total = weights.sum(axis=-1, keepdims=True)
    if not np.all(total > 0.0):
        raise InputError(
            "channels: expected a light that every channel sees, but one channel sees none of it; "
            "check the light and the channels"
        )
    return np.asarray(weights / total)


def channel_values(spectral: Array, weights: Array, tile: ArrayLike = 1.0) -> Array:
    """f_c [..., channels] of spectral values [..., 81]. `tile` is the reflectance [81] of the instrument's white
    reference: the instrument divides by its signal, as if its reflectance were 1."""
    white = np.broadcast_to(np.asarray(tile, dtype=float), weights.shape[-1:]) @ weights.T
    return np.asarray(spectral @ weights.T / white)
