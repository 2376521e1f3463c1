"""A camera's response from photographs of one scene with several exposure times.

Debevec and Malik, "Recovering high dynamic range radiance maps from photographs" (SIGGRAPH 1997), Eq. 3: the
logarithm of exposure g(z) of each value z is found such that g(z) = ln E + ln t for all pixels and photographs.
This module differs in three points:

- The pixels' ln E are eliminated, so thousands of pixels cost little more than a few.
- The values are noisy. g is evaluated at the value that a pixel's mean predicts; the noisy value only adds g'
  times its difference. If g were evaluated at noisy values, least squares would prefer stairs and waves, which
  exposure steps of 4 do not contradict.
- g is a Gaussian process whose slope over ln z varies by an unknown amount. Each amount is weighted by the
  likelihood of the photographs under it. Some shapes, such as waves with the period of all exposure steps, cannot
  be determined from the photographs; the uncertainty includes them. A power law has no cost, so the response of a
  linear sensor comes out straight.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from coupole.errors import InputError
from coupole.exchange.bracket.photographs import Photographs

Array = NDArray[np.float64]
NODES = 256
SATURATED, DARK = 0.98, 0.01
"""A pixel gives only a bound if its value is at least the first or at most the second of these."""
_PIXELS = 3000
_WIDE = 2.6
"""Smallest factor between exposure times that leaves waves of the response undetermined: 4 leaves them
undetermined, 2 does not."""
_ROUNDS, _SMOOTH_ROUNDS, _OUTLIER = 10, 6, 4.0
"""Number of rounds of the fit; number of first rounds, which have a stiff response; standard deviations above
which a sample has less weight in the next round."""
_LEAST_FITTED, _MOST_FITTED = 0.02, 0.97
"""Range of predicted values in which samples are fitted. A selection by the noisy values would favour those with
high noise."""
_STIFF, _WANDERS = -2.0, np.arange(-7.0, 2.1, 0.25)
"""ln of the slope's variation: in the first rounds, and the values that are averaged afterwards."""
_POWER_WIDTH = 0.35
"""Width of the window in ln z over which a slope is computed for weights."""
_LEAST_POWER, _MOST_POWER = 0.3, 8.0
_QUANTIZATION = 0.29
"""Standard deviation of rounding, in levels."""
_MIDDLE = NODES // 2
_LOG_NODES = np.log(np.maximum(np.arange(NODES), 0.5))
"""ln of the nodes' values in steps; between nodes, g is linear in ln z."""
_OTHERS = np.arange(NODES) != _MIDDLE
"""Nodes other than the middle one, where g is 0."""


@dataclass(frozen=True)
class Response:
    """ln of exposure as a function of the value, for red, green and blue; 0 at half of the largest value."""

    log_exposure: Array
    """[NODES, 3] ln of exposure at evenly spaced values from 0 to 1."""
    covariance: Array
    """[3, NODES, NODES] covariance of `log_exposure`."""
    is_shown: NDArray[np.bool_]
    """[NODES, 3] False where no photograph has such values."""
    noise: Array
    """[3] standard deviation of values, from the residuals of the fit."""

    @property
    def uncertainty(self) -> Array:
        """[NODES, 3] standard uncertainty of `log_exposure`; inf where no photograph has such values."""
        sigma = np.sqrt(np.maximum(np.diagonal(self.covariance, axis1=1, axis2=2).T, 0.0))
        return np.where(self.is_shown, sigma, np.inf)

    def exposure(self, values: NDArray[np.floating], channel: int) -> Array:
        """Return the relative exposure of values."""
        return np.asarray(np.exp(_at(self.log_exposure[:, channel], values)))

    def slope(self, values: NDArray[np.floating], channel: int) -> Array:
        """Return d ln(exposure) / d value."""
        return _slope(_powers(self.log_exposure[:, channel]), values)

    def value(self, exposure: Array, channel: int) -> Array:
        """Return the value of an exposure."""
        return _value_of(np.log(np.maximum(exposure, 1e-300)), self.log_exposure[:, channel])

    def straightness(self) -> float:
        """Greatest relative deviation from a straight line through 0, for values of 0.1 to 0.9."""
        z = np.linspace(0.0, 1.0, NODES)
        inside = (z >= 0.1) & (z <= 0.9)
        off = self.log_exposure[inside] - np.log(z[inside])[:, None]
        return float(np.abs(np.exp(off - np.median(off, axis=0)) - 1.0).max())


