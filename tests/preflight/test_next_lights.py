"""The choice of the next lights, against scipy's interpolation with each light really left out, and by what it is
for: fewer errors between lights than as many lights that are merely spread."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.interpolate import RBFInterpolator

from coupole.preflight import next_lights as next_lights_module
from coupole.preflight.next_lights import FEWEST_TAKEN, left_out_squares, next_lights, spread_lights

Floats = NDArray[np.float64]


def dome(count: int = 400) -> Floats:
    """Directions [count, 3] spread evenly over the upper half of a sphere, by the golden angle."""
    number = np.arange(count)
    z = 1.0 - (number + 0.5) / count
    turn = number * np.pi * (3.0 - np.sqrt(5.0))
    r = np.sqrt(1.0 - z**2)
    return np.stack([r * np.cos(turn), r * np.sin(turn), z], axis=1)


def shiny_ball(directions: Floats) -> Floats:
    """Values [lights, sites] of normals up to 15 degrees from the top, under Phong's model: a matt body and a
    narrow highlight, which comes from lights up to 30 degrees from the top."""
    normals = dome(600)[:20]
    view = np.array([0.0, 0.0, 1.0])
    mirrored = 2.0 * normals * (normals @ view)[:, None] - view
    matt = np.maximum(directions @ normals.T, 0.0)
    return 0.3 * matt + np.maximum(directions @ mirrored.T, 0.0) ** 60


def rms_between(directions: Floats, values: Floats, taken: NDArray[np.int64]) -> float:
    others = np.setdiff1d(np.arange(len(directions)), taken)
    made = RBFInterpolator(directions[taken], values[taken], kernel="linear", degree=1)(directions[others])
    return float(np.sqrt(np.mean((made - values[others]) ** 2)))


def chosen(directions: Floats, values: Floats, count: int, burst: int) -> NDArray[np.int64]:
    every = np.arange(len(directions))
    taken = spread_lights(directions, every, 24)
    while len(taken) < count:
        taken = np.append(taken, next_lights(values[taken], directions, taken, every, burst).lights)
    return taken[:count]


def test_errors_of_left_out_lights_are_those_of_scipy_with_each_left_out() -> None:
    directions = dome(30)
    values = np.random.default_rng(3).normal(size=(30, 7))
    expected = []
    for light in range(30):
        others = np.delete(np.arange(30), light)
        made = RBFInterpolator(directions[others], values[others], kernel="linear", degree=1)(directions[[light]])
        expected.append(np.mean((made - values[light]) ** 2))
    np.testing.assert_allclose(left_out_squares(values, directions), expected, rtol=2e-4)


@pytest.mark.parametrize("burst", [1, 8, 32])
def test_where_a_highlight_passes_it_looks_more_closely(burst: int) -> None:
    directions = dome()
    values = shiny_ball(directions)
    taken = chosen(directions, values, 104, burst)
    assert len(set(taken.tolist())) == 104
    spread = spread_lights(directions, np.arange(len(directions)), 104)
    ours, theirs = rms_between(directions, values, taken), rms_between(directions, values, spread)
    assert ours < 0.8 * theirs, "2 dB at least"


def test_a_matt_body_is_never_much_worse_than_with_spread_lights() -> None:
    directions = dome()
    values = np.maximum(directions @ dome(150)[:40].T, 0.0)
    taken = chosen(directions, values, 88, 16)
    spread = spread_lights(directions, np.arange(len(directions)), 88)
    assert rms_between(directions, values, taken) < 1.05 * rms_between(directions, values, spread)


def test_the_expected_error_is_the_one_that_is_found() -> None:
    directions = dome()
    values = shiny_ball(directions)
    for count in (56, 104, 152):
        taken = chosen(directions, values, count, 16)
        said = next_lights(values[taken], directions, taken, np.arange(len(directions)), 16)
        bright = np.quantile(values[taken], 0.999)
        assert 0.5 < said.expected_rms * bright / rms_between(directions, values, taken) < 2.0
        assert said.expected_rms_after < said.expected_rms


def test_hidden_lights_are_never_chosen_and_the_last_ones_end_it() -> None:
    directions = dome(40)
    values = shiny_ball(directions)
    allowed = np.arange(0, 40, 2)
    taken = spread_lights(directions, allowed, 8)
    assert set(taken.tolist()) <= set(allowed.tolist())
    said = next_lights(values[taken], directions, taken, allowed, 50)
    assert sorted([*said.lights.tolist(), *taken.tolist()]) == allowed.tolist()
    assert said.expected_rms_after == 0.0
    nothing_left = next_lights(values[allowed], directions, allowed, allowed, 5)
    assert len(nothing_left.lights) == 0
    assert nothing_left.expected_rms == 0.0


def test_the_same_is_chosen_twice_and_alternatives_are_others() -> None:
    directions = dome(100)
    values = shiny_ball(directions)
    taken = spread_lights(directions, np.arange(100), 12)
    first, again = (next_lights(values[taken], directions, taken, np.arange(100), 6) for _ in range(2))
    assert first.lights.tolist() == again.lights.tolist()
    assert not set(first.alternatives) & {int(first.lights[0]), *taken.tolist()}


@pytest.mark.parametrize("coming", [1, 5, 11])
def test_lights_whose_pictures_are_still_to_come_count_as_taken(coming: int) -> None:
    directions = dome(100)
    values = shiny_ball(directions)
    every, taken = np.arange(100), spread_lights(directions, np.arange(100), 24)
    at_once = next_lights(values[taken], directions, taken, every, 12)
    first = next_lights(values[taken], directions, taken, every, coming)
    rest = next_lights(values[taken], directions, taken, every, 12 - coming, coming_lights=first.lights)
    assert [*first.lights, *rest.lights] == at_once.lights.tolist()
    assert rest.expected_rms == pytest.approx(first.expected_rms_after, rel=1e-9)
    assert rest.expected_rms_after == pytest.approx(at_once.expected_rms_after, rel=1e-9)


def test_expected_errors_are_those_of_a_field_given_the_lights_taken() -> None:
    """By numpy's own inverse of the whole covariance, with a field as strong everywhere."""
    directions = dome(60)
    taken = spread_lights(directions, np.arange(60), 20)
    errors = next_lights_module._Errors(np.exp(-np.arccos(np.clip(directions @ directions.T, -1, 1))))
    whole = np.exp(-np.arccos(np.clip(directions @ directions.T, -1, 1)))
    for light in taken.tolist():
        errors.take(light)
    left = np.setdiff1d(np.arange(60), taken)
    given = (
        whole[np.ix_(left, left)]
        - whole[np.ix_(left, taken)] @ np.linalg.inv(whole[np.ix_(taken, taken)]) @ whole[np.ix_(taken, left)]
    )
    assert np.allclose(errors.variances[left], np.diag(given), rtol=1e-9)


@pytest.mark.parametrize("directions", [np.tile(dome(12), (2, 1)), np.eye(3)[[0, 1, 0, 1]].repeat(3, axis=0)])
def test_lights_in_one_place_or_one_plane_are_no_error(directions: Floats) -> None:
    values = np.random.default_rng(1).random((len(directions), 5))
    taken = np.arange(8)
    said = next_lights(values[taken], directions, taken, np.arange(len(directions)), 2)
    assert np.isfinite(said.expected_rms)
    assert not set(said.lights.tolist()) & set(taken.tolist())


def test_black_pictures_still_have_a_next_light() -> None:
    directions = dome(50)
    taken = spread_lights(directions, np.arange(50), 10)
    said = next_lights(np.zeros((10, 4)), directions, taken, np.arange(50), 3)
    assert len(said.lights) == 3
    assert said.expected_rms < 1e-100


def test_too_few_lights_are_refused() -> None:
    with pytest.raises(ValueError, match="at least 6 lights"):
        next_lights(np.ones((5, 2)), dome(20), np.arange(FEWEST_TAKEN - 1), np.arange(20), 1)
