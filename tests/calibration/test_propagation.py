"""Propagation of distributions against published examples and closed forms."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from coupole.calibration.budget.propagation import Inputs, Quantity, linear, monte_carlo, tolerance, validate
from coupole.calibration.rotations import Floats
from coupole.errors import InputError

ROOT3 = 3.0**0.5


def added(q: Mapping[str, Floats]) -> Floats:
    total: Floats = sum(q.values(), np.zeros(1))
    return total


def four(shape: str, last_u: float = 1.0) -> Inputs:
    """JCGM 101, 9.2: four quantities that are added up."""
    return Inputs(tuple(Quantity(f"x{i}", 0.0, u, shape) for i, u in enumerate((1.0, 1.0, 1.0, last_u))))  # type: ignore[arg-type]


def mass(q: Mapping[str, Floats]) -> Floats:
    """JCGM 101, 9.3, equation 32: deviation of a weight from its nominal 100 g, mg."""
    buoyancy = (q["rho_air"] - 1.2) * (1 / q["rho_w"] - 1 / q["rho_r"])
    return (q["m_r"] + q["dm_r"]) * (1 + buoyancy) - 100_000.0


MASS = Inputs(
    (
        Quantity("m_r", 100_000.0, 0.05),
        Quantity("dm_r", 1.234, 0.02),
        Quantity("rho_air", 1.2, 0.1 / ROOT3, "rectangular"),
        Quantity("rho_w", 8000.0, 1000 / ROOT3, "rectangular"),
        Quantity("rho_r", 8000.0, 50 / ROOT3, "rectangular"),
    )
)


@pytest.mark.parametrize(
    ("inputs", "u", "half"),
    [(four("normal"), 2.00, 3.92), (four("rectangular"), 2.00, 3.88), (four("rectangular", 10.0), 10.15, 17.0)],
)
def test_sums_have_the_published_intervals(inputs: Inputs, u: float, half: float) -> None:
    found = monte_carlo(added, inputs, coverages=(0.95,), digits=3, most_trials=1_000_000)
    low_high = found.interval(0.95, "symmetric")
    assert found.u == pytest.approx(u, rel=0.004)
    assert (low_high.low, low_high.high) == pytest.approx((-half, half), rel=0.006)


def test_the_linear_formula_overstates_a_dominating_rectangle_as_published() -> None:
    found = linear(added, four("rectangular", 10.0), (0.95,)).result
    assert found.intervals[0].high == pytest.approx(19.9, abs=0.05)


def test_mass_calibration_has_the_published_digits() -> None:
    numeric = monte_carlo(mass, MASS, coverages=(0.95,), digits=2)
    shortest = numeric.interval(0.95, "shortest")
    assert numeric.estimate == pytest.approx(1.234, abs=5e-4)
    assert numeric.u == pytest.approx(0.0754, abs=5e-4)
    assert (shortest.low, shortest.high) == pytest.approx((1.083, 1.382), abs=3e-3)
    straight = linear(mass, MASS, (0.95,)).result
    assert straight.u == pytest.approx(0.0539, abs=1e-4)
    assert straight.intervals[0].low == pytest.approx(1.1285, abs=2e-4)
    assert straight.intervals[0].high == pytest.approx(1.3395, abs=2e-4)
    assert not any(test.is_within_tolerance for test in validate(straight, numeric, digits=1))


def test_a_product_of_powers_agrees_with_its_closed_form() -> None:
    """exp of a normal sum: ln f has the variance of the sum of p_i^2 u_i^2."""
    inputs = Inputs((Quantity("a", 0.0, 0.1), Quantity("b", 0.0, 0.2)))
    found = monte_carlo(lambda q: np.exp(2 * q["a"] - q["b"]), inputs, digits=3, most_trials=2_000_000)
    sigma = np.hypot(0.2, 0.2)
    for coverage, k in ((0.68, 0.99446), (0.95, 1.95996)):
        interval = found.interval(coverage, "symmetric")
        assert interval.low == pytest.approx(np.exp(-k * sigma), rel=0.004)
        assert interval.high == pytest.approx(np.exp(k * sigma), rel=0.004)
    assert found.u == pytest.approx(np.sqrt(np.expm1(sigma**2) * np.exp(sigma**2)), rel=0.01)
    shortest = found.interval(0.95, "shortest")
    assert shortest.high - shortest.low < 2 * np.exp(sigma**2 / 2) * np.sinh(1.95996 * sigma)


def test_a_linear_model_of_normal_inputs_passes_the_comparison_for_sure() -> None:
    inputs = four("normal")
    numeric = monte_carlo(added, inputs, digits=1, within=0.2)
    found = validate(linear(added, inputs).result, numeric, digits=1)
    assert all(test.is_within_tolerance and test.sure for test in found)
    assert {test.tolerance for test in found} == {0.5}, "u = 2 is 2 x 10^0 to one digit"


def test_a_comparison_with_too_few_trials_near_the_tolerance_is_not_sure() -> None:
    inputs = four("normal")
    found = validate(linear(added, inputs).result, monte_carlo(added, inputs, most_trials=20_000), digits=3)
    assert not all(test.sure for test in found)


def test_the_ends_scatter_as_much_as_is_said_of_them() -> None:
    inputs = four("normal")
    runs = [monte_carlo(added, inputs, coverages=(0.95,), most_trials=100_000, seed=seed) for seed in range(40)]
    lows = np.array([run.interval(0.95, "symmetric").low for run in runs])
    said = np.median([run.interval(0.95, "symmetric").numerical for run in runs])
    assert 0.6 < said / (2 * lows.std(ddof=1)) < 2.0


def test_a_fifth_of_the_tolerance_takes_many_more_trials() -> None:
    inputs = four("normal")
    rough, fine = (monte_carlo(added, inputs, within=within, most_trials=4_000_000) for within in (1.0, 0.2))
    assert rough.stable
    assert fine.stable
    assert fine.trials > 5 * rough.trials


@given(st.floats(-0.99, 0.99))
def test_correlation_changes_a_difference_as_it_must(r: float) -> None:
    inputs = Inputs((Quantity("a", 5.0, 1.0), Quantity("b", 3.0, 2.0)), (("a", "b", r),))
    found = linear(lambda q: q["a"] - q["b"], inputs).result
    assert found.u == pytest.approx(np.sqrt(1 + 4 - 4 * r), rel=1e-6)


def test_correlated_samples_have_their_correlation() -> None:
    inputs = Inputs((Quantity("a", 5.0, 1.0), Quantity("b", 3.0, 2.0)), (("a", "b", 0.9),))
    found = monte_carlo(lambda q: q["a"] - q["b"], inputs, most_trials=500_000)
    assert found.u == pytest.approx(np.sqrt(5 - 3.6), rel=0.01)


def test_impossible_correlations_are_refused() -> None:
    quantities = tuple(Quantity(name, 0.0, 1.0) for name in "abc")
    inputs = Inputs(quantities, (("a", "b", 0.9), ("b", "c", 0.9), ("a", "c", -0.9)))
    with pytest.raises(InputError, match="no quantities can have these correlations"):
        linear(added, inputs)


@given(st.floats(1e-6, 1e6), st.integers(1, 4))
def test_the_tolerance_is_half_a_unit_of_the_last_digit(u: float, digits: int) -> None:
    power = np.floor(np.log10(2 * tolerance(u, digits)) + 0.5)
    assert 10 ** (digits - 1) - 0.5 <= u / 10**power <= 10**digits


def test_effective_degrees_of_freedom_are_welchs_and_satterthwaites() -> None:
    inputs = Inputs((Quantity("a", 0.0, 1.0, degrees_of_freedom=4), Quantity("b", 0.0, 1.0, degrees_of_freedom=4)))
    assert linear(added, inputs).degrees_of_freedom == pytest.approx(8.0)
