"""Shadows of moving bodies: capsules between the lights and the sites of a view.

One segment from each site to the light's centre is tested exactly. For a few bodies this is faster than building a
new tree for each pose.
"""

from __future__ import annotations

import numba
import numpy as np
from numpy.typing import NDArray

from coupole.kernels import kernel

_CHUNK = 256
"""Number of sites for which the bodies that may hide the light are found together."""


def cast(
    radiance: NDArray[np.float32],
    points_mm: NDArray[np.float32],
    capsules_mm: NDArray[np.float64],
    light_mm: NDArray[np.float64],
) -> None:
    """Set `radiance` [n, 3] to 0 where a capsule of [m, 7] (two ends, radius) hides the light from a point [n, 3].

    Neighbours in the list should be neighbours in space, because groups of a few hundred are tested against the
    capsules near them.
    """
    if len(points_mm) > 0 and len(capsules_mm) > 0:
        _cast(radiance, points_mm, capsules_mm, light_mm)


def warm_up() -> None:
    """Compile, before the first frame is due."""
    capsules = np.array([[0.0, 0.0, 50.0, 0.0, 10.0, 50.0, 5.0]])
    cast(np.ones((1, 3), np.float32), np.zeros((1, 3), np.float32), capsules, np.array([0.0, 0.0, 100.0]))


@kernel
def distance_mm(a, b, c, d):  # type: ignore[no-untyped-def]
    """Distance of the segments a b and c d (Ericson, Real-Time Collision Detection, 5.1.9).

    Lines that are parallel within 1e-6 rad count as parallel. The distance is then too large by up to a millionth
    of their length.
    """
    along, across, between = b - a, d - c, a - c
    aa, cc, f = along @ along, across @ across, across @ between
    if aa < 1e-12:
        s, t = 0.0, (min(max(f / cc, 0.0), 1.0) if cc > 1e-12 else 0.0)
    else:
        g = along @ between
        if cc < 1e-12:
            s, t = min(max(-g / aa, 0.0), 1.0), 0.0
        else:
            h = along @ across
            below = aa * cc - h * h
            s = min(max((h * f - g * cc) / below, 0.0), 1.0) if below > 1e-12 * aa * cc else 0.0
            t = (h * s + f) / cc
            if t < 0.0:
                s, t = min(max(-g / aa, 0.0), 1.0), 0.0
            elif t > 1.0:
                s, t = min(max((h - g) / aa, 0.0), 1.0), 1.0
    gap = between + s * along - t * across
    return np.sqrt(gap @ gap)


@kernel(parallel=True)
def _cast(radiance, points, capsules, light):  # type: ignore[no-untyped-def]
    for part in numba.prange(-(-len(points) // _CHUNK)):
        first, last = part * _CHUNK, min(len(points), (part + 1) * _CHUNK)
        near = _near(points[first:last], capsules, light)
        at = np.empty(3)
        for i in range(first, last if len(near) else first):
            if radiance[i, 0] == 0.0 and radiance[i, 1] == 0.0 and radiance[i, 2] == 0.0:
                continue
            at[0], at[1], at[2] = points[i, 0], points[i, 1], points[i, 2]
            for k in near:
                if distance_mm(at, light, capsules[k, :3], capsules[k, 3:6]) < capsules[k, 6]:
                    radiance[i, :] = 0.0
                    break


@kernel
def _near(points, capsules, light):  # type: ignore[no-untyped-def]
    """Return the numbers of the capsules that may hide the light from any of a few points, found by a ball around
    these points."""
    middle, reach = np.empty(3), 0.0
    for k in range(3):
        low, high = np.float64(points[:, k].min()), np.float64(points[:, k].max())
        middle[k] = 0.5 * (low + high)
        reach += 0.25 * (high - low) ** 2
    reach = np.sqrt(reach)
    indices = np.empty(len(capsules), np.int64)
    count = 0
    for k in range(len(capsules)):
        if distance_mm(middle, light, capsules[k, :3], capsules[k, 3:6]) < capsules[k, 6] + reach:
            indices[count] = k
            count += 1
    return indices[:count]
