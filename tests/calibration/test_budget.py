"""The budget of a reflectance: against the paper's figures, and against itself."""

from __future__ import annotations

from dataclasses import replace
from functools import cache

import numpy as np
import pytest

from coupole.calibration.budget.budget import Budget, Geometry, Known, budget_of, sample_inputs, spread_over
from coupole.calibration.budget.measurement import reflectance, reflectance_of
from coupole.calibration.budget.propagation import linear
from coupole.calibration.light.irradiance import irradiance_per_flux
from coupole.errors import InputError


@cache
def budget_at(incidence_deg: float) -> Budget:
    return budget_of(Known(), Geometry(incidence_deg), most_trials=20_000)


def test_a_surface_gives_back_the_reflectance_that_it_was_made_with() -> None:
    """A small Lambertian emitter at 1 m: E = Phi cos_i cos_e / (pi d^2)."""
    led, axis = 1000 * np.array([0.6, 0, 0.8]), -np.array([0.6, 0, 0.8])
    lit = 2e4 * 0.8 / np.pi
    exact = irradiance_per_flux(np.zeros(3), np.array([0.0, 0, 1]), led, axis)
    f = reflectance(0.25 * lit * 0.01 * 0.9, 0.01, 0.9, 2e4, exact)
    assert f == pytest.approx(0.25, rel=2e-5)


def test_the_samples_quantities_give_the_surfaces_own_reflectance() -> None:
    inputs, axis = sample_inputs(Known(), Geometry(40.0))
    q = {name: np.array([value]) for name, value in inputs.values().items()}
    twice = {**q, "power.own": np.array([2.0])}
    assert reflectance_of(twice, axis)[0] == pytest.approx(reflectance_of(q, axis)[0] / 2)
    paper = reflectance_of(q, axis, emission="paper")[0]
    assert reflectance_of(q, axis)[0] / paper == pytest.approx(np.cos(np.radians(10.0)), rel=1e-5)


def test_half_of_a_domes_samples_are_as_uncertain_as_the_paper_says() -> None:
    """Lucat et al. 2025, section 6.1: half of all within [-10.66, +14.00] %, at 68 %."""
    cosines = np.linspace(0.98, 0.5, 9)
    found = spread_over(Known(), [Geometry(float(np.degrees(np.arccos(c)))) for c in cosines])
    low, high = found.half
    assert -0.14 < low < -0.07
    assert 0.10 < high < 0.19
    assert -found.best[0] < 0.03
    assert found.most[0] < low
    assert found.most[1] > high


def test_a_better_scanner_helps_as_much_as_the_paper_says() -> None:
    """Lucat et al. 2025, section 7: with 20 um the median falls to [-8.11, +9.51] %."""
    better = budget_of(Known(vertex_mm=0.02), Geometry(42.0), most_trials=20_000).relative(0.68)
    today = budget_at(42.0).relative(0.68)
    assert 0.5 < (better[1] - better[0]) / (today[1] - today[0]) < 0.85


def test_vertices_dominate_at_oblique_light() -> None:
    shares = budget_at(42.0).shares
    assert shares[0].source == "vertices"
    assert shares[0].width_decrease > 0.5
    assert sum(share.linear for share in shares) == pytest.approx(1.0)


def test_intervals_are_asymmetric_where_the_normal_is_uncertain() -> None:
    low, high = budget_at(42.0).relative(0.68)
    assert high > -1.1 * low
    assert not any(validation.is_within_tolerance for validation in budget_at(42.0).validations)


def test_with_exact_vertices_the_linear_formula_will_do() -> None:
    found = budget_of(Known(vertex_mm=1e-6), Geometry(30.0), digits=1, most_trials=300_000)
    assert all(validation.is_within_tolerance for validation in found.validations if validation.digits == 1)
    assert found.numeric.u == pytest.approx(found.linear.result.u, rel=0.02)


def test_an_error_that_led_and_mesh_share_drops_out() -> None:
    same = replace(Known(), vertex_mm=1e-6, led_mm=5.0, mesh_mm=5.0, led_deg=1e-6, mesh_deg=1e-6, pixels=100_000)

    def u(robot_mm: float) -> float:
        inputs, axis = sample_inputs(replace(same, robot_mm=robot_mm), Geometry(50.0))
        return linear(lambda q: reflectance_of(q, axis), inputs).result.u

    assert u(4.9) < 0.95 * u(0.0)


def test_a_light_below_the_horizon_is_refused() -> None:
    with pytest.raises(InputError, match="from 0 to 88 deg, found 95"):
        budget_of(Known(), Geometry(95.0))
