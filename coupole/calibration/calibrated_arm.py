"""The arm as a hand-eye calibration describes it: zero errors of its axes, and the uncertainty of the hand-eye.

A hand-eye record that was made with the arm's model (`coupole calibrate hand-eye --rig`) is valid for poses that
are corrected by its axis zeros. Without this correction, an error of 0.02 degrees in the zero of an axis shifts
everything that the camera sees by a third of a millimetre. The shift is the same in every view, so no residual
shows it.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from coupole.calibration.arm_errors import axis_sensitivity
from coupole.calibration.posed_camera import HAND_EYE, CameraPrior
from coupole.calibration.record import intrinsics_of, read_record, step_names
from coupole.calibration.rotations import Floats, rotation
from coupole.kinematics import Arm

ZEROS = tuple(f"axis_zero.a{axis}_deg" for axis in range(2, 7))
"""Axis zeros that are estimated. A1 is not among them: it rotates everything about the base, and cannot be
distinguished from the direction of the base's x axis."""


@dataclass(frozen=True)
class CalibratedArm:
    """An arm's model with the axis zeros of a hand-eye record."""

    model: Arm
    zeros_deg: Floats
    """[6]; A1 stays 0."""
    covariance: Floats
    """[f + 6 + 5, f + 6 + 5] covariance of the lens, of the hand-eye's step (mm, rad) and of the zeros of A2 to A6
    (deg)."""


@dataclass(frozen=True)
class CarriedCamera:
    """A camera on an arm, as its records describe it."""

    prior: CameraPrior
    arm: CalibratedArm | None = None
    """None if the hand-eye record has no axis zeros."""


def has_axis_zeros(hand_eye: Path) -> bool:
    """Tell whether a hand-eye record was made with the arm's model."""
    return any(parameter.name in ZEROS for parameter in read_record(hand_eye).parameters)


def read_arm(hand_eye: Path, model: Arm) -> CalibratedArm:
    """Return the arm from a hand-eye record that `has_axis_zeros`."""
    record = read_record(hand_eye)
    names = [parameter.name for parameter in record.parameters]
    zeros_deg = np.array([0.0, *(record.value(name) for name in ZEROS)])
    lens = [name for name in names if name.removesuffix("_px") in intrinsics_of(record)[1]]
    at = [names.index(name) for name in (*lens, *step_names(HAND_EYE), *ZEROS)]
    units = np.ones(len(at))
    units[len(lens) + 3 : len(lens) + 6] = np.radians(1.0)
    return CalibratedArm(model, zeros_deg, record.covariance_matrix[np.ix_(at, at)] * np.outer(units, units))


def calibrated_poses(
    base_from_flange: Floats, joints_deg: Floats, arm: CalibratedArm, prior: CameraPrior
) -> tuple[Floats, CameraPrior]:
    """Return the reported poses [v, 4, 4] corrected by the axis zeros, and the camera's prior for them. The prior
    includes the uncertainty of the zeros."""
    sensitivity = axis_sensitivity(arm.model, joints_deg)
    arm_prior = replace(prior, covariance=arm.covariance, axis_sensitivity=sensitivity[:, :, 1:])
    return _poses_with_zeros(base_from_flange, sensitivity, arm), arm_prior


def corrected_poses(base_from_flange: Floats, joints_deg: Floats, arm: CalibratedArm) -> Floats:
    """Return the reported poses [v, 4, 4] corrected by the axis zeros."""
    return _poses_with_zeros(base_from_flange, axis_sensitivity(arm.model, joints_deg), arm)


def _poses_with_zeros(base_from_flange: Floats, sensitivity: Floats, arm: CalibratedArm) -> Floats:
    steps = sensitivity @ arm.zeros_deg
    moves = np.broadcast_to(np.eye(4), base_from_flange.shape).copy()
    moves[:, :3, :3], moves[:, :3, 3] = rotation(steps[:, 3:]), steps[:, :3]
    base_from_moved_flange: Floats = base_from_flange @ moves
    return base_from_moved_flange
