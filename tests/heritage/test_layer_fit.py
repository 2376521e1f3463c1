"""K and S from films: intervals hold, on specimens of the matrix exponential and of a walk of photons."""

from __future__ import annotations

import numpy as np
import pytest
from painted_films import four_fluxes, in_air, two_fluxes, walk

from coupole.appearance.matter.glossy_face import BARE, face
from coupole.errors import InputError
from coupole.heritage.analysis import four_flux_fit, layer_fit, layer_model
from coupole.heritage.analysis.layer_fit import COVERAGE_FACTOR, Film

NOISE, FACE = 0.005, face(1.5)
BLACK, WHITE, H_MM, U_H_MM = 0.02, 0.9, 0.035, 0.0007
ROUNDS, EACH = 12, 80
HELD = (0.93, 0.97)


def seen(inside: float, rng: np.random.Generator, n: int = EACH) -> np.ndarray:
    return in_air(inside) + NOISE * rng.standard_normal(n)


def ground(inside: float, rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
    """A measured ground inside, and its uncertainty."""
    found, slope = seen(inside, rng), FACE.passing
    return found / (slope + FACE.inner * found), NOISE * slope / (slope + FACE.inner * found) ** 2


def films_of(kind: str, k: float, s: float, rng: np.random.Generator) -> list[Film]:
    """As measured once: 80 bands alike, each with its own noise, one error of each thickness."""
    over = {name: ground(value, rng) for name, value in (("black", BLACK), ("white", WHITE))}

    def film(name: str, value: float, true_mm: float, told_mm: float) -> Film:
        on, u = over[name]
        return Film(seen(two_fluxes(k, s, true_mm, value), rng), on, name, u, told_mm, 0.02 * true_mm)

    if kind == "two grounds":
        told = H_MM + U_H_MM * rng.standard_normal()
        return [film("black", BLACK, H_MM, told), film("white", WHITE, H_MM, told)]
    if kind == "opaque and thin":
        thin = film("white", WHITE, H_MM, H_MM + U_H_MM * rng.standard_normal())
        return [Film(seen(two_fluxes(k, s, 40.0 / (k + s), 0.5), rng), None), thin]
    return [film("white", WHITE, h, h * (1.0 + 0.02 * rng.standard_normal())) for h in (0.015, 0.03, 0.06)]


@pytest.mark.parametrize("kind", ["two grounds", "opaque and thin", "series"])
def test_intervals_of_k_and_s_hold_the_truth_in_95_percent(kind: str) -> None:
    rng = np.random.default_rng(11)
    k, s, held = 10.0, 20.0, []
    for _ in range(ROUNDS):
        found = layer_fit.fit(films_of(kind, k, s, rng), FACE, NOISE)
        assert found.determined_bands.mean() > 0.9
        held.append(np.abs(found.absorption - k) < COVERAGE_FACTOR * found.u_absorption)
        held.append(np.abs(found.scattering - s) < COVERAGE_FACTOR * found.u_scattering)
    # The error of a thickness is common to a round, so that chance is wider than that of 2000 draws.
    assert HELD[0] - 0.03 <= np.mean(held) <= HELD[1] + 0.03


def test_without_noise_k_and_s_come_back_from_every_kind_of_films() -> None:
    truth = [(0.05, 30.0), (2.0, 20.0), (15.0, 20.0), (20.0, 2.0)]
    exact = [two_fluxes(k, s, 0.02, g) for k, s in truth for g in (BLACK, WHITE)]
    inside = np.array(exact).reshape(4, 2)
    films = [Film(in_air(inside[:, i]), np.full(4, g), str(g), 0.0, 0.02) for i, g in enumerate((BLACK, WHITE))]

    found = layer_fit.fit(films, FACE, 1e-4)

    # The face's numbers of tables are rounded to three digits.
    assert found.absorption == pytest.approx([k for k, _ in truth], rel=0.02, abs=0.02)
    assert found.scattering == pytest.approx([s for _, s in truth], rel=0.02)


def test_an_error_of_thickness_is_one_of_k_and_s_and_noise_is_the_rest() -> None:
    films = [
        Film(in_air(np.full(3, two_fluxes(5.0, 20.0, H_MM, g))), np.full(3, g), str(g), 0.0, H_MM, 0.02 * H_MM)
        for g in (BLACK, WHITE)
    ]

    found = layer_fit.fit(films, FACE, 1e-5)

    assert found.u_scattering / found.scattering == pytest.approx(np.full(3, 0.02), rel=0.02)
    assert found.u_absorption / found.absorption == pytest.approx(np.full(3, 0.02), rel=0.02)


def test_a_film_that_hides_its_ground_tells_no_scattering() -> None:
    rng = np.random.default_rng(3)
    hiding = [
        Film(seen(two_fluxes(60.0, 30.0, 0.2, g), rng), np.full(EACH, g), str(g), 0.0, 0.2) for g in (BLACK, WHITE)
    ]

    found = layer_fit.fit(hiding, FACE, NOISE)

    assert not found.determined_bands.any()
    assert layer_model.deserved_model(found, hiding, FACE, NOISE).model == "K/S only"
    assert found.absorption / found.scattering == pytest.approx(np.full(EACH, 2.0), rel=0.4)


def test_films_that_are_alike_are_refused() -> None:
    one = Film(np.full(3, 0.3), np.full(3, 0.9), "white")
    with pytest.raises(InputError, match="cannot separate K from S"):
        layer_fit.fit([one, one], FACE, NOISE)


def test_what_photons_show_over_another_ground_is_in_the_interval_and_k_is_twice_the_absorption() -> None:
    """Another ground is what both models define: a Lambertian ground makes all light that enters the film from
    below
    Lambertian, so rho and tau of a film are the same numbers in both, and only K and S mean different things."""
    photons, absorbed = walk(2.0, 40_000, 5), np.array([0.02, 0.1, 0.3])
    exact = np.array([[photons.reflectance(a, g) for a in absorbed] for g in (BLACK, WHITE, 0.5)])
    often = np.tile(exact, 300)
    measured = often[:2] + NOISE * np.random.default_rng(6).standard_normal((2, 900))
    films = [Film(y, np.full(900, g), str(g)) for y, g in zip(measured, (BLACK, WHITE), strict=True)]
    shown = layer_fit.predict(layer_fit.fit(films, BARE, NOISE), BARE, 1.0, 0.5)
    held = np.abs(shown.seen - often[2]) < COVERAGE_FACTOR * shown.u_seen
    assert HELD[0] - 0.02 <= np.mean(held) <= HELD[1] + 0.02

    sharp = [Film(exact[i], np.full(3, g), str(g)) for i, g in enumerate((BLACK, WHITE))]
    found = layer_fit.fit(sharp, BARE, 1e-4)
    assert found.absorption / (2.0 * 2.0 * absorbed) == pytest.approx(np.ones(3), abs=0.12)
    assert found.scattering / (0.75 * 2.0) == pytest.approx(np.ones(3), abs=0.08)


def test_four_fluxes_come_back_with_their_intervals() -> None:
    rng = np.random.default_rng(8)
    k, s, direct, s_i, s_j = 10.0, 20.0, 5.0, 25.0, 10.0
    diffuse = {g: two_fluxes(k, s, H_MM, g) for g in (BLACK, WHITE)}
    straight = {
        g: FACE.passing * four_fluxes(k, s, direct, s_i, s_j, H_MM, g) / (1.0 - FACE.inner * diffuse[g])
        for g in (BLACK, WHITE)
    }
    passing = np.exp(-(direct + s_i + s_j) * H_MM)

    def noisy(value: float) -> np.ndarray:
        return value + NOISE * rng.standard_normal(EACH)

    films = [Film(seen(diffuse[g], rng), np.full(EACH, g), str(g), 0.0, H_MM, 1e-9) for g in (BLACK, WHITE)]
    light = four_flux_fit.Directional(noisy(straight[BLACK]), noisy(straight[WHITE]), noisy(passing))

    found = four_flux_fit.fit(films[0], films[1], light, FACE, NOISE)

    for value, u, truth in (
        (found.direct_absorption, found.u_direct_absorption, direct),
        (found.forward, found.u_forward, s_i),
        (found.backward, found.u_backward, s_j),
    ):
        assert 0.85 <= np.mean(np.abs(value - truth) < COVERAGE_FACTOR * u) <= 1.0
        assert value.mean() == pytest.approx(truth, abs=4.0 * float(np.mean(u)) / np.sqrt(EACH))
    measured = (films[0].reflectance, films[1].reflectance)
    verdict = layer_model.deserved_by_measurement(
        measured, (light.over_black, light.over_white), light.transmittance, NOISE
    )
    assert verdict.model == "four fluxes"
    again = [in_air(diffuse[g]) + NOISE * rng.standard_normal(EACH) for g in (BLACK, WHITE)]
    same = layer_model.deserved_by_measurement(measured, (again[0], again[1]), light.transmittance, NOISE)
    assert same.model == "two fluxes"


def test_a_hiding_white_deserves_two_fluxes_and_a_glaze_four() -> None:
    def verdict(k: float, s: float, h: float) -> str:
        films = [
            Film(in_air(np.full(3, two_fluxes(k, s, h, g))), np.full(3, g), str(g), 0.0, h) for g in (BLACK, WHITE)
        ]
        return layer_model.deserved_model(layer_fit.fit(films, FACE, NOISE), films, FACE, NOISE).model

    assert verdict(0.2, 120.0, 0.1) == "two fluxes"
    assert verdict(8.0, 6.0, 0.03) == "four fluxes"


def test_a_grinding_half_as_coarse_scatters_twice_as_much() -> None:
    s = np.linspace(10.0, 20.0, 9)
    found = layer_model.grain_ratio((s, 0.05 * s), (2.0 * s, 0.1 * s))
    assert found.ratio == pytest.approx(2.0)
    with pytest.raises(InputError, match="within 25 %"):
        layer_model.grain_ratio((s, s), (s, s))
