"""Drift of the LEDs between their calibration and a run, measured on a tile in the run's views.

A reading is the tile's signal divided by the signal expected from the calibrated power. It is 1 if nothing has
changed. Its logarithm is common level + rate * hours + coefficient * (T - T0) + noise, where T0 is the board's
temperature when the LED's power was calibrated. The coefficient has a prior (white power LEDs: about -0.3 % per
kelvin), because temperature and time are correlated within a run. So each frame gets its own factor from its
board's temperature and its time, with an uncertainty. Errors that all readings share (the tile's tilt, in the run
and in the calibration of the powers) are estimated too, with their priors.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from coupole.calibration.rotations import Floats
from coupole.errors import InputError

NAMES = ("level", "rate_per_h", "per_k")
LEAST_READINGS = 3
_SUDDEN_SIGMA = 5.0
_SUDDEN = 0.003
"""Largest relative step that is accepted."""
_UNKNOWN = 10.0
_NEIGHBOURS = 11
_ODD_SIGMA, _ODD = 6.0, 0.01
"""Largest distance of a reading from its neighbours' median. A larger distance shows a fault of the LED, not
drift."""
_NO_FIGURES: Floats = np.zeros((0, 0))


@dataclass(frozen=True)
class Reading:
    """The reference tile in one frame."""

    name: str
    t_s: float
    warmer_k: float
    """Temperature of the LED's board minus its temperature when the power was calibrated; NaN if one of them is
    not known."""
    ratio: float
    """Measured signal, relative to the signal expected from the LED's calibrated power."""
    u_ratio: float
    """Standard uncertainty of the ratio, from noise and from the LED's own calibration."""
    by_shared: tuple[float, ...] = ()
    """Relative change of the ratio by one unit of each figure that all readings share."""


@dataclass(frozen=True)
class Drift:
    """Factor of LED power relative to its calibration."""

    parameters: Floats
    """[3] values of the parameters `NAMES`."""
    covariance: Floats
    """[3, 3]."""
    start_s: float
    """Time of the first reading, on the frames' clock."""
    noise: float
    """Relative noise of one reading: the estimated noise, but at least the stated one."""
    used_readings: tuple[Reading, ...]
    """Readings that were used, in their order."""
    residuals: Floats
    """[used] relative residuals."""
    odd: tuple[Reading, ...]
    """Readings that were left out, because they are far from their neighbours."""
    freedom: float

    @property
    def hours(self) -> float:
        """Time from the first to the last reading. Outside this time the factor is an extrapolation."""
        return (self.used_readings[-1].t_s - self.used_readings[0].t_s) / 3600.0

    def factor(self, warmer_k: ArrayLike, t_s: ArrayLike) -> Floats:
        """Return power over calibrated power [...] for boards' temperatures relative to the calibration (K) and
        times."""
        value: Floats = np.exp(self._design(warmer_k, t_s) @ self.parameters)
        return value

    def u_factor(self, warmer_k: ArrayLike, t_s: ArrayLike) -> Floats:
        """Return the relative standard uncertainty [...] of the factor."""
        design = self._design(warmer_k, t_s)
        u: Floats = np.sqrt(np.einsum("...i,ij,...j->...", design, self.covariance, design))
        return u

    def _design(self, warmer_k: ArrayLike, t_s: ArrayLike) -> Floats:
        hours = (np.asarray(t_s, float) - self.start_s) / 3600.0
        hours, warm = np.broadcast_arrays(hours, np.nan_to_num(np.asarray(warmer_k, float)))
        return np.stack([np.ones_like(hours), hours, warm], axis=-1)


def fit_drift(
    readings: Sequence[Reading],
    *,
    shared_covariance: Floats = _NO_FIGURES,
    per_k: float = -0.003,
    u_per_k: float = 0.002,
    rate_per_h: float = 0.0,
    u_rate_per_h: float = 0.005,
) -> Drift:
    """Find the factor from a run's readings. `shared_covariance` [c, c] is the prior of the shared figures, whose
    mean is 0.

    Raises InputError for too few readings, a dark tile, or a sudden change (with the frames before and after it).
    """
    ordered_readings = sorted(readings, key=lambda reading: reading.t_s)
    _refuse_few(ordered_readings)
    if dark := [reading.name for reading in ordered_readings if reading.ratio < 0.1]:
        raise InputError(
            f"drift: the reference tile is dark in {', '.join(dark[:5])}; is the LED dead, or the tile hidden?"
        )
    prior = np.concatenate([[0.0, rate_per_h, per_k], np.zeros(len(shared_covariance))])
    precision = np.zeros((len(prior), len(prior)))
    precision[:3, :3] = np.diag(np.array([_UNKNOWN, u_rate_per_h, u_per_k]) ** -2.0)
    precision[3:, 3:] = np.linalg.inv(shared_covariance)
    first = _solve(ordered_readings, prior, precision)
    odd = _odd(first.residuals, first.noise)
    used_readings = [reading for reading, out in zip(ordered_readings, odd, strict=True) if not out]
    _refuse_few(used_readings)
    solution = _solve(used_readings, prior, precision) if odd.any() else first
    _refuse_sudden([reading.name for reading in used_readings], solution.residuals, solution.noise)
    return Drift(
        solution.parameters[:3],
        solution.covariance[:3, :3],
        used_readings[0].t_s,
        float(np.median(solution.noise) * solution.scale),
        tuple(used_readings),
        solution.residuals,
        tuple(reading for reading, out in zip(ordered_readings, odd, strict=True) if out),
        solution.freedom,
    )


