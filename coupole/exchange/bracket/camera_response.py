"""A camera's response from photographs of one scene with several exposure times.

Debevec and Malik, "Recovering high dynamic range radiance maps from photographs" (SIGGRAPH 1997), Eq. 3: the
logarithm of exposure g(z) of each value z, such that g(z) = ln E + ln t for all pixels and photographs, by
least squares, with hat weights. What is different: the pixels' ln E are eliminated, so that thousands of
pixels cost no more than a few; g shall be smooth over ln z instead of z, which costs a power law nothing; and
it has a standard uncertainty, from what the photographs leave over.
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
"""Values from which on, and up to which, a pixel says nothing but a bound."""
_PIXELS = 3000
_SMOOTH = 0.3
_WIDE = 2.6
"""Least factor between exposure times that leaves waves of the response open: 4 does, 2 does not."""
_ROUNDS, _OUTLIER = 8, 4.0
"""Rounds of the fit; standard deviations from which on a sample counts for less in the next round."""
_MIDDLE = NODES // 2


@dataclass(frozen=True)
class Response:
    """ln of exposure by value, for red, green and blue; 0 at half of the largest value."""

    log_exposure: Array
    """[NODES, 3] at evenly spaced values from 0 to 1."""
    uncertainty: Array
    """[NODES, 3], standard, of `log_exposure`; inf where no photograph has such values."""
    noise: Array
    """[3], standard deviation of values, as the fit leaves it over."""

    def exposure(self, values: NDArray[np.float32], channel: int) -> Array:
        """Relative exposure of values."""
        return np.asarray(np.exp(_at(self.log_exposure[:, channel], values)))

    def slope(self, values: NDArray[np.floating], channel: int) -> Array:
        """d ln(exposure) / d value."""
        steps = np.gradient(self.log_exposure[:, channel], 1.0 / (NODES - 1))
        return np.asarray(np.maximum(_at(steps, values), 1e-3))

    def value(self, exposure: Array, channel: int) -> Array:
        """The value of an exposure."""
        rising = np.maximum.accumulate(self.log_exposure[:, channel])
        return np.interp(np.log(np.maximum(exposure, 1e-300)), rising, np.linspace(0.0, 1.0, NODES))

    def straightness(self) -> float:
        """Most relative departure from a straight line through 0, for values of 0.1 to 0.9."""
        z = np.linspace(0.0, 1.0, NODES)
        inside = (z >= 0.1) & (z <= 0.9)
        off = self.log_exposure[inside] - np.log(z[inside])[:, None]
        return float(np.abs(np.exp(off - np.median(off, axis=0)) - 1.0).max())


def linear_response(noise: Array) -> Response:
    """Return the response of a sensor whose values are proportional to exposure."""
    z = np.maximum(np.linspace(0.0, 1.0, NODES), 0.5 / NODES)
    curve = np.repeat((np.log(z) - np.log(z[_MIDDLE]))[:, None], 3, axis=1)
    return Response(curve, np.zeros((NODES, 3)), noise)


def found_response(photographs: Photographs) -> Response:
    """Raises InputError where the photographs have too little in common."""
    curves, uncertain, noise = [], [], []
    for channel in range(3):
        samples = _samples(photographs.values[..., channel])
        curve, sigma, value_noise = _solve_curve(samples, np.log(photographs.exposure_s))
        curves.append(curve)
        uncertain.append(sigma)
        noise.append(value_noise)
    return Response(np.stack(curves, axis=1), np.stack(uncertain, axis=1), np.array(noise))


def left_open(exposure_s: Array) -> str:
    """Return, in words, what photographs of these times cannot tell of a response; empty if they can tell all.

    With all times a factor apart, g(z) may have any wave of that period in ln E, which no pixel contradicts.
    """
    factor = float(np.exp(np.diff(np.sort(np.log(exposure_s))).min()))
    if factor < _WIDE:
        return ""
    return (
        f"no two photographs are nearer than {factor:.1f} times in exposure: the response may have waves of "
        "several percent, which the uncertainty does not have; take steps of 2, or raw files"
    )


def hat(values: Array) -> Array:
    """Debevec and Malik's weight, Eq. 4: 0 at both ends, 1 in the middle."""
    return np.asarray(np.where((values > DARK) & (values < SATURATED), 1.0 - np.abs(2.0 * values - 1.0), 0.0))


