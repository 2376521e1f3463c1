"""Path deviation: distance of the moving arm from its planned path."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

PATH_TOLERANCE_MM = 10.0


def path_deviation_mm(
    way_deg: Sequence[NDArray[np.float64]], joints_deg: NDArray[np.float64], reach_mm: NDArray[np.float64]
) -> float:
    """Upper bound of the distance of any point of arm and tool from the straight motions of `way_deg` ([6] each),
    with the axes at `joints_deg` [6]: for the nearest posture of the path, the sum over the axes of the deviation
    times the greatest distance of any point from that axis, `reach_mm` [6] (`CellBodies.reach_mm`)."""
    best = np.inf
    for a, b in pairwise([*way_deg, way_deg[-1]]):
        along, off = (b - a) * reach_mm, (joints_deg - a) * reach_mm
        length = float(along @ along)
        share = min(1.0, max(0.0, float(off @ along) / length)) if length else 0.0
        best = min(best, float(np.abs(off - share * along).sum()))
    return float(np.radians(best))
