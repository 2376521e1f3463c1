"""Compares each frame with the frames of the neighbouring LEDs, to find an LED that is much too dim or bright.

A picture changes steadily with the direction of its light. So the picture under each LED is predicted from the
pictures of its nearest neighbours. The prediction is a weighted linear fit over directions, in units of the light
that the LED table gives each LED. The view itself shows how good the prediction is: its scatter sets the limits.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]
_NEIGHBOURS = 12
_FEWEST = 24
"""Least number of LEDs; with fewer, neighbours are too far away for a prediction."""
_RIDGE = 1e-2
_LIT = 0.3
"""Share of a place's median brightness. A place that is darker than this counts as if it had this brightness."""


def foretelling(directions: Floats) -> Floats | None:
    """Return [n, n] weights that predict the light from each of n directions [n, 3] from its neighbours; None if
    there are too few."""
    from scipy.spatial import cKDTree

    count = len(directions)
    if count < _FEWEST:
        return None
    distances, neighbours = cKDTree(directions).query(directions, k=_NEIGHBOURS + 1)
    weights = np.zeros((count, count))
    for row, direction in enumerate(directions):
        near, away = neighbours[row, 1:], distances[row, 1:]
        reach = away[len(away) // 2]
        across = np.linalg.svd(direction[None])[2][1:]  # two axes of the plane across the direction
        columns = np.column_stack([np.ones(len(near)), (directions[near] - direction) @ across.T / reach])
        weighted_columns = columns * np.exp(-0.5 * (away / reach) ** 2)[:, None]
        normal = weighted_columns.T @ columns + np.diag([0.0, _RIDGE, _RIDGE]) * weighted_columns[:, 0].sum()
        weights[row, near] = np.linalg.solve(normal, weighted_columns.T)[0]
    return weights


def shares_over_neighbours(tiles_dn: Floats, light: Floats, weights: Floats) -> Floats:
    """Return [n] the excess of the light in frames over the prediction from their neighbours, as a share of the
    prediction.

    Frames are the means of their tiles [n, tiles] under `light` [n] of the LED table. The weighted median of the
    tiles counts, so that a change in less than half of the picture has no effect.
    """
    per_light = tiles_dn / light[:, None]
    foretold = np.maximum(weights @ per_light, 0.0) * light[:, None]
    usual = np.median(per_light, axis=0)[None, :] * light[:, None]
    measure = np.maximum(np.maximum(foretold, _LIT * usual), 1e-9)
    ratio = (tiles_dn - foretold) / measure
    order = np.argsort(ratio, axis=1)
    weight = np.take_along_axis(measure, order, axis=1)
    half = np.argmax(np.cumsum(weight, axis=1) >= 0.5 * weight.sum(axis=1, keepdims=True), axis=1)
    return np.asarray(np.take_along_axis(ratio, order, axis=1)[np.arange(len(ratio)), half])


def scatter_of(values: Floats) -> float:
    """Return the standard deviation of most values; outliers have no effect."""
    return 1.4826 * float(np.median(np.abs(values)))
