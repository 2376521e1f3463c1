"""The dome's LEDs as individuals: their spectra, and their fluxes relative to the table.

Everything is a function of seed, LED and flash; the model's values are the truth against which calibrations are
tested.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

import numpy as np
from numpy.typing import ArrayLike
from pydantic import ConfigDict

from coupole.appearance.spectra import channels
from coupole.appearance.spectra.grid import Array
from coupole.appearance.spectra.white_led import WHITE_LED, LedSpectrum, spectral_power

_OWN_FLUX, _OWN_PUMP, _FLASH, _LOOSE = 1, 2, 3, 4
"""Numbers of the seed's random streams, by use."""


@dataclass(frozen=True)
class LedModel:
    """Deviations of a dome's LEDs from their table; all values are assumed, of the order of white power LEDs."""

    __pydantic_config__: ClassVar[ConfigDict] = ConfigDict(extra="forbid")

    seed: int = 1
    flux_spread: float = 0.04
    """Standard deviation of the logarithm of the ratio of an LED's flux to its tabulated flux. Makers' bins are
    about 10 % wide."""
    pump_spread_nm: float = 2.5
    """Standard deviation of the pump chip's peak wavelength."""
    flux_per_k: float = -0.003
    """Relative change of flux per kelvin of board temperature."""
    reference_c: float = 25.0
    """Board temperature at which the table is valid."""
    hours_to_70_percent: float = 50_000.0
    """Operating time after which 70 % of the flux remains (L70), with exponential decay."""
    hours_shone: float = 0.0
    """Operating time of the LEDs before this run."""
    flicker: float = 5e-4
    """Relative standard deviation of flux from flash to flash."""
    dead: tuple[int, ...] = ()
    """LEDs that give no light."""
    spectrum: LedSpectrum = WHITE_LED


STEADY = LedModel(flux_spread=0.0, pump_spread_nm=0.0, flux_per_k=0.0, flicker=0.0)
"""LEDs that always give the flux of their table."""


def own_flux_factor(model: LedModel, led: int) -> float:
    """Flux of a new LED at the reference temperature, relative to its tabulated flux; 0 if it is dead."""
    if led in model.dead:
        return 0.0
    return float(np.exp(model.flux_spread * _normal(model.seed, _OWN_FLUX, led)))


def led_flux_factor(model: LedModel, led: int, flash: int, temperature_c: float, *, hours: float = 0.0) -> float:
    """Flux of one flash over the tabulated flux.

    `flash` numbers this world's flashes, `temperature_c` is the board's, `hours` the LED's operating time.
    """
    warmth = 1.0 + model.flux_per_k * (temperature_c - model.reference_c)
    age = 0.7 ** (hours / model.hours_to_70_percent)
    flicker = 1.0 + model.flicker * _normal(model.seed, _FLASH, led, flash)
    return max(0.0, float(own_flux_factor(model, led) * warmth * age * flicker))


class Flashes:
    """Flux of a world's flashes, in sequence."""

    def __init__(self, model: LedModel) -> None:
        self._model = model
        self._count = 0
        self.unsteady: dict[int, float] = {}
        """LEDs with a loose contact: relative standard deviation from flash to flash, in addition to the
        model's."""

    def flux(self, led: int, temperature_c: float) -> float:
        """Flux of the LED's next flash, relative to its tabulated flux."""
        self._count += 1
        loose = self.unsteady.get(led, 0.0) * _normal(self._model.seed, _LOOSE, led, self._count)
        flux = led_flux_factor(self._model, led, self._count, temperature_c, hours=self._model.hours_shone)
        return max(0.0, flux * (1.0 + loose))


def led_power(model: LedModel, led: int) -> Array:
    """Relative spectral power [81] of one LED with its own pump wavelength; the sum is 1."""
    model_spectrum = model.spectrum
    shift_nm = model.pump_spread_nm * _normal(model.seed, _OWN_PUMP, led)
    return spectral_power(
        LedSpectrum(
            model_spectrum.pump_nm + shift_nm,
            model_spectrum.pump_fwhm_nm,
            model_spectrum.phosphor_nm,
            model_spectrum.phosphor_fwhm_nm,
            model_spectrum.pump_share,
        )
    )


def channel_factors(model: LedModel, led: int, sensitivities: Array) -> Array:
    """[channels] signal of white under this LED relative to the model's own spectrum, at equal radiant power.

    `sensitivities` [channels, 81], such as `coupole.appearance.spectra.light.camera()`.
    """
    return np.asarray(sensitivities @ led_power(model, led) / (sensitivities @ spectral_power(model.spectrum)))


def camera_weights(model: LedModel, sensitivities: ArrayLike) -> Array:
    """[channels, 81] for `channels.channel_values`: weights of spectra under the model's LED."""
    return channels.channel_weights(spectral_power(model.spectrum), sensitivities)


def _normal(*where: int) -> float:
    """Standard normal number at an index of the seed's streams."""
    return float(np.random.default_rng(where).standard_normal())
