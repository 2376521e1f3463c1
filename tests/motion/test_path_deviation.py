"""Path deviation of a moving arm: zero on the path, and never less than the true distance."""

from __future__ import annotations

import numpy as np
import pytest
from arms import KR10, KR10_R1100_SIXX
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from coupole.kinematics import link_frames
from coupole.motion.bodies import Capsule, capsules_of
from coupole.motion.collisions import CellBodies, Surroundings
from coupole.motion.path_deviation import deviation_at_rest_mm

TOOL = Capsule("tool", 7, (0, 0, 0), (0, 0, 120), 1)
REACH_MM = CellBodies(KR10, Surroundings(np.eye(4), 740.0, 1500.0, 74.0, np.zeros((0, 3))), [TOOL]).reach_mm
LOW, HIGH = np.array(KR10_R1100_SIXX.limits_deg).T
places = st.integers(0, 2**32 - 1).map(lambda seed: np.random.default_rng(seed).uniform(LOW, HIGH))
shares = st.floats(0.0, 1.0)


def _points_mm(joints_deg: NDArray[np.float64]) -> NDArray[np.float64]:
    """[..., n, 3] ends of all capsules of the arm, and of a tool of 120 mm, in the base frame."""
    frames = link_frames(KR10_R1100_SIXX, joints_deg)
    ends = [(c.link, end) for c in capsules_of(KR10) for end in (c.start_mm, c.end_mm)] + [(7, (0.0, 0.0, 120.0))]
    return np.stack([frames[..., k, :3, :3] @ np.array(end) + frames[..., k, :3, 3] for k, end in ends], axis=-2)


def standing_off_mm(way_deg: list[NDArray[np.float64]], joints_deg: NDArray[np.float64]) -> float:
    """Deviation of an arm at rest."""
    return deviation_at_rest_mm(way_deg, joints_deg, np.zeros(6), REACH_MM, 0.0)


@given(places, places, places, shares)
def test_on_the_way_it_is_zero(start: NDArray, via: NDArray, goal: NDArray, share: float) -> None:  # type: ignore[type-arg]
    way = [start, via, goal]
    assert standing_off_mm(way, via + share * (goal - via)) < 1e-9


@settings(max_examples=60)
@given(places, places, shares, st.integers(0, 2**32 - 1), st.floats(0.0, 3.0))
def test_it_is_never_less_than_the_farthest_point_is_off(
    start: NDArray,
    goal: NDArray,
    share: float,
    seed: int,
    deviation_deg: float,  # type: ignore[type-arg]
) -> None:
    off_deg = np.random.default_rng(seed).uniform(-deviation_deg, deviation_deg, 6)
    joints_deg = start + share * (goal - start) + off_deg
    on_the_way = start + np.linspace(0, 1, 2001)[:, None] * (goal - start)
    apart_mm = np.linalg.norm(_points_mm(joints_deg) - _points_mm(on_the_way), axis=-1).max(axis=-1).min()
    step_mm = np.linalg.norm(np.diff(_points_mm(on_the_way), axis=0), axis=-1).max()
    assert standing_off_mm([start, goal], joints_deg) >= apart_mm - step_mm


def test_an_arm_that_has_no_way_to_go_is_off_by_where_it_stands() -> None:
    here = np.zeros(6)
    assert standing_off_mm([here], here) == 0.0
    assert standing_off_mm([here], np.array([0.1, 0, 0, 0, 0, 0])) > 2.0


@given(places, places, st.floats(0.0, 1.0), st.floats(0.0, 200.0))
def test_speed_along_the_path_does_not_count(start: NDArray, goal: NDArray, share: float, speed: float) -> None:  # type: ignore[type-arg]
    along = (goal - start) / max(1e-9, float(np.abs(goal - start).max()))
    here = start + share * (goal - start)
    assert deviation_at_rest_mm([start, goal], here, speed * along, REACH_MM, 0.5) < 1e-6


def test_an_arm_that_leaves_its_path_counts_with_the_place_where_it_comes_to_rest() -> None:
    """Axis 1 turns at 2 deg/s while only axis 3 should: 1376 mm away that is 48 mm/s, for half a second."""
    start, goal = np.zeros(6), np.array([0.0, 0, 90, 0, 0, 0])
    here, speeds = np.array([0.1, 0, 30, 0, 0, 0]), np.array([2.0, 0, 60, 0, 0, 0])
    now_mm = standing_off_mm([start, goal], here)
    assert np.isclose(now_mm, np.radians(0.1) * REACH_MM[0])
    at_rest_mm = deviation_at_rest_mm([start, goal], here, speeds, REACH_MM, 0.5)
    assert np.isclose(at_rest_mm, now_mm + 0.5 * np.radians(2.0) * REACH_MM[0])


def test_an_arm_that_should_stand_counts_with_all_its_speed() -> None:
    here, speeds = np.zeros(6), np.array([0.0, 1.0, 0, 0, 0, 0])
    at_rest_mm = deviation_at_rest_mm([here], here, speeds, REACH_MM, 0.4)
    assert np.isclose(at_rest_mm, 0.4 * np.radians(1.0) * REACH_MM[1])


@pytest.mark.parametrize(("at_deg", "off_deg"), [(-3.0, 3.0), (4.0, 0.0), (12.0, 2.0)])
def test_beyond_an_end_of_its_path_the_arm_is_off_by_what_it_went_too_far(at_deg: float, off_deg: float) -> None:
    way = [np.zeros(6), np.array([10.0, 0, 0, 0, 0, 0])]
    found_mm = standing_off_mm(way, np.array([at_deg, 0, 0, 0, 0, 0]))
    assert found_mm == pytest.approx(np.radians(off_deg) * REACH_MM[0], abs=1e-9)
