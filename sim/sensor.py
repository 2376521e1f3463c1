"""From radiance to digital numbers: Bayer filter, exposure, shot and read noise, black level, saturation.

Noise comes from a counter-based generator: the same seed, frame and pixel give the same value, whatever the
number of threads or the order of frames.
"""

from __future__ import annotations

from dataclasses import dataclass

import numba
import numpy as np
from numpy.typing import NDArray

CHANNEL = {"R": 0, "G": 1, "B": 2}


@dataclass(frozen=True)
class SensorModel:
    """The simulated sensor; figures of the CMV12000 class (facts/instrument: full well 13.5 ke-)."""

    bayer_pattern: str = "GBRG"
    bit_depth: int = 12
    black_dn: int = 64
    full_well_e: float = 13_500.0
    read_noise_e: float = 13.0
    seed: int = 1

    @property
    def white_dn(self) -> int:
        return (1 << self.bit_depth) - 1

    @property
    def electrons_per_dn(self) -> float:
        return self.full_well_e / (self.white_dn - self.black_dn)

    def channels(self) -> NDArray[np.int64]:
        """[2, 2] channel (0 red, 1 green, 2 blue) of each place in the Bayer cell; MONO is all green."""
        letters = self.bayer_pattern if self.bayer_pattern != "MONO" else "GGGG"
        return np.array([CHANNEL[c] for c in letters]).reshape(2, 2)


@numba.njit(cache=True, nogil=True)
def _mix(x):  # type: ignore[no-untyped-def]
    """SplitMix64's finaliser (Steele, Lea, Flood 2014): a bijection of 64 bits that scatters a counter."""
    x = (x ^ (x >> np.uint64(30))) * np.uint64(0xBF58476D1CE4E5B9)
    x = (x ^ (x >> np.uint64(27))) * np.uint64(0x94D049BB133111EB)
    return x ^ (x >> np.uint64(31))


@numba.njit(cache=True, nogil=True)
def _expose(  # type: ignore[no-untyped-def]
    out, triangle, radiance, falloff, channels, electrons, black, white, e_per_dn, read_noise_e, key
):
    height, width = triangle.shape
    for row in range(height):
        for col in range(width):
            t = triangle[row, col]
            signal_e = 0.0
            if t >= 0:
                signal_e = radiance[t, channels[row & 1, col & 1]] * falloff[row, col] * electrons
            bits = _mix(key + np.uint64(row * width + col) * np.uint64(0x9E3779B97F4A7C15))
            # Four 16-bit uniforms: their sum has variance 4/12, near enough to normal for a look.
            total = (
                (bits & np.uint64(0xFFFF))
                + ((bits >> np.uint64(16)) & np.uint64(0xFFFF))
                + ((bits >> np.uint64(32)) & np.uint64(0xFFFF))
                + (bits >> np.uint64(48))
            )
            normal = (np.float64(total) / 65535.0 - 2.0) * 1.7320508
            noisy_e = signal_e + normal * np.sqrt(signal_e + read_noise_e * read_noise_e)
            dn = black + noisy_e / e_per_dn + 0.5
            out[row, col] = np.uint16(min(max(dn, 0.0), white))


def expose(
    out: NDArray[np.uint16],
    triangle: NDArray[np.int32],
    radiance: NDArray[np.float32],
    falloff: NDArray[np.float32],
    *,
    model: SensorModel,
    electrons_per_radiance: float,
    frame: int,
) -> None:
    """Fill `out` [h, w] with one frame, DN.

    `radiance` [seen, 3] times `electrons_per_radiance` is the mean number of electrons at the image's centre.
    """
    key = np.uint64((model.seed * 0x9E3779B97F4A7C15 + frame * 0xD1B54A32D192ED03) % 2**64)
    _expose(
        out,
        triangle,
        radiance,
        falloff,
        model.channels(),
        electrons_per_radiance,
        float(model.black_dn),
        float(model.white_dn),
        model.electrons_per_dn,
        model.read_noise_e,
        key,
    )
