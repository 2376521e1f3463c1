"""Half widths of intervals that are valid in each stratum: quantiles of residuals over a predicted scale, by
strata.

Samples are divided into strata in several ways, and each stratum has a factor. The factors are adjusted in turn
until the interval contains the wanted share in all strata at once (multivalid conformal prediction: Jung et al.
2023, algorithm 1). With one way to divide, this is Mondrian conformal prediction (Vovk et al. 2003). The factor of
a small stratum is shrunk towards 1.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]
Labels = Mapping[str, NDArray[np.int64]]
"""Number [n] of each sample's stratum, 0 to `MOST_STRATA` - 1, for each way to divide the samples."""

MOST_STRATA = 100
_ROUNDS = 6
_SHRINK_LIGHTS = 3.0
"""Number of lights at which a stratum's factor has half of its weight."""
_SHRINK_SAMPLES = 200.0
"""Number of samples at which a stratum's factor has half of its weight."""


@dataclass(frozen=True)
class StratumFactors:
    """Logarithm of a quantile for all samples, and the amount that each stratum adds to it."""

    log_quantile: float
    log_factors: dict[str, Floats]
    """[`MOST_STRATA`] logarithms of factors for each way to divide; 0 for a stratum without samples."""

    def quantiles(self, labels: Labels) -> Floats:
        """Return the quantile [n] of each sample, from all its strata."""
        logs = [factors[labels[name]] for name, factors in self.log_factors.items()]
        return np.asarray(np.exp(self.log_quantile + np.sum(logs, axis=0)), dtype=np.float64)


def fit_strata(ratios: Floats, labels: Labels, lights: NDArray[np.int64], level: float) -> StratumFactors:
    """Fit factors so that in each stratum the share `level` of the `ratios` [n], residual over scale, is below the
    quantile. `lights` [n] are the lights of the samples; residuals under one light are correlated."""
    log_quantile = float(np.log(max(np.quantile(ratios, level), 1e-12)))
    factors = {name: np.zeros(MOST_STRATA) for name in labels}
    log_ratios = np.log(np.maximum(ratios, 1e-12)) - log_quantile
    strata = [
        (name, number, samples, _trust(lights[samples]))
        for name in labels
        for number, samples in _members(labels[name])
    ]
    for _ in range(_ROUNDS):
        for name, number, samples, trust in strata:
            step = trust * float(np.quantile(log_ratios[samples], level))
            factors[name][number] += step
            log_ratios[samples] -= step
    return StratumFactors(log_quantile, factors)


def _members(labels: NDArray[np.int64]) -> list[tuple[int, NDArray[np.int64]]]:
    """Return each stratum's number and its samples."""
    return [(int(number), np.flatnonzero(labels == number)) for number in np.unique(labels)]


def _trust(lights: NDArray[np.int64]) -> float:
    """Return the weight of a stratum's own factor, 0 to 1, from its number of samples and its effective number of
    lights (Kish 1965)."""
    counts = np.bincount(lights).astype(np.float64)
    effective = float(counts.sum() ** 2 / np.sum(counts**2))
    return effective / (effective + _SHRINK_LIGHTS) * len(lights) / (len(lights) + _SHRINK_SAMPLES)