def linear_response(noise: Array) -> Response:
    """Return the response of a sensor whose values are proportional to exposure."""
    curve = np.repeat((_LOG_NODES - _LOG_NODES[_MIDDLE])[:, None], 3, axis=1)
    return Response(curve, np.zeros((3, NODES, NODES)), np.ones((NODES, 3), bool), noise)


def found_response(photographs: Photographs) -> Response:
    """Return the response. Raises InputError if the photographs have too little in common."""
    least_noise = _QUANTIZATION / (photographs.levels - 1)
    channels = [
        _solve_curve(_samples(photographs.values[..., channel]), np.log(photographs.exposure_s), least_noise)
        for channel in range(3)
    ]
    curves, covariances, is_shown, noise = zip(*channels, strict=True)
    return Response(np.stack(curves, axis=1), np.stack(covariances), np.stack(is_shown, axis=1), np.array(noise))


def left_open(exposure_s: Array) -> str:
    """Return, in words, the part of a response that photographs with these times cannot determine; empty if there
    is none.

    If all times are the same factor apart, g(z) may contain any wave with that period in ln E, because no pixel
    contradicts it. The uncertainty includes the waves that the smoothness of the response allows.
    """
    factor = float(np.exp(np.diff(np.sort(np.log(exposure_s))).min()))
    if factor < _WIDE:
        return ""
    return (
        f"the exposures of all photographs differ by at least {factor:.1f} times: only the assumed smoothness "
        "excludes waves of the response, and u is larger for this reason; steps of 2, or raw files, determine "
        "the response better"
    )


def hat(values: Array) -> Array:
    """Debevec and Malik's weight, Eq. 4: 0 at both ends, 1 in the middle."""
    return np.asarray(np.where((values > DARK) & (values < SATURATED), 1.0 - np.abs(2.0 * values - 1.0), 0.0))


