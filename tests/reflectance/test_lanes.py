"""Eight numbers at once against NumPy's."""

from __future__ import annotations

import numba
import numpy as np
import pytest

from coupole.kernels.lanes import (
    absolute,
    add_in_turns,
    four_gathered,
    gather_lanes,
    if_less,
    in_turns,
    lanes,
    larger,
    load_row,
    root,
    store,
    store_halves,
    total,
)


@numba.njit
def halves(numbers, bits):  # type: ignore[no-untyped-def]
    for row in range(len(numbers)):
        store_halves(load_row(numbers, row), bits[row])


@numba.njit(error_model="numpy")
def combined(numbers, bits):  # type: ignore[no-untyped-def]
    one, other = load_row(numbers, 0), load_row(numbers, 1)
    store_halves(root(absolute(one - other)) / np.float32(3.0), bits[0])
    store_halves(larger(one, np.float32(0.5) * other), bits[1])
    store_halves(if_less(one, other, one + other, np.float32(7.0)), bits[2])


@numba.njit
def picked(arrays, rows, place, bits):  # type: ignore[no-untyped-def]
    store_halves(gather_lanes(arrays, rows, place), bits)


def test_halves_are_those_of_numpy() -> None:
    """From the smallest to the largest, ties, and what is none."""
    random = np.random.default_rng(1)
    numbers = np.exp(random.uniform(np.log(1e-8), np.log(6e4), 5000)).astype(np.float32)
    ties = (np.arange(2048, 4096) + 0.5).astype(np.float32)
    numbers = np.concatenate([numbers, -numbers, ties, [0.0, np.nan], np.zeros(6)]).astype(np.float32)
    found = np.empty((len(numbers) // 8, 8), np.uint16)
    halves(numbers.reshape(-1, 8), found)
    np.testing.assert_array_equal(found.view(np.float16).ravel(), numbers.astype(np.float16))


def test_lanes_are_reckoned_each_for_itself() -> None:
    numbers = np.random.default_rng(2).normal(0, 1, (2, 8)).astype(np.float32)
    numbers[0, 3], numbers[1, 5], numbers[1, 6] = np.nan, np.inf, numbers[0, 6]
    found = np.empty((3, 8), np.uint16)
    combined(numbers, found)
    one, other = numbers
    with np.errstate(invalid="ignore"):
        wanted = [
            np.sqrt(np.abs(one - other)) / np.float32(3.0),
            np.where(one > other / 2, one, other / 2),
            np.where(one < other, one + other, 7.0),
        ]
    np.testing.assert_array_equal(found.view(np.float16), np.array(wanted).astype(np.float16))


@numba.njit
def doubled(numbers, found):  # type: ignore[no-untyped-def]
    made = lanes(3.0) / load_row(numbers, 1)
    made -= 0.1
    store(made, found, 2)
    return total(made)


def test_lanes_of_double_precision_round_as_doubles_do() -> None:
    numbers, found = np.random.default_rng(4).uniform(1, 2, (2, 8)), np.zeros((3, 8))
    summed = doubled(numbers, found)
    np.testing.assert_array_equal(found[2], 3.0 / numbers[1] - 0.1)
    assert not found[:2].any()
    assert summed == pytest.approx(found[2].sum(), rel=1e-15)


def test_lanes_of_two_precisions_are_not_mixed() -> None:
    mixed = numba.njit(lambda one, other, found: store(load_row(one, 0) + load_row(other, 0), found, 0))
    with pytest.raises(numba.errors.TypingError, match="expected lanes of one precision"):
        mixed(np.zeros((1, 8)), np.zeros((1, 8), np.float32), np.zeros((1, 8)))


def test_lanes_are_gathered_from_eight_rows() -> None:
    frames = np.random.default_rng(3).integers(0, 2048, (11, 50)).astype(np.uint16)
    rows, found = np.array([3, 1, 10, 0, 7, 7, 2, 5]), np.empty(8, np.uint16)
    picked(frames[:, ::5], rows, 6, found)
    np.testing.assert_array_equal(found.view(np.float16), frames[rows, 30])


@numba.njit
def four_of(arrays, rows, first, found):  # type: ignore[no-untyped-def]
    one, two, three, four = four_gathered(arrays, rows, first)
    store(one, found, 0)
    store(two, found, 1)
    store(three, found, 2)
    store(four, found, 3)


def test_four_numbers_of_eight_rows_become_four_lanes() -> None:
    numbers, found = (
        np.random.default_rng(6).normal(0, 1, (11, 7)).astype(np.float32),
        np.empty((4, 8), np.float32),
    )
    rows = np.array([3, 1, 10, 0, 7, 7, 2, 5])
    four_of(numbers, rows, 3, found)
    np.testing.assert_array_equal(found, numbers[rows, 3:].T)


@numba.njit
def twice_and_next(points, found):  # type: ignore[no-untyped-def]
    x, y, z = in_turns(points, 1)
    add_in_turns(x + x, y + y, z + z, found, 2)
    add_in_turns(y, z, x, found, 2)


def test_three_lanes_take_turns_in_a_row() -> None:
    points = np.random.default_rng(7).normal(0, 1, (2, 24)).astype(np.float32)
    found = np.ones((4, 24), np.float32)
    twice_and_next(points, found)
    x = points[1].reshape(8, 3)
    np.testing.assert_array_equal(found[2].reshape(8, 3), 1 + 2 * x + np.roll(x, -1, axis=1))
    assert (found[[0, 1, 3]] == 1).all()


def test_rows_that_are_not_contiguous_are_refused() -> None:
    with pytest.raises(numba.errors.TypingError, match="expected an array in C order, got the order F"):
        halves(np.zeros((8, 8), np.float32, order="F"), np.empty((8, 8), np.uint16))
