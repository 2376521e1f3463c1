"""The arm's kinematics, against the data sheet, the stand-in's own chain of joints, and itself."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray

from coupole.geometry import abc_from_rotation, transform
from coupole.kinematics import (
    KR10_R1100_SIXX,
    forward,
    inverse,
    limit_margin_deg,
    limit_violations,
    move_duration_s,
    nearest,
    slowed,
    unreachable_reason,
    within_limits,
)
from sim.kuka_kinematics import flange_pose

HOME_DEG = (0.0, -90.0, 90.0, 0.0, 90.0, 0.0)


def random_joints_deg(count: int, seed: int) -> NDArray[np.float64]:
    low, high = np.array(KR10_R1100_SIXX.limits_deg).T
    return np.random.default_rng(seed).uniform(low, high, (count, 6))


def test_home_is_where_the_data_sheet_says() -> None:
    pose = forward(KR10_R1100_SIXX, HOME_DEG)
    assert np.allclose(pose[:3, 3], (540.0, 0.0, 915.0), atol=1e-9)
    assert np.allclose(abc_from_rotation(pose[:3, :3]), (180.0, 0.0, 180.0), atol=1e-9)


def test_driver_and_stand_in_agree_on_where_the_flange_is() -> None:
    joints_deg = random_joints_deg(500, seed=1)
    poses = forward(KR10_R1100_SIXX, joints_deg)
    for pose, joints in zip(poses, joints_deg, strict=True):
        assert np.allclose(pose, flange_pose(joints.tolist()), rtol=0.0, atol=1e-9)


def test_every_solution_reaches_the_pose_and_the_original_is_among_them() -> None:
    joints_deg = random_joints_deg(3000, seed=2)
    for joints, pose in zip(joints_deg, forward(KR10_R1100_SIXX, joints_deg), strict=True):
        solutions = inverse(KR10_R1100_SIXX, pose)
        assert within_limits(KR10_R1100_SIXX, solutions)
        assert np.max(np.abs(forward(KR10_R1100_SIXX, solutions)[:, :3, 3] - pose[:3, 3])) < 1e-6
        assert np.min(np.max(np.abs(solutions - joints), axis=1)) < 1e-5


@pytest.mark.parametrize(
    "joints_deg",
    [
        (20.0, -187.5, 60.0, 15.0, 45.0, -30.0),
        (20.0, -180.5, -10.0, 15.0, -45.0, -30.0),
        (0.0, -90.0, 90.0, 183.0, 40.0, 0.0),
        (0.0, -90.0, 90.0, -183.0, 40.0, 345.0),
        (0.0, -90.0, 90.0, 10.0, 40.0, -349.0),
        (170.0, -190.0, 156.0, 185.0, 120.0, 350.0),
    ],
)
def test_angles_past_a_half_turn_are_found(joints_deg: tuple[float, ...]) -> None:
    solutions = inverse(KR10_R1100_SIXX, forward(KR10_R1100_SIXX, joints_deg))
    assert np.min(np.max(np.abs(solutions - np.array(joints_deg)), axis=1)) < 1e-6


@pytest.mark.parametrize("a6_deg", [-200.0, 0.0, 33.0])
def test_a_stretched_wrist_is_no_dead_end(a6_deg: float) -> None:
    pose = forward(KR10_R1100_SIXX, (10.0, -80.0, 70.0, 0.0, 0.0, a6_deg))
    solutions = inverse(KR10_R1100_SIXX, pose)
    assert np.min(np.max(np.abs(solutions - (10.0, -80.0, 70.0, 0.0, 0.0, a6_deg)), axis=1)) < 1e-5
    assert np.max(np.abs(forward(KR10_R1100_SIXX, solutions) - pose)) < 1e-6


def test_the_nearest_solution_is_the_one_reached_first() -> None:
    solutions = inverse(KR10_R1100_SIXX, forward(KR10_R1100_SIXX, HOME_DEG))
    for joints_deg in solutions:
        assert np.array_equal(nearest(KR10_R1100_SIXX, solutions, joints_deg), joints_deg)


def test_of_equally_near_solutions_the_one_farther_from_its_limits_is_taken() -> None:
    near_limit, free = (10.0, -90.0, 90.0, 0.0, 119.0, 0.0), (10.0, -90.0, 90.0, 0.0, 99.0, 0.0)
    middle = (10.0, -90.0, 90.0, 0.0, 109.0, 0.0)
    assert np.array_equal(nearest(KR10_R1100_SIXX, [near_limit, free], middle), free)
    assert limit_margin_deg(KR10_R1100_SIXX, near_limit) == pytest.approx(1.0)


def test_nothing_to_choose_from_is_an_error() -> None:
    with pytest.raises(ValueError, match="no solution"):
        nearest(KR10_R1100_SIXX, np.empty((0, 6)), HOME_DEG)


def test_a_pose_too_far_away_is_said_to_be_out_of_reach() -> None:
    pose = transform((1500.0, 0.0, 500.0), (0.0, 90.0, 0.0))
    assert len(inverse(KR10_R1100_SIXX, pose)) == 0
    assert unreachable_reason(KR10_R1100_SIXX, pose).startswith("out of reach")


def test_a_pose_that_only_a_limit_forbids_names_axis_and_limit() -> None:
    pose = forward(KR10_R1100_SIXX, (0.0, -90.0, 157.5, 0.0, 100.0, 0.0))
    assert len(inverse(KR10_R1100_SIXX, pose)) == 0
    assert unreachable_reason(KR10_R1100_SIXX, pose) == "A3 would be 157.500 deg, its limits are -120 to 156 deg"


def test_a_reachable_pose_has_no_reason_against_it() -> None:
    assert unreachable_reason(KR10_R1100_SIXX, forward(KR10_R1100_SIXX, HOME_DEG)) == ""
    assert limit_violations(KR10_R1100_SIXX, HOME_DEG) == ""


def test_a_joint_angle_that_is_no_number_is_not_within_limits() -> None:
    assert not within_limits(KR10_R1100_SIXX, (np.nan, -90.0, 90.0, 0.0, 90.0, 0.0))
    assert "A1" in limit_violations(KR10_R1100_SIXX, (np.nan, -90.0, 90.0, 0.0, 90.0, 0.0))


def test_a_long_motion_takes_as_long_as_its_slowest_axis() -> None:
    arm = slowed(KR10_R1100_SIXX, speed_fraction=0.1, acceleration_deg_s2=300.0, jerk_deg_s3=3000.0)
    target = (60.0, -90.0, 90.0, 0.0, 90.0, 0.0)
    # 60 deg at 30 deg/s, and v/a + a/j to gain and to lose speed, half of it on the way
    assert move_duration_s(arm, HOME_DEG, target) == pytest.approx(60.0 / 30.0 + 30.0 / 300.0 + 0.1, abs=1e-6)


def test_a_motion_to_where_the_arm_is_takes_no_time() -> None:
    assert move_duration_s(KR10_R1100_SIXX, HOME_DEG, HOME_DEG) == 0.0
