"""Bounds in closed form against Monte Carlo through the measurement equation, and each source by itself."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from triangle_cases import unit

from coupole.calibration.budget.measurement import reflectance
from coupole.calibration.light.irradiance import Emission, irradiance_per_flux
from coupole.reflectance.run_uncertainty import percentiles
from coupole.reflectance.sample_uncertainty import SOURCES, MonteCarlo, Places, Sources, bounds, tilt_covariance

COUNT = 40


def placed(incidence_deg: float, side_mm: float = 1.0) -> Places:
    """Triangles of all shapes, turned about the middle of a dome, each under a LED at this angle that faces it."""
    random = np.random.default_rng(4)
    flat = random.uniform(-1, 1, (COUNT, 3, 2))
    while (thin := np.abs(np.linalg.det(flat[:, 1:] - flat[:, :1])) < 0.6).any():
        flat[thin] = random.uniform(-1, 1, (int(thin.sum()), 3, 2))
    mirrored = np.linalg.det(flat[:, 1:] - flat[:, :1]) < 0
    flat[mirrored, 1:] = flat[mirrored, :0:-1]
    x, up = unit(random.normal(size=(COUNT, 3))), unit(random.normal(size=(COUNT, 3)))
    normal = unit(np.cross(x, up))
    y = np.cross(normal, x)
    corners = side_mm * (flat[..., :1] * x[:, None] + flat[..., 1:] * y[:, None])
    angle = np.radians(incidence_deg)
    way = np.cos(angle) * normal + np.sin(angle) * y
    return Places(corners, corners.mean(axis=1) + 1000.0 * way, -way)


def sources(**known: float) -> Sources:
    return Sources(*(np.full(COUNT, known.get(name, 0.0)) for name in SOURCES))


@pytest.mark.parametrize(("incidence_deg", "least"), [(10, 0.03), (50, 0.05), (75, 0.15)])
@pytest.mark.parametrize("quantile", [pytest.param(0.994458, marks=pytest.mark.full), 1.959964])
def test_the_closed_form_is_that_of_monte_carlo(incidence_deg: float, least: float, quantile: float) -> None:
    """With vertices off by 3 % of a triangle's size, as with 30 um on 1 mm, and all other sources."""
    places = placed(incidence_deg)
    whole = sources(u_noise=0.02, u_own=0.01, u_shared=0.006, vertex_um=30.0, led_mm=0.1)
    ratios = MonteCarlo(places, 20_000, np.random.default_rng(2)).ratios(whole)
    below = 0.5 * (1 - {0.994458: 0.68, 1.959964: 0.95}[quantile])
    known = np.nanquantile(ratios, [below, 1 - below], axis=1)
    found = np.array(bounds(places, whole, quantile))
    width = known[1] - known[0]
    assert width.min() > least
    np.testing.assert_allclose((found - known) / width, 0.0, atol=0.08)  # a tilt counts to second order too


def test_bounds_are_asymmetric_where_the_light_grazes_and_open_where_it_grazes_too_much() -> None:
    low, high = bounds(placed(80.0), sources(vertex_um=15.0), 1.0)
    assert (high - 1 > 1.1 * (1 - low)).all()
    low, high = bounds(placed(87.0), sources(vertex_um=60.0), 1.96)
    assert np.isinf(high).all()
    assert ((low > 0) & (low < 1)).all()


def test_each_source_alone_is_what_it_is_known_to_be() -> None:
    places, random = placed(60.0), np.random.default_rng(3)
    low, high = bounds(places, sources(u_noise=0.03), 2.0)
    np.testing.assert_allclose([low, high], np.broadcast_to([[0.94], [1.06]], (2, COUNT)))
    low, high = bounds(places, sources(u_shared=0.1), 2.0)
    np.testing.assert_allclose([low, high], np.broadcast_to([[1 / 1.2], [1 / 0.8]], (2, COUNT)))
    for name, value in {
        "u_noise": 0.03,
        "u_own": 0.02,
        "u_shared": 0.01,
        "vertex_um": 20.0,
        "led_mm": 1.0,
    }.items():
        alone = sources(**{name: value})
        assert np.nanstd(MonteCarlo(places, 2000, random).ratios(alone)) > 1e-4
        assert np.nanstd(MonteCarlo(places, 200, random).ratios(alone.without(name))) == 0.0
    far = np.nanstd(MonteCarlo(places, 20_000, random).ratios(sources(led_mm=1.0)), axis=1)
    known = 1e-3 * np.sqrt(4 + np.tan(np.radians(60)) ** 2)  # distance, and incidence
    np.testing.assert_allclose(far, known, rtol=0.05)
    low, high = bounds(places, sources(led_mm=1.0), 1.0)
    np.testing.assert_allclose((high - low) / 2, known, rtol=0.01)


