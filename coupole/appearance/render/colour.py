"""Converts spectra to a picture on a screen: observer, chromatic adaptation, sRGB."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from coupole.appearance.render import bands
from coupole.appearance.render.bands import StepNm
from coupole.appearance.render.spectra import LM_PER_W
from coupole.appearance.spectra import light
from coupole.appearance.spectra.grid import Array

_CONES = {
    # Li et al., "Comprehensive color solutions: CAM16, CAT16, and CAM16-UCS", Color Res. Appl. 42, 703 (2017).
    "CAT16": [[0.401288, 0.650173, -0.051461], [-0.250268, 1.204414, 0.045854], [-0.002079, 0.048952, 0.953127]],
    # ICC.1:2022, annex E.
    "Bradford": [[0.8951, 0.2664, -0.1614], [-0.7502, 1.7135, 0.0367], [0.0389, -0.0685, 1.0296]],
}
_D65 = np.array([0.95047, 1.0, 1.08883])
"""White of sRGB (IEC 61966-2-1), 2 degrees."""


@dataclass(frozen=True)
class Eye:
    """An observer who is adapted to a light."""

    weights: Array
    """[4, bands] weights of radiance in W/(m^2 sr nm) for X, Y, Z and luminance."""
    white: Array
    """XYZ [3] of that light, Y = 1."""

    def tristimulus(self, radiance: NDArray[np.floating]) -> Array:
        """Return XYZ [..., 3] in cd/m^2 of radiance [..., bands].

        They are scaled so that Y of the light itself is its luminance. Without this, Y of the 10-degree observer
        is not a luminance (under D65 it is 10 % higher).
        """
        return np.asarray(np.asarray(radiance, dtype=float) @ self.weights[:3].T)

    def luminance(self, radiance: NDArray[np.floating]) -> Array:
        """Return luminance [...] in cd/m^2, by V(lambda) of the 2-degree observer (CIE 1924)."""
        return np.asarray(np.asarray(radiance, dtype=float) @ self.weights[3])


def eye(observer: light.Observer, power: Array, white_power: Array, step_nm: StepNm) -> Eye:
    """Return the eye of an observer in the light `power` [81] who is adapted to `white_power` [81]."""
    luminosity = light.observer("2 deg")[1]
    functions = light.observer(observer)
    white = functions @ white_power
    scale = (luminosity @ white_power) / white[1]
    curves = LM_PER_W * np.concatenate([scale * functions, luminosity[None]])
    return Eye(bands.weights(curves, power, step_nm), white / white[1])


def adapted_xyz(xyz: Array, white: Array, transform: str) -> Array:
    """Return corresponding XYZ [..., 3] under D65 for XYZ under `white` [3] (von Kries adaptation)."""
    if transform == "none":
        return xyz
    cones = np.array(_CONES[transform])
    gains = (cones @ _D65) / (cones @ (white / white[1]))
    return np.asarray(xyz @ (np.linalg.inv(cones) @ np.diag(gains) @ cones).T)


def displayed_srgb(xyz: Array) -> tuple[NDArray[np.uint8], float]:
    """Return sRGB [h, w, 3] of XYZ with white at Y = 1, and the share of pixels outside the gamut.

    Pixels that are too bright are scaled down with constant hue. Pixels that are too saturated are clipped at 0.
    """
    linear = light.linear_srgb(xyz)
    brightest = linear.max(axis=-1, keepdims=True)
    outside = (brightest[..., 0] > 1.0 + 1e-6) | (linear.min(axis=-1) < -0.01)
    in_gamut = np.clip(linear / np.maximum(1.0, brightest), 0.0, 1.0)
    srgb = np.where(in_gamut <= 0.0031308, 12.92 * in_gamut, 1.055 * in_gamut ** (1.0 / 2.4) - 0.055)
    return np.round(255.0 * srgb).astype(np.uint8), float(outside.mean())
