"""Spectra of white LEDs: a blue chip that pumps a yellow phosphor."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from coupole.appearance.spectra.grid import WAVELENGTHS_NM, Array


@dataclass(frozen=True)
class LedSpectrum:
    """A blue chip under a yellow phosphor. Both bands are Gaussian; the figures are those of a white LED of about
    5500 K (assumed)."""

    pump_nm: float = 450.0
    pump_fwhm_nm: float = 20.0
    phosphor_nm: float = 560.0
    phosphor_fwhm_nm: float = 115.0
    pump_share: float = 0.22
    """Share of the radiant power between 380 and 780 nm that comes from the blue chip."""


WHITE_LED = LedSpectrum()


def spectral_power(spectrum: LedSpectrum) -> Array:
    """Relative spectral power [81] of a white LED; its sum is 1."""
    pump = _band(spectrum.pump_nm, spectrum.pump_fwhm_nm)
    phosphor = _band(spectrum.phosphor_nm, spectrum.phosphor_fwhm_nm)
    return spectrum.pump_share * pump + (1.0 - spectrum.pump_share) * phosphor


def _band(centre_nm: float, fwhm_nm: float) -> Array:
    """Return a Gaussian on the grid; its sum is 1."""
    curve = np.exp(-4.0 * np.log(2.0) * ((WAVELENGTHS_NM - centre_nm) / fwhm_nm) ** 2)
    return np.asarray(curve / curve.sum())
