"""Photon transfer: gain, read noise and full well of a sensor, with uncertainties (EMVA 1288, release 4.0, 6.5).

The temporal variance of a pixel is read^2 + 1/12 + K * signal, with K in DN per electron. The variance is half the
mean square of the difference of two frames, in which fixed patterns cancel. Pixels of equal mean are evaluated
together, so the scene need not be uniform.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from coupole.calibration.light.pairs import BLOCK, Estimate, Pair, pair_names, refuse_all_clipped
from coupole.calibration.rotations import Floats
from coupole.errors import InputError

ROUNDING_VARIANCE = 1.0 / 12.0
_LEVELS = 24
_LEAST_PIXELS = 400
"""Least number of pixels of one level. Fewer pixels do not determine its variance."""
_COLLAPSED = 0.7
"""A level counts as saturated if its variance, divided by the variance of the line, is below this."""
_GROSS = 6.0


@dataclass(frozen=True)
class PhotonTransfer:
    """Photon transfer of one channel."""

    gain_dn_per_e: Estimate
    read_noise_dn: Estimate
    """Read noise of one frame, with row noise, without rounding."""
    read_noise_e: Estimate
    saturation_dn: float
    """Signal above dark at which variance has its maximum (EMVA 1288, 6.6)."""
    saturation_e: Estimate
    saturated_seen: bool
    """False if no frame reached saturation. `saturation_dn` is then only the highest level."""
    prnu: Estimate | None
    """Relative PRNU; None if the scene was not uniform enough."""
    covariance: Floats
    """[2, 2] covariance of intercept (DN^2) and gain (DN)."""
    chi2_per_degree: float
    signal_dn: Floats
    """[levels] mean signal of each level; the next two fields are for the same levels."""
    variance_dn2: Floats
    u_variance_dn2: Floats
    used_levels: NDArray[np.bool_]

    @property
    def electrons_per_dn(self) -> Estimate:
        gain = self.gain_dn_per_e
        return Estimate(1.0 / gain.value, gain.u / gain.value**2)


def photon_transfer(pairs: Sequence[Pair]) -> PhotonTransfer:
    """Find gain, read noise and saturation of one channel, from pairs of frames at several levels.

    Raises InputError for no pair, too few levels below saturation, or a variance that does not grow with the
    signal.
    """
    if not pairs:
        raise InputError("response: expected two frames of each exposure; set `repeats: 2` in the plan")
    refuse_all_clipped(pairs)
    levels, variances, counts = _levels(*_squared_differences(pairs))
    fit, is_used = _line_of_sound_levels(levels, variances, counts)
    if fit.slope <= 0.0 or fit.slope < 3.0 * np.sqrt(fit.covariance[1, 1]):
        raise InputError(
            "response: the variance of pixels does not grow with their signal; does the camera process its "
            "frames, or is the light equal in all frames?"
        )
    read_var = fit.intercept - ROUNDING_VARIANCE
    u_read_var = float(np.sqrt(fit.covariance[0, 0]))
    read_noise_dn = float(np.sqrt(max(read_var, u_read_var**2 / max(read_var, u_read_var))))
    gain = Estimate(fit.slope, float(np.sqrt(fit.covariance[1, 1])))
    by_intercept, by_gain = 1.0 / (2 * read_noise_dn * fit.slope), -read_noise_dn / fit.slope**2
    slopes = np.array([by_intercept, by_gain])
    u_read_e = float(np.sqrt(slopes @ fit.covariance @ slopes))
    peak = int(np.argmax(np.where(levels > 0, variances, 0.0)))
    saturated_seen = any(pair.saturation_mask.any() for pair in pairs)
    saturation_dn = float(levels[peak])
    saturation_e = saturation_dn / fit.slope
    return PhotonTransfer(
        gain,
        Estimate(read_noise_dn, u_read_var / (2 * read_noise_dn)),
        Estimate(read_noise_dn / fit.slope, u_read_e),
        saturation_dn,
        Estimate(saturation_e, saturation_e * gain.u / gain.value),
        saturated_seen,
        _prnu(pairs),
        fit.covariance,
        fit.chi2_per_degree,
        levels,
        variances,
        variances * np.sqrt(2.0 / counts),
        is_used,
    )


@dataclass(frozen=True)
class _Line:
    intercept: float
    slope: float
    covariance: Floats
    chi2_per_degree: float


def _squared_differences(pairs: Sequence[Pair]) -> tuple[Floats, Floats]:
    """Return the mean of the two frames and their squared difference over 2, at each unsaturated pixel of all
    pairs."""
    signal, squares = [], []
    for pair in pairs:
        keep = ~pair.saturation_mask
        if keep.sum() < _LEAST_PIXELS:
            continue
        mean = 0.5 * (pair.first[keep] + pair.second[keep])
        difference = pair.first[keep] - pair.second[keep]
        ratio = float(difference.sum() / max(mean.sum(), 1e-9))
        difference = difference - ratio * mean  # flicker makes one frame of a pair brighter as a whole
        signal.append(mean)
        squares.append(difference**2 / 2.0)
    if not signal:
        raise InputError(f"response: {pair_names(pairs)}: nearly all pixels are saturated; add shorter exposures")
    return np.concatenate(signal), np.concatenate(squares)


def _line_of_sound_levels(levels: Floats, variances: Floats, counts: Floats) -> tuple[_Line, NDArray[np.bool_]]:
    """Return the line through the levels that are neither saturated nor gross errors, and a mask [levels] of these
    levels."""
    is_used = np.ones(len(levels), np.bool_)
    fit = _line(levels, variances, counts, is_used)
    for _ in range(10):
        line_variances = fit.intercept + fit.slope * levels
        # Near saturation noise is clipped: the first level with too little variance and all above are left out.
        short = (variances < _COLLAPSED * line_variances) & (levels > np.median(levels))
        beyond = levels >= levels[short].min() if short.any() else np.zeros(len(levels), np.bool_)
        off = np.abs(variances - line_variances) > _GROSS * line_variances * np.sqrt(2.0 / counts)
        # A level with a deviation below 3 % is not a gross error: it counts in chi^2.
        off &= np.abs(variances - line_variances) > 0.03 * line_variances
        now = ~beyond & ~off
        if now.sum() < 4 or (now == is_used).all():
            break
        is_used = now
        fit = _line(levels, variances, counts, is_used)
    return fit, is_used


def _levels(signal: Floats, squared_differences: Floats) -> tuple[Floats, Floats, Floats]:
    """Return mean signal, mean squared difference over 2 and number of pixels, in levels of similar signal."""
    order = np.argsort(signal, kind="stable")
    # Equal steps of signal, not of rank: bright pixels may be few, and they determine most of the gain.
    edges = np.linspace(signal[order[len(order) // 500]], signal[order[-1 - len(order) // 2000]], _LEVELS + 1)
    bins = np.clip(np.searchsorted(edges, signal, side="right") - 1, 0, _LEVELS - 1)
    counts = np.bincount(bins, minlength=_LEVELS).astype(float)
    keep = counts >= _LEAST_PIXELS
    if keep.sum() < 4:
        raise InputError(
            f"response: expected four or more levels of signal, found {int(keep.sum())}; bracket the exposure"
        )
    mean = np.bincount(bins, signal, _LEVELS)[keep] / counts[keep]
    variance = np.bincount(bins, squared_differences, _LEVELS)[keep] / counts[keep]
    return mean, variance, counts[keep]


def _line(signal: Floats, variance: Floats, counts: Floats, used_levels: NDArray[np.bool_]) -> _Line:
    """Fit a weighted line. The weights come from the line itself, because weights from single variances would bias
    it downwards."""
    x, y, n = signal[used_levels], variance[used_levels], counts[used_levels]
    expected_variance = np.maximum(y, 1e-6)
    design = np.column_stack([np.ones_like(x), x])
    coefficients, covariance = np.zeros(2), np.eye(2)
    for _ in range(6):
        weight = n / (2.0 * expected_variance**2)
        covariance = np.asarray(np.linalg.inv(design.T @ (design * weight[:, None])), np.float64)
        coefficients = covariance @ (design.T @ (weight * y))
        expected_variance = np.maximum(design @ coefficients, 0.05 * np.maximum(y, 1e-6))
    squares = (y - design @ coefficients) ** 2 * n / (2.0 * expected_variance**2)
    per_degree = float(squares.sum() / max(1, len(x) - 2))
    return _Line(float(coefficients[0]), float(coefficients[1]), covariance * max(1.0, per_degree), per_degree)


def _prnu(pairs: Sequence[Pair]) -> Estimate | None:
    """Return the relative scatter of the pixels' responses (EMVA 1288, 6.8), from the brightest even pair without
    saturation.

    In each block of neighbours the scene is modelled by a parabola. Returns None if this is not sufficient.
    """
    clean = [pair for pair in pairs if not pair.saturation_mask.any()]
    if not clean:
        return None
    pair = max(clean, key=lambda p: float(p.first.mean()))
    count = len(pair.first) // BLOCK * BLOCK
    a, b = (values[:count].reshape(-1, BLOCK) for values in (pair.first, pair.second))
    level = 0.5 * (a + b).mean(axis=1)
    if (level <= 0).any():
        return None
    steps = np.linspace(-1.0, 1.0, BLOCK)
    trend = np.linalg.qr(np.vander(steps, 3))[0]
    a, b = (values - (values @ trend) @ trend.T for values in (a, b))
    # Temporal noise averages out in the product of both frames' deviations.
    relative = (a * b).sum(axis=1) / (BLOCK - 3) / level**2
    if np.mean(np.abs(relative) > 25 * np.median(np.abs(relative))) > 0.05:
        return None
    variance, u = float(relative.mean()), float(relative.std() / np.sqrt(len(relative)))
    if variance <= u:
        return None
    return Estimate(float(np.sqrt(variance)), u / (2 * float(np.sqrt(variance))))
