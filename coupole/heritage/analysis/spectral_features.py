"""Features by which reflectance spectra are compared, and appearances of the same paint in other measurements.

Bands are every 10 nm, ultraviolet to near infrared; bands that were not measured are NaN.
"""

from __future__ import annotations

from dataclasses import dataclass

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
_DARKEST, _LIGHTEST = 0.003, 0.99
"""Limits of reflectance; beyond them K/S depends mostly on the instrument's stray light, or on its white."""
_SLOPE_BANDS = 2
_SLOPE, _REFLECTANCE, _LEVEL = 3.0, 0.5, 0.3
_OF_WHITE_GROUND = 0.85
_MEDIUM_NM = 550.0


@dataclass(frozen=True)
class _Appearance:
    """The same pigment in another paint."""

    ratio: float = 1.0
    """Factor on K/S at 550 nm: white lowers K/S, and oil raises it, because grains scatter less in oil."""
    exponent: float = 0.0
    """K/S changes also as (wavelength/550 nm)^exponent: fine grains scatter short waves more."""
    from_within: float = 0.0
    """Share of the light from within that the surface returns."""
    gloss: float = 0.0
    """Reflectance that the surface adds."""
    scattering: float = np.inf
    """Scattering power S h of the layer, which is over a white ground; opaque without limit."""


_APPEARANCES = (
    _Appearance(),
    _Appearance(0.4),
    _Appearance(2.5, exponent=0.7),
    _Appearance(6.0, exponent=-0.7),
    _Appearance(15.0),
    _Appearance(1.6, from_within=0.45),
    _Appearance(1.6, gloss=0.02),
    _Appearance(scattering=0.5),
    _Appearance(6.0, scattering=0.5),
)
_SURFACE = 0.04


def on_bands(spectrum: Measured) -> Array:
    """[221] reflectance at `BANDS_NM`."""
    return resample(spectrum, BANDS_NM, STEP_NM)[0]


def log_k_over_s(reflectance: Array) -> Array:
    """Return log(K/S) of an opaque layer, for arrays of any shape; reflectances are limited to 0.003 to 0.99."""
    return np.log(kubelka_munk.k_over_s(np.clip(reflectance, _DARKEST, _LIGHTEST)))


def appearances(reflectance: Array, wavelengths_nm: Array) -> Array:
    """[a, n, bands]: spectra [n, bands] unchanged, then tinted, in oil, under gloss, and as thin layers on white.

    Binder and white change K/S by a factor and its trend with the wavelength; a thin layer shows its ground
    (`kubelka_munk`); a surface acts by Saunderson's equation (`glossy_face.Face`).
    """
    ratio = kubelka_munk.k_over_s(np.clip(reflectance, _DARKEST, _LIGHTEST))
    looks = [reflectance]
    for appearance in _APPEARANCES[1:]:
        absorption = ratio * appearance.ratio * (wavelengths_nm / _MEDIUM_NM) ** appearance.exponent
        if np.isinf(appearance.scattering):
            look = kubelka_munk.opaque(absorption)
        else:
            rho, tau = kubelka_munk.layer(absorption, 1.0, appearance.scattering)
            look = kubelka_munk.over(rho, tau, _OF_WHITE_GROUND)
        if appearance.from_within:
            face = Face(
                np.array((1.0 - _SURFACE) * (1.0 - appearance.from_within)),
                np.array(appearance.from_within),
                np.zeros(()),
            )
            look = face.reflectance_in_air(InternalReflectance(look)).values
        looks.append(appearance.gloss + (1.0 - appearance.gloss) * look)
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
