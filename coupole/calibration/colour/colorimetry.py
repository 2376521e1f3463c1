"""Colorimetry for the profile: XYZ of reflectances under D50 for the 1931 observer, L*a*b*, CIEDE2000.

The observer and D50 are the CIE's tables, from colour-science; all formulas are here.
"""

from __future__ import annotations

import warnings
from functools import cache

import numpy as np
from numpy.typing import ArrayLike

from coupole.calibration.rotations import Floats
from coupole.errors import InputError

D50_WHITE = np.array([0.9642, 1.0, 0.8249])
"""White of the profile connection space (ICC.1:2022, 7.2.16)."""
_D65_WHITE = np.array([0.95047, 1.0, 1.08883])
_BRADFORD = np.array([[0.8951, 0.2664, -0.1614], [-0.7502, 1.7135, 0.0367], [0.0389, -0.0685, 1.0296]])
_FIRST_NM, _LAST_NM = 380.0, 780.0
_MOST_MISSING_NM = 50.0


def xyz_of_spectra(wavelengths_nm: Floats, reflectances: Floats) -> Floats:
    """Return XYZ [n, 3] of reflectances [n, bands]. Y is 1 for the perfect white under D50, which is `D50_WHITE`
    exactly.

    Spectra are interpolated by cubic splines to 1 nm and continued by their last value (CIE 15:2018, 7.2).
    Raises InputError if they do not span 430 to 730 nm, or without colour-science.
    """
    from scipy.interpolate import CubicSpline

    first, last = float(wavelengths_nm[0]), float(wavelengths_nm[-1])
    if first > _FIRST_NM + _MOST_MISSING_NM or last < _LAST_NM - _MOST_MISSING_NM:
        raise InputError(
            f"colour: expected spectra from {_FIRST_NM + _MOST_MISSING_NM:g} nm or below to "
            f"{_LAST_NM - _MOST_MISSING_NM:g} nm or above, found {first:g} to {last:g} nm; export all bands"
        )
    nm, weights = _weights()
    fine = CubicSpline(wavelengths_nm, reflectances, axis=1)(np.clip(nm, first, last))
    return np.asarray(fine @ weights.T)


@cache
def _weights() -> tuple[Floats, Floats]:
    """Return wavelengths [m] in nm, and D50 times the observer's functions [3, m]. The sums of these are
    `D50_WHITE`."""
    try:
        with warnings.catch_warnings():
            warnings.filterwarnings("ignore", message='"Matplotlib" related')
            import colour
    except ImportError as error:
        raise InputError(
            f"colour of spectra needs colour-science: pip install coupole[materials] ({error})"
        ) from error
    nm = np.arange(_FIRST_NM, _LAST_NM + 0.5)
    functions = colour.MSDS_CMFS["CIE 1931 2 Degree Standard Observer"]
    light = colour.SDS_ILLUMINANTS["D50"]
    at = np.searchsorted(functions.wavelengths, nm)
    power = np.interp(nm, light.wavelengths, light.values)
    products = np.asarray(functions.values)[at].T * power
    return nm, np.asarray(products * (D50_WHITE / products.sum(axis=1))[:, None])


def lab_of(xyz: ArrayLike) -> Floats:
    """Return CIE 1976 L*, a*, b* [..., 3] of XYZ under D50. Below 0 the formula continues as a straight line (CIE
    15:2018, 8.2.1)."""
    ratio = np.asarray(xyz, dtype=np.float64) / D50_WHITE
    f = np.where(ratio > (6.0 / 29.0) ** 3, np.cbrt(ratio), ratio * (29.0 / 6.0) ** 2 / 3.0 + 4.0 / 29.0)
    return np.stack(
        [116.0 * f[..., 1] - 16.0, 500.0 * (f[..., 0] - f[..., 1]), 200.0 * (f[..., 1] - f[..., 2])], axis=-1
    )


