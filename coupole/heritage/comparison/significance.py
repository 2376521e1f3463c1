"""Significance of many differences: p-values with a noise estimated from the data, and a limit on false
discoveries.

If noise is correlated from point to point, or surfaces are sampled unevenly, differences scatter more than local
fits predict. Most of an object does not change, so the bulk of all differences shows their true scatter (an
empirical null: Efron, J. American Statistical Association 99, 2004). Uncertainties are enlarged to this scatter,
never reduced. At most 5 % of the marked points are expected to be unchanged (Benjamini, Hochberg, J. Royal
Statistical Society B 57(1), 1995).
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.special import fdtrc, fdtri, stdtr, stdtrit  # scipy.stats takes half a second to import

from coupole.heritage.comparison.state_files import Floats

FALSE_SHARE = 0.05
_BULK = 0.5
"""Quantile of the differences from which their scatter is estimated. If more than half of an object has changed,
the estimate is wrong."""


def of_lengths(differences: Floats, u: Floats, freedom: float) -> tuple[Floats, float]:
    """Return two-sided p-values of differences [n] with standard uncertainties [n], and the factor that enlarges
    the uncertainties."""
    ratio = np.abs(differences) / u
    factor = max(1.0, float(np.nanquantile(ratio, _BULK) / stdtrit(freedom, (1 + _BULK) / 2)))
    return np.asarray(2 * stdtr(freedom, -ratio / factor)), factor


def of_vectors(differences: Floats, covariances: Floats, freedom: float) -> tuple[Floats, float]:
    """Return p-values of differences [n, c] with covariances [n, c, c] (Hotelling's T2), and the factor that
    enlarges the uncertainties."""
    dimensions = differences.shape[1]
    statistic = np.full(len(differences), np.nan)
    is_known = np.isfinite(differences).all(axis=1) & np.isfinite(covariances).all(axis=(1, 2))
    columns = differences[is_known][:, :, None]
    statistic[is_known] = np.squeeze(
        np.swapaxes(columns, 1, 2) @ np.linalg.solve(covariances[is_known], columns), (1, 2)
    )
    freedom_left = freedom - dimensions + 1
    statistic *= freedom_left / (freedom * dimensions)
    bulk = np.nanquantile(statistic, _BULK) if is_known.any() else 0.0
    factor = max(1.0, float(np.sqrt(bulk / fdtri(dimensions, freedom_left, _BULK))))
    return np.asarray(fdtrc(dimensions, freedom_left, statistic / factor**2)), factor


def discoveries(p: Floats, false_share: float = FALSE_SHARE) -> NDArray[np.bool_]:
    """Return a mask of the significant p-values [n], for which at most the given share is expected to be false.
    NaN is not significant."""
    finite_rows = np.flatnonzero(np.isfinite(p))
    order = finite_rows[np.argsort(p[finite_rows])]
    under = p[order] <= false_share * np.arange(1, len(order) + 1) / max(1, len(order))
    is_discovery = np.zeros(len(p), bool)
    if under.any():
        is_discovery[order[: int(np.flatnonzero(under)[-1]) + 1]] = True
    return is_discovery
