"""The tube round a leg that was found clear: how far an arm on its way is from where it would be."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

PATH_TOLERANCE_MM = 10.0


def path_deviation_mm(
    way_deg: Sequence[NDArray[np.float64]], joints_deg: NDArray[np.float64], reach_mm: NDArray[np.float64]
) -> float:
    """How far, at most, any point of arm and tool is from where it would be on the straight motions of `way_deg`
    ([6] each), with the axes at `joints_deg` [6]: the nearest place of the way is taken, and each axis' deviation
    there times the farthest that anything can be from that axis, `reach_mm` [6] (`CellBodies.reach_mm`)."""
    best = np.inf
    for a, b in pairwise([*way_deg, way_deg[-1]]):
        along, off = (b - a) * reach_mm, (joints_deg - a) * reach_mm
        length = float(along @ along)
        share = min(1.0, max(0.0, float(off @ along) / length)) if length else 0.0
        best = min(best, float(np.abs(off - share * along).sum()))
    return float(np.radians(best))