# -- helpers --------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class _Solved:
    parameters: Floats
    covariance: Floats
    residuals: Floats
    """[readings] residuals, relative."""
    noise: Floats
    """[readings] stated noise, relative."""
    scale: float
    """Estimated noise divided by stated noise, at least 1."""
    freedom: float


def _solve(readings: Sequence[Reading], prior: Floats, precision: Floats) -> _Solved:
    """Solve by least squares with a prior. The residuals scale the noise."""
    ratio = np.array([reading.ratio for reading in readings])
    hours = np.array([(reading.t_s - readings[0].t_s) / 3600.0 for reading in readings])
    warm = np.nan_to_num(np.array([reading.warmer_k for reading in readings]))
    shared_terms = np.array([reading.by_shared for reading in readings]).reshape(len(readings), len(prior) - 3)
    design = np.column_stack([np.ones_like(hours), hours, warm, shared_terms])
    noise = np.array([reading.u_ratio for reading in readings]) / ratio
    freedom = max(1, len(readings) - 3)
    scale = 1.0
    for _ in range(3):
        weight = (noise * scale) ** -2.0
        covariance = np.asarray(np.linalg.inv(precision + design.T @ (design * weight[:, None])), np.float64)
        parameters = covariance @ (precision @ prior + design.T @ (weight * np.log(ratio)))
        residuals = np.log(ratio) - design @ parameters
        scale = max(1.0, float(np.sqrt(np.sum((residuals / noise) ** 2) / freedom)))
    return _Solved(parameters, covariance, residuals, noise, scale, float(freedom))


def _refuse_few(readings: Sequence[Reading]) -> None:
    if len(readings) < LEAST_READINGS:
        raise InputError(
            f"drift: expected {LEAST_READINGS} readings of the reference tile or more, found {len(readings)}; put "
            "the tile into the field of a view, or add a view of it"
        )


def _excess(residuals: Floats, noise: Floats) -> float:
    """Return the ratio of the estimated to the stated noise, from the median of neighbours' differences. A single
    step hardly changes it."""
    differences = np.abs(np.diff(residuals)) / np.hypot(noise[1:], noise[:-1])
    return max(1.0, float(np.median(differences) * 1.4826))


def _odd(residuals: Floats, noise: Floats) -> NDArray[np.bool_]:
    """Return a mask [n] of single readings that are far from their neighbours' median. A lasting step does not
    count."""
    from scipy.ndimage import median_filter

    if len(residuals) < _NEIGHBOURS:
        return np.zeros(len(residuals), np.bool_)
    off = np.abs(residuals - median_filter(residuals, _NEIGHBOURS, mode="nearest"))
    return np.asarray(off > np.maximum(_ODD, _ODD_SIGMA * _excess(residuals, noise) * noise))


def _refuse_sudden(names: Sequence[str], residuals: Floats, noise: Floats) -> None:
    """Raise InputError if the level of the readings has a step. The test uses the largest difference of the means
    before and after, divided by its noise."""
    weight = (_excess(residuals, noise) * noise) ** -2.0
    before, sums = np.cumsum(weight)[:-1], np.cumsum(weight * residuals)[:-1]
    after, rest = weight.sum() - before, (weight * residuals).sum() - sums
    steps = rest / after - sums / before
    over = np.abs(steps) / np.sqrt(1.0 / before + 1.0 / after)
    at = int(np.argmax(over))
    if over[at] > _SUDDEN_SIGMA and abs(steps[at]) > _SUDDEN:
        raise InputError(
            f"drift: the light changed suddenly by {steps[at]:+.2%} between {names[at]} and {names[at + 1]}; "
            "look at the tile, the supply and the LED, and take the frames after it again"
        )
