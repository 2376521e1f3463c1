"""Shadows of known edges, and the table that remembers them."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray
from scenes import quad, relief, scene_of

from sim.render.embree import Obstacles
from sim.render.shadows import Shadows

LIGHT = np.array([[0.0, 0.0, 1000.0], [600.0, 0.0, 300.0], [0.0, -500.0, 200.0]])


def lit(shadows: Shadows, sides: NDArray[np.int64], led: int) -> NDArray[np.bool_]:
    places = shadows.places(sides)
    bits = shadows.reached_bits(led)
    reached: NDArray[np.bool_] = ((bits[places >> 3] >> (places & 7)) & 1).astype(bool)
    return reached


def fronts(count: int) -> NDArray[np.int64]:
    return 2 * np.arange(count, dtype=np.int64)


def test_the_shadow_of_a_square_ends_where_similar_triangles_say() -> None:
    floor = relief(400, 200, 0.0)
    corners = np.concatenate([floor, quad((0, 0, 500.0), 50.0)])
    shadows = Shadows(Obstacles(scene_of(corners).corners_mm), LIGHT, 1 << 20)
    dark = ~lit(shadows, fronts(len(floor)), 0)
    centroids = floor.mean(axis=1)
    # Half way between light and floor: the shadow is twice as large.
    assert np.array_equal(dark, np.abs(centroids[:, :2]).max(axis=1) < 100.0)


def test_a_side_that_faces_away_is_not_reached_and_the_other_is() -> None:
    shadows = Shadows(Obstacles(scene_of(quad((0, 0, 0), 5.0)).corners_mm), LIGHT, 1 << 20)
    assert lit(shadows, np.array([0, 1, 2, 3]), 0).tolist() == [True, False, True, False]


def test_a_triangle_does_not_shade_itself_though_coordinates_are_rounded() -> None:
    slope = relief(300, 100, 0.0)
    slope[..., 2] = 0.7 * slope[..., 0] + 1000.0
    shadows = Shadows(Obstacles(scene_of(slope).corners_mm), np.array([[-500.0, 0.0, 2500.0]]), 1 << 20)
    assert lit(shadows, fronts(len(slope)), 0).all()


def test_what_a_second_view_shows_is_added_and_the_first_stays_as_it_was() -> None:
    corners = relief(120, 40, 25.0)
    obstacles = Obstacles(scene_of(corners).corners_mm)
    random = np.random.default_rng(3)
    some, all_sides = random.permutation(fronts(len(corners)))[:1001], fronts(len(corners))
    shadows, whole = Shadows(obstacles, LIGHT, 1 << 20), Shadows(obstacles, LIGHT, 1 << 20)
    for led in range(3):
        before = lit(shadows, some, led)
        after = lit(shadows, all_sides, led)
        assert np.array_equal(after, lit(whole, all_sides, led))
        assert np.array_equal(after[some >> 1], before)
        assert (after.mean() < 1.0) == (led > 0)  # a relief hides nothing from straight above


@pytest.mark.parametrize("memory_bytes", [0, 150, 500])
def test_with_too_little_memory_answers_stay_the_same(memory_bytes: int) -> None:
    corners = relief(120, 20, 6.0)
    obstacles = Obstacles(scene_of(corners).corners_mm)
    roomy, tight = Shadows(obstacles, LIGHT, 1 << 20), Shadows(obstacles, LIGHT, memory_bytes)
    for first in (0, 300, 100):
        sides = fronts(len(corners))[first : first + 400]
        for led in (0, 1, 2, 0):
            assert np.array_equal(lit(tight, sides, led), lit(roomy, sides, led))
