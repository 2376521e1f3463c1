"""Regularised least squares against NumPy's solution of the problem that is written out."""

from __future__ import annotations

import numpy as np
import pytest

from coupole.reflectance.least_squares import factorise, gram, one_thread, solve, solve_by_samples, sums


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
        assert solve_by_samples(rows, penalty, values.copy(), np.empty(3 * count * count), right)
    np.testing.assert_allclose(right, wanted, atol=1e-9)
