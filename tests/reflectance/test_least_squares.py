"""Regularised least squares against NumPy's solution of the problem that is written out."""

from __future__ import annotations

import numpy as np
import pytest

from coupole.reflectance.least_squares import (
    factorise,
    gram,
    left_out,
    one_thread,
    solve,
    solve_by_samples,
    sums,
)


@pytest.mark.parametrize("samples", [24, 60, 99])
def test_fewer_samples_than_functions_give_the_same_solution(samples: int) -> None:
    random, count = np.random.default_rng(samples), 100
    rows, values = random.normal(0, 1, (count, samples)), random.normal(0, 1, (3, samples))
    penalty = 10.0 ** random.uniform(-6, 0, count)
    penalty[7] = 1e9  # a coefficient that is held at 0
    design = np.concatenate([rows.T, np.diag(np.sqrt(penalty))])
    wanted = np.linalg.lstsq(design, np.concatenate([values.T, np.zeros((count, 3))]), rcond=None)[0].T
    right, product, factor = np.empty((3, count)), np.zeros((count, count)), np.empty((count, count))
    with one_thread():
        gram(rows, product)
        assert factorise(product, penalty, factor)
        sums(rows, values, right)
        solve(factor, right)
        np.testing.assert_allclose(right, wanted, atol=1e-7)
        room, factor = np.empty(2 * count * count), np.empty((samples, samples))
        assert solve_by_samples(rows, penalty, values.copy(), room, factor, right)
    np.testing.assert_allclose(right, wanted, atol=1e-9)


@pytest.mark.parametrize("samples", [30, 140])
def test_a_sample_left_out_is_missed_by_the_fit_to_the_others(samples: int) -> None:
    random, count = np.random.default_rng(samples), 60
    rows, values = random.normal(0, 1, (count, samples)), random.normal(0, 1, (2, samples))
    penalty, right = 10.0 ** random.uniform(-2, 1, count), np.empty((2, count))
    size, left, off = min(count, samples), values.copy(), np.empty((2, -(-samples // 7)))
    factor = np.empty((size, size))
    with one_thread():
        if samples < count:
            assert solve_by_samples(rows, penalty, left, np.empty(2 * count * count), factor, right)
        else:
            product = np.zeros((count, count))
            gram(rows, product)
            assert factorise(product, penalty, factor)
            sums(rows, values, right)
            solve(factor, right)
        left_out(rows, left, right, factor, 7, off)
    for place, sample in enumerate(range(0, samples, 7)):
        others = np.delete(np.arange(samples), sample)
        design = np.concatenate([rows[:, others].T, np.diag(np.sqrt(penalty))])
        fit = np.linalg.lstsq(design, np.concatenate([values[:, others].T, np.zeros((count, 2))]), rcond=None)[0]
        np.testing.assert_allclose(off[:, place], values[:, sample] - rows[:, sample] @ fit, rtol=1e-7)
