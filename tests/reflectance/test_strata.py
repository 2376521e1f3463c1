"""Quantiles by strata: they hold in each stratum at once, and small strata say little."""

from __future__ import annotations

import numpy as np
import pytest

from coupole.reflectance.strata import fit_strata

LIGHTS = 40


def drawn_errors(seed: int) -> tuple[np.ndarray, dict[str, np.ndarray], np.ndarray]:
    """Absolute errors that depend on two ways to divide the samples, their strata, and their lights."""
    random = np.random.default_rng(seed)
    labels = {"first": random.integers(0, 4, 60_000), "second": random.integers(0, 3, 60_000)}
    scale = np.array([1.0, 2.0, 5.0, 0.3])[labels["first"]] * np.array([1.0, 0.2, 3.0])[labels["second"]]
    return np.abs(random.normal(0.0, scale)), labels, random.integers(0, LIGHTS, 60_000)


@pytest.mark.parametrize("level", [0.95, 0.6827])
def test_quantiles_hold_in_each_stratum_of_new_errors(level: float) -> None:
    factors = fit_strata(*drawn_errors(0), level)
    errors, labels, _ = drawn_errors(1)
    inside = errors <= factors.quantiles(labels)
    for stratum in labels.values():
        for number in np.unique(stratum):
            assert inside[stratum == number].mean() == pytest.approx(level, abs=0.02)


def test_a_stratum_of_one_light_counts_less_than_one_of_many() -> None:
    random = np.random.default_rng(0)
    labels = np.repeat([0, 1, 2], [20_000, 2_000, 2_000])
    errors = np.abs(random.normal(0.0, np.repeat([1.0, 4.0, 4.0], [20_000, 2_000, 2_000])))
    lights = random.integers(0, LIGHTS, len(labels))
    lights[labels == 2] = 0
    factors = fit_strata(errors, {"all": labels}, lights, 0.95)
    of_many, of_one = np.exp(factors.log_factors["all"][1:3] - factors.log_factors["all"][0])
    assert of_many > 2.5
    assert of_one < of_many


def test_a_stratum_that_was_never_seen_has_the_common_quantile() -> None:
    errors, labels, lights = drawn_errors(0)
    factors = fit_strata(errors, {"first": labels["first"]}, lights, 0.95)
    assert factors.quantiles({"first": np.array([7])})[0] == pytest.approx(np.exp(factors.log_quantile))
