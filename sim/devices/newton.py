"""Joint angles that bring a stand-in's flange to a pose, for any chain of six revolute joints."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence

import numpy as np
from numpy.typing import NDArray

from coupole.geometry import Transform

Chain = Callable[[Sequence[float]], tuple[Transform, NDArray[np.float64], NDArray[np.float64]]]
"""Function of six joint angles in degrees, which returns `base_from_flange` and, in the base frame, the joints'
origins in mm and their axes, each [6, 3]."""

_STEPS = 30
_REACH_MM = 1000.0
"""Scales millimetres against radians."""
_REACHED = 1e-10
"""Error at which the pose is reached: a tenth of a nanometre, or a few billionths of a degree."""
_DAMPING = 1e-10
_LONGEST_STEP = 0.2
_TINY = 1e-12


def joints_near(
    chain: Chain, base_from_flange: Transform, joints_deg: Sequence[float]
) -> tuple[float, ...] | None:
    """The joint angles that reach the pose from `joints_deg`, or None if the iteration does not converge.

    Damped Newton steps: Nakamura, Hanafusa, "Inverse Kinematic Solutions with Singularity Robustness" (1986).
    Limits are not checked. A controller that follows a pose works in the same way, from the present axes. Near a
    singularity the axes may turn fast, or have no solution.
    """
    angles = np.radians(np.asarray(joints_deg, dtype=np.float64))
    for _ in range(_STEPS):
        here, origins_mm, axes = chain(np.degrees(angles).tolist())
        away = np.zeros(6)
        away[:3] = (base_from_flange[:3, 3] - here[:3, 3]) / _REACH_MM
        away[3:] = rotation_vector(base_from_flange[:3, :3] @ here[:3, :3].T)
        if float(np.linalg.norm(away)) < _REACHED:
            return tuple(np.degrees(angles).tolist())
        jacobian = np.vstack([np.cross(axes, here[:3, 3] - origins_mm).T / _REACH_MM, axes.T])
        step = jacobian.T @ np.linalg.solve(jacobian @ jacobian.T + _DAMPING * np.eye(6), away)
        angles = angles + step * min(1.0, _LONGEST_STEP / float(np.abs(step).max()))
    return None


def rotation_vector(rotation: NDArray[np.float64]) -> NDArray[np.float64]:
    """[3]: axis times angle in radians of a 3x3 rotation by less than half a turn."""
    sines = 0.5 * (rotation - rotation.T)[[2, 0, 1], [1, 2, 0]]
    sine = float(np.linalg.norm(sines))
    if sine < _TINY:
        return sines
    vector: NDArray[np.float64] = sines / sine * math.atan2(sine, (float(np.trace(rotation)) - 1.0) / 2.0)
    return vector
