"""A film at another thickness: radiative transfer and intervals against photons that walk in the layer."""

from __future__ import annotations

import numpy as np
import pytest
from painted_films import Walk, walk

from coupole.appearance.matter import scattering_layer
from coupole.appearance.matter.glossy_face import BARE
from coupole.appearance.matter.scattering_layer import diffuse_response
from coupole.heritage.analysis import layer_fit, other_thickness
from coupole.heritage.analysis.layer_fit import COVERAGE_FACTOR, Film

PHOTONS = 40_000
BY_CHANCE = 4.0 * 0.5 / np.sqrt(PHOTONS)
WIDEST = 0.035
"""Half width of the model's error; it is up to 0.030 for photons."""
GROUNDS = (0.02, 0.9)
ABSORBED = np.array([0.002, 0.02, 0.1])
"""By each scattering, of grains that scatter evenly."""


def seen_by(photons: Walk, absorbed: np.ndarray) -> np.ndarray:
    """[2 grounds, n]."""
    return np.array([[photons.reflectance(a, ground) for a in absorbed] for ground in GROUNDS])


@pytest.mark.parametrize("mean_cosine", [0.0, 0.8])
@pytest.mark.parametrize("depth", [0.5, 2.0, 10.0])
def test_transfer_shows_what_photons_show(depth: float, mean_cosine: float) -> None:
    scattering = depth / (1.0 - mean_cosine)
    exact = seen_by(walk(scattering, PHOTONS, 1, mean_cosine), ABSORBED * (1.0 - mean_cosine))

    rho, tau = diffuse_response(ABSORBED * depth, np.full(3, scattering), mean_cosine)

    for ground, photons in zip(GROUNDS, exact, strict=True):
        assert rho + tau**2 * ground / (1.0 - rho * ground) == pytest.approx(photons, abs=BY_CHANCE)


def test_transfer_loses_no_light_where_nothing_is_absorbed() -> None:
    rho, tau = diffuse_response(np.zeros(4), np.array([0.01, 1.0, 30.0, 400.0]), 0.8)
    assert rho + tau == pytest.approx(np.ones(4), abs=1e-6)


def test_more_directions_change_nothing(monkeypatch: pytest.MonkeyPatch) -> None:
    layers = np.array([0.01, 0.2, 0.0, 1.0]), np.array([1.0, 5.0, 30.0, 100.0])
    few = diffuse_response(*layers, 0.8)
    monkeypatch.setattr(scattering_layer, "DIRECTIONS", 24)
    scattering_layer._directions.cache_clear()

    many = diffuse_response(*layers, 0.8)

    scattering_layer._directions.cache_clear()
    assert np.array(few) == pytest.approx(np.array(many), abs=5e-4)


@pytest.mark.parametrize("mean_cosine", [0.0, 0.8])
@pytest.mark.parametrize("depth", [0.5, 1.0, 5.0])
def test_intervals_at_other_thicknesses_hold_what_photons_show(depth: float, mean_cosine: float) -> None:
    """K and S alone miss by many times the noise of the photons; the interval has the model's error."""
    scattering, absorbed = depth / (1.0 - mean_cosine), ABSORBED * (1.0 - mean_cosine)
    measured = seen_by(walk(scattering, PHOTONS, 2, mean_cosine), absorbed)
    films = [
        Film(values, np.full(3, ground), str(ground)) for values, ground in zip(measured, GROUNDS, strict=True)
    ]
    fit = layer_fit.fit(films, BARE, 1e-4)
    largest = 0.0
    for times in (0.5, 2.0, 4.0):
        exact = seen_by(walk(times * scattering, PHOTONS, 3, mean_cosine), absorbed)
        for film, photons in zip(other_thickness.films_at(fit, films, BARE, [times]), exact, strict=True):
            off = np.abs(film.reflectance - photons)
            assert np.all(off < COVERAGE_FACTOR * film.u_reflectance + BY_CHANCE)
            assert np.all(COVERAGE_FACTOR * film.u_model < WIDEST)
            largest = max(largest, float(np.nanmax(off - COVERAGE_FACTOR * film.u_measured)))
    assert largest > 0.005 or depth > 1.0


def test_at_its_own_thickness_a_film_is_what_was_measured_and_the_model_adds_nothing() -> None:
    measured = seen_by(walk(1.0, PHOTONS, 4), ABSORBED)
    films = [
        Film(values, np.full(3, ground), str(ground), thickness_mm=0.05)
        for values, ground in zip(measured, GROUNDS, strict=True)
    ]
    for film, values in zip(
        other_thickness.films_at(layer_fit.fit(films, BARE, 1e-4), films, BARE, [0.05]), measured, strict=True
    ):
        assert film.reflectance == pytest.approx(values, abs=1e-4)
        assert film.u_model == pytest.approx(np.zeros(3), abs=1e-6)


def test_bands_that_hide_their_grounds_are_not_predicted() -> None:
    films = [Film(np.array([0.3, 0.3]), np.full(2, ground), str(ground), thickness_mm=0.1) for ground in GROUNDS]
    fit = layer_fit.fit(films, BARE, 0.005)
    assert np.isnan(other_thickness.films_at(fit, films, BARE, [0.2])[0].reflectance).all()
