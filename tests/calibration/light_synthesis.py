"""A small sensor of the tests' own: electrons, Poisson, gain, rounding. No code of the simulator's."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]


@dataclass(frozen=True)
class TrueSensor:
    """What the calibrations have to find."""

    shape: tuple[int, int]
    e_per_dn: float = 3.2
    read_e: float = 13.0
    row_e: float = 1.0
    black_dn: float = 64.0
    white_dn: int = 4095
    prnu: float = 0.01
    offset_e: float = 3.0
    dark_e_per_s: float = 100.0
    hot: int = 0
    doubling_k: float = 6.5
    bend: tuple[float, float] = (0.0, 0.0)
    """Of the inverse response y + c2 y^2/R + c3 y^3/R^2."""
    seed: int = 1

    def pattern(self) -> tuple[Array, Array, Array]:
        """Response, offset (e), dark current (e/s at 25 C)."""
        random = np.random.default_rng(self.seed)
        response = 1.0 + self.prnu * random.standard_normal(self.shape)
        offset = self.offset_e * random.standard_normal(self.shape)
        dark = self.dark_e_per_s * np.exp(0.3 * random.standard_normal(self.shape))
        hot = random.choice(dark.size, self.hot, replace=False)
        dark.ravel()[hot] *= 100.0
        return response, offset, dark

    def frame(
        self, light_e: Array | float, exposure_s: float, random: np.random.Generator, temperature_c: float = 25.0
    ) -> NDArray[np.uint16]:
        """[H, W] DN of a mean of `light_e` electrons."""
        response, offset, dark = self.pattern()
        warmth = 2.0 ** ((temperature_c - 25.0) / self.doubling_k)
        mean = np.broadcast_to(light_e, self.shape) * response + dark * exposure_s * warmth
        electrons = random.poisson(mean) + offset + self.read_e * random.standard_normal(self.shape)
        electrons = electrons + self.row_e * random.standard_normal((self.shape[0], 1))
        dn = self.bent(electrons / self.e_per_dn)
        return np.clip(np.round(self.black_dn + dn), 0, self.white_dn).astype(np.uint16)

    def bent(self, linear_dn: Array) -> Array:
        """Solves the inverse response by Newton's method."""
        c2, c3 = self.bend
        span = self.white_dn - self.black_dn
        y = linear_dn.copy()
        for _ in range(6):
            x = y / span
            y -= (y * (1 + c2 * x + c3 * x * x) - linear_dn) / (1 + 2 * c2 * x + 3 * c3 * x * x)
        return y


def coverage(errors_over_u: Sequence[float] | Array, factor: float | Array = 1.96) -> tuple[float, float]:
    """Share inside the 95 % intervals, and rms of error over standard uncertainty."""
    values = np.asarray(errors_over_u, float)
    return float(np.mean(np.abs(values) < factor)), float(np.sqrt(np.mean(values**2)))
