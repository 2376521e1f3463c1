"""Shadows of moving bodies: capsules between the lights and the visible triangles.

Tested exactly, one segment from each triangle's centroid to the light's centre: for a few bodies this is faster
than building a new tree for each pose.
"""

from __future__ import annotations

import numba
import numpy as np
from numpy.typing import NDArray


def cast(
    radiance: NDArray[np.float32],
    centroids_mm: NDArray[np.float32],
    capsules_mm: NDArray[np.float64],
    light_mm: NDArray[np.float64],
) -> None:
    """Set `radiance` [n, 3] to 0 where a capsule of [m, 7] (two ends, radius) hides the light from a centroid."""
    if len(centroids_mm) == 0 or len(capsules_mm) == 0:
        return
    low, high = centroids_mm.min(axis=0).astype(np.float64), centroids_mm.max(axis=0).astype(np.float64)
    middle, reach = 0.5 * (low + high), 0.5 * float(np.linalg.norm(high - low))
    near = [c for c in capsules_mm if distance_mm(middle, light_mm, c[:3], c[3:6]) < c[6] + reach]
    if near:
        _cast(radiance, centroids_mm, np.array(near), light_mm)


def warm_up() -> None:
    """Compile, before the first frame is due."""
    capsules = np.array([[0.0, 0.0, 50.0, 0.0, 10.0, 50.0, 5.0]])
    cast(np.ones((1, 3), np.float32), np.zeros((1, 3), np.float32), capsules, np.array([0.0, 0.0, 100.0]))


@numba.njit(cache=True, nogil=True)
def distance_mm(a, b, c, d):  # type: ignore[no-untyped-def]
    """Distance of the segments a b and c d (Ericson, Real-Time Collision Detection, 5.1.9).

    Lines that are parallel to 1e-6 rad count as parallel: up to a millionth of their length too far.
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


@numba.njit(cache=True, nogil=True, parallel=True)
def _cast(radiance, centroids, capsules, light):  # type: ignore[no-untyped-def]
    chunk = 4096
    for part in numba.prange(-(-len(centroids) // chunk)):
        at = np.empty(3)
        for i in range(part * chunk, min(len(centroids), (part + 1) * chunk)):
            if radiance[i, 0] == 0.0 and radiance[i, 1] == 0.0 and radiance[i, 2] == 0.0:
                continue
            at[0], at[1], at[2] = centroids[i, 0], centroids[i, 1], centroids[i, 2]
            for k in range(len(capsules)):
                if distance_mm(at, light, capsules[k, :3], capsules[k, 3:6]) < capsules[k, 6]:
                    radiance[i, :] = 0.0
                    break
