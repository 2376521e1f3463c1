"""The response of a sensor: photon transfer (gain, noise, full well) and linearity, with uncertainties.

Definitions are those of EMVA 1288, release 4.0. Photon transfer (section 6.5): the temporal variance of a pixel is
read^2 + 1/12 + K * signal, with K in DN per electron; variance is half the mean square of the difference of two
frames, in which fixed patterns cancel. Pixels of equal mean are looked at together, so the scene need not be even.

Linearity (section 8): under constant light the signal of any pixel is its rate times the exposure time. Pixels of
several brightnesses share one curve, y + c2 y^2/R + c3 y^3/R^2 = rate * (t + t0), so that an exposure time that is
off and a curve that is bent are told apart; each exposure may have its own factor of light (flicker), which a bent
curve could otherwise be taken for.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import least_squares
from scipy.stats import chi2

from coupole.calibration.rotations import Floats
from coupole.errors import InputError

ROUNDING_VARIANCE = 1.0 / 12.0
_LEVELS = 24
_LEAST_PIXELS = 400
"""Of one level: fewer say little of its variance."""
_GROUPS = 12
"""Of pixels of like brightness."""
_BLOCK = 64
"""Neighbouring pixels of the sample whose scene is a smooth curve."""
_CLIPPED_SHARE = 1e-3
_COLLAPSED = 0.7
"""Variance over what the line says, below which a level counts as saturated."""
_GROSS = 6.0
_CHANGED = 0.01
"""Relative: groups of pixels that keep their ratio less well than this were not looking at the same scene."""
_SCENE_SIGMA = 8.0


@dataclass(frozen=True)
class Pair:
    """Two frames of one scene, light and exposure; [pixels] DN above the dark frame, of one channel."""

    name: str
    exposure_us: float
    first: Floats
    second: Floats
    saturated: NDArray[np.bool_]
    """[pixels] True where either frame reached the end of the scale."""


@dataclass(frozen=True)
class Estimate:
    """A figure and its standard uncertainty."""

    value: float
    u: float


@dataclass(frozen=True)
class PhotonTransfer:
    """Of one channel."""

    gain_dn_per_e: Estimate
    read_noise_dn: Estimate
    """Of one frame, without rounding; row noise included."""
    read_noise_e: Estimate
    saturation_dn: float
    """Signal above dark at which variance has its maximum (EMVA 1288, 6.6)."""
    saturation_e: Estimate
    saturated_seen: bool
    """False if no frame came so far: then `saturation_dn` is only the highest level."""
    prnu: Estimate | None
    """Relative; None if the scene was not even enough."""
    covariance: Floats
    """[2, 2] of intercept (DN^2) and gain (DN)."""
    chi2_per_degree: float
    signal_dn: Floats
    """[levels] and variance of each, with its standard uncertainty."""
    variance_dn2: Floats
    u_variance_dn2: Floats
    used: NDArray[np.bool_]

    @property
    def electrons_per_dn(self) -> Estimate:
        gain = self.gain_dn_per_e
        return Estimate(1.0 / gain.value, gain.u / gain.value**2)


@dataclass(frozen=True)
class Linearity:
    """How far the response is from a line, and the polynomial that makes it one."""

    coefficients: Floats
    """c2, c3 of y + c2 y^2/R + c3 y^3/R^2; zeros where a line will do."""
    covariance: Floats
    """[2, 2]."""
    range_dn: float
    """R, above dark."""
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
        """Signal made linear; same shape, DN above dark."""
        x = signal_dn / self.range_dn
        corrected: Floats = signal_dn * (1.0 + x * (self.coefficients[0] + x * self.coefficients[1]))
        return corrected

    def u_linear(self, signal_dn: Floats) -> Floats:
        """Relative standard uncertainty that the curve adds to a signal."""
        x = np.asarray(signal_dn) / self.range_dn
        by = np.stack([x, x * x])
        u: Floats = np.sqrt(np.maximum(np.einsum("i...,ij,j...->...", by, self.covariance, by), 0.0))
        return u


def photon_transfer(pairs: Sequence[Pair]) -> PhotonTransfer:
    """Gain, read noise and saturation of one channel, from pairs of frames at several levels.

    Raises InputError: no pair, too few levels below saturation, variance that does not grow with the signal.
    """
    if not pairs:
        raise InputError("response: expected two frames of each exposure; set `repeats: 2` in the plan")
    _refuse_all_clipped(pairs)
    signal, squared = [], []
    for pair in pairs:
        keep = ~pair.saturated
        if keep.sum() < _LEAST_PIXELS:
            continue
        mean = 0.5 * (pair.first[keep] + pair.second[keep])
        difference = pair.first[keep] - pair.second[keep]
        ratio = float(difference.sum() / max(mean.sum(), 1e-9))
        difference = difference - ratio * mean  # flicker makes one frame of a pair brighter as a whole
        signal.append(mean)
        squared.append(difference**2 / 2.0)
    if not signal:
        raise InputError(f"response: {_named(pairs)}: nearly all pixels are saturated; add shorter exposures")
    levels, variances, counts = _levels(np.concatenate(signal), np.concatenate(squared))
    used = np.ones(len(levels), np.bool_)
    fit = _line(levels, variances, counts, used)
    for _ in range(10):
        predicted = fit.intercept + fit.slope * levels
        # Near the end of the scale noise is cut off: levels above the first that falls short are left out.
        short = (variances < _COLLAPSED * predicted) & (levels > np.median(levels))
        beyond = levels >= levels[short].min() if short.any() else np.zeros(len(levels), np.bool_)
        off = np.abs(variances - predicted) > _GROSS * predicted * np.sqrt(2.0 / counts)
        # A level that is off by less than 3 % is no gross error: it counts in chi^2.
        off &= np.abs(variances - predicted) > 0.03 * predicted
        now = ~beyond & ~off
        if now.sum() < 4 or (now == used).all():
            break
        used = now
        fit = _line(levels, variances, counts, used)
    if fit.slope <= 0.0 or fit.slope < 3.0 * np.sqrt(fit.covariance[1, 1]):
        raise InputError(
            "response: the variance of pixels does not grow with their signal; is the camera's picture processed, "
            "or the light the same in all frames?"
        )
    read_var = fit.intercept - ROUNDING_VARIANCE
    u_read_var = float(np.sqrt(fit.covariance[0, 0]))
    read = float(np.sqrt(max(read_var, u_read_var**2 / max(read_var, u_read_var))))
    gain = Estimate(fit.slope, float(np.sqrt(fit.covariance[1, 1])))
    by_intercept, by_gain = 1.0 / (2 * read * fit.slope), -read / fit.slope**2
    slopes = np.array([by_intercept, by_gain])
    u_read_e = float(np.sqrt(slopes @ fit.covariance @ slopes))
    peak = int(np.argmax(np.where(levels > 0, variances, 0.0)))
    saturated_seen = any(pair.saturated.any() for pair in pairs)
    saturation_dn = float(levels[peak])
    saturation_e = saturation_dn / fit.slope
    return PhotonTransfer(
        gain,
        Estimate(read, u_read_var / (2 * read)),
        Estimate(read / fit.slope, u_read_e),
        saturation_dn,
        Estimate(saturation_e, saturation_e * gain.u / gain.value),
        saturated_seen,
        _prnu(pairs),
        fit.covariance,
        fit.chi2_per_degree,
        levels,
        variances,
        variances * np.sqrt(2.0 / counts),
        used,
    )


def linearity(pairs: Sequence[Pair], range_dn: float, *, significance: float = 1e-3) -> Linearity:
    """Deviation from a line; its correction if a straight one would look like this less often than `significance`.

    Raises InputError with what is wrong: clipped, a scene that changed, flickering light, exposures that do not
    make it brighter.
    """
    _refuse_all_clipped(pairs)
    ordered = sorted(pairs, key=lambda pair: pair.exposure_us)
    signals, u_signals = _grouped(ordered)
    seen = np.asarray(np.isfinite(signals).any(axis=0))
    ordered = [pair for pair, use in zip(ordered, seen, strict=True) if use]
    signals, u_signals = signals[:, seen], u_signals[:, seen]
    exposures = np.array([pair.exposure_us for pair in ordered])
    if len(np.unique(exposures)) < 4:
        raise InputError(
            f"response: expected four exposures or more, found {len(np.unique(exposures))}; use a bracket"
        )
    flicker = _flicker(ordered)
    _refuse_contradictions(ordered, signals, flicker)
    known = np.isfinite(signals)
    start = np.nanmedian(signals / exposures, axis=1)
    scatter = max(flicker / np.sqrt(2.0), 1e-6)

    def residuals(p: Floats) -> Floats:
        c2, c3, t0, rates, light = (
            p[0],
            p[1],
            p[2] * 1e3,
            start * np.exp(p[3 : 3 + len(start)]),
            p[-len(exposures) :],
        )
        x = signals / range_dn
        made_linear = signals * (1.0 + x * (c2 + x * c3))
        expected = rates[:, None] * (exposures + t0) * (1.0 + light)
        left = (made_linear - expected) / u_signals
        return np.concatenate([left[known], light / scatter])

    fit = least_squares(residuals, np.zeros(3 + len(start) + len(exposures)), method="trf", x_scale="jac")
    degrees = max(1, len(fit.fun) - len(fit.x))
    factor = max(1.0, 2.0 * fit.cost / degrees)  # Birge: never better than the data agree
    covariance = np.linalg.pinv(fit.jac.T @ fit.jac) * factor
    coefficients, c_covariance = fit.x[:2], covariance[:2, :2]
    x = np.linspace(0.05, 0.95, 91)
    curve = x * coefficients[0] + x * x * coefficients[1]
    deviation = _from_line(x, curve)
    basis = np.stack([_from_line(x, x), _from_line(x, x * x)])
    worst = int(np.argmax(np.abs(deviation)))
    u_worst = float(np.sqrt(max(basis[:, worst] @ c_covariance @ basis[:, worst], 0.0)))
    unlikely = float(chi2.sf(coefficients @ np.linalg.solve(c_covariance, coefficients), 2))
    _refuse_other_scene(ordered, fit.fun[: known.sum()], known, signals, u_signals)
    rates = start * np.exp(fit.x[3 : 3 + len(start)])
    light = fit.x[-len(exposures) :]
    deviations = signals / (rates[:, None] * (exposures + 1e3 * fit.x[2]) * (1.0 + light)) - 1.0
    return Linearity(
        coefficients if unlikely < significance else np.zeros(2),
        c_covariance,
        range_dn,
        Estimate(float(1e3 * fit.x[2]), float(1e3 * np.sqrt(covariance[2, 2]))),
        float(abs(deviation[worst])),
        u_worst,
        exposures,
        deviations,
        signals,
        flicker,
    )


# -- photon transfer -----------------------------------------------------------------------------------------


@dataclass(frozen=True)
class _Line:
    intercept: float
    slope: float
    covariance: Floats
    chi2_per_degree: float


def _levels(signal: Floats, squared: Floats) -> tuple[Floats, Floats, Floats]:
    """Mean signal, mean squared difference over 2 and count, in levels of like signal."""
    order = np.argsort(signal, kind="stable")
    # Equal steps of signal, not of rank: a scene may have few bright pixels, and they say most of the gain.
    edges = np.linspace(signal[order[len(order) // 500]], signal[order[-1 - len(order) // 2000]], _LEVELS + 1)
    bins = np.clip(np.searchsorted(edges, signal, side="right") - 1, 0, _LEVELS - 1)
    counts = np.bincount(bins, minlength=_LEVELS).astype(float)
    keep = counts >= _LEAST_PIXELS
    if keep.sum() < 4:
        raise InputError(
            f"response: expected four or more levels of signal, found {int(keep.sum())}; bracket the exposure"
        )
    mean = np.bincount(bins, signal, _LEVELS)[keep] / counts[keep]
    variance = np.bincount(bins, squared, _LEVELS)[keep] / counts[keep]
    return mean, variance, counts[keep]


def _line(signal: Floats, variance: Floats, counts: Floats, used: NDArray[np.bool_]) -> _Line:
    """Weighted line; weights from the line itself, as weights from single variances would pull it down."""
    x, y, n = signal[used], variance[used], counts[used]
    expected = np.maximum(y, 1e-6)
    design = np.column_stack([np.ones_like(x), x])
    found, covariance = np.zeros(2), np.eye(2)
    for _ in range(6):
        weight = n / (2.0 * expected**2)
        covariance = np.asarray(np.linalg.inv(design.T @ (design * weight[:, None])), np.float64)
        found = covariance @ (design.T @ (weight * y))
        expected = np.maximum(design @ found, 0.05 * np.maximum(y, 1e-6))
    left = (y - design @ found) ** 2 * n / (2.0 * expected**2)
    per_degree = float(left.sum() / max(1, len(x) - 2))
    return _Line(float(found[0]), float(found[1]), covariance * max(1.0, per_degree), per_degree)


def _prnu(pairs: Sequence[Pair]) -> Estimate | None:
    """Relative scatter of the pixels' responses (EMVA 1288, 6.8), from the brightest even pair without saturation.

    In each block of neighbours a parabola stands for the scene; None where that is too poor for it.
    """
    clean = [pair for pair in pairs if not pair.saturated.any()]
    if not clean:
        return None
    pair = max(clean, key=lambda p: float(p.first.mean()))
    count = len(pair.first) // _BLOCK * _BLOCK
    a, b = (values[:count].reshape(-1, _BLOCK) for values in (pair.first, pair.second))
    level = 0.5 * (a + b).mean(axis=1)
    if (level <= 0).any():
        return None
    steps = np.linspace(-1.0, 1.0, _BLOCK)
    trend = np.linalg.qr(np.vander(steps, 3))[0]
    a, b = (values - (values @ trend) @ trend.T for values in (a, b))
    # The product of both frames' departures has no temporal noise in its mean.
    relative = (a * b).sum(axis=1) / (_BLOCK - 3) / level**2
    if np.mean(np.abs(relative) > 25 * np.median(np.abs(relative))) > 0.05:
        return None
    variance, u = float(relative.mean()), float(relative.std() / np.sqrt(len(relative)))
    if variance <= u:
        return None
    return Estimate(float(np.sqrt(variance)), u / (2 * float(np.sqrt(variance))))


# -- linearity -----------------------------------------------------------------------------------------------


def _grouped(pairs: Sequence[Pair]) -> tuple[Floats, Floats]:
    """[groups, exposures] mean signals of pixels of like brightness, and their standard uncertainties; NaN where
    some pixel of the group is saturated."""
    bright = max(pairs, key=lambda p: float(np.where(p.saturated.mean() < _CLIPPED_SHARE, p.first.mean(), -1.0)))
    # Blocks of neighbours are sorted, not pixels: sorted by its noise a pixel would look brighter than it is.
    blocks = np.arange(len(bright.first) // _BLOCK * _BLOCK).reshape(-1, _BLOCK)
    order = blocks[np.argsort((bright.first + bright.second)[blocks].mean(axis=1), kind="stable")]
    signals, u = np.full((_GROUPS, len(pairs)), np.nan), np.ones((_GROUPS, len(pairs)))
    for g, members in enumerate(map(np.ravel, np.array_split(order, _GROUPS))):
        for i, pair in enumerate(pairs):
            if pair.saturated[members].mean() > _CLIPPED_SHARE:
                continue
            mean = 0.5 * (pair.first[members] + pair.second[members])
            noise = np.std(pair.first[members] - pair.second[members]) / 2.0
            signals[g, i] = mean.mean()
            u[g, i] = max(noise / np.sqrt(len(members)), 1e-3)
    return signals, u


def _flicker(pairs: Sequence[Pair]) -> float:
    """Relative standard deviation of the light from frame to frame, from the two frames of each pair."""
    found = []
    for pair in pairs:
        keep = ~pair.saturated
        total = pair.first[keep].sum() + pair.second[keep].sum()
        if total > 0:
            found.append(2.0 * (pair.first[keep].sum() - pair.second[keep].sum()) / total)
    return float(np.sqrt(np.mean(np.square(found)) / 2.0))


def _refuse_contradictions(pairs: Sequence[Pair], signals: Floats, flicker: float) -> None:
    if flicker > 0.01:
        raise InputError(
            f"response: the light flickers by {flicker:.1%} from frame to frame; at most 1 % can be told from a "
            "bent response. Let it warm up, or take panels"
        )
    usable = np.isfinite(signals).sum(axis=0) >= _GROUPS // 3
    exposures = np.array([pair.exposure_us for pair in pairs])
    total = np.nanmean(np.where(np.isfinite(signals), signals, np.nan)[:, usable][: _GROUPS // 3], axis=0)
    steps = np.diff(exposures[usable]) > 0
    for place in np.flatnonzero(steps & (np.diff(total) <= 0)):
        names = [pair.name for pair, use in zip(pairs, usable, strict=True) if use]
        raise InputError(
            f"response: {names[place + 1]} is exposed longer than {names[place]} and yet not brighter; was the "
            "light off, or is the exposure time not what is written?"
        )


def _refuse_other_scene(
    pairs: Sequence[Pair], left: Floats, known: NDArray[np.bool_], signals: Floats, u_signals: Floats
) -> None:
    """Raise InputError if one exposure's groups of pixels do not have the others' ratios."""
    relative = np.full(known.shape, np.nan)
    relative[known] = left * u_signals[known] / signals[known]
    rms = np.sqrt(np.nanmean((relative - np.nanmean(relative, axis=0)) ** 2, axis=0))
    noise = np.sqrt(np.nanmean((u_signals / signals) ** 2, axis=0))
    worst = int(np.nanargmax(rms - _SCENE_SIGMA * noise))
    if rms[worst] > _CHANGED + _SCENE_SIGMA * noise[worst]:
        raise InputError(
            f"response: the scene is another one in {pairs[worst].name}; nothing may move while it is photographed"
        )


def _from_line(x: Floats, relative: Floats) -> Floats:
    """What is left of relative deviations after the best proportional line, in the middle of its extremes."""
    left: Floats = relative - 0.5 * (relative.max() + relative.min())
    return left


def _refuse_all_clipped(pairs: Sequence[Pair]) -> None:
    clipped = [pair for pair in pairs if pair.saturated.mean() > 0.5]
    if len(clipped) > len(pairs) - 4:
        raise InputError(
            f"response: more than half of the pixels are saturated in {_named(clipped)}; expected four exposures "
            "or more without. Add shorter ones"
        )


def _named(pairs: Sequence[Pair]) -> str:
    names = [pair.name for pair in pairs]
    return ", ".join(names[:4]) + (" and others" if len(names) > 4 else "")
