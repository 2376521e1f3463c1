"""Gold leaf on bole: Maxwell Garnett, the leaf's thickness, holes and cracks."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.integrate import quad

from coupole.appearance.matter import gilding, layered, typical
from coupole.appearance.matter.glossy_face import InternalReflectance, face
from coupole.appearance.optics import effective_medium, fresnel, indices
from coupole.appearance.optics.thin_film import Film, stack_power
from coupole.appearance.spectra import light
from coupole.appearance.spectra.grid import WAVELENGTHS_NM

GOLD = indices.gold()
BOLE = typical.bole()
SEEN = face(indices.EGG_WHITE).reflectance_in_air(BOLE).values
"""As an instrument sees it, gloss excluded."""


@settings(deadline=None, max_examples=40)
@given(flatness=st.floats(1.0, 1000.0))
def test_the_depolarisation_factor_equals_its_integral(flatness: float) -> None:
    # A = a^2 c/2 times the integral of ds/((s + c^2)^(3/2) (s + a^2)), with c = 1 and s + 1 = 1/u^2.
    integral, _ = quad(lambda u: flatness**2 * u**2 / (1.0 + (flatness**2 - 1.0) * u**2), 0.0, 1.0, limit=200)

    assert effective_medium.depolarisation_short(flatness) == pytest.approx(integral, rel=1e-6)


def test_the_series_near_a_sphere_joins_the_formula() -> None:
    e = np.array([0.9999e-3, 1.0001e-3])

    below, above = effective_medium.depolarisation_short(np.sqrt(1.0 + e**2))

    assert below == pytest.approx(above, abs=1e-9)


def test_the_three_depolarisation_factors_sum_to_one() -> None:
    flatness = np.array([1.0, 2.0, 50.0])

    total = effective_medium.depolarisation_short(flatness) + 2.0 * effective_medium.depolarisation_in_plane(
        flatness
    )
    assert total == pytest.approx(1.0)


@settings(deadline=None, max_examples=40)
@given(depolarisation=st.floats(0.01, 0.99), share=st.floats(0.0, 1.0))
def test_equation_four_is_maxwell_garnett(depolarisation: float, share: float) -> None:
    e_m, e_i = GOLD**2, 1.36**2
    contrast = e_i - e_m
    standard = e_m * (1.0 + share * contrast / (e_m + depolarisation * (1.0 - share) * contrast))

    found = effective_medium.maxwell_garnett(GOLD, 1.36, share, depolarisation) ** 2

    assert found == pytest.approx(standard, rel=1e-9)


def test_without_holes_the_leaf_is_gold_and_with_nothing_else_egg_white() -> None:
    assert gilding.leaf_index(GOLD, 0.0) == pytest.approx(GOLD)
    assert gilding.leaf_index(GOLD, 1.0) == pytest.approx(indices.constant(1.36))


@settings(deadline=None, max_examples=40)
@given(share=st.floats(0.0, 0.3), more=st.floats(0.01, 0.1))
def test_more_holes_make_the_leaf_absorb_less(share: float, more: float) -> None:
    before, after = (gilding.leaf_index(GOLD, p) for p in (share, share + more))

    assert np.all(after.imag >= 0.0)
    assert np.all(after.imag < before.imag)


def test_grains_of_gold_in_egg_white_do_not_behave_as_the_paper_says() -> None:
    # The paper's reading: gold as inclusions, its own factor A. Absorption rises with the first holes.
    paper = effective_medium.depolarisation_short(20.0)

    grains = effective_medium.maxwell_garnett(indices.EGG_WHITE, GOLD, 0.9, paper)

    assert np.any(grains.imag > GOLD.imag)


def test_ten_percent_of_holes_let_more_light_through_at_every_wavelength() -> None:
    solid, holed = (
        stack_power(1.0, WAVELENGTHS_NM, [Film(gilding.leaf_index(GOLD, share), 60.0)], substrate=1.36)[1]
        for share in (0.0, 0.1)
    )

    assert np.all(holed > solid)


def test_a_leaf_of_no_thickness_is_the_bole_as_measured() -> None:
    specular, diffuse = gilding.reflectances(gilding.gilt(GOLD, 0.0, BOLE))

    assert diffuse == pytest.approx(SEEN, abs=1e-12)
    assert specular == pytest.approx(np.full(81, fresnel.reflectance(1.0, indices.EGG_WHITE)), abs=1e-12)


def test_a_thick_leaf_is_bulk_gold() -> None:
    specular, diffuse = gilding.reflectances(gilding.gilt(GOLD, 500.0, BOLE))

    assert specular == pytest.approx(fresnel.reflectance(1.0, GOLD), abs=1e-6)
    assert np.all(diffuse < 1e-6)


def test_a_leaf_that_is_all_holes_is_the_bole_as_measured() -> None:
    _, diffuse = gilding.reflectances(gilding.gilt(GOLD, 200.0, BOLE, bare_share=1.0))

    assert diffuse == pytest.approx(SEEN, abs=1e-12)


@pytest.mark.parametrize(("thickness_nm", "percent"), [(0.0, 11.7), (25.0, 1.29), (50.0, 0.08)])
def test_the_bole_under_a_leaf_is_as_bright_as_the_tables_of_the_reference_say(
    thickness_nm: float, percent: float
) -> None:
    _, diffuse = gilding.reflectances(gilding.gilt(GOLD, thickness_nm, BOLE))

    seen = light.tristimulus(diffuse, light.illuminant("D65"), light.observer())[1]
    assert 100.0 * seen == pytest.approx(percent, rel=0.05)


def test_the_step_wedge_darkens_the_bole_step_by_step() -> None:
    wedge = [gilding.reflectances(gilding.gilt(GOLD, d, BOLE))[1] for d in (0.0, 20.0, 50.0, 100.0, 200.0)]

    assert np.all(np.diff(wedge, axis=0) < 0.0)


def test_a_thin_leaf_is_green_when_light_shines_through_it() -> None:
    _, through = stack_power(1.0, WAVELENGTHS_NM, [Film(GOLD, 80.0)], substrate=1.36)

    assert 480.0 <= WAVELENGTHS_NM[np.argmax(through)] <= 540.0


@settings(deadline=None, max_examples=20)
@given(thickness_nm=st.floats(0.0, 300.0), holes=st.floats(0.0, 0.3), bare=st.floats(0.0, 1.0))
def test_no_gilt_reflects_more_than_it_gets(thickness_nm: float, holes: float, bare: float) -> None:
    white = InternalReflectance(np.ones(81))

    specular, diffuse = gilding.reflectances(
        gilding.gilt(gilding.leaf_index(GOLD, holes), thickness_nm, white, bare_share=bare)
    )

    assert np.all(specular + diffuse <= 1.0 + 1e-9)
    assert np.all(np.minimum(specular, diffuse) >= 0.0)


def test_a_sheets_internal_reflectance_equals_a_plain_quadrature() -> None:
    band = 30
    sheet = layered.sheet([Film(GOLD, 25.0)], 1.36)
    film = [Film(GOLD[band : band + 1], 25.0)]

    def from_below(mu: float, which: int) -> float:
        return 2.0 * mu * stack_power(mu, WAVELENGTHS_NM[band], film, outside=1.36)[which][0]

    critical = np.sqrt(1.0 - 1.0 / 1.36**2)
    reflected, passed = (quad(from_below, 1e-9, 1.0, args=(which,), points=[critical])[0] for which in (0, 1))

    assert sheet.internal_reflectance[band] == pytest.approx(reflected, abs=1e-5)
    assert sheet.internal_transmittance[band] == pytest.approx(passed, abs=1e-5)
