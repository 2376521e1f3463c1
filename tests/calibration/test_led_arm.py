"""LEDs from an arm whose axes have zero errors, which the hand-eye record knows, and how well."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
from arms import KR10_R1100_SIXX
from domes import Dome, dome
from scipy.linalg import block_diag
from scipy.spatial.transform import Rotation
from synthesis import Array
from test_led_record import REQUEST, images

from coupole.calibration.calibrated_arm import CalibratedArm
from coupole.calibration.leds.equations import Stated
from coupole.calibration.leds.workflow import LedsFound, leds_from
from coupole.kinematics import forward

ZEROS_DEG = np.array([0.0, 0.03, -0.02, 0.025, -0.03, 0.02])
VIEWS = 24


def arm_of(made: Dome, off_deg: Array, u_deg: float) -> CalibratedArm:
    """The arm by a record whose zeros are off by so much, and say that they are known to `u_deg`."""
    covariance = block_diag(made.prior.covariance, u_deg**2 * np.eye(5))
    return CalibratedArm(KR10_R1100_SIXX, ZEROS_DEG + np.array([0.0, *off_deg]), covariance)


def postures(random: np.random.Generator) -> Array:
    return random.uniform(-60, 60, (VIEWS, 6)) + np.array([0, -90, 90, 0, 0, 0])


def off_by_axes(made: Dome, joints_deg: Array) -> Dome:
    """The same dome, its poses reported by an arm that does not know of its axes' zeros."""
    poses = []
    for pose, joints in zip(made.base_from_flange, joints_deg, strict=True):
        step = np.linalg.inv(forward(KR10_R1100_SIXX, joints)) @ forward(KR10_R1100_SIXX, joints + ZEROS_DEG)
        poses.append(pose @ np.linalg.inv(step))
    return replace(made, base_from_flange=np.stack(poses))


def found(made: Dome, joints_deg: Array, arm: CalibratedArm | None) -> LedsFound:
    seen = replace(images(made), joints_deg=joints_deg)
    return leds_from(seen, made.table, made.prior, REQUEST, stated_noise=Stated(), arm=arm)


def test_axis_zeros_of_the_hand_eye_record_are_taken_out_of_the_poses() -> None:
    made = dome(1, views=VIEWS)
    joints_deg = postures(np.random.default_rng(1))
    wrong = off_by_axes(made, joints_deg)
    arm = arm_of(made, np.zeros(5), 1e-4)
    alone, corrected = (found(wrong, joints_deg, one) for one in (None, arm))
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


def test_intervals_hold_with_what_is_left_of_the_zero_errors(scale: Callable[[int, int], int]) -> None:
    domes, u_deg = scale(6, 100), 0.01
    normalised = []
    for seed in range(domes):
        made = dome(200 + seed, views=VIEWS)
        random = np.random.default_rng(seed)
        joints_deg = postures(random)
        arm = arm_of(made, random.normal(0.0, u_deg, 5), u_deg)
        geometry = found(off_by_axes(made, joints_deg), joints_deg, arm).geometry
        off = geometry.centres_mm - made.true_mm
        whole = np.linalg.cholesky(geometry.centre_covariance)
        normalised.append(np.linalg.solve(whole, off[:, :, None]))
    z = np.concatenate(normalised)
    slack = 0.25 if domes < 20 else 0.0  # LEDs of one dome share their arm's errors
    assert 0.90 - slack / 2 <= np.mean(np.abs(z) < 1.96) <= 0.99 + slack
    assert 0.8 - slack < np.sqrt(np.mean(z**2)) < 1.25 + slack
