"""Each frame against those of the neighbouring LEDs: an LED that is much too dim or bright.

A picture changes steadily with the direction of its light. So the picture under each LED is foretold from those of
its nearest neighbours, by a weighted linear fit over directions, in units of the light that the LED table gives
each. How well that does is measured on the view itself: its own scatter sets the limits.
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
"""Share of a place's median brightness below which it counts as if it were so bright."""


def foretelling(directions: Floats) -> Floats | None:
    """[n, n] weights by which the light from each of n directions [n, 3] is foretold from its neighbours; None for
    too few."""
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
    """[n] excess of the light in frames over the prediction by their neighbours, as a share of the prediction.

    Frames are the means of their tiles [n, tiles] under `light` [n] of the LED table. Of the tiles the weighted
    median counts, so that a change of less than half of the picture does not.
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
    """Standard deviation of most values, whatever the others are."""
    return 1.4826 * float(np.median(np.abs(values)))
