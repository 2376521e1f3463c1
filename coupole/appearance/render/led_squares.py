"""The LEDs of a dome's table for the renderer."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray


@dataclass(frozen=True)
class Leds:
    """The LED table: positions [n, 3] and normals [n, 3] in the base frame, flux [n] in lm."""

    ids: NDArray[np.int64]
    boards: NDArray[np.int64]
    positions_mm: NDArray[np.float64]
    normals: NDArray[np.float64]
    flux_lm: NDArray[np.float64]


def read_leds(path: Path) -> Leds:
    """Read the LEDs of a dome's CSV file: id, board, x_mm, y_mm, z_mm, nx, ny, nz, flux_lm; `#` starts a
    comment."""
    lines = [line for line in path.read_text().splitlines() if line and not line.startswith("#")]
    table = np.array([[float(v) for v in line.split(",")] for line in lines[1:]])
    return Leds(table[:, 0].astype(int), table[:, 1].astype(int), table[:, 2:5], table[:, 5:8], table[:, 8])