def _samples(values: NDArray[np.float32]) -> Array:
    """[pixels, photographs] values of pixels in uniform surroundings, evenly distributed over brightness."""
    middle = values[len(values) // 2]
    steep = np.hypot(*np.gradient(middle)) if min(middle.shape) > 1 else np.zeros_like(middle)
    useful = (hat(values.astype(float)) > 0.0).sum(axis=0) >= 2
    if np.count_nonzero(useful) < 50:
        raise InputError(
            "bracket: expected many pixels that are neither dark nor saturated in two photographs; found "
            f"{np.count_nonzero(useful)}; take photographs in steps of 2 times the exposure"
        )
    flat = useful & (steep <= np.quantile(steep[useful], 0.6))
    pixels = values[:, flat].T.astype(float)
    order = np.argsort(pixels.mean(axis=1), kind="stable")
    return np.asarray(pixels[order[np.linspace(0, len(order) - 1, min(_PIXELS, len(order))).astype(int)]])


@dataclass(frozen=True)
class _Fit:
    """The values that one round of the fit passes to the next round."""

    g: Array
    robust: Array
    """[pixels, photographs] weights, which are small for outliers."""
    noise: float


def _solve_curve(
    samples: Array, log_t: Array, least_noise: float
) -> tuple[Array, Array, NDArray[np.bool_], float]:
    """g [NODES], its covariance, the nodes that photographs show, and the noise of values."""
    start = 1.5 * (_LOG_NODES - _LOG_NODES[_MIDDLE])
    fit = _Fit(start, np.ones_like(samples), max(1.0 / 255.0, least_noise))
    for number in range(_ROUNDS):
        wanders = _WANDERS if number >= _SMOOTH_ROUNDS else np.array([_STIFF])
        fit, covariance_of_others, weights = _next_fit(fit, samples, log_t, wanders, least_noise)
    covariance = np.zeros((NODES, NODES))
    covariance[np.ix_(_OTHERS, _OTHERS)] = covariance_of_others
    counts = np.histogram(samples[weights > 0.0], bins=NODES, range=(0.0, 1.0))[0]
    bins, is_shown = np.flatnonzero(counts), np.zeros(NODES, bool)
    is_shown[bins.min() : bins.max() + 1] = True
    return fit.g, covariance, is_shown, fit.noise


def _next_fit(
    fit: _Fit, samples: Array, log_t: Array, wanders: Array, least_noise: float
) -> tuple[_Fit, Array, Array]:
    """Do one round: return the fit, its covariance without the middle node, and the weights."""
    rising, powers = np.maximum.accumulate(fit.g) + 1e-9 * np.arange(NODES), _powers(fit.g)
    weights = ((samples > DARK) & (samples < SATURATED)) * fit.robust
    predicted_values = _predict_values(samples, weights, log_t, rising, powers)
    usable = (predicted_values > _LEAST_FITTED) & (predicted_values < _MOST_FITTED) & (samples < SATURATED)
    usable &= usable.sum(axis=1, keepdims=True) > 1
    slope = _slope(powers, predicted_values)
    weights = usable * fit.robust / (slope * fit.noise) ** 2
    target = log_t - slope * (samples - predicted_values)
    normal = _normal_equations(predicted_values, weights, target)
    g, covariance = _average_curve(*normal, wanders)
    return _with_noise(g, weights, _at(g, predicted_values) - target, slope, least_noise), covariance, weights


def _predict_values(samples: Array, weights: Array, log_t: Array, g: Array, powers: Array) -> Array:
    """[pixels, photographs] the values that each pixel's mean predicts, in three steps with the local slopes."""
    predicted_values = samples
    for _ in range(3):
        slope = _slope(powers, predicted_values)
        logs = _at(g, predicted_values) + slope * (samples - predicted_values) - log_t
        predicted_values = _value_of(_pixel_means(weights / slope**2, logs) + log_t, g)
    return predicted_values


def _with_noise(g: Array, weights: Array, off: Array, slope: Array, least_noise: float) -> _Fit:
    """Return the fit with the noise of its residuals. `off` is the samples' ln of exposure minus the ln of the
    time."""
    free = 1.0 - weights / np.maximum(weights.sum(axis=1, keepdims=True), 1e-300)
    residuals = (off - _pixel_means(weights, off)) / slope / np.sqrt(np.maximum(free, 1e-3))
    noise = max(float(1.4826 * np.median(np.abs(residuals[(weights > 0.0) & (free > 0.2)]))), least_noise)
    return _Fit(g, 1.0 / (1.0 + (residuals / (_OUTLIER * noise)) ** 2) ** 2, noise)


def _pixel_means(weights: Array, logs: Array) -> Array:
    """[pixels, 1]."""
    total = np.maximum(weights.sum(axis=1, keepdims=True), 1e-300)
    return np.asarray((weights * logs).sum(axis=1, keepdims=True) / total)


def _normal_equations(predicted_values: Array, weights: Array, target: Array) -> tuple[Array, Array, float]:
    """Matrix and right side of the equations for g alone, and the sum of squares. Each pixel's ln E is its
    weighted mean."""
    from scipy.sparse import csr_matrix

    pixels, photographs = predicted_values.shape
    low, share = _place(predicted_values.ravel())
    rows = np.repeat(np.arange(len(low)), 2)
    columns = np.stack([low, low + 1], axis=1).ravel()
    shares = np.stack([1.0 - share, share], axis=1).ravel()
    design = csr_matrix((shares, (rows, columns)), (len(low), NODES))
    weighted_design = design.multiply(weights.reshape(-1, 1)).tocsr()
    owners = np.repeat(np.arange(pixels), photographs), np.arange(len(low))
    sums = (csr_matrix((np.ones(len(low)), owners), (pixels, len(low))) @ weighted_design).toarray()
    total = np.maximum(weights.sum(axis=1), 1e-300)
    target_sums = (weights * target).sum(axis=1)
    matrix = (design.T @ weighted_design).toarray() - sums.T @ (sums / total[:, None])
    right = np.asarray(weighted_design.T @ target.ravel()) - sums.T @ (target_sums / total)
    return matrix, right, float((weights * target**2).sum() - (target_sums**2 / total).sum())


def _average_curve(matrix: Array, right: Array, squares: float, wanders: Array) -> tuple[Array, Array]:
    """Return g [NODES], and its covariance without the middle node. Both are means over all amounts of variation,
    weighted by the likelihood of the samples. All amounts have the same prior (Hoeting et al., "Bayesian model
    averaging", Stat. Sci. 14, 382, 1999).
    """
    matrix, right, roughness = matrix[np.ix_(_OTHERS, _OTHERS)], right[_OTHERS], _roughness()
    log_likelihoods, curves = np.zeros(len(wanders)), np.zeros((len(wanders), NODES - 1))
    inverses = np.zeros((len(wanders), NODES - 1, NODES - 1))
    for number, wander in enumerate(wanders):
        stiff = matrix + roughness * np.exp(-2.0 * wander)
        inverses[number] = np.linalg.inv(stiff)
        curves[number] = inverses[number] @ right
        log_likelihoods[number] = -0.5 * (
            np.linalg.slogdet(stiff)[1] + 2.0 * (NODES - 2) * wander + squares - right @ curves[number]
        )
    shares = np.exp(log_likelihoods - log_likelihoods.max())
    shares /= shares.sum()
    g = np.zeros(NODES)
    g[_OTHERS] = shares @ curves
    off = curves - g[_OTHERS]
    covariance = np.tensordot(shares, inverses, 1) + np.einsum("w,wi,wj->ij", shares, off, off)
    return g, np.asarray(covariance)


def _roughness() -> Array:
    """[NODES - 1, NODES - 1] matrix of the squared changes of the slope over ln z, which are 0 for a power law.

    The slope may vary most at small values: the variance of a step is that of z, divided by the root of z.
    """
    step = np.diff(_LOG_NODES)
    change = np.zeros((NODES - 2, NODES))
    rows = np.arange(NODES - 2)
    change[rows, rows] = 1.0 / step[:-1]
    change[rows, rows + 1] = -1.0 / step[:-1] - 1.0 / step[1:]
    change[rows, rows + 2] = 1.0 / step[1:]
    z = np.arange(1, NODES - 1) / (NODES - 1.0)
    change *= np.sqrt(NODES * np.sqrt(z))[:, None]
    return np.asarray((change.T @ change)[np.ix_(_OTHERS, _OTHERS)])


def _powers(g: Array) -> Array:
    """[NODES] d g / d ln z from straight lines over a window."""
    even = np.linspace(_LOG_NODES[0], _LOG_NODES[-1], 600)
    at_even = np.interp(even, _LOG_NODES, g)
    window = np.exp(-0.5 * ((even[:, None] - even) / _POWER_WIDTH) ** 2)
    window /= window.sum(axis=1, keepdims=True)
    middle = window @ even
    slope = (window @ (even * at_even) - middle * (window @ at_even)) / (window @ even**2 - middle**2)
    return np.asarray(np.interp(_LOG_NODES, even, np.clip(slope, _LEAST_POWER, _MOST_POWER)))


def _slope(powers: Array, values: NDArray[np.floating]) -> Array:
    return np.asarray(_at(powers, values) / np.maximum(values, 0.5 / (NODES - 1)))


def _value_of(log_exposure: Array, g: Array) -> Array:
    rising = np.maximum.accumulate(g) + 1e-12 * np.arange(NODES)
    return np.asarray(np.exp(np.interp(log_exposure, rising, _LOG_NODES)) / (NODES - 1))


def _at(nodes: Array, values: NDArray[np.floating]) -> Array:
    """Return a quantity of the nodes at values, by linear interpolation in ln z."""
    return np.asarray(np.interp(_logs(values), _LOG_NODES, nodes))


def _place(values: Array) -> tuple[NDArray[np.intp], Array]:
    """Return the node below each value, and the weight of the node above."""
    low = np.minimum((np.clip(values, 0.0, 1.0) * (NODES - 1)).astype(int), NODES - 2)
    share = (_logs(values) - _LOG_NODES[low]) / (_LOG_NODES[low + 1] - _LOG_NODES[low])
    return low, np.clip(share, 0.0, 1.0)


def _logs(values: NDArray[np.floating]) -> Array:
    return np.asarray(np.log(np.maximum(np.asarray(values, float) * (NODES - 1), 0.5)))
