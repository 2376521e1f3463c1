"""What the RSI driver says to the controller, what it cannot say, and how far the arm goes after `stop`."""

from __future__ import annotations

import numpy as np
import pytest
from arms import KR10_R1100_SIXX
from hypothesis import given
from hypothesis import strategies as st
from pydantic import ValidationError

from coupole.geometry import rotation_from_abc
from coupole.kinematics import forward, structure_of
from drivers.kuka.rsi import shared_state
from drivers.kuka.rsi.corrections import Corrections
from drivers.kuka.rsi.driver import Settings
from drivers.kuka.rsi.limits import correction_violations
from drivers.kuka.rsi.pose import Pose, corrected_pose, correction, flange_pose
from drivers.kuka.rsi.trajectory import Motion

HOME_DEG = (0.0, -90.0, 90.0, 0.0, 90.0, 0.0)
GEOMETRY = structure_of(KR10_R1100_SIXX).lengths
joints = st.tuples(*[st.floats(low, high) for low, high in KR10_R1100_SIXX.limits_deg])


def matrix(pose: Pose) -> np.ndarray:
    base_from_flange = np.eye(4)
    base_from_flange[:3, :3] = np.reshape(pose.rotation, (3, 3))
    base_from_flange[:3, 3] = pose.position_mm
    return base_from_flange


@given(joints)
def test_the_pose_is_that_of_the_projects_kinematics(joints_deg: shared_state.Six) -> None:
    assert np.allclose(matrix(flange_pose(GEOMETRY, joints_deg)), forward(KR10_R1100_SIXX, joints_deg), atol=1e-9)


@given(joints, joints)
def test_a_correction_leads_from_one_pose_to_the_other(
    before_deg: shared_state.Six, after_deg: shared_state.Six
) -> None:
    before, after = flange_pose(GEOMETRY, before_deg), flange_pose(GEOMETRY, after_deg)
    values = correction(before, after)
    assert np.allclose(matrix(corrected_pose(before, values)), matrix(after), atol=1e-6)


def test_a_correction_moves_in_base_axes_and_turns_about_them() -> None:
    home = flange_pose(GEOMETRY, HOME_DEG)
    there = matrix(corrected_pose(home, (1.0, 2.0, 3.0, 10.0, -20.0, 30.0)))
    assert np.allclose(there[:3, 3], np.add(home.position_mm, (1.0, 2.0, 3.0)))
    assert np.allclose(there[:3, :3], rotation_from_abc(10.0, -20.0, 30.0) @ matrix(home)[:3, :3])


@pytest.mark.parametrize("corrects", ["axes", "pose"])
def test_roundings_of_relative_corrections_do_not_add_up(corrects: str) -> None:
    corrections = Corrections(corrects, "relative", GEOMETRY)
    corrections.begin(HOME_DEG)
    place = flange_pose(GEOMETRY, HOME_DEG)
    sum_deg = np.zeros(6)
    for cycle in range(1, 5001):
        values = corrections.to(tuple(angle + 1.03e-6 * cycle for angle in HOME_DEG))
        corrections.note_applied()
        sum_deg += values
        place = corrected_pose(place, values)
    target_deg = np.array(HOME_DEG) + 1.03e-6 * 5000
    if corrects == "axes":
        assert np.allclose(HOME_DEG + sum_deg, target_deg, atol=1e-6)
    else:
        assert np.allclose(matrix(place), forward(KR10_R1100_SIXX, target_deg), atol=2e-6)


def test_an_increment_that_was_not_applied_is_said_again_with_the_next() -> None:
    corrections = Corrections("axes", "relative", GEOMETRY)
    corrections.begin(HOME_DEG)
    assert corrections.to((0.25, *HOME_DEG[1:]))[0] == 0.25
    assert corrections.to((0.25, *HOME_DEG[1:]))[0] == 0.25
    corrections.note_applied()
    assert corrections.to((0.75, *HOME_DEG[1:]))[0] == 0.5
    assert corrections.hold() == (0.0,) * 6


def violations(target_deg: shared_state.Six, *on_the_way_deg: shared_state.Six, **settings: object) -> str:
    return correction_violations(
        Settings.model_validate({"arm_model": KR10_R1100_SIXX, "listen": "127.0.0.1:0", **settings}),
        KR10_R1100_SIXX,
        HOME_DEG,
        on_the_way_deg or (HOME_DEG,),
        target_deg,
    )


def test_an_axis_beyond_its_correction_limit_is_named() -> None:
    limits = {"axis_correction_deg": (20.0, 10.0, 20.0, 20.0, 20.0, 20.0)}
    assert violations((0.0, -81.0, 90.0, 0.0, 90.0, 0.0), **limits) == ""
    assert "A2 would be 11.000 deg" in violations((0.0, -79.0, 90.0, 0.0, 90.0, 0.0), **limits)
    assert "A2 would be -11.000 deg" in violations((0.0, -101.0, 90.0, 0.0, 90.0, 0.0), **limits)


