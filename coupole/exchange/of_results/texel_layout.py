"""Positions of triangles' values in a square texture, one texel for each triangle."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from coupole.exchange.of_results.measured_surface import Floats


def side_of(count: int) -> int:
    """Width and height, px, of the texture of `count` triangles."""
    return max(1, math.ceil(math.sqrt(count)))


def middles(count: int) -> Floats:
    """[count, 2] middles of the texels, 0 to 1, to the right and down from the top left."""
    side = side_of(count)
    row, column = np.divmod(np.arange(count), side)
    return np.asarray((np.stack([column, row], axis=1) + 0.5) / side)


def texture(values: Floats) -> NDArray[np.float64]:
    """[side, side, k] texture of values [n, k], row by row; 0 where there is no triangle."""
    side = side_of(len(values))
    texels = np.zeros((side * side, values.shape[1]))
    texels[: len(values)] = values
    return texels.reshape(side, side, -1)
