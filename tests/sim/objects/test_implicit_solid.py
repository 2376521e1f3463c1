"""Sculpture from implicit solids: heights of forms whose surface is known in closed form."""

from __future__ import annotations

import numpy as np
import pytest

from sim.objects.implicit_solid import Form, ball, height_above_plane, mirror_pair

UPRIGHT = np.eye(3)
X, Y = np.meshgrid(np.linspace(-1.4, 1.4, 29), np.linspace(-1.4, 1.4, 29))


def heights(*forms: Form, turn: np.ndarray = UPRIGHT) -> np.ndarray:
    return height_above_plane(forms, X, Y, turn, 3.0, -3.0)


def test_a_ball_is_as_high_as_a_sphere() -> None:
    found = heights(ball((0.2, -0.1, 0.5), 0.8))
    inside = 0.64 - (X - 0.2) ** 2 - (Y + 0.1) ** 2
    assert found[inside > 0.02] == pytest.approx(0.5 + np.sqrt(inside[inside > 0.02]), abs=3e-4)
    assert (found[inside < -0.02] == -3.0).all()


def test_a_stretched_ball_is_an_ellipsoid() -> None:
    found = heights(ball((0.0, 0.0, 0.0), 1.0, stretch=(1.2, 0.8, 0.5)))
    inside = 1.0 - (X / 1.2) ** 2 - (Y / 0.8) ** 2
    assert found[inside > 0.05] == pytest.approx(0.5 * np.sqrt(inside[inside > 0.05]), abs=5e-4)


def test_sharp_forms_are_the_higher_of_both_and_a_cut_takes_away() -> None:
    one, other = ball((-0.4, 0.0, 0.0), 0.6), ball((0.4, 0.0, 0.2), 0.5)
    assert heights(one, other) == pytest.approx(np.maximum(heights(one), heights(other)), abs=5e-4)
    middle = (14, 14)
    assert heights(ball((0.0, 0.0, 0.0), 1.0), ball((0.0, 0.0, 1.0), 0.3, is_cut=True))[middle] == pytest.approx(
        0.7, abs=5e-4
    )


def test_a_transition_adds_a_quarter_of_its_width_where_both_forms_meet() -> None:
    pair = mirror_pair(ball((0.5, 0.0, 0.0), 0.5, 0.2))
    apart = height_above_plane(pair, np.array([0.0]), np.array([0.0]), UPRIGHT, 3.0, -3.0)
    # Both balls touch at the origin. There the distance to either is a quarter of the width.
    assert apart[0] == pytest.approx(np.sqrt((0.5 + 0.05) ** 2 - 0.25), abs=5e-4)


def test_a_cone_has_the_height_of_its_axis_and_its_radius_there() -> None:
    found = heights(Form((-1.0, 0.0, 0.0), (1.0, 0.0, 0.0), (0.3, 0.3)))
    assert found[14, 4:25] == pytest.approx(0.3, abs=5e-4)


def test_a_turned_solid_is_the_solid_seen_from_its_side() -> None:
    quarter = np.array([[0.0, 0.0, 1.0], [0.0, 1.0, 0.0], [-1.0, 0.0, 0.0]])
    found = heights(ball((0.0, 0.0, 0.6), 0.5), turn=quarter)
    assert found == pytest.approx(heights(ball((0.6, 0.0, 0.0), 0.5)), abs=5e-4)


def test_forms_far_from_a_ray_change_nothing() -> None:
    crowd = [ball((0.7 * np.cos(a), 0.7 * np.sin(a), 0.1 * a), 0.3, 0.1) for a in np.linspace(0.0, 6.0, 9)]
    columns = [(X[:, k : k + 1], Y[:, k : k + 1]) for k in range(29)]
    one_by_one = [height_above_plane(crowd, x, y, UPRIGHT, 3.0, -3.0) for x, y in columns]
    assert np.array_equal(np.concatenate(one_by_one, axis=1), heights(*crowd))
    # A smooth surface has no steps from ray to ray where one form stops to count.
    x = np.linspace(0.55, 0.85, 4001)
    along = height_above_plane(crowd, x, np.zeros(4001), UPRIGHT, 3.0, -3.0)
    assert np.abs(np.diff(along, 2)).max() < 5e-4
