"""Round trips and meanings of the transforms."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.strategies import SearchStrategy

from coupole.geometry import (
    abc_from_rotation,
    apply,
    direction,
    inverse,
    look_at,
    rotation_angle_deg,
    rotation_from_abc,
    transform,
)


def degrees(limit: float) -> SearchStrategy[float]:
    return st.floats(-limit, limit, allow_nan=False)


def coordinates_mm() -> SearchStrategy[tuple[float, float, float]]:
    return st.tuples(degrees(2000.0), degrees(2000.0), degrees(2000.0))


near_gimbal_lock = st.tuples(st.sampled_from([-90.0, 90.0]), degrees(1e-4)).map(sum)


@given(a=degrees(180.0), b=st.one_of(degrees(90.0), near_gimbal_lock), c=degrees(180.0))
def test_a_rotation_survives_the_way_to_abc_and_back(a: float, b: float, c: float) -> None:
    rotation = rotation_from_abc(a, b, c)
    assert np.allclose(rotation_from_abc(*abc_from_rotation(rotation)), rotation, atol=1e-8)


@given(a=degrees(179.9), b=degrees(89.0), c=degrees(179.9))
def test_away_from_gimbal_lock_the_angles_themselves_survive(a: float, b: float, c: float) -> None:
    assert np.allclose(abc_from_rotation(rotation_from_abc(a, b, c)), (a, b, c), atol=1e-6)


@given(a=degrees(180.0), c=degrees(180.0))
def test_at_gimbal_lock_c_is_zero(a: float, c: float) -> None:
    assert abc_from_rotation(rotation_from_abc(a, 90.0, c))[2] == 0.0


@given(position_mm=coordinates_mm(), abc_deg=st.tuples(degrees(180.0), degrees(90.0), degrees(180.0)))
def test_the_inverse_undoes_a_transform(
    position_mm: tuple[float, float, float], abc_deg: tuple[float, float, float]
) -> None:
    t = transform(position_mm, abc_deg)
    assert np.allclose(inverse(t) @ t, np.eye(4), atol=1e-9)
    assert np.allclose(apply(inverse(t), apply(t, [[1.0, 2.0, 3.0]])), [[1.0, 2.0, 3.0]], atol=1e-9)


@given(
    target_mm=coordinates_mm(),
    distance_mm=st.floats(50.0, 1000.0),
    azimuth=degrees(360.0),
    elevation=degrees(89.9),
    roll=degrees(180.0),
)
def test_the_cameras_axis_hits_the_target(
    target_mm: tuple[float, float, float], distance_mm: float, azimuth: float, elevation: float, roll: float
) -> None:
    support_from_camera = look_at(target_mm, distance_mm, azimuth, elevation, roll)
    assert np.allclose(apply(support_from_camera, (0.0, 0.0, distance_mm)), target_mm, atol=1e-8)
    assert np.allclose(support_from_camera[:3, :3].T @ support_from_camera[:3, :3], np.eye(3), atol=1e-12)
    assert np.linalg.det(support_from_camera[:3, :3]) > 0.0


@given(azimuth=degrees(360.0), elevation=degrees(89.9))
def test_the_image_is_upright(azimuth: float, elevation: float) -> None:
    support_from_camera = look_at((0.0, 0.0, 60.0), 335.0, azimuth, elevation)
    right, down = support_from_camera[:3, 0], support_from_camera[:3, 1]
    assert abs(right[2]) < 1e-12
    assert down[2] < 0.0


def test_seen_from_the_side_what_is_to_the_right_appears_right() -> None:
    camera_from_support = inverse(look_at((0.0, 0.0, 0.0), 500.0, azimuth_deg=0.0, elevation_deg=0.0))
    assert np.allclose(apply(camera_from_support, (0.0, 10.0, 5.0)), (10.0, -5.0, 500.0))


@pytest.mark.parametrize(
    ("azimuth_deg", "elevation_deg", "expected"),
    [
        (0, 0, (1, 0, 0)),
        (90, 0, (0, 1, 0)),
        (-90, 0, (0, -1, 0)),
        (0, 90, (0, 0, 1)),
        (0, -90, (0, 0, -1)),
        (60, 30, (3**0.5 / 4, 0.75, 0.5)),
    ],
)
def test_directions_by_hand(azimuth_deg: float, elevation_deg: float, expected: tuple[float, ...]) -> None:
    np.testing.assert_allclose(direction(azimuth_deg, elevation_deg), expected, atol=1e-15)


@given(azimuth=degrees(360.0), elevation=degrees(90.0))
def test_a_direction_has_length_one(azimuth: float, elevation: float) -> None:
    assert np.isclose(np.linalg.norm(direction(azimuth, elevation)), 1.0)


@given(angle=st.floats(0.0, 179.9))
def test_the_angle_between_orientations_is_that_of_the_turn(angle: float) -> None:
    turned = transform(abc_deg=(0.0, 0.0, angle))
    assert np.isclose(rotation_angle_deg(np.eye(4), turned), angle, atol=1e-9)
