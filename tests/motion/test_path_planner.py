"""Legs: clear on all of their way, the same back and forth, and honest where there is none."""

from __future__ import annotations

import tracemalloc
from itertools import pairwise

import numpy as np
import pytest
from arms import KR10, KR10_R1100_SIXX
from numpy.typing import NDArray

from coupole.geometry import transform
from coupole.kinematics import move_duration_s, move_durations_s, slowed_arm
from coupole.motion.bodies import Capsule
from coupole.motion.collisions import CellBodies, Clearances, Surroundings
from coupole.motion.path_planner import PathPlanner

ARM = slowed_arm(KR10_R1100_SIXX, speed_fraction=0.3, acceleration_deg_s2=300.0, jerk_deg_s3=3000.0)
HOME = np.array((0.0, -170.0, 150.0, 0.0, -70.0, 0.0))
LEFT, RIGHT = (np.array((a1, -60.0, 60.0, 0.0, 60.0, 0.0)) for a1 in (-50.0, 50.0))
WALL = ("wall", (550.0, -30.0, 0.0), (1100.0, 30.0, 1000.0))
"""Stands across the straight way from LEFT to RIGHT."""


def cell(*boxes: tuple[str, tuple[float, float, float], tuple[float, float, float]]) -> CellBodies:
    around = Surroundings(
        transform((200, 0, 1450), (0, 0, 180)), 740.0, 1500.0, 74.0, np.zeros((0, 3)), keep_out_boxes=boxes
    )
    return CellBodies(KR10, around, (Capsule("camera", 7, (0, 0, 20), (0, 0, 100), 60),), Clearances())


def planner(*boxes: tuple[str, tuple[float, float, float], tuple[float, float, float]]) -> PathPlanner:
    return PathPlanner(ARM, cell(*boxes), [HOME.tolist()])


def is_clear(bodies: CellBodies, places: list[NDArray[np.float64]]) -> bool:
    return all(bodies.contact_on_the_way(a, b) is None for a, b in pairwise(places))


def test_where_nothing_is_in_the_way_the_leg_is_straight() -> None:
    leg = planner().leg(LEFT, RIGHT)
    assert np.array_equal(leg.waypoints, [RIGHT])
    assert leg.duration_s == pytest.approx(move_duration_s(ARM, LEFT, RIGHT))


def test_times_between_all_pairs_of_many_postures_are_those_of_each_and_take_one_number_a_pair() -> None:
    """2,000 views have 16,000 postures: 2 GB of times, and 72 GB if each pair is kept by its axes."""
    places = np.random.default_rng(3).uniform(-170.0, 170.0, (800, 6))
    places[1] = places[0]
    places[2, 1:] = places[0, 1:]
    planner().straight_s(places[:2])  # compiled
    tracemalloc.start()
    seconds = planner().straight_s(places)
    _, most_bytes = tracemalloc.get_traced_memory()
    tracemalloc.stop()
    assert most_bytes < 1.2 * seconds.nbytes
    assert np.allclose(seconds, move_durations_s(ARM, places[:, None], places), rtol=1e-12, atol=0.0)
    assert seconds[0, 1] == 0.0


def test_a_leg_round_an_obstacle_is_clear_on_all_of_its_way() -> None:
    bodies = cell(WALL)
    assert bodies.contact_on_the_way(LEFT, RIGHT) is not None
    leg = planner(WALL).leg(LEFT, RIGHT)
    assert len(leg.waypoints) > 1
    assert np.array_equal(leg.waypoints[-1], RIGHT)
    assert is_clear(bodies, [LEFT, *leg.waypoints])


def test_a_legs_time_is_that_of_its_motions() -> None:
    leg = planner(WALL).leg(LEFT, RIGHT)
    motions = pairwise([LEFT, *leg.waypoints])
    assert leg.duration_s == pytest.approx(sum(move_duration_s(ARM, a, b) for a, b in motions))


def test_the_way_back_is_the_way_there() -> None:
    found = planner(WALL)
    there, back = found.leg(LEFT, RIGHT), found.leg(RIGHT, LEFT)
    assert np.array_equal([LEFT, *there.waypoints], [RIGHT, *back.waypoints][::-1])
    assert there.duration_s == pytest.approx(back.duration_s)


def test_a_leg_does_not_depend_on_what_was_asked_before() -> None:
    fresh, used = planner(WALL), planner(WALL)
    used.leg(HOME, LEFT)
    used.leg(HOME, RIGHT)
    assert np.array_equal(fresh.leg(LEFT, RIGHT).waypoints, used.leg(LEFT, RIGHT).waypoints)


def test_a_place_inside_something_has_no_way_to_it_and_says_what_is_there() -> None:
    block = ("block", (-740.0, -740.0, 0.0), (740.0, 740.0, 900.0))
    leg = planner(block).leg(HOME, LEFT)
    assert leg.waypoints == ()
    assert leg.contact is not None
    assert leg.contact.other_name == "keep-out `block`"


def test_a_leg_goes_over_home_where_that_is_the_way_round() -> None:
    found = planner(WALL)
    assert is_clear(cell(WALL), [LEFT, *found.leg(LEFT, HOME).waypoints])
    assert found.leg(LEFT, RIGHT).duration_s < 30.0