def xyz_of(lab: ArrayLike) -> Floats:
    """Return the inverse of `lab_of`."""
    lightness, a, b = np.moveaxis(np.asarray(lab, dtype=np.float64), -1, 0)
    y = (lightness + 16.0) / 116.0
    f = np.stack([y + a / 500.0, y, y - b / 200.0], axis=-1)
    return np.asarray(np.where(f > 6.0 / 29.0, f**3, 3.0 * (6.0 / 29.0) ** 2 * (f - 4.0 / 29.0)) * D50_WHITE)


def d65_from_d50() -> Floats:
    """Return [3, 3], which maps XYZ under D50 to XYZ under D65, by Bradford's adaptation as in ICC.1:2022, annex
    E."""
    scale = (_BRADFORD @ _D65_WHITE) / (_BRADFORD @ D50_WHITE)
    return np.asarray(np.linalg.solve(_BRADFORD, scale[:, None] * _BRADFORD))


def de00(lab: Floats, reference: Floats) -> Floats:
    """Return CIEDE2000 [...] (CIE 142-2001), with all weights 1."""
    return np.asarray(np.linalg.norm(de00_parts(lab, reference), axis=-1))


def de00_parts(lab: Floats, reference: Floats) -> Floats:
    """Return three differences [..., 3] whose length is CIEDE2000. They are smooth where two colours agree;
    CIEDE2000 itself, a root, is not smooth there.

    They are the formula's dL'/S_L, dC'/S_C, dH'/S_H with its rotation term. The quadratic form of the last two has
    the matrix [[1, R/2], [R/2, 1]]. It is written as a sum of squares: (c + R h / 2, h sqrt(1 - R^2 / 4)).
    """
    l_1, a_1, b_1 = np.moveaxis(np.asarray(reference), -1, 0)
    l_2, a_2, b_2 = np.moveaxis(np.asarray(lab), -1, 0)
    mean_c = 0.5 * (np.hypot(a_1, b_1) + np.hypot(a_2, b_2))
    stretch = 1.0 + 0.5 * (1.0 - np.sqrt(mean_c**7 / (mean_c**7 + 25.0**7)))
    c_1, c_2 = np.hypot(stretch * a_1, b_1), np.hypot(stretch * a_2, b_2)
    h_1 = np.degrees(np.arctan2(b_1, stretch * a_1)) % 360.0
    h_2 = np.degrees(np.arctan2(b_2, stretch * a_2)) % 360.0
    turn = (h_2 - h_1 + 180.0) % 360.0 - 180.0
    turn = np.where(c_1 * c_2 == 0.0, 0.0, turn)
    hue = 2.0 * np.sqrt(c_1 * c_2) * np.sin(np.radians(0.5 * turn))
    mean_h = np.where(np.abs(h_1 - h_2) > 180.0, 0.5 * (h_1 + h_2 + 360.0), 0.5 * (h_1 + h_2))
    mean_h = np.where(c_1 * c_2 == 0.0, h_1 + h_2, mean_h)
    mean_l, mean_c = 0.5 * (l_1 + l_2), 0.5 * (c_1 + c_2)
    t = (
        1.0
        - 0.17 * np.cos(np.radians(mean_h - 30.0))
        + 0.24 * np.cos(np.radians(2.0 * mean_h))
        + 0.32 * np.cos(np.radians(3.0 * mean_h + 6.0))
        - 0.20 * np.cos(np.radians(4.0 * mean_h - 63.0))
    )
    s_l = 1.0 + 0.015 * (mean_l - 50.0) ** 2 / np.sqrt(20.0 + (mean_l - 50.0) ** 2)
    s_c, s_h = 1.0 + 0.045 * mean_c, 1.0 + 0.015 * mean_c * t
    bend = 30.0 * np.exp(-(((mean_h % 360.0 - 275.0) / 25.0) ** 2))
    rotation = -2.0 * np.sqrt(mean_c**7 / (mean_c**7 + 25.0**7)) * np.sin(np.radians(2.0 * bend))
    light, chroma, hue = (l_2 - l_1) / s_l, (c_2 - c_1) / s_c, hue / s_h
    return np.stack([light, chroma + 0.5 * rotation * hue, hue * np.sqrt(1.0 - 0.25 * rotation**2)], axis=-1)
