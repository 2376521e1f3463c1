"""P-values of differences whose stated uncertainties are too small by a common factor: it is found and used."""

from __future__ import annotations

import numpy as np
import pytest

from coupole.heritage.comparison.significance import of_lengths, of_vectors

POINTS, FREEDOM = 20_000, 12


@pytest.mark.parametrize("true_factor", [1.0, 1.5, 3.0])
def test_lengths_with_estimated_uncertainties_have_students_distribution(true_factor: float) -> None:
    rng = np.random.default_rng(5)
    u = np.sqrt(rng.chisquare(FREEDOM, POINTS) / FREEDOM)
    p, factor = of_lengths(true_factor * rng.normal(size=POINTS), u, FREEDOM)
    assert factor == pytest.approx(true_factor, rel=0.03)
    for level in (0.01, 0.05, 0.5):
        assert np.mean(p < level) == pytest.approx(level, rel=0.2)


@pytest.mark.parametrize("true_factor", [1.0, 1.5, 3.0])
def test_vectors_with_estimated_covariances_have_hotellings_distribution(true_factor: float) -> None:
    rng = np.random.default_rng(6)
    drawn = rng.normal(size=(POINTS, FREEDOM, 3))
    covariances = np.swapaxes(drawn, 1, 2) @ drawn / FREEDOM
    p, factor = of_vectors(true_factor * rng.normal(size=(POINTS, 3)), covariances, FREEDOM)
    assert factor == pytest.approx(true_factor, rel=0.03)
    for level in (0.01, 0.05, 0.5):
        assert np.mean(p < level) == pytest.approx(level, rel=0.2)


def test_stated_uncertainties_are_never_reduced_and_unknown_differences_have_no_p_value() -> None:
    rng = np.random.default_rng(7)
    assert of_lengths(0.5 * rng.normal(size=POINTS), np.ones(POINTS), 1e6)[1] == 1.0
    differences = 0.5 * rng.normal(size=(POINTS, 2))
    differences[3, 1] = np.nan
    p, factor = of_vectors(differences, np.tile(np.eye(2), (POINTS, 1, 1)), 1e6)
    assert factor == 1.0
    assert np.flatnonzero(np.isnan(p)).tolist() == [3]