def _samples(values: NDArray[np.float32]) -> Array:
    """[pixels, photographs] of pixels in flat surroundings, evenly by their brightness."""
    middle = values[len(values) // 2]
    steep = np.hypot(*np.gradient(middle)) if min(middle.shape) > 1 else np.zeros_like(middle)
    useful = (hat(values.astype(float)) > 0.0).sum(axis=0) >= 2
    if np.count_nonzero(useful) < 50:
        raise InputError(
            "bracket: expected many pixels that two photographs show, neither dark nor saturated; found "
            f"{np.count_nonzero(useful)}; take photographs in steps of 2 times the exposure"
        )
    flat = useful & (steep <= np.quantile(steep[useful], 0.6))
    pixels = values[:, flat].T.astype(float)
    order = np.argsort(pixels.mean(axis=1), kind="stable")
    return np.asarray(pixels[order[np.linspace(0, len(order) - 1, min(_PIXELS, len(order))).astype(int)]])


def _solve_curve(samples: Array, log_t: Array) -> tuple[Array, Array, float]:
    """g [NODES], its uncertainty, and the noise of values. What moved between photographs counts for little."""
    weights = hat(samples)
    for _ in range(_ROUNDS):
        g, inverse = _fit_curve(samples, weights, log_t)
        off, noise = _left_over(samples, weights, g, log_t)
        slope = np.maximum(_at(np.gradient(g, 1.0 / (NODES - 1)), samples), 1e-3)
        weights = hat(samples) / (1.0 + (off / (_OUTLIER * noise * slope)) ** 2) ** 2
    free = max(1, int((weights > 0.0).sum()) - len(samples) - NODES // 8)
    uncertain = np.sqrt(np.maximum(np.diag(inverse) * float((weights * off**2).sum() / free), 0.0))
    bins = np.flatnonzero(np.histogram(samples[weights > 0.0], bins=NODES, range=(0.0, 1.0))[0])
    uncertain[: bins.min()] = np.inf
    uncertain[bins.max() + 1 :] = np.inf
    return g, uncertain, noise


def _fit_curve(samples: Array, weights: Array, log_t: Array) -> tuple[Array, Array]:
    """g [NODES], and the inverse of its normal equations."""
    matrix, target = _normal_equations(samples, weights, log_t)
    gauge = np.zeros((NODES, NODES))
    gauge[_MIDDLE, _MIDDLE] = max(np.trace(matrix), 1.0)
    inverse = np.linalg.inv(matrix + _SMOOTH * np.trace(matrix) / NODES * _roughness() + gauge)
    g = inverse @ target
    return g - g[_MIDDLE], inverse


def _left_over(samples: Array, weights: Array, g: Array, log_t: Array) -> tuple[Array, float]:
    """Each sample less its pixel's mean, in ln of exposure; and the noise of values that this means."""
    logs = _at(g, samples) - log_t
    mean = (weights * logs).sum(axis=1, keepdims=True) / np.maximum(weights.sum(axis=1, keepdims=True), 1e-12)
    slope = np.maximum(_at(np.gradient(g, 1.0 / (NODES - 1)), samples), 1e-3)
    typical = np.median(np.abs((logs - mean) / slope)[weights > 0.2])
    return logs - mean, float(1.4826 * typical * np.sqrt(samples.shape[1] / (samples.shape[1] - 1.0)))


def _normal_equations(samples: Array, weights: Array, log_t: Array) -> tuple[Array, Array]:
    """Return the normal equations of g alone: each pixel's ln E is its weighted mean."""
    place = np.clip(samples, 0.0, 1.0) * (NODES - 1)
    low = np.minimum(place.astype(int), NODES - 2)
    share = place - low
    matrix, target = np.zeros((NODES, NODES)), np.zeros(NODES)
    mean = np.zeros((len(samples), NODES))
    pixels = np.arange(len(samples))
    for photograph, t in enumerate(log_t):
        w, a, s = weights[:, photograph], low[:, photograph], share[:, photograph]
        for first, of_first in ((a, 1.0 - s), (a + 1, s)):
            np.add.at(mean, (pixels, first), w * of_first)
            np.add.at(target, first, w * of_first * t)
            for second, of_second in ((a, 1.0 - s), (a + 1, s)):
                np.add.at(matrix, (first, second), w * of_first * of_second)
    total = np.maximum(weights.sum(axis=1), 1e-12)
    matrix -= mean.T @ (mean / total[:, None])
    target -= mean.T @ ((weights @ log_t) / total)
    return matrix, target


def _roughness() -> Array:
    """[NODES, NODES], squares of the change of slope over ln z, which a power law does not have."""
    u = np.log(np.arange(NODES) + 0.5)
    step = np.diff(u)
    change = np.zeros((NODES - 2, NODES))
    rows = np.arange(NODES - 2)
    change[rows, rows] = 1.0 / step[:-1]
    change[rows, rows + 1] = -1.0 / step[:-1] - 1.0 / step[1:]
    change[rows, rows + 2] = 1.0 / step[1:]
    return np.asarray(change.T @ change / NODES)


def _at(nodes: Array, values: NDArray[np.floating]) -> Array:
    return np.asarray(np.interp(values, np.linspace(0.0, 1.0, NODES), nodes))
