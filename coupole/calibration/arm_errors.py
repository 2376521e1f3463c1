"""Motion of an arm's flange by errors of its axes, the `axis_sensitivity` of the adjustment."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike

from coupole.calibration.rotations import Floats, between
from coupole.kinematics import Arm, forward

_STEP_DEG = 1e-3


def axis_sensitivity(arm: Arm, joints_deg: ArrayLike) -> Floats:
    """Return [n, 6, 6] for joints [n, 6]: the step of the flange in its own frame (mm, radians) for one degree of
    each axis."""
    joints = np.asarray(joints_deg, dtype=np.float64)
    sensitivity = np.empty((len(joints), 6, 6))
    for number, at in enumerate(joints):
        for axis in range(6):
            change = _STEP_DEG * np.eye(6)[axis]
            before, after = forward(arm, at - change), forward(arm, at + change)
            step = between(before, after) / (2 * _STEP_DEG)
            sensitivity[number, :, axis] = [*(before[:3, :3].T @ step[:3]), *step[3:]]
    return sensitivity
