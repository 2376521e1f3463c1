"""Where an arm comes to rest: braking along the path costs nothing, across it everything."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from coupole.motion.path_deviation import deviation_at_rest_mm

REACH_MM = np.array([1200.0, 1100.0, 900.0, 500.0, 400.0, 300.0])
STOPPING_S = 0.5
postures = st.tuples(*[st.floats(-170, 170)] * 6).map(np.array)


@given(postures, postures, st.one_of(st.just(1.0), st.floats(0, 1)), st.floats(0, 2))
def test_an_arm_on_its_path_comes_to_rest_on_it_up_to_its_very_end(
    a: np.ndarray, b: np.ndarray, share: float, speed_per_s: float
) -> None:
    """Controllers tell angles with four decimals."""
    joints_deg = np.round(a + share * (b - a), 4)
    off_mm = deviation_at_rest_mm([a, b], joints_deg, speed_per_s * (b - a), REACH_MM, STOPPING_S)
    assert off_mm < 0.02


def test_an_arm_that_leaves_its_path_comes_to_rest_beside_it() -> None:
    a, b = np.zeros(6), np.array([0.0, 30.0, 0.0, 0.0, 0.0, 0.0])
    across_deg_s = np.array([2.0, 10.0, 0.0, 0.0, 0.0, 0.0])
    off_mm = deviation_at_rest_mm([a, b], 0.5 * b, across_deg_s, REACH_MM, STOPPING_S)
    assert off_mm == pytest.approx(np.radians(2.0) * 1200.0 * STOPPING_S)
