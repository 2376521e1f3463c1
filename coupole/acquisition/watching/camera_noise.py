"""Noise of a look's bins, from the rig's figures: photons, readout, rows, rounding (EMVA 1288).

The pixels' own responses (PRNU) are the same in both frames of a comparison, so they cancel.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from coupole.acquisition.watching.frame_look import LookGrid
from coupole.plan.watch import WatchLimits

Floats = NDArray[np.float64]
_ROUNDING_DN2 = 1.0 / 12.0


@dataclass(frozen=True)
class CameraNoise:
    """Noise of bins at one gain."""

    dn_per_e: float
    read_dn2: float
    """Variance of one pixel's readout, with its rounding."""
    row_dn2: float
    """Variance of the offset that all pixels of a row have in common."""
    pixels: int
    """Number of pixels in a bin."""
    rows: int

    @staticmethod
    def of(limits: WatchLimits, grid: LookGrid, gain_db: float) -> CameraNoise:
        """The noise by the rig's figures."""
        frame_format = grid.frame_format
        dn_per_e = (frame_format.white_dn - frame_format.black_dn) / limits.full_well_e * 10.0 ** (gain_db / 20.0)
        read_dn2 = (limits.read_noise_e * dn_per_e) ** 2 + _ROUNDING_DN2
        row_dn2 = (limits.row_noise_e * dn_per_e) ** 2
        return CameraNoise(dn_per_e, read_dn2, row_dn2, grid.pixels_in_bin, grid.rows_in_bin)

    def variance_dn2(self, mean_dn: NDArray[np.floating]) -> Floats:
        """Variance of bins with these means above black."""
        photons_dn2 = self.dn_per_e * np.maximum(np.asarray(mean_dn, float), 0.0)
        return np.asarray((self.read_dn2 + photons_dn2) / self.pixels + self.row_dn2 / self.rows)

    def dark_sigma_dn(self, rows: int, columns: int) -> float:
        """Standard deviation of the mean of a dark rectangle of bins."""
        return float(np.sqrt(self.read_dn2 / (self.pixels * rows * columns) + self.row_dn2 / (self.rows * rows)))