def test_draws_lit_from_below_do_not_count() -> None:
    ratios = MonteCarlo(placed(88.0), 500, np.random.default_rng(7)).ratios(sources(vertex_um=60.0))
    assert 0.05 < np.isnan(ratios).mean() < 0.6
    assert np.nanmin(ratios) > 0


def test_tilts_are_those_of_moved_vertices() -> None:
    places = placed(0.0)
    random = np.random.default_rng(6)
    moved = places.corners_mm[:, None] + random.normal(0, 0.01, (COUNT, 20_000, 3, 3))
    normals = unit(np.cross(moved[:, :, 1] - moved[:, :, 0], moved[:, :, 2] - moved[:, :, 0]))
    mean = unit(normals.mean(axis=1))
    across = normals - np.einsum("nij,nj->ni", normals, mean)[..., None] * mean[:, None]
    known = np.einsum("nki,nkj->nij", across, across) / 20_000
    found = tilt_covariance(places.corners_mm, np.full(COUNT, 10.0))
    scale = np.trace(known, axis1=1, axis2=2)[:, None, None]
    np.testing.assert_allclose((found - known) / scale, 0.0, atol=0.05)
    equal = np.array([[[0, 0, 0], [0.2, 0, 0], [0.1, 0.1 * 3**0.5, 0.0]]])
    deg = np.degrees(np.sqrt(tilt_covariance(equal, np.array([30.0]))[0, 0, 0]))
    assert deg == pytest.approx(np.degrees(2**0.5 * 0.03 / 0.2), rel=1e-6)  # some 12 degrees


@pytest.mark.parametrize("emission", ["lambertian", "paper"])
def test_draws_are_those_of_the_budgets_measurement_equation(emission: Emission) -> None:
    """Which was written for `coupole budget`, with the exact square of the LED."""
    places, draws = placed(60.0), 8000
    random = np.random.default_rng(8)
    corners = places.corners_mm[:, None] + random.normal(0, 0.03, (COUNT, draws, 3, 3))
    leds = places.led_mm[:, None] + random.normal(0, 0.5, (COUNT, draws, 3))
    power = (1 + random.normal(0, 0.01, (COUNT, draws))) * (1 + random.normal(0, 0.006, (COUNT, draws)))
    normals = unit(np.cross(corners[:, :, 1] - corners[:, :, 0], corners[:, :, 2] - corners[:, :, 0]))
    axes = np.broadcast_to(places.led_normals[:, None], leds.shape)
    signal = 1 + random.normal(0, 0.02, (COUNT, draws))

    def true(signal: np.ndarray, power: np.ndarray, *places: np.ndarray) -> np.ndarray:
        return reflectance(signal, 1.0, 1.0, power, irradiance_per_flux(*places, emission=emission))

    flat = unit(np.cross(*(places.corners_mm[:, k] - places.corners_mm[:, 0] for k in (1, 2))))
    middle = places.corners_mm.mean(axis=1)
    measured = true(np.ones(COUNT), np.ones(COUNT), middle, flat, places.led_mm, places.led_normals)
    budget = true(signal, power, corners.mean(axis=2), normals, leds, axes) / measured[:, None]
    whole = sources(u_noise=0.02, u_own=0.01, u_shared=0.006, vertex_um=30.0, led_mm=0.5)
    mine = MonteCarlo(places, draws, random, paper=emission == "paper").ratios(whole)
    known, found = (np.nanquantile(ratios, [0.05, 0.16, 0.5, 0.84, 0.95], axis=1) for ratios in (budget, mine))
    np.testing.assert_allclose((found - known) / (known[-1] - known[0]), 0.0, atol=0.06)


def test_the_papers_emission_counts_in_the_draws() -> None:
    """An LED that looks past the triangle: the second cosine doubles what its turn does."""
    places = placed(20.0)
    turned = unit(places.led_normals + 0.5 * unit(np.cross(places.led_normals, np.array([1.0, 2.0, 3.0]))))
    aside = replace(places, led_normals=turned)
    some = sources(led_mm=5.0)
    widths = [
        np.nanstd(MonteCarlo(aside, 4000, np.random.default_rng(1), paper=two).ratios(some), axis=1)
        for two in (False, True)
    ]
    assert (widths[1] > widths[0]).mean() > 0.9


def test_samples_whose_bounds_are_all_open_are_counted_and_no_error() -> None:
    told = percentiles(np.full(4, 0.5), np.full(4, np.inf))
    assert told == {"median": None, "percentile_95": None, "unbounded_share": 1.0}
    some = percentiles(np.array([0.9, 0.5]), np.array([1.1, np.inf]))
    assert some["median"] == pytest.approx([-10.0, 10.0])
    assert some["unbounded_share"] == 0.5


def test_a_sample_of_which_nothing_is_known_has_open_bounds() -> None:
    places = placed(80.0)
    low, high = bounds(places, sources(u_noise=2.0, vertex_um=300.0), 1.96)
    assert (low == 0).all()
    assert np.isinf(high).all()
