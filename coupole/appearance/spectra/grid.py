"""The wavelengths of every spectrum in this package: 380 to 780 nm by 5 nm, as in the papers (Dumazet et al. 2008,
section 3.4)."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray

from coupole.errors import InputError

Array = NDArray[np.float64]
Complex = NDArray[np.complex128]

FIRST_NM, LAST_NM, STEP_NM = 380.0, 780.0, 5.0
BANDS = 81
WAVELENGTHS_NM: Array = np.linspace(FIRST_NM, LAST_NM, BANDS)
WAVELENGTHS_NM.setflags(write=False)


def within(name: str, values: ArrayLike, low: float, high: float) -> Array:
    """Return `values` as float64. Raises InputError if a value is outside `low` to `high` or is not a number."""
    array = np.asarray(values, dtype=float)
    if not np.all((array >= low) & (array <= high)):
        worst = array[~((array >= low) & (array <= high))].flat[0]
        raise InputError(f"{name}: expected {low:g} to {high:g}, found {worst:g}; give a value in that range")
    return array
