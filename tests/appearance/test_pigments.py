"""Mixtures of pigments and their fit."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from coupole.appearance.matter import kubelka_munk, pigments, typical
from coupole.appearance.matter.glossy_face import InternalReflectance
from coupole.errors import InputError

WHITE = pigments.from_opaque("white", typical.reflectance("white_shape"), 1.0)
RED = pigments.from_opaque("red", typical.reflectance("red_shape"), 0.7)
BLUE = pigments.from_opaque("blue", typical.reflectance("blue_one_peak_shape"), 0.4)
OCHRE = pigments.from_opaque("ochre", typical.reflectance("dull_yellow_shape"), 0.5)


@pytest.mark.parametrize("name", typical.SHAPES)
def test_typical_paints_reflect_a_share(name: str) -> None:
    reflectance = typical.reflectance(name).values

    assert np.all((reflectance > 0.0) & (reflectance < 1.0))


def test_a_blue_of_two_peaks_reflects_red_again_and_one_of_one_peak_does_not() -> None:
    blue, red = slice(12, 20), slice(70, 81)  # 440 to 475 nm, 730 to 780 nm
    two, one = (typical.reflectance(f"blue_{peaks}_shape").values for peaks in ("two_peaks", "one_peak"))

    assert two[red].max() > 0.8 * two[blue].max()
    assert one[red].max() < 0.6 * one[blue].max()


def test_an_unknown_shape_is_refused_with_those_that_are_known() -> None:
    with pytest.raises(InputError, match=r"red_shape.*found 'mauve'"):
        typical.reflectance("mauve")


def test_a_shape_is_understood_by_the_pigments_name_that_it_had() -> None:
    assert set(typical.FORMER_NAMES.values()) == set(typical.SHAPES)
    assert np.array_equal(typical.reflectance("azurite").values, typical.reflectance("blue_one_peak_shape").values)


def test_a_pure_mixture_is_the_pigment() -> None:
    mixed = pigments.mixture([WHITE, RED], [0.0, 3.0])

    assert pigments.opaque_reflectance(mixed).values == pytest.approx(typical.reflectance("red_shape").values)
    assert mixed.name == "100 % red"


@settings(deadline=None, max_examples=40)
@given(share=st.floats(0.0, 1.0))
def test_a_mixtures_k_over_s_lies_between_those_of_its_parts(share: float) -> None:
    mixed = pigments.mixture([WHITE, BLUE], [share, 1.0 - share])
    ends = np.stack([p.absorption / p.scattering for p in (WHITE, BLUE)])

    ratio = mixed.absorption / mixed.scattering
    assert np.all((ratio >= ends.min(axis=0) - 1e-9) & (ratio <= ends.max(axis=0) + 1e-9))


def test_a_pigments_coefficients_come_back_from_its_tint() -> None:
    tint = pigments.opaque_reflectance(pigments.mixture([WHITE, BLUE], [0.8, 0.2]))
    masstone, white = (pigments.opaque_reflectance(p) for p in (BLUE, WHITE))

    found = pigments.from_tint("azurite", masstone, tint, white, 0.2)

    # The coefficients are relative to the white's scattering, which is 1 here, and the white absorbs as well.
    assert found.scattering == pytest.approx(BLUE.scattering, rel=1e-6)
    assert found.absorption == pytest.approx(BLUE.absorption, rel=1e-6)


def test_a_tint_that_is_darker_than_its_masstone_is_refused() -> None:
    masstone, white = (pigments.opaque_reflectance(p) for p in (BLUE, WHITE))

    with pytest.raises(InputError, match="between its masstone and the white"):
        pigments.from_tint("azurite", masstone, InternalReflectance(0.8 * masstone.values), white, 0.2)


@settings(deadline=None, max_examples=25)
@given(shares=st.lists(st.floats(0.05, 1.0), min_size=4, max_size=4))
def test_a_recipe_comes_back_from_its_reflectance(shares: list[float]) -> None:
    palette = [WHITE, RED, BLUE, OCHRE]
    target = pigments.opaque_reflectance(pigments.mixture(palette, shares))

    recipe = pigments.fit(target, palette)

    assert list(recipe.concentrations.values()) == pytest.approx(np.array(shares) / sum(shares), abs=1e-4)
    assert recipe.rms < 1e-6


def test_a_fit_is_the_best_in_reflectance_when_a_pigment_is_missing() -> None:
    target = pigments.opaque_reflectance(pigments.mixture([WHITE, RED, BLUE], [0.5, 0.3, 0.2]))
    palette = [WHITE, RED, OCHRE]

    recipe = pigments.fit(target, palette)

    rng = np.random.default_rng(3)
    best = np.array(list(recipe.concentrations.values()))
    for _ in range(50):
        other = np.maximum(best + 0.02 * rng.standard_normal(3), 0.0)
        missed = pigments.opaque_reflectance(pigments.mixture(palette, other)).values - target.values
        assert np.sqrt(np.mean(missed**2)) >= recipe.rms - 1e-7


def test_a_fit_with_noise_finds_the_pigments_within_two_percent() -> None:
    target = pigments.opaque_reflectance(pigments.mixture([WHITE, RED, BLUE], [0.6, 0.3, 0.1]))
    noisy = InternalReflectance(target.values + 0.002 * np.random.default_rng(5).standard_normal(81))

    found = pigments.fit(noisy, [WHITE, RED, BLUE, OCHRE]).concentrations

    assert list(found.values()) == pytest.approx([0.6, 0.3, 0.1, 0.0], abs=0.02)


def test_a_thin_wash_shows_its_ground_and_a_thick_one_does_not() -> None:
    k, s = BLUE.absorption * 30.0, BLUE.scattering * 30.0
    thin, thick = (
        [kubelka_munk.over(*kubelka_munk.layer(k, s, h), ground) for ground in (0.05, 0.9)] for h in (0.005, 2.0)
    )

    assert np.all(thin[1] - thin[0] > 0.2)
    assert thick[1] == pytest.approx(thick[0], abs=1e-3)


@pytest.mark.parametrize("shares", [[1.0], [0.0, 0.0], [1.0, -0.1]])
def test_concentrations_that_make_no_mixture_are_refused(shares: list[float]) -> None:
    with pytest.raises(InputError):
        pigments.mixture([WHITE, RED], shares)
