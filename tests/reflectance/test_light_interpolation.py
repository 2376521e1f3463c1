import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from picture_cases import lights_in_rings
from scipy.interpolate import RBFInterpolator

from coupole.reflectance.light_interpolation import KERNELS, left_without, nearest, weights

LIGHTS = lights_in_rings()
BETWEEN = LIGHTS[1:20] + LIGHTS[2:21]
BETWEEN /= np.linalg.norm(BETWEEN, axis=1, keepdims=True)


@pytest.mark.parametrize(
    ("kernel", "theirs"), [("linear", "linear"), ("thin plate", "thin_plate_spline"), ("cubic", "cubic")]
)
def test_sums_are_those_of_scipy(kernel: str, theirs: str) -> None:
    values = np.random.default_rng(1).normal(size=(len(LIGHTS), 5))
    expected = RBFInterpolator(LIGHTS, values, kernel=theirs, degree=1)(BETWEEN)
    np.testing.assert_allclose(weights(LIGHTS, BETWEEN, kernel) @ values, expected, rtol=0, atol=1e-8)


@pytest.mark.parametrize("kernel", KERNELS)
@given(slope=st.tuples(*[st.floats(-10, 10)] * 4))
@settings(max_examples=20)
def test_what_is_linear_in_the_direction_is_kept(kernel: str, slope: tuple[float, ...]) -> None:
    def value(directions: np.ndarray) -> np.ndarray:
        return directions @ np.array(slope[:3]) + slope[3]

    np.testing.assert_allclose(weights(LIGHTS, BETWEEN, kernel) @ value(LIGHTS), value(BETWEEN), atol=1e-7)


@pytest.mark.parametrize("kernel", KERNELS)
def test_a_measured_light_is_given_back(kernel: str) -> None:
    np.testing.assert_allclose(weights(LIGHTS, LIGHTS, kernel), np.eye(len(LIGHTS)), atol=1e-8)


def test_lights_in_one_ring_leave_no_hole() -> None:
    """All have one z: the tail's slope along z is open, and must not blow up."""
    ring = LIGHTS[1:10]
    made = weights(ring, (ring[:1] + ring[1:2]) / np.linalg.norm(ring[0] + ring[1]), "linear")
    assert np.abs(made).max() < 2
    assert made.sum() == pytest.approx(1.0, abs=0.01)


def test_a_light_goes_with_its_neighbours() -> None:
    left = left_without(LIGHTS, 3, 2)
    assert len(left) == len(LIGHTS) - 3
    assert set(range(len(LIGHTS))) - set(left.tolist()) == set(nearest(LIGHTS, LIGHTS[3], 3).tolist())


def test_of_lights_that_are_equally_near_the_first_is_taken_whatever_the_last_bits_say() -> None:
    top = np.array([0.0, 0.0, 1.0])
    for off in (0.0, 1e-15, -1e-15):
        assert nearest(LIGHTS, top + np.array([off, -off, 0]), 10).tolist() == list(range(10))
