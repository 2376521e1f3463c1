"""The parameters of a simulated sensor, for `sim.optics.sensor`."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

import numpy as np
from numpy.typing import NDArray
from pydantic import ConfigDict

CHANNEL = {"R": 0, "G": 1, "B": 2}


@dataclass(frozen=True)
class SensorModel:
    """The simulated sensor; full well and range are those of the CMV12000, the rest is assumed."""

    __pydantic_config__: ClassVar[ConfigDict] = ConfigDict(extra="forbid")

    bayer_pattern: str = "GBRG"
    bit_depth: int = 12
    black_dn: int = 64
    full_well_e: float = 13_500.0
    read_noise_e: float = 13.0
    """Standard deviation of one pixel's readout."""
    seed: int = 1
    adc_share: float = 0.96
    """Fraction of the full well that fills the ADC at gain 1. Below 1 the ADC clips first, as makers set it. With
    a value of 1, read noise would leave half of all saturated pixels below `white_dn`.
    """
    row_noise_e: float = 1.0
    """Standard deviation of the offset common to all pixels of a row in one frame."""
    prnu: float = 0.01
    """Relative standard deviation of the pixels' responses."""
    dsnu_e: float = 3.0
    """Standard deviation of the pixels' offsets, the same in every frame."""
    dark_e_per_s: float = 100.0
    """Median dark current at `dark_reference_c`."""
    dark_spread: float = 0.3
    """Standard deviation of the natural logarithm of the pixels' dark currents."""
    dark_reference_c: float = 25.0
    dark_doubling_k: float = 6.5
    """Temperature rise that doubles the dark current."""
    hot_share: float = 1e-4
    """Fraction of pixels whose dark current is greater by the factor `hot_factor`."""
    hot_factor: float = 100.0
    ambient_e_per_s: tuple[float, float, float] = (0.0, 0.0, 0.0)
    """Red, green, blue: ambient light of the room, the same on every pixel."""

    @property
    def white_dn(self) -> int:
        return (1 << self.bit_depth) - 1

    @property
    def full_scale_e(self) -> float:
        """Electrons that fill the ADC at gain 1; to be divided by the gain."""
        return self.full_well_e * self.adc_share

    @property
    def electrons_per_dn(self) -> float:
        """Electrons per DN at gain 1; to be divided by the gain."""
        return self.full_scale_e / (self.white_dn - self.black_dn)

    def dark_factor(self, temperature_c: float) -> float:
        """Dark current at a temperature, relative to that at `dark_reference_c`."""
        return float(2.0 ** ((temperature_c - self.dark_reference_c) / self.dark_doubling_k))

    def channels(self) -> NDArray[np.int64]:
        """[2, 2] channel (0 red, 1 green, 2 blue) of each pixel of the Bayer cell; MONO is all green."""
        letters = self.bayer_pattern if self.bayer_pattern != "MONO" else "GGGG"
        return np.array([CHANNEL[c] for c in letters]).reshape(2, 2)
