"""Tells whether the samples determine a specular lobe. A lobe that is nearly nothing is stated in words, and not
drawn as noise."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

MOST_RELATIVE_U = 0.5
"""Relative standard uncertainty of ks above which a triangle's lobe cannot be distinguished from none."""
LEAST_HIGHLIGHT = 0.1
"""Brightness of the lobe in the mirror direction, as a share of the diffuse part, below which the lobe is not
visible. It is used for results that state no uncertainty."""
LEAST_SHARE = 0.02
"""Least share of the object with a determined lobe for which a map of lobes is drawn."""


def is_told_by_uncertainty(ks: NDArray[Any], u_relative: NDArray[Any]) -> NDArray[np.bool_]:
    """[n] True for a determined lobe, from ks [n, channels] and relative standard uncertainties [n]; NaN counts as
    not determined."""
    has_lobe = np.nan_to_num(np.asarray(ks).max(axis=1)) > 0
    return np.asarray(has_lobe & (np.nan_to_num(u_relative, nan=np.inf) <= MOST_RELATIVE_U))


def highlights(kd: NDArray[Any], ks: NDArray[Any], alpha: NDArray[Any]) -> NDArray[np.float64]:
    """Return the brightness [n] of a lobe in the mirror direction under a light along the normal, as a share of
    the diffuse part.

    In this direction D V = 1 / (4 pi alpha^2) (`coupole.reflectance.ggx`). kd and ks are [n, channels], alpha is
    [n].
    """
    diffuse = np.maximum(np.asarray(kd, np.float64).mean(axis=1), 1e-12)
    lobe = np.asarray(ks, np.float64).mean(axis=1) / (
        4 * np.pi * np.maximum(np.asarray(alpha, np.float64), 1e-3) ** 2
    )
    return np.asarray(np.nan_to_num(lobe / diffuse))


def no_lobe_in_words(share: float, reason: str) -> str:
    """Return a sentence that replaces a map that is not drawn."""
    return f"Specular lobe and roughness are not drawn: {reason} in {1 - share:.0%} of the object."
