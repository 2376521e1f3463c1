"""Pairs of references that explain a spectrum better than any single reference.

K/S of an opaque mixture is the weighted sum of its pigments' K/S if all scatter alike (Duncan 1949), and white
only scales it. Weights come from least squares of the relative residual. Two references are compared with one by
Schwarz's criterion (Ann. Stat. 6, 461, 1978). The logarithm of the number of choices is added for the search (Chen
and Chen, Biometrika 95, 759, 2008).
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
_INDEPENDENT_EVERY = 3
"""Number of bands of 10 nm for one independent value; reflectances of neighbours are correlated."""


@dataclass(frozen=True)
class Unmixed:
    """The best pair of references of different classes."""

    references: tuple[int, int]
    """Numbers of the references, the larger share first."""
    shares: tuple[float, float]
    """Shares of the mixture's K/S, mean over the bands; they sum to 1."""
    residual: float
    """Relative residual of K/S, rms."""
    gain: float
    """Schwarz's criterion of the best single reference minus that of the pair; more than 10 is very strong
    evidence (Kass and Raftery 1995)."""
    lead: float
    """Schwarz's criterion of the best pair of other classes minus that of this pair."""

    @property
    def is_settled(self) -> bool:
        """True if the spectrum is a mixture of these classes: K/S within 2 %, gain and lead of 20 or more."""
        return self.residual <= _MOST_RESIDUAL and min(self.gain, self.lead) >= _LEAST_GAIN


def unmix(reflectance: Array, references: Array, classes: NDArray[np.intp]) -> Unmixed | None:
    """Return the pair of `references` [n, bands], of different `classes` [n], whose mixture is nearest to a
    spectrum [bands]; None if no pair has two shares of 0.15 or more."""
    weight = _weight(reflectance)
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
    rivals = pair[(lowest != lowest[best]) | (highest != highest[best])]

    def criterion(residual: float, parameters: int, choices: float) -> float:
        scatter = independent * np.log((residual + floor) / bands)
        return float(scatter + parameters * np.log(independent) + 2.0 * np.log(choices))

    of_pair = criterion(float(pair[best]), 2, count * (count - 1) / 2)
    order = (first[best], second[best]) if share[best] >= 0.5 else (second[best], first[best])
    larger = float(max(share[best], 1.0 - share[best]))
    return Unmixed(
        (int(order[0]), int(order[1])),
        (larger, 1.0 - larger),
        float(np.sqrt(pair[best] / whole)),
        criterion(float(np.maximum(single.min(), 0.0)), 1, count) - of_pair,
        criterion(float(rivals.min()), 2, count * (count - 1) / 2) - of_pair if len(rivals) else np.inf,
    )


def _weight(reflectance: Array) -> Array:
    """[bands] weights: near 1 where the model limits the accuracy of K/S, less where noise of reflectance limits
    it."""
    r = np.clip(reflectance, 0.008, 0.99)
    noise = _NOISE * (1.0 + r) / (r * (1.0 - r))
    weight: Array = _MODEL / np.sqrt(_MODEL**2 + noise**2)
    return weight
