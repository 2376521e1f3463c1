"""Measured spectra on the grid of 380 to 780 nm by 5 nm.

Samples at 5 nm or coarser are interpolated with PCHIP (Fritsch and Butland 1984), which does not overshoot: values
between 0 and 1 remain so. Finer samples are averaged with a triangle of 5 nm width at half height, the bandpass of
a 5 nm instrument, which reduces noise. Bands that were not measured are NaN.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from coupole.appearance.spectra.grid import STEP_NM, WAVELENGTHS_NM, Array
from coupole.appearance.spectra.measured import Measured
from coupole.errors import InputError

_WIDEST_GAP_NM = 20.0
_TRIANGLE = 101


@dataclass(frozen=True)
class OnGrid:
    """A spectrum on the grid."""

    name: str
    values: Array
    """[81] values; NaN where the spectrum was not measured."""
    error: float
    """Estimate of the largest error that resampling makes, in the unit of the values.

    For interpolated samples, it is a quarter of the largest error with which every other sample is found from its
    neighbours, because PCHIP's error falls at least as the square of the spacing. For averaged samples, it is the
    largest difference between the band mean and the sampled curve at the band's centre, including noise.
    """


def on_grid(spectrum: Measured) -> OnGrid:
    """Return `spectrum` on the grid. Bands outside its range, or in a gap wider than 20 nm, are NaN."""
    result, error = resample(spectrum, WAVELENGTHS_NM, STEP_NM)
    if not np.isfinite(result).any():
        nm = spectrum.wavelengths_nm
        raise InputError(
            f"spectrum {spectrum.name}: expected samples between 380 and 780 nm, found {nm[0]:g} to {nm[-1]:g}; "
            "give a spectrum of visible light"
        )
    return OnGrid(spectrum.name, result, error)


def resample(spectrum: Measured, bands_nm: Array, step_nm: float) -> tuple[Array, float]:
    """Return `spectrum` at `bands_nm` [n] in rising order, NaN outside its range and in gaps wider than 20 nm; and
    the error as in `OnGrid`. Samples coarser than `step_nm` are interpolated, finer samples are averaged."""
    nm, values = spectrum.wavelengths_nm, spectrum.values
    bands = np.array(bands_nm)
    result = np.full(bands.shape, np.nan)
    inside = (bands >= nm[0] - 1e-6) & (bands <= nm[-1] + 1e-6)
    above = np.clip(np.searchsorted(nm, bands), 1, len(nm) - 1)
    on_sample = np.isclose(nm[above], bands) | np.isclose(nm[above - 1], bands)
    is_covered = inside & ((nm[above] - nm[above - 1] <= _WIDEST_GAP_NM) | on_sample)
    if not is_covered.any():
        return result, 0.0
    if np.median(np.diff(nm)) < step_nm - 1e-6:
        result[is_covered], error = _average(nm, values, bands[is_covered], step_nm)
    else:
        result[is_covered], error = _interpolate(nm, values, bands[is_covered])
    return result, error


def fill_missing(spectrum: OnGrid) -> Array:
    """[81] values, with missing ends filled by the nearest measured value, and gaps by straight lines.

    The filled values are guesses. Rendering needs them, identification does not.
    """
    is_known = np.isfinite(spectrum.values)
    return np.interp(WAVELENGTHS_NM, WAVELENGTHS_NM[is_known], spectrum.values[is_known])


def _interpolate(nm: Array, values: Array, at: Array) -> tuple[Array, float]:
    from scipy.interpolate import PchipInterpolator

    # Ends within rounding of the range belong to it.
    band_values = np.asarray(PchipInterpolator(nm, values)(np.clip(at, nm[0], nm[-1])))
    if np.isclose(at[:, None], nm).any(axis=1).all():
        return band_values, 0.0
    even_rows = np.arange(0, len(nm), 2)
    left_out = np.arange(1, even_rows[-1], 2)
    if len(even_rows) < 2 or not len(left_out):
        return band_values, float(np.ptp(values))
    again = PchipInterpolator(nm[even_rows], values[even_rows])(nm[left_out])
    return band_values, 0.25 * float(np.abs(again - values[left_out]).max())


def _average(nm: Array, values: Array, at: Array, step_nm: float) -> tuple[Array, float]:
    # At the ends of the range the triangle is narrower, so that it remains symmetric about the band's centre.
    half = np.minimum(step_nm, np.maximum(np.minimum(at - nm[0], nm[-1] - at), 0.0))
    u = np.linspace(-1.0, 1.0, _TRIANGLE)
    weight = (1.0 - np.abs(u)) / np.sum(1.0 - np.abs(u))
    band_values = np.interp(at[:, None] + half[:, None] * u, nm, values) @ weight
    return band_values, float(np.abs(band_values - np.interp(at, nm, values)).max())
