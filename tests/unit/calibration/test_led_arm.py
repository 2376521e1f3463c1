"""LEDs from an arm whose axes have zero errors, which the hand-eye record knows."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from domes import Dome, dome
from scipy.spatial.transform import Rotation
from test_led_record import WISH, images

from coupole.calibration.calibrated_arm import CalibratedArm
from coupole.calibration.leds.equations import Stated
from coupole.calibration.leds.workflow import LedsFound, leds_from
from coupole.kinematics import KR10_R1100_SIXX, forward

ZEROS_DEG = np.array([0.0, 0.03, -0.02, 0.025, -0.03, 0.02])
ARM = CalibratedArm(KR10_R1100_SIXX, ZEROS_DEG, 1e-8 * np.eye(11))


def off_by_axes(made: Dome, joints_deg: np.ndarray[tuple[int, ...], np.dtype[np.float64]]) -> Dome:
    """The same dome, its poses reported by an arm that does not know of its axes' zeros."""
    poses = []
    for pose, joints in zip(made.base_from_flange, joints_deg, strict=True):
        step = np.linalg.inv(forward(KR10_R1100_SIXX, joints)) @ forward(KR10_R1100_SIXX, joints + ZEROS_DEG)
        poses.append(pose @ np.linalg.inv(step))
    return replace(made, base_from_flange=np.stack(poses))


def found(
    made: Dome, joints_deg: np.ndarray[tuple[int, ...], np.dtype[np.float64]], arm: CalibratedArm | None
) -> LedsFound:
    seen = replace(images(made), joints_deg=joints_deg)
    return leds_from(seen, made.table, made.prior, WISH, stated=Stated(), arm=arm)


def test_axis_zeros_of_the_hand_eye_record_are_taken_out_of_the_poses() -> None:
    made = dome(1, views=24)
    random = np.random.default_rng(1)
    joints_deg = random.uniform(-60, 60, (24, 6)) + np.array([0, -90, 90, 0, 0, 0])
    wrong = off_by_axes(made, joints_deg)
    alone, corrected = (found(wrong, joints_deg, arm) for arm in (None, ARM))
    off_mm = [
        float(np.median(np.linalg.norm(one.new_table.positions_mm - made.true_mm, axis=1)))
        for one in (alone, corrected)
    ]
    assert off_mm[1] < 0.1
    assert off_mm[0] > 2 * off_mm[1]
    assert any("axis zeros" in remark for remark in corrected.record.remarks)
    assert not any("axis zeros" in remark for remark in alone.record.remarks)
    turns = Rotation.from_matrix(
        np.swapaxes(wrong.base_from_flange[:, :3, :3], 1, 2) @ made.base_from_flange[:, :3, :3]
    )
    assert np.degrees(turns.magnitude()).max() > 0.02, "the fault is there to be found"
