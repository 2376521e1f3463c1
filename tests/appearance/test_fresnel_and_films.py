"""One interface and stacks of films, against closed forms and an independent implementation."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from coupole.appearance.optics import fresnel, indices
from coupole.appearance.optics.thin_film import Film, stack_power
from coupole.appearance.spectra.grid import BANDS, WAVELENGTHS_NM

ANY_INDEX = st.builds(complex, st.floats(0.05, 4.0), st.floats(0.0, 6.0))
COSINE = st.floats(0.01, 1.0)


def test_glass_reflects_four_percent_along_the_normal() -> None:
    assert fresnel.reflectance(1.0, 1.5) == pytest.approx(0.04)


def test_all_light_is_reflected_at_grazing_incidence() -> None:
    assert fresnel.reflectance(1e-9, 1.5 + 0.3j) == pytest.approx(1.0)


def test_p_light_is_not_reflected_at_brewsters_angle() -> None:
    cosine = np.cos(np.arctan(1.5))
    _, r_p, _, _ = fresnel.amplitudes(cosine, fresnel.cos_inside(cosine, 1.0, 1.5), 1.0, 1.5)

    assert abs(r_p) < 1e-15


def test_beyond_the_critical_angle_all_light_is_reflected() -> None:
    assert fresnel.reflectance(np.cos(np.radians(45.0)), 1.0, outside=1.5) == pytest.approx(1.0)


@settings(deadline=None, max_examples=40)
@given(cosine=COSINE, index=ANY_INDEX)
def test_reflectance_is_a_share(cosine: float, index: complex) -> None:
    assert 0.0 <= fresnel.reflectance(cosine, index) <= 1.0 + 1e-12


def test_diffuse_reflectance_equals_walshs_closed_form() -> None:
    n = 1.5
    walsh = (
        0.5
        + (n - 1.0) * (3.0 * n + 1.0) / (6.0 * (n + 1.0) ** 2)
        + n**2 * (n**2 - 1.0) ** 2 / (n**2 + 1.0) ** 3 * np.log((n - 1.0) / (n + 1.0))
        - 2.0 * n**3 * (n**2 + 2.0 * n - 1.0) / ((n**2 + 1.0) * (n**4 - 1.0))
        + 8.0 * n**4 * (n**4 + 1.0) / ((n**2 + 1.0) * (n**4 - 1.0) ** 2) * np.log(n)
    )

    assert fresnel.diffuse_external(n) == pytest.approx(walsh, abs=1e-12)
    assert fresnel.diffuse_internal(n) == pytest.approx(0.5963, abs=1e-4)


@settings(deadline=None, max_examples=60)
@given(
    outside=st.floats(1.0, 1.6),
    films=st.lists(st.tuples(ANY_INDEX, st.floats(1.0, 200.0)), max_size=3),
    substrate=st.builds(complex, st.floats(1.0, 2.0), st.floats(0.0, 2.0)),
    cosine=COSINE,
    wavelength_nm=st.floats(380.0, 780.0),
)
def test_stacks_agree_with_an_independent_transfer_matrix(
    outside: float,
    films: list[tuple[complex, float]],
    substrate: complex,
    cosine: float,
    wavelength_nm: float,
) -> None:
    import tmm

    stack = [Film(np.array([index]), thickness) for index, thickness in films]

    reflected, transmitted = stack_power(cosine, wavelength_nm, stack, outside=outside, substrate=substrate)

    indices_in_order = [outside, *(index for index, _ in films), substrate]
    depths = [np.inf, *(thickness for _, thickness in films), np.inf]
    both = [tmm.coh_tmm(p, indices_in_order, depths, np.arccos(cosine), wavelength_nm) for p in "sp"]
    assert reflected[0] == pytest.approx(0.5 * (both[0]["R"] + both[1]["R"]), abs=1e-9)
    assert transmitted[0] == pytest.approx(0.5 * (both[0]["T"] + both[1]["T"]), abs=1e-9)


@settings(deadline=None, max_examples=40)
@given(index=ANY_INDEX, thickness_nm=st.floats(0.0, 1e6), cosine=COSINE)
def test_a_film_never_gives_more_light_than_it_gets(index: complex, thickness_nm: float, cosine: float) -> None:
    reflected, transmitted = stack_power(cosine, WAVELENGTHS_NM, [Film(np.full(BANDS, index), thickness_nm)])

    assert np.all(reflected >= 0.0)
    assert np.all(transmitted >= 0.0)
    assert np.all(reflected + transmitted <= 1.0 + 1e-9)


def test_a_transparent_film_loses_nothing() -> None:
    reflected, transmitted = stack_power(0.6, WAVELENGTHS_NM, [Film(indices.constant(2.3), 330.0)], substrate=1.5)

    assert reflected + transmitted == pytest.approx(1.0, abs=1e-12)


def test_a_quarter_wave_film_of_the_right_index_does_not_reflect() -> None:
    film = Film(np.array([np.sqrt(1.5) + 0j]), 550.0 / (4.0 * np.sqrt(1.5)))

    reflected, _ = stack_power(1.0, 550.0, [film], substrate=1.5)

    assert reflected[0] < 1e-15


def test_a_thick_gold_film_is_bulk_gold() -> None:
    gold = indices.gold()

    reflected, transmitted = stack_power(0.5, WAVELENGTHS_NM, [Film(gold, 50_000.0)], substrate=1.36)

    assert reflected == pytest.approx(fresnel.reflectance(0.5, gold), abs=1e-12)
    assert transmitted == pytest.approx(0.0, abs=1e-12)


def test_gold_is_yellow_and_silver_white() -> None:
    blue, red = (int(np.searchsorted(WAVELENGTHS_NM, nm)) for nm in (450.0, 650.0))
    gold, silver = fresnel.reflectance(1.0, indices.gold()), fresnel.reflectance(1.0, indices.silver())

    assert gold[blue] < 0.45
    assert gold[red] > 0.95
    assert silver.min() > 0.9


def test_gold_lies_on_the_line_between_two_lines_of_the_published_table() -> None:
    # Johnson and Christy 1972, 2.26 and 2.13 eV.
    published = np.interp(580.0, [548.6, 582.1], [0.43 + 2.455j, 0.29 + 2.863j])

    assert indices.gold()[int(np.searchsorted(WAVELENGTHS_NM, 580.0))] == pytest.approx(published, abs=1e-4)


@settings(deadline=None, max_examples=40)
@given(fraction=st.floats(0.0, 1.0))
def test_alloys_of_gold_and_silver_absorb_at_any_composition(fraction: float) -> None:
    index = indices.gold_silver(fraction)

    assert np.all(index.real > 0.0)
    assert np.all(index.imag > 0.0)


def test_silver_makes_gold_paler() -> None:
    blue = int(np.searchsorted(WAVELENGTHS_NM, 470.0))
    reflected = [
        fresnel.reflectance(1.0, indices.gold_silver(fraction))[blue] for fraction in (1.0, 0.7, 0.4, 0.0)
    ]

    assert reflected == sorted(reflected)
