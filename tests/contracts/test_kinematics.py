"""The arm's kinematics, against the data sheet, the stand-in's own chain of joints, and itself."""

from __future__ import annotations

import numpy as np
import pytest
from arms import KR10_R1100_SIXX
from hypothesis import given
from hypothesis import strategies as st
from numpy.typing import NDArray

from coupole.geometry import abc_from_rotation, transform
from coupole.kinematics import (
    forward,
    inverse,
    limit_margin_deg,
    limit_violations,
    move_duration_s,
    move_durations_s,
    nearest,
    slowed_arm,
    unreachable_reason,
    within_limits,
)
from coupole.motion.singularities import distances, margin, posture_cost, reason
from sim.devices.kuka_kinematics import flange_pose

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
    arm = slowed_arm(KR10_R1100_SIXX, speed_fraction=0.1, acceleration_deg_s2=300.0, jerk_deg_s3=3000.0)
    target = (60.0, -90.0, 90.0, 0.0, 90.0, 0.0)
    # 60 deg at 30 deg/s, and v/a + a/j to gain and to lose speed, half of it on the way
    assert move_duration_s(arm, HOME_DEG, target) == pytest.approx(60.0 / 30.0 + 30.0 / 300.0 + 0.1, abs=1e-6)


def test_a_motion_to_where_the_arm_is_takes_no_time() -> None:
    assert move_duration_s(KR10_R1100_SIXX, HOME_DEG, HOME_DEG) == 0.0


@given(st.integers(0, 2**32 - 1))
def test_a_motion_takes_as_long_as_ruckigs(seed: int) -> None:
    from ruckig import InputParameter, Ruckig, Trajectory

    random = np.random.default_rng(seed)
    arm = slowed_arm(
        KR10_R1100_SIXX,
        speed_fraction=random.uniform(0.01, 1.0),
        acceleration_deg_s2=10 ** random.uniform(1, 4),
        jerk_deg_s3=10 ** random.uniform(1.5, 5),
    )
    way_deg = random.uniform(-1, 1, 6) * 10 ** random.uniform(-3, 2.2)
    motion = InputParameter(1)
    motion.current_position, motion.target_position = [0.0], [1.0]
    motion.max_velocity, motion.max_acceleration, motion.max_jerk = (
        [float(np.min(np.array(limits) / np.abs(way_deg)))]
        for limits in (arm.velocity_deg_s, arm.acceleration_deg_s2, arm.jerk_deg_s3)
    )
    trajectory = Trajectory(1)
    Ruckig(1).calculate(motion, trajectory)
    assert move_duration_s(arm, np.array(HOME_DEG), HOME_DEG + way_deg) == pytest.approx(
        trajectory.duration, rel=1e-9
    )


def test_durations_of_many_motions_are_those_of_each() -> None:
    places = random_joints_deg(5, seed=8)
    table_s = move_durations_s(KR10_R1100_SIXX, places[:, None], places)
    assert table_s.shape == (5, 5)
    assert table_s[1, 3] == move_duration_s(KR10_R1100_SIXX, places[1], places[3])
    assert np.array_equal(np.diag(table_s), np.zeros(5))


# ------------------------------------------------------------------------------------------- singularities


def jacobian(joints_deg: NDArray[np.float64]) -> NDArray[np.float64]:
    """[6, 6] of the flange's position (m) and orientation by the axes (rad), by differences."""
    columns = []
    for axis in range(6):
        step = np.zeros(6)
        step[axis] = 1e-5
        before, after = (forward(KR10_R1100_SIXX, joints_deg + way * np.degrees(step)) for way in (-1, 1))
        turn = after[:3, :3] @ before[:3, :3].T
        spin = np.array((turn[2, 1] - turn[1, 2], turn[0, 2] - turn[2, 0], turn[1, 0] - turn[0, 1])) / 2
        columns.append(np.concatenate([(after - before)[:3, 3] / 1000, spin]) / 2e-5)
    return np.array(columns).T


@given(st.integers(0, 2**32 - 1))
def test_the_jacobians_determinant_is_the_product_of_the_distances_from_singularities(seed: int) -> None:
    joints_deg = random_joints_deg(1, seed)[0]
    wrist_deg, elbow_deg, shoulder_mm = distances(KR10_R1100_SIXX, joints_deg)
    upper_m, fore_m = 0.560, np.hypot(0.515, 0.035)
    product = (
        upper_m * fore_m * abs(np.sin(np.radians(wrist_deg)) * np.sin(np.radians(elbow_deg)) * shoulder_mm / 1000)
    )
    assert abs(np.linalg.det(jacobian(joints_deg))) == pytest.approx(product, abs=1e-6)


def test_a_posture_well_away_from_singularities_has_no_reason_against_it() -> None:
    assert reason(KR10_R1100_SIXX, HOME_DEG) == ""
    assert margin(KR10_R1100_SIXX, HOME_DEG) > 1.0


def test_a_posture_is_the_less_easy_the_nearer_it_is_to_a_singularity_or_a_limit() -> None:
    postures = np.array([HOME_DEG, (0, -90, 90, 0, 8, 0), (0, -90, 90, 0, 5, 0), (0, -90, 90, 0, 118, 0)])
    easy, near, nearest_, limited = posture_cost(KR10_R1100_SIXX, postures)
    assert easy == 0.0
    assert 0.0 < near < nearest_ == 1.0
    assert limited == pytest.approx(0.8)
