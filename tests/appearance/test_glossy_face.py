"""What an instrument sees of a paint and what holds inside its binder."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.integrate import quad

from coupole.appearance.matter.glossy_face import (
    BARE,
    Face,
    Geometry,
    InternalReflectance,
    MeasuredReflectance,
    face,
)
from coupole.errors import InputError

GEOMETRIES: tuple[Geometry, ...] = ("gloss excluded", "gloss included", "45:0")


def schlick_free_fresnel(sin_in_air: float, n: float) -> float:
    """Of a dielectric from air, by Fresnel's own formulas of angles."""
    a, b = np.arcsin(sin_in_air), np.arcsin(sin_in_air / n)
    if a == 0.0:
        return float(((n - 1.0) / (n + 1.0)) ** 2)
    return float(0.5 * ((np.sin(a - b) / np.sin(a + b)) ** 2 + (np.tan(a - b) / np.tan(a + b)) ** 2))


def by_counting_reflections(r: float, n: float, geometry: Geometry) -> float:
    """Light that enters, is scattered 2000 times between layer and face, and leaves a little each time."""
    entering_sin = np.sqrt(0.5) if geometry == "45:0" else 0.0
    along = schlick_free_fresnel(0.0, n)
    kept_outside, _ = quad(lambda s: 2.0 * s * schlick_free_fresnel(s, n), 0.0, 1.0)
    leaving = (1.0 - kept_outside) / n**2
    caught = 1.0 - leaving
    inside = 1.0 - schlick_free_fresnel(entering_sin, n)
    seen = 0.0
    for _ in range(2000):
        inside *= r
        seen += inside * ((1.0 - along) / n**2 if geometry == "45:0" else leaving)
        inside *= caught
    return seen + (along if geometry == "gloss included" else 0.0)


@pytest.mark.parametrize("geometry", GEOMETRIES)
@pytest.mark.parametrize("inside", [0.02, 0.5, 0.97])
def test_what_is_seen_is_the_sum_of_what_leaves_after_each_reflection(geometry: Geometry, inside: float) -> None:
    seen = face(1.5, geometry).reflectance_in_air(InternalReflectance(np.asarray(inside))).values

    assert seen == pytest.approx(by_counting_reflections(inside, 1.5, geometry), abs=2e-6)


@settings(deadline=None, max_examples=40)
@given(inside=st.floats(0.0, 1.0), index=st.floats(1.01, 2.0), geometry=st.sampled_from(GEOMETRIES))
def test_what_is_inside_comes_back(inside: float, index: float, geometry: Geometry) -> None:
    one = face(index, geometry)

    seen = one.reflectance_in_air(InternalReflectance(np.asarray(inside)))

    assert one.inside(seen).values == pytest.approx(inside, abs=1e-9)


def test_the_half_that_an_instrument_sees_is_three_quarters_inside() -> None:
    inside = face(1.5).inside(MeasuredReflectance(np.asarray(0.5))).values

    # k1 = 0.04 and k2 = 0.596, from tables of Saunderson's correction.
    assert inside == pytest.approx(0.5 / (0.96 * 0.404 + 0.596 * 0.5), abs=2e-3)


@pytest.mark.parametrize("seen", [0.99, -0.01])
def test_what_no_paint_behind_the_face_can_show_is_refused(seen: float) -> None:
    with pytest.raises(InputError, match="inside the binder"):
        face(1.5).inside(MeasuredReflectance(np.asarray(seen)))


def test_without_a_face_what_is_seen_is_what_is_inside() -> None:
    assert BARE.inside(MeasuredReflectance(np.asarray(0.37))).values == pytest.approx(0.37, abs=1e-15)


def test_a_face_of_dispersion_has_its_own_numbers_in_each_band() -> None:
    together = face(np.array([1.45, 1.55]))
    for number, index in enumerate((1.45, 1.55)):
        one: Face = face(index)
        assert together.passing[number] == pytest.approx(one.passing)
        assert together.inner[number] == pytest.approx(one.inner)


def test_the_two_kinds_have_no_arithmetic_in_common() -> None:
    seen, inside = MeasuredReflectance(np.ones(2)), InternalReflectance(np.ones(2))

    with pytest.raises(TypeError):
        seen + inside  # type: ignore[operator]
    with pytest.raises(InputError, match="inside the binder"):
        InternalReflectance(np.array([0.2, 1.01]))
