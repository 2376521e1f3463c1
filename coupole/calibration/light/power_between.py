"""Observations of LEDs in views of the tile, in logarithms, with the LEDs' own powers eliminated."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from coupole.calibration.rotations import Floats


@dataclass(frozen=True)
class Between:
    """Observations of LEDs in views, in logarithms, with the LEDs' own powers eliminated."""

    residuals: Floats
    """[n] against the mean of the LED's views."""
    design: Floats
    """[n, c] derivatives with respect to the shared figures, less their mean over the LED's views."""
    weights: Floats
    """[n] inverse squares of the stated noise."""
    led: NDArray[np.intp]
    """[n] numbers of the LEDs."""
    leds: int
    prior: Floats
    """[c] standard uncertainties of the shared figures."""

    @property
    def weight(self) -> Floats:
        """[leds] sum of the weights of each LED."""
        return np.asarray(np.bincount(self.led, self.weights, self.leds), np.float64)

    @property
    def redundancy(self) -> float:
        return max(1.0, float(len(self.led) - len(np.unique(self.led))))

    def means(self, values: Floats) -> Floats:
        """Return [leds, k] weighted means of values [n, k] over the views of each LED."""
        total = np.maximum(self.weight, 1e-300)
        return np.column_stack([np.bincount(self.led, self.weights * v, self.leds) / total for v in values.T])


def between_views(
    y: Floats, weights: Floats, led: NDArray[np.intp], design: Floats, leds: int, prior: Floats
) -> tuple[Between, Floats]:
    """Return observations y [n] with the LEDs' own powers eliminated, and the mean [leds] of each LED."""
    raw = Between(y, design, weights, led, leds, prior)
    mean_y = raw.means(y[:, None])[:, 0]
    return replace(raw, residuals=y - mean_y[led], design=design - raw.means(design)[led]), mean_y
