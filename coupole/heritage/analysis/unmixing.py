"""Pairs of references that explain a spectrum better than any single reference.

K/S of an opaque mixture is the weighted sum of its pigments' K/S if all scatter alike (Duncan 1949), and white
only scales it. Weights come from least squares of the relative residual. Two references are compared with one by
Schwarz's criterion (Ann. Stat. 6, 461, 1978). The logarithm of the number of choices is added for the search (Chen
and Chen, Biometrika 95, 759, 2008).

The interval of the shares contains the error of the weights, from the residuals, and the choice among pairs of the
same two classes. It does not contain the difference between batches of a pigment.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from coupole.appearance.spectra.grid import Array
from coupole.heritage.analysis.spectral_features import log_k_over_s

_LEAST_SHARE = 0.15
_MOST_RESIDUAL = 0.02
_LEAST_GAIN = 20.0
_MODEL, _NOISE = 0.01, 0.001
"""Relative error of K/S from the assumption of additivity, and noise of reflectance."""
_CORRELATED_BANDS = 3.0
"""Length, in bands, over which the model's error is correlated."""
_RATIOS = (0.0, 0.05, 0.25)
"""Ratios of the variance of the model's error to the variance of noise, relative to `_MODEL` and `_NOISE`."""
_LEAST_NOISE = 0.02
"""Variance of noise where the model limits the accuracy; with it, no band is without noise."""
_LEAST_RESIDUAL = 1e-8
_INDEPENDENT_EVERY = 3
"""Number of bands of 10 nm for one independent value; reflectances of neighbours are correlated."""


@dataclass(frozen=True)
class Unmixed:
    """The best pair of references of different classes."""

    references: tuple[int, int]
    """Numbers of the references, the larger share first."""
    shares: tuple[float, float]
    """Shares of the mixture's K/S, mean over the bands; they sum to 1."""
    share_interval: tuple[float, float]
    """Interval of 95 % of the larger share, from 0 to 1. The interval of the other share is 1 minus this one."""
    residual: float
    """Relative residual of K/S, rms."""
    gain: float
    """Schwarz's criterion of the best single reference minus the pair's criterion; more than 10 is very strong
    evidence (Kass and Raftery 1995)."""
    lead: float
    """Schwarz's criterion of the best pair of other classes minus this pair's criterion."""

    @property
    def is_settled(self) -> bool:
        """True if the spectrum is a mixture of these classes: K/S within 2 %, gain and lead of 20 or more."""
        return self.residual <= _MOST_RESIDUAL and min(self.gain, self.lead) >= _LEAST_GAIN


def unmix(reflectance: Array, references: Array, classes: NDArray[np.intp]) -> Unmixed | None:
    """Return the pair of `references` [n, bands], of different `classes` [n], whose mixture is nearest to a
    spectrum [bands]; None if no pair has two shares of 0.15 or more."""
    weight = weights_of_bands(reflectance)
    relative = np.exp(log_k_over_s(references) - log_k_over_s(reflectance)) * weight
    count, bands = relative.shape
    gram, target, whole = relative @ relative.T, relative @ weight, float(weight @ weight)
    single = whole - target**2 / np.diag(gram)
    first, second = np.triu_indices(count, 1)
    determinant = gram[first, first] * gram[second, second] - gram[first, second] ** 2
    with np.errstate(divide="ignore", invalid="ignore"):
        a = (gram[second, second] * target[first] - gram[first, second] * target[second]) / determinant
        b = (gram[first, first] * target[second] - gram[first, second] * target[first]) / determinant
    of_a, of_b = a * target[first], b * target[second]
    share = of_a / (of_a + of_b)
    is_allowed = (
        (classes[first] != classes[second])
        & (determinant > 1e-9 * gram[first, first] * gram[second, second])
        & (a > 0.0)
        & (b > 0.0)
        & (np.minimum(share, 1.0 - share) >= _LEAST_SHARE)
    )
    if not is_allowed.any():
        return None
    first, second, share = first[is_allowed], second[is_allowed], share[is_allowed]
    pair = np.maximum(whole - of_a[is_allowed] - of_b[is_allowed], 0.0)
    best = int(np.argmin(pair))
    independent = bands / _INDEPENDENT_EVERY
    floor = bands * 1e-6
    lowest, highest = classes[first], classes[second]
    lowest, highest = np.minimum(lowest, highest), np.maximum(lowest, highest)
    is_rival = (lowest != lowest[best]) | (highest != highest[best])
    rivals = pair[is_rival]

    def criterion(residual: float, parameters: int, choices: float) -> float:
        scatter = independent * np.log((residual + floor) / bands)
        return float(scatter + parameters * np.log(independent) + 2.0 * np.log(choices))

    of_pair = criterion(float(pair[best]), 2, count * (count - 1) / 2)
    order = (first[best], second[best]) if share[best] >= 0.5 else (second[best], first[best])
    larger = float(max(share[best], 1.0 - share[best]))
    # All pairs of the same two classes, with the class of the larger share first.
    kin = np.column_stack([first, second])[~is_rival]
    is_swapped = classes[kin[:, 0]] != classes[order[0]]
    kin[is_swapped] = kin[is_swapped, ::-1]
    return Unmixed(
        (int(order[0]), int(order[1])),
        (larger, 1.0 - larger),
        _share_interval(relative, weight, kin),
        float(np.sqrt(pair[best] / whole)),
        criterion(float(np.maximum(single.min(), 0.0)), 1, count) - of_pair,
        criterion(float(rivals.min()), 2, count * (count - 1) / 2) - of_pair if len(rivals) else np.inf,
    )


