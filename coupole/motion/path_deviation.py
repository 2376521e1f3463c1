"""Path deviation: distance of the moving arm from its planned path, now and at the place where it would come to
rest."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

PATH_TOLERANCE_MM = 10.0


def deviation_at_rest_mm(
    way_deg: Sequence[NDArray[np.float64]],
    joints_deg: NDArray[np.float64],
    speeds_deg_s: NDArray[np.float64],
    reach_mm: NDArray[np.float64],
    stopping_s: float,
) -> float:
    """Return an upper bound of the distance of any point of arm and tool from the straight motions of `way_deg`
    ([6] each). It is taken at the place where the arm comes to rest if it is stopped now.

    The axes are at `joints_deg` [6]. The first part of the bound is a sum over the axes for the nearest posture of
    the path: the deviation of an axis times the greatest distance of any point from it, `reach_mm` [6]
    (`CellBodies.reach_mm`). The second part is the speed across the path at `speeds_deg_s` [6], kept for
    `stopping_s`. An arm that is stopped brakes along its path, so its speed along it does not count."""
    off_mm, along = _nearest(way_deg, joints_deg, reach_mm)
    speeds_mm_s = np.radians(speeds_deg_s) * reach_mm
    length = float(along @ along)
    across_mm_s = speeds_mm_s - (float(speeds_mm_s @ along) / length if length else 0.0) * along
    return off_mm + stopping_s * float(np.abs(across_mm_s).sum())


def _nearest(
    way_deg: Sequence[NDArray[np.float64]], joints_deg: NDArray[np.float64], reach_mm: NDArray[np.float64]
) -> tuple[float, NDArray[np.float64]]:
    """Return the deviation from the nearest motion of the path, mm, and that motion [6], with each axis multiplied
    by its reach."""
    best, nearest = np.inf, np.zeros(6)
    for a, b in pairwise(way_deg) if len(way_deg) > 1 else [(way_deg[0], way_deg[0])]:
        along, off = (b - a) * reach_mm, (joints_deg - a) * reach_mm
        length = float(along @ along)
        share = min(1.0, max(0.0, float(off @ along) / length)) if length else 0.0
        deviation = float(np.abs(off - share * along).sum())
        if deviation < best:
            best, nearest = deviation, along
    return float(np.radians(best)), nearest
