"""Mixtures of pigments and their fit."""

from __future__ import annotations

import numpy as np
import pytest

from coupole.appearance.matter import kubelka_munk, pigments, typical
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


def test_a_thin_wash_shows_its_ground_and_a_thick_one_does_not() -> None:
    k, s = BLUE.absorption * 30.0, BLUE.scattering * 30.0
    thin, thick = (
        [kubelka_munk.over(*kubelka_munk.layer(k, s, h), ground) for ground in (0.05, 0.9)] for h in (0.005, 2.0)
    )

    assert np.all(thin[1] - thin[0] > 0.2)
    assert thick[1] == pytest.approx(thick[0], abs=1e-3)