@given(joints)
def test_the_default_limits_forbid_no_axis_anything(target_deg: shared_state.Six) -> None:
    assert violations(target_deg) == ""


def test_a_pose_too_far_from_the_start_is_refused_also_on_the_way() -> None:
    away_deg = (60.0, *HOME_DEG[1:])
    assert violations(away_deg, corrects="pose") == ""
    assert "540 mm from where RSI was started" in violations(away_deg, corrects="pose", pose_correction_mm=500)
    assert "60.0 deg" in violations(away_deg, corrects="pose", pose_correction_deg=50)
    assert "540 mm" in violations(HOME_DEG, away_deg, corrects="pose", pose_correction_mm=500)


@pytest.mark.parametrize(
    ("target_deg", "name"),
    [
        ((0.0, -90.0, 90.0, 0.0, -60.0, 0.0), "wrist"),
        ((0.0, -90.0, 90.0, 0.0, 4.0, 0.0), "wrist"),
        ((0.0, -60.0, -40.0, 0.0, 90.0, 0.0), "elbow"),
        ((0.0, -140.0, 90.0, 0.0, 90.0, 0.0), "shoulder"),
    ],
)
def test_corrections_of_the_pose_keep_off_singularities(target_deg: shared_state.Six, name: str) -> None:
    assert name in violations(target_deg, corrects="pose")
    assert violations(target_deg) == ""


def test_a_new_target_in_mid_motion_is_checked_from_the_whole_rest_of_the_way() -> None:
    """The arm may brake anywhere between the two places: from the second the new line crosses the singularity."""
    here_deg, there_deg = (0.0, -90.0, 90.0, 0.0, 90.0, 0.0), (0.0, -90.0, 90.0, 0.0, 3.0, 0.0)
    target_deg = (20.0, *HOME_DEG[1:])
    assert violations(target_deg, here_deg, corrects="pose") == ""
    assert "wrist" in violations(target_deg, here_deg, there_deg, corrects="pose")


def test_a_trajectory_that_cannot_be_computed_leaves_the_axes_at_rest_and_is_told() -> None:
    motion = Motion(0.004, ((100.0,) * 6, (300.0,) * 6, (3000.0,) * 6))
    motion.stand_at(HOME_DEG)
    motion.move_to((float("nan"), *HOME_DEG[1:]))
    assert not motion.step()
    assert motion.phase == shared_state.STANDING
    assert motion.commanded_deg == HOME_DEG
    assert motion.velocity_deg_s == (0.0,) * 6


@pytest.mark.parametrize(
    "settings",
    [
        {"axis_correction_deg": (1.0,) * 5},
        {"axis_correction_deg": (0.0,) * 6},
        {"corrects": "tool"},
        {"mode": "both"},
    ],
)
def test_settings_that_make_no_sense_are_refused(settings: dict[str, object]) -> None:
    with pytest.raises(ValidationError):
        Settings.model_validate({"arm_model": KR10_R1100_SIXX, "listen": "127.0.0.1:0", **settings})


@given(
    target_deg=joints,
    stop_at=st.integers(0, 400),
    speed_fraction=st.sampled_from([0.1, 0.5, 1.0]),
    acceleration_deg_s2=st.sampled_from([100.0, 300.0, 1000.0]),
    jerk_deg_s3=st.sampled_from([500.0, 3000.0, 20_000.0]),
)
def test_the_stopping_distance_holds_for_every_motion(
    target_deg: shared_state.Six,
    stop_at: int,
    speed_fraction: float,
    acceleration_deg_s2: float,
    jerk_deg_s3: float,
) -> None:
    settings = Settings(
        arm_model=KR10_R1100_SIXX,
        listen="127.0.0.1:0",
        speed_fraction=speed_fraction,
        acceleration_deg_s2=acceleration_deg_s2,
        jerk_deg_s3=jerk_deg_s3,
        follow_lag_s=0,
    )
    arm = settings.arm()
    motion = Motion(0.004, (arm.velocity_deg_s, arm.acceleration_deg_s2, arm.jerk_deg_s3))
    motion.stand_at(HOME_DEG)
    motion.move_to(target_deg)
    for _ in range(stop_at):
        motion.step()
    called_deg = motion.commanded_deg
    motion.step()
    motion.stop()
    while motion.phase != shared_state.STANDING:
        motion.step()
    assert np.all(np.abs(np.subtract(motion.commanded_deg, called_deg)) <= settings.stopping_deg())
