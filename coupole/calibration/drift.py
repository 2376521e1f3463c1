"""Drift of the LEDs between their calibration and a run, seen on a tile that is in every run.

A reading is the tile's signal over what the calibrated power makes of it: 1 if nothing changed. In logarithms it
is common level + rate * hours + coefficient * (T - T0) + noise. The coefficient of board temperature has a prior
(white power LEDs: about -0.3 % per kelvin), since within a run temperature and time go up together. So each
frame gets a factor of its own, from its board's temperature and its time, with an uncertainty.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from coupole.calibration.rotations import Floats
from coupole.errors import InputError

NAMES = ("level", "rate_per_h", "per_k")
_LEAST_READINGS = 3
_SUDDEN_SIGMA = 5.0
_SUDDEN = 0.003
"""Relative: a smaller step is no matter."""
_UNKNOWN = 10.0


@dataclass(frozen=True)
class Reading:
    """The reference tile in one frame."""

    name: str
    t_s: float
    temperature_c: float
    ratio: float
    """Signal seen over signal expected from the LED's calibrated power."""
    u_ratio: float
    """From noise; what all readings share is no matter of drift."""


@dataclass(frozen=True)
class Drift:
    """Factor of LED power against its calibration."""

    parameters: Floats
    """[3] as `NAMES`."""
    covariance: Floats
    """[3, 3]."""
    start_s: float
    reference_c: float
    noise: float
    """Relative scatter of one reading, over its stated noise if that is greater."""
    residuals: Floats
    """[readings] relative."""
    hours: tuple[float, float]
    """From the first to the last reading; beyond them the factor is an extrapolation."""

    def factor(self, temperature_c: ArrayLike, t_s: ArrayLike) -> Floats:
        """Power now over calibrated power, of frames at board temperatures and times [...]."""
        value: Floats = np.exp(self._design(temperature_c, t_s) @ self.parameters)
        return value

    def u_factor(self, temperature_c: ArrayLike, t_s: ArrayLike) -> Floats:
        """Its relative standard uncertainty [...]."""
        design = self._design(temperature_c, t_s)
        u: Floats = np.sqrt(np.einsum("...i,ij,...j->...", design, self.covariance, design))
        return u

    def _design(self, temperature_c: ArrayLike, t_s: ArrayLike) -> Floats:
        hours = (np.asarray(t_s, float) - self.start_s) / 3600.0
        warm = np.asarray(temperature_c, float) - self.reference_c
        hours, warm = np.broadcast_arrays(hours, warm)
        return np.stack([np.ones_like(hours), hours, warm], axis=-1)


def fit_drift(
    readings: tuple[Reading, ...] | list[Reading],
    *,
    reference_c: float,
    per_k: float = -0.003,
    u_per_k: float = 0.002,
    rate_per_h: float = 0.0,
    u_rate_per_h: float = 0.005,
) -> Drift:
    """The factor from a run's readings; `reference_c` is the board temperature of the powers' calibration.

    Raises InputError: too few readings, a dark tile, a sudden change, named by the frames it lies between.
    """
    ordered = sorted(readings, key=lambda reading: reading.t_s)
    if len(ordered) < _LEAST_READINGS:
        raise InputError(
            f"drift: expected {_LEAST_READINGS} readings of the reference tile or more, found {len(ordered)}; put "
            "the tile into the field of a view, or add a view of it"
        )
    ratio = np.array([reading.ratio for reading in ordered])
    if dark := [reading.name for reading in ordered if reading.ratio < 0.1]:
        raise InputError(
            f"drift: the reference tile is dark in {', '.join(dark[:5])}; is the LED dead, or the tile hidden?"
        )
    t_s = np.array([reading.t_s for reading in ordered])
    warm = np.array([reading.temperature_c for reading in ordered])
    start_s = float(t_s[0])
    hours = (t_s - start_s) / 3600.0
    design = np.column_stack([np.ones_like(hours), hours, np.nan_to_num(warm - reference_c)])
    noise = np.array([reading.u_ratio / reading.ratio for reading in ordered])
    prior = np.array([0.0, rate_per_h, per_k])
    precision = np.diag(np.array([_UNKNOWN, u_rate_per_h, u_per_k]) ** -2.0)
    scale = 1.0
    found, covariance = prior, np.eye(3)
    for _ in range(3):
        weight = (noise * scale) ** -2.0
        covariance = np.asarray(np.linalg.inv(precision + design.T @ (design * weight[:, None])), np.float64)
        found = covariance @ (precision @ prior + design.T @ (weight * np.log(ratio)))
        left = np.log(ratio) - design @ found
        degrees = max(1, len(ordered) - 3)
        scale = max(1.0, float(np.sqrt(np.sum((left / noise) ** 2) / degrees)))
    _refuse_sudden([reading.name for reading in ordered], left, noise)
    return Drift(
        found,
        covariance,
        start_s,
        reference_c,
        float(np.median(noise) * scale),
        left,
        (float(hours[0]), float(hours[-1])),
    )


def _refuse_sudden(names: list[str], left: Floats, noise: NDArray[np.float64]) -> None:
    """Raise InputError if the readings' level steps: the greatest step of means before and after, over its noise.

    Noise is that of neighbouring readings' differences (one step among many changes their median little).
    """
    count = len(left)
    differences = np.abs(np.diff(left))
    single = max(float(np.median(differences)) * 1.4826 / np.sqrt(2.0), float(np.median(noise)))
    best, place, size = 0.0, 0, 0.0
    for k in range(1, count):
        step = float(left[k:].mean() - left[:k].mean())
        over = abs(step) / (single * np.sqrt(1.0 / k + 1.0 / (count - k)))
        if over > best:
            best, place, size = over, k, step
    if best > _SUDDEN_SIGMA and abs(size) > _SUDDEN:
        raise InputError(
            f"drift: the light changed suddenly by {size:+.2%} between {names[place - 1]} and {names[place]}; "
            "look at the tile, the supply and the LED, and take the frames after it again"
        )
