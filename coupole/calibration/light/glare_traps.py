"""Black traps beside a white field in a picture: their places, and the light of their pixels."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]
Integers = NDArray[np.intp]

_DARK = 0.2
"""Share of the picture's white. A pixel below it may belong to a trap."""
_WHITE = 0.3
"""Least share of the picture's white that everything around a trap must have."""
_LEAST_CELLS = 12
"""Fewest cells of 2 x 2 pixels inside a trap."""
_RIM_CELLS = 2.0
"""Least width of a trap's rim, which is unsharp, in cells of 2 x 2 pixels."""
_RIM_SHARE = 0.2
"""Least width of the rim over half of the trap's width."""
_BESIDE_CELLS = 5
"""Width of the white around a trap that is read, in cells."""


@dataclass(frozen=True)
class Trap:
    """One trap in a picture, in cells of 2 x 2 pixels: each has pixels of all channels."""

    outer: Integers
    inner: Integers
    """[n, 2] rows and columns of the first pixels of its cells near the rim, and of the cells in its middle. The
    rim itself is left out. Less light from nearby reaches the middle."""
    beside: Integers
    """[n, 2] cells of the white around it."""

    @property
    def middle_px(self) -> tuple[float, float]:
        """x, y of the trap's middle."""
        row, column = np.concatenate([self.outer, self.inner]).mean(axis=0)
        return float(column) + 0.5, float(row) + 0.5


def find_traps(signal: NDArray[np.float32]) -> list[Trap]:
    """Find traps in a picture [h, w] of linear signal: dark places that are completely surrounded by white."""
    from scipy import ndimage

    height, width = (size // 2 * 2 for size in signal.shape)
    cells = signal[:height, :width].reshape(height // 2, 2, width // 2, 2).mean(axis=(1, 3))
    white = float(np.quantile(cells, 0.9))
    labels, _ = ndimage.label(cells < _DARK * white)
    traps = []
    for number, (rows, columns) in enumerate(ndimage.find_objects(labels), start=1):
        first_row, first_column = rows.start - _BESIDE_CELLS, columns.start - _BESIDE_CELLS
        last_row, last_column = rows.stop + _BESIDE_CELLS, columns.stop + _BESIDE_CELLS
        if first_row < 0 or first_column < 0 or last_row > cells.shape[0] or last_column > cells.shape[1]:
            continue
        window = np.s_[first_row:last_row, first_column:last_column]
        parts = _cells_of_trap(labels[window] == number, cells[window] >= _WHITE * white)
        if parts is not None:
            corner = np.array([first_row, first_column])
            traps.append(Trap(*(2 * (np.argwhere(part) + corner) for part in parts)))
    return traps


def _cells_of_trap(
    trap_mask: NDArray[np.bool_], is_white: NDArray[np.bool_]
) -> tuple[NDArray[np.bool_], NDArray[np.bool_], NDArray[np.bool_]] | None:
    """Return outer and inner cells of a trap, and the cells beside it. None if something that is not white is
    around the trap or in it, or if the trap is too small."""
    from scipy import ndimage

    near = ndimage.binary_dilation(trap_mask, iterations=2)
    beside = ndimage.binary_dilation(trap_mask, iterations=_BESIDE_CELLS) & ~near
    depth = ndimage.distance_transform_edt(trap_mask)
    inside = depth > max(_RIM_CELLS, _RIM_SHARE * float(depth.max()))
    is_full = np.array_equal(ndimage.binary_fill_holes(trap_mask), trap_mask)
    if not is_white[beside].all() or not is_full or np.count_nonzero(inside) < _LEAST_CELLS:
        return None
    deep = depth > np.median(depth[inside])
    return inside & ~deep, inside & deep, beside
