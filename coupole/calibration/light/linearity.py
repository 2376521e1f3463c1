"""Linearity of a sensor, with uncertainty (EMVA 1288, release 4.0, section 8).

Under constant light the signal of any pixel is its rate times the exposure time. Pixels of several brightnesses
share one curve, y + c2 y^2/R + c3 y^3/R^2 = rate * (t + t0). This separates an error of the exposure time from a
curvature of the response. Each exposure has its own factor of light (flicker), because flicker could otherwise
look like curvature.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import least_squares
from scipy.special import chdtrc

from coupole.calibration.light.pairs import BLOCK, Estimate, Pair, refuse_all_clipped
from coupole.calibration.rotations import Floats
from coupole.errors import InputError

_GROUPS = 12
"""Number of groups of pixels of similar brightness."""
_CLIPPED_SHARE = 1e-3
_CHANGED = 0.01
"""Largest relative change of ratios between groups of pixels. If they change by more, the scene was changed."""
_SCENE_SIGMA = 8.0


@dataclass(frozen=True)
class Linearity:
    """Deviation of the response from a line, and the polynomial that corrects it."""

    coefficients: Floats
    """c2, c3 of y + c2 y^2/R + c3 y^3/R^2. They are zero if a line is sufficient."""
    covariance: Floats
    """[2, 2]."""
    with_offset: Floats
    """[2] covariances of c2 and c3 with the time offset."""
    range_dn: float
    """R, the range above dark."""
    time_offset_us: Estimate
    worst_deviation: float
    """Largest deviation from a line between 5 and 95 % of the range, relative (EMVA 1288, 8.3)."""
    u_deviation: float
    exposures_us: Floats
    deviations: Floats
    """[groups, exposures] relative deviations of the uncorrected signal; NaN where saturated."""
    signals_dn: Floats
    """[groups, exposures]."""
    flicker: float
    """Relative scatter of the light from frame to frame."""

    def linear(self, signal_dn: Floats) -> Floats:
        """Return the linearised signal, of the same shape, DN above dark."""
        x = signal_dn / self.range_dn
        linear_dn: Floats = signal_dn * (1.0 + x * (self.coefficients[0] + x * self.coefficients[1]))
        return linear_dn


def linearity(pairs: Sequence[Pair], range_dn: float, *, significance: float = 1e-3) -> Linearity:
    """Find the deviation from a line. It is corrected if its probability for a straight line is below
    `significance`.

    Raises InputError for clipped frames, a scene that changed, flickering light, or a longer exposure that is not
    brighter.
    """
    refuse_all_clipped(pairs)
    ordered_pairs = sorted(pairs, key=lambda pair: pair.exposure_us)
    signals, u_signals = _grouped_signals(ordered_pairs)
    is_seen = np.asarray(np.isfinite(signals).any(axis=0))
    ordered_pairs = [pair for pair, use in zip(ordered_pairs, is_seen, strict=True) if use]
    signals, u_signals = signals[:, is_seen], u_signals[:, is_seen]
    exposures = np.array([pair.exposure_us for pair in ordered_pairs])
    if len(np.unique(exposures)) < 4:
        raise InputError(
            f"response: expected four exposures or more, found {len(np.unique(exposures))}; use a bracket"
        )
    flicker = _flicker(ordered_pairs)
    _refuse_contradictions(ordered_pairs, signals, flicker)
    fit = _fit(signals, u_signals, exposures, range_dn, flicker)
    coefficients, c_covariance = fit.coefficients, fit.covariance[:2, :2]
    x = np.linspace(0.05, 0.95, 91)
    curve = x * coefficients[0] + x * x * coefficients[1]
    deviation = _from_line(x, curve)
    basis = np.stack([_from_line(x, x), _from_line(x, x * x)])
    worst = int(np.argmax(np.abs(deviation)))
    u_worst = float(np.sqrt(max(float(basis[:, worst] @ c_covariance @ basis[:, worst]), 0.0)))
    unlikely = float(chdtrc(2, coefficients @ np.linalg.solve(c_covariance, coefficients)))
    _refuse_other_scene(ordered_pairs, fit.residuals, np.isfinite(signals), signals, u_signals)
    return Linearity(
        coefficients if unlikely < significance else np.zeros(2),
        c_covariance,
        1e3 * fit.covariance[:2, 2],
        range_dn,
        Estimate(float(fit.time_offset_us), float(1e3 * np.sqrt(fit.covariance[2, 2]))),
        float(abs(deviation[worst])),
        u_worst,
        exposures,
        fit.deviations,
        signals,
        flicker,
    )


@dataclass(frozen=True)
class _Fit:
    coefficients: Floats
    """c2, c3."""
    time_offset_us: float
    covariance: Floats
    """[3, 3] covariance of c2, c3 and the time offset in ms."""
    residuals: Floats
    """Residuals of the unsaturated signals, divided by their uncertainties."""
    deviations: Floats
    """[groups, exposures] relative deviations of the uncorrected signals from a line."""


def _fit(signals: Floats, u_signals: Floats, exposures: Floats, range_dn: float, flicker: float) -> _Fit:
    """Fit the curve, the time offset (ms), the logarithm of each group's rate relative to its start, and the
    relative light of each exposure."""
    is_known = np.isfinite(signals)
    start = np.nanmedian(signals / exposures, axis=1)
    scatter = max(flicker / np.sqrt(2.0), 1e-6)

    def expected_signals(p: Floats) -> Floats:
        rates, light = start * np.exp(p[3 : 3 + len(start)]), p[-len(exposures) :]
        signal: Floats = rates[:, None] * (exposures + 1e3 * p[2]) * (1.0 + light)
        return signal

    def residuals(p: Floats) -> Floats:
        x = signals / range_dn
        made_linear = signals * (1.0 + x * (p[0] + x * p[1]))
        scaled_residuals = (made_linear - expected_signals(p)) / u_signals
        return np.concatenate([scaled_residuals[is_known], p[-len(exposures) :] / scatter])

    fit = least_squares(residuals, np.zeros(3 + len(start) + len(exposures)), method="trf", x_scale="jac")
    degrees = max(1, len(fit.fun) - len(fit.x))
    factor = max(1.0, 2.0 * fit.cost / degrees)  # Birge ratio: never smaller than the scatter of the data shows
    covariance = np.linalg.pinv(fit.jac.T @ fit.jac) * factor
    deviations = signals / expected_signals(fit.x) - 1.0
    return _Fit(fit.x[:2], 1e3 * fit.x[2], covariance[:3, :3], fit.fun[: is_known.sum()], deviations)


def _grouped_signals(pairs: Sequence[Pair]) -> tuple[Floats, Floats]:
    """Return mean signals [groups, exposures] of pixels of similar brightness, and their standard uncertainties.
    They are NaN if more than `_CLIPPED_SHARE` of a group is saturated."""
    bright = max(
        pairs, key=lambda p: float(np.where(p.saturation_mask.mean() < _CLIPPED_SHARE, p.first.mean(), -1.0))
    )
    # Blocks of neighbours are sorted, not pixels: sorting by noisy values would bias the groups' means.
    blocks = np.arange(len(bright.first) // BLOCK * BLOCK).reshape(-1, BLOCK)
    order = blocks[np.argsort((bright.first + bright.second)[blocks].mean(axis=1), kind="stable")]
    signals, u = np.full((_GROUPS, len(pairs)), np.nan), np.ones((_GROUPS, len(pairs)))
    for g, members in enumerate(map(np.ravel, np.array_split(order, _GROUPS))):
        for i, pair in enumerate(pairs):
            if pair.saturation_mask[members].mean() > _CLIPPED_SHARE:
                continue
            mean = 0.5 * (pair.first[members] + pair.second[members])
            noise = np.std(pair.first[members] - pair.second[members]) / 2.0
            signals[g, i] = mean.mean()
            u[g, i] = max(noise / np.sqrt(len(members)), 1e-3)
    return signals, u


def _flicker(pairs: Sequence[Pair]) -> float:
    """Return the relative standard deviation of the light from frame to frame, from the two frames of each
    pair."""
    differences = []
    for pair in pairs:
        keep = ~pair.saturation_mask
        total = pair.first[keep].sum() + pair.second[keep].sum()
        if total > 0:
            differences.append(2.0 * (pair.first[keep].sum() - pair.second[keep].sum()) / total)
    return float(np.sqrt(np.mean(np.square(differences)) / 2.0))


def _refuse_contradictions(pairs: Sequence[Pair], signals: Floats, flicker: float) -> None:
    if flicker > 0.01:
        raise InputError(
            f"response: the light flickers by {flicker:.1%} from frame to frame; a flicker above 1 % cannot be "
            f"separated from a bent response. Let the light warm up, or use panels"
        )
    usable = np.isfinite(signals).sum(axis=0) >= _GROUPS // 3
    exposures = np.array([pair.exposure_us for pair in pairs])
    total = np.nanmean(np.where(np.isfinite(signals), signals, np.nan)[:, usable][: _GROUPS // 3], axis=0)
    steps = np.diff(exposures[usable]) > 0
    for place in np.flatnonzero(steps & (np.diff(total) <= 0)):
        names = [pair.name for pair, use in zip(pairs, usable, strict=True) if use]
        raise InputError(
            f"response: {names[place + 1]} is exposed longer than {names[place]} and yet not brighter; was the "
            "light off, or is the recorded exposure time wrong?"
        )


def _refuse_other_scene(
    pairs: Sequence[Pair], residuals: Floats, known_mask: NDArray[np.bool_], signals: Floats, u_signals: Floats
) -> None:
    """Raise InputError if the ratios between groups of pixels differ in one exposure."""
    relative = np.full(known_mask.shape, np.nan)
    relative[known_mask] = residuals * u_signals[known_mask] / signals[known_mask]
    rms = np.sqrt(np.nanmean((relative - np.nanmean(relative, axis=0)) ** 2, axis=0))
    noise = np.sqrt(np.nanmean((u_signals / signals) ** 2, axis=0))
    worst = int(np.nanargmax(rms - _SCENE_SIGMA * noise))
    if rms[worst] > _CHANGED + _SCENE_SIGMA * noise[worst]:
        raise InputError(
            f"response: the scene has changed in {pairs[worst].name}; nothing may move between exposures"
        )


def _from_line(x: Floats, relative: Floats) -> Floats:
    """Return relative deviations from the proportional line that halves their range."""
    deviations: Floats = relative - 0.5 * (relative.max() + relative.min())
    return deviations
