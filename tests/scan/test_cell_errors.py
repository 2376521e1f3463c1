"""The covariance by cells of space is that of a jackknife: each cell left out in turn, and all fitted anew."""

from __future__ import annotations

import numpy as np
import pytest

from coupole.scan.registration.cell_errors import Overlap, gradient_covariance

SCANS, CELL_MM = 3, 10.0
FREE = np.arange(6, 6 * SCANS)
"""The first scan stands still."""


def made_up() -> tuple[list[Overlap], list[np.ndarray]]:
    """Overlaps of three scans in five cells, whose distances are what is left of a least squares fit; weights."""
    rng = np.random.default_rng(3)
    pairs = [(0, 1), (1, 2), (0, 2)]
    points_mm = [np.c_[rng.uniform(-20, 30, 90), rng.uniform(0, 9, (90, 2))] for _ in pairs]
    derivatives = [rng.normal(size=(90, 12)) for _ in pairs]
    weights = [rng.uniform(0.5, 2.0, 90) for _ in pairs]
    measured_mm = [rng.normal(size=90) for _ in pairs]
    rows, columns = (
        np.zeros((270, 6 * SCANS)),
        [np.r_[6 * a + np.arange(6), 6 * b + np.arange(6)] for a, b in pairs],
    )
    for number, (derivative, column) in enumerate(zip(derivatives, columns, strict=True)):
        rows[90 * number : 90 * number + 90, column] = derivative
    root = np.sqrt(np.concatenate(weights))
    steps = np.linalg.lstsq(rows[:, FREE] * root[:, None], np.concatenate(measured_mm) * root, rcond=None)[0]
    off_mm = np.split(np.concatenate(measured_mm) - rows[:, FREE] @ steps, len(pairs))
    some_mm = np.ones(90)
    return [
        Overlap(*pair, derivative, off, points, some_mm)
        for pair, derivative, off, points in zip(pairs, derivatives, off_mm, points_mm, strict=True)
    ], weights


def equations(
    overlaps: list[Overlap], weights: list[np.ndarray], left_out: int | None
) -> tuple[np.ndarray, np.ndarray]:
    """Normal matrix and gradient of all points but those of a cell, along x."""
    normal, gradient = np.zeros((6 * SCANS,) * 2), np.zeros(6 * SCANS)
    for overlap, weight in zip(overlaps, weights, strict=True):
        kept = np.floor(overlap.points_mm[:, 0] / CELL_MM) != (np.inf if left_out is None else left_out)
        rows = overlap.derivatives[kept]
        normal[np.ix_(overlap.columns, overlap.columns)] += (rows * weight[kept, None]).T @ rows
        gradient[overlap.columns] += (rows * weight[kept, None]).T @ overlap.off_mm[kept]
    return normal[np.ix_(FREE, FREE)], gradient[FREE]


def test_it_is_that_of_all_fitted_anew_without_each_cell() -> None:
    overlaps, weights = made_up()
    normal, gradient = equations(overlaps, weights, None)
    assert gradient == pytest.approx(0.0, abs=1e-10)
    expected = np.zeros_like(normal)
    for cell in range(-2, 3):
        step = np.linalg.solve(*equations(overlaps, weights, cell))
        expected += np.outer(step, step)
    inverse = np.zeros((6 * SCANS,) * 2)
    inverse[np.ix_(FREE, FREE)] = np.linalg.inv(normal)
    got = inverse @ gradient_covariance(overlaps, weights, inverse, CELL_MM) @ inverse
    np.testing.assert_allclose(got[np.ix_(FREE, FREE)], expected, rtol=1e-9)
    assert not got[:6].any()


def test_without_overlaps_there_is_none() -> None:
    assert not gradient_covariance([], [], np.eye(6), CELL_MM).any()
