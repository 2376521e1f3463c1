"""Features by which reflectance spectra are compared, and appearances of the same paint in other measurements.

Bands are every 10 nm, ultraviolet to near infrared; bands that were not measured are NaN.
"""

from __future__ import annotations

import numpy as np

from coupole.appearance.matter import kubelka_munk
from coupole.appearance.matter.glossy_face import Face, InternalReflectance
from coupole.appearance.spectra.grid import Array
from coupole.appearance.spectra.measured import Measured
from coupole.appearance.spectra.resampling import resample

STEP_NM = 10.0
BANDS_NM: Array = np.arange(300.0, 2500.0 + STEP_NM / 2, STEP_NM)
BANDS_NM.setflags(write=False)
NEAR_INFRARED_NM = 780.0
_DARKEST, _LIGHTEST = 0.008, 0.99
"""Limits of reflectance; beyond them K/S depends mostly on the instrument's stray light, or on its white."""
_SLOPE_BANDS = 2
_SLOPE, _REFLECTANCE, _LEVEL = 3.0, 0.5, 0.3
_APPEARANCES = (
    # K/S by a factor, share of light that the surface returns from within, share that it adds
    (1.0, 0.0, 0.0),
    (0.4, 0.0, 0.0),
    (2.5, 0.0, 0.0),
    (6.0, 0.0, 0.0),
    (15.0, 0.0, 0.0),
    (1.6, 0.45, 0.0),
    (1.6, 0.0, 0.02),
)
_SURFACE = 0.04


def on_bands(spectrum: Measured) -> Array:
    """[221] reflectance at `BANDS_NM`."""
    return resample(spectrum, BANDS_NM, STEP_NM)[0]


def log_k_over_s(reflectance: Array) -> Array:
    """Return log(K/S) of an opaque layer, for arrays of any shape; reflectances are limited to 0.008 to 0.99."""
    return np.log(kubelka_munk.k_over_s(np.clip(reflectance, _DARKEST, _LIGHTEST)))


def appearances(reflectance: Array) -> Array:
    """[a, n, bands]: spectra [n, bands] unchanged, then tinted, in oil, under gloss, with light from the surface.

    Binder and white change K/S by a factor; a surface acts by Saunderson's equation (`glossy_face.Face`).
    """
    ratio = kubelka_munk.k_over_s(np.clip(reflectance, _DARKEST, _LIGHTEST))
    looks = []
    for factor, internal, gloss in _APPEARANCES:
        look = kubelka_munk.opaque(ratio * factor)
        if internal:
            face = Face(np.array((1.0 - _SURFACE) * (1.0 - internal)), np.array(internal), np.zeros(()))
            look = face.reflectance_in_air(InternalReflectance(look)).values
        looks.append(gloss + (1.0 - gloss) * look)
    looks[0] = reflectance
    return np.stack(looks)


def features(reflectance: Array) -> Array:
    """[n, f] features of spectra [n, bands], which are measured in all bands. Euclidean distances of features are
    compared.


    The features are:

    - the deviation of log(K/S) from its mean, which a factor on K/S does not change;
    - its slope over 20 nm, times 3;
    - reflectance and its slope, each scaled to unit deviation, times 0.5;
    - the level (means of log(K/S), logarithm and value of the highest reflectance), times 0.3 and the root of the
      number of bands.
    """
    log_ratio = log_k_over_s(reflectance)
    slope = log_ratio[:, _SLOPE_BANDS:] - log_ratio[:, :-_SLOPE_BANDS]
    rise = reflectance[:, _SLOPE_BANDS:] - reflectance[:, :-_SLOPE_BANDS]
    highest = reflectance.max(axis=1, keepdims=True)
    level = np.hstack([log_ratio.mean(axis=1, keepdims=True), np.log(np.maximum(highest, 0.0) + 0.02), highest])
    shape = reflectance - reflectance.mean(axis=1, keepdims=True)
    return np.hstack(
        [
            log_ratio - log_ratio.mean(axis=1, keepdims=True),
            _SLOPE * slope,
            _REFLECTANCE * shape / (reflectance.std(axis=1, keepdims=True) + 0.02),
            _REFLECTANCE * rise / (np.sqrt(np.mean(rise**2, axis=1, keepdims=True)) + 0.004),
            _LEVEL * np.sqrt(reflectance.shape[1]) * level,
        ]
    )
