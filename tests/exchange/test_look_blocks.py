"""Numbers that a page carries lose no more than it says."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from coupole.exchange.look.look_blocks import (
    LOG_LEAST,
    LOG_RATIO,
    LOG_STEPS,
    block_of,
    halves,
    log_coded,
    octahedral,
)


@given(st.floats(1e-4, 10.0))
def test_an_uncertainty_is_kept_to_a_fortieth(value: float) -> None:
    (code,) = log_coded(np.array([value]))
    assert LOG_LEAST * LOG_RATIO ** ((int(code) - 1) / LOG_STEPS) == pytest.approx(value, rel=0.0232)


def test_an_uncertainty_that_is_not_known_is_told_from_the_least_one() -> None:
    assert log_coded(np.array([np.nan, np.inf, 0.0, 1e-5, 99.0])).tolist() == [0, 0, 1, 1, 255]


def test_normals_turn_by_less_than_a_250th_of_a_degree() -> None:
    drawn = np.random.default_rng(1).normal(size=(20_000, 3))
    drawn[:3] = np.eye(3)
    drawn[3:6] = -np.eye(3)
    normals = drawn / np.linalg.norm(drawn, axis=1, keepdims=True)
    x, y = (octahedral(normals) / 65535.0 * 2.0 - 1.0).T
    z = 1.0 - np.abs(x) - np.abs(y)
    over = np.maximum(-z, 0.0)  # what is folded out goes back
    read = np.stack([x - np.copysign(over, x), y - np.copysign(over, y), z], axis=1)
    read /= np.linalg.norm(read, axis=1, keepdims=True)
    off = np.degrees(np.linalg.norm(np.cross(read, normals), axis=1))
    assert off.max() < 0.004
    assert (np.einsum("nk,nk->n", read, normals) > 0).all()


@given(st.floats(0.0, 65504.0) | st.floats(0.0, 1e-4))
def test_a_half_is_off_by_no_more_than_a_page_says(value: float) -> None:
    assert halves(np.array([value])).astype(np.float64)[0] == pytest.approx(value, rel=5e-4, abs=3e-8)


def test_a_kind_of_number_that_pages_do_not_read_is_refused() -> None:
    with pytest.raises(ValueError, match="float64"):
        block_of("kd", np.zeros(3))
