"""Times of straight motions between all pairs of many postures. They are compiled, for `motion.path_planner`."""

from __future__ import annotations

import numpy as np

from coupole.kernels import kernel


@kernel
def pairwise_s(places_deg, velocity_deg_s, acceleration_deg_s2, jerk_deg_s3):  # type: ignore[no-untyped-def]
    """Return [n, n] durations, s, of the straight motions between all pairs of postures [n, 6], as
    `kinematics.move_durations_s` computes them. The limits are [6] each. The memory is one number per pair,
    however many postures there are."""
    n = len(places_deg)
    seconds = np.zeros((n, n))
    for a in range(n):
        for b in range(a):
            seconds[a, b] = seconds[b, a] = _seconds(
                places_deg[a], places_deg[b], velocity_deg_s, acceleration_deg_s2, jerk_deg_s3
            )
    return seconds


@kernel
def _seconds(from_deg, to_deg, velocity_deg_s, acceleration_deg_s2, jerk_deg_s3):  # type: ignore[no-untyped-def]
    v_most = a_most = j_most = np.inf
    longest_deg = 0.0
    for axis in range(6):
        way_deg = abs(to_deg[axis] - from_deg[axis])
        longest_deg = max(longest_deg, way_deg)
        share_of_deg = 1.0 / max(way_deg, 1e-9)
        v_most = min(v_most, velocity_deg_s[axis] * share_of_deg)
        a_most = min(a_most, acceleration_deg_s2[axis] * share_of_deg)
        j_most = min(j_most, jerk_deg_s3[axis] * share_of_deg)
    if longest_deg == 0.0:
        return 0.0
    ramp_of_jerk_s = a_most / j_most
    if j_most**2 >= 2.0 * a_most**3:
        v = min(v_most, (np.sqrt(ramp_of_jerk_s**2 + 4.0 / a_most) - ramp_of_jerk_s) * a_most / 2.0)
    else:
        v = min(v_most, np.cbrt(j_most / 4.0))
    if v >= a_most * ramp_of_jerk_s:
        return 1.0 / v + v / a_most + ramp_of_jerk_s
    return 1.0 / v + 2.0 * np.sqrt(v / j_most)