def _share_interval(relative: Array, weight: Array, pairs: NDArray[np.intp]) -> tuple[float, float]:
    """Return the interval of 95 % of the first share, by Student's t about the mean over pairs and ratios.

    Residuals are noise, and an error of the model that neighbouring bands share. Each pair is fitted with each
    ratio of the two, by generalised least squares, and counts by its restricted likelihood (Patterson and
    Thompson, Biometrika 58, 545, 1971).
    """
    from scipy.stats import t

    bands = len(weight)
    apart = np.abs(np.subtract.outer(np.arange(bands), np.arange(bands))) / _CORRELATED_BANDS
    smooth = np.outer(weight, weight) * np.exp(-0.5 * apart**2)
    designs = relative[pairs]
    shares, variances, likelihoods = [], [], []
    for ratio in _RATIOS:
        whitener = np.linalg.inv(np.linalg.cholesky(np.diag(1.0 + _LEAST_NOISE - weight**2) + ratio * smooth))
        x, y = designs @ whitener.T, whitener @ weight
        information = x @ x.swapaxes(1, 2)
        inverse = np.linalg.inv(information)
        estimate = np.einsum("pij,pjb,b->pi", inverse, x, y)
        residual = np.maximum(
            ((y - np.einsum("pi,pib->pb", estimate, x)) ** 2).sum(axis=1), _LEAST_RESIDUAL * bands
        )
        parts = estimate[:, :, None] * designs
        first = parts[:, 0] / parts.sum(axis=1)
        slope = ((first * (1.0 - first)) @ weight**2 / (weight @ weight))[:, None] / estimate
        gradient = slope * np.array([1.0, -1.0])
        shares.append(first @ weight**2 / (weight @ weight))
        variances.append(np.einsum("pi,pij,pj->p", gradient, inverse, gradient) * residual / (bands - 2.0))
        likelihoods.append(
            np.log(np.diag(whitener)).sum()
            - 0.5 * np.linalg.slogdet(information)[1]
            - 0.5 * (bands - 2.0) * np.log(residual)
        )
    share, variance, likelihood = (np.concatenate(values) for values in (shares, variances, likelihoods))
    probability = np.exp(likelihood - likelihood.max())
    probability /= probability.sum()
    mean = float(probability @ share)
    standard_uncertainty = float(np.sqrt(probability @ (variance + (share - mean) ** 2)))
    half_width = float(t.ppf(0.975, bands - 2.0)) * standard_uncertainty
    return max(mean - half_width, 0.0), min(mean + half_width, 1.0)


def weights_of_bands(reflectance: Array) -> Array:
    """[bands] weights of relative residuals of K/S: near 1 where the model limits the accuracy of K/S, less where
    noise of reflectance limits it."""
    r = np.clip(reflectance, 0.008, 0.99)
    noise = _NOISE * (1.0 + r) / (r * (1.0 - r))
    weight: Array = _MODEL / np.sqrt(_MODEL**2 + noise**2)
    return weight
