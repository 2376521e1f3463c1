"""Light of a square Lambertian emitter: closed forms, quadrature, the horizon."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.typing import NDArray

from sim.render.emitter import FAR_SIDES, LED_SIDE_MM, Emitter, irradiance, square

DOWN = square((0, 0, 0), (0, 0, -1), side_mm=LED_SIDE_MM, flux_lm=1.0)
UP = (0.0, 0.0, 1.0)


def by_quadrature(
    emitter: Emitter, point_mm: NDArray[np.float64], normal: NDArray[np.float64], nodes: int
) -> float:
    """E as the integral of L cos cos / d^2 over the square, by Gauss and Legendre."""
    x, w = np.polynomial.legendre.leggauss(nodes)
    u, v = np.meshgrid(x, x)
    at = emitter.centre_mm + u[..., None] * emitter.half_u_mm + v[..., None] * emitter.half_v_mm - point_mm
    distance_mm = np.linalg.norm(at, axis=-1)
    cosines = np.maximum(0, -(at @ emitter.normal)) * np.maximum(0, at @ normal) / distance_mm**2
    return float(emitter.flux_lm * 1e6 / np.pi * (cosines / distance_mm**2 * np.outer(w, w)).sum() / 4)


@pytest.mark.parametrize(("angle_deg", "per_m2"), [(0.0, 0.318304687), (30.0, 0.238731440), (60.0, 0.0795790963)])
def test_irradiance_at_1_m_has_its_known_values(angle_deg: float, per_m2: float) -> None:
    a = np.radians(angle_deg)
    point_mm = [1000.0 * np.sin(a), 0.0, -1000.0 * np.cos(a)]
    assert irradiance(DOWN, point_mm, UP)[0] == pytest.approx(per_m2, rel=3e-9)


def test_view_factor_at_7_mm_is_that_of_the_closed_form() -> None:
    area_m2 = (LED_SIDE_MM * 1e-3) ** 2
    assert irradiance(DOWN, [0, 0, -7.0], UP)[0] * area_m2 == pytest.approx(0.2394564705, rel=1e-9)


@pytest.mark.parametrize("distance_mm", [20.0, 1000.0])
def test_an_emitter_sunk_to_half_below_the_horizon_gives_what_its_upper_half_gives(distance_mm: float) -> None:
    whole = square((0, 0, 0), (1, 0, 0), side_mm=7.0, flux_lm=1.0)
    upper = Emitter(np.array([0, 0, 1.75]), whole.normal, whole.half_u_mm, whole.half_v_mm / 2, 0.5)
    point_mm = np.array([distance_mm, 0.0, 0.0])
    expected = by_quadrature(upper, point_mm, np.array(UP), 12)
    assert irradiance(whole, point_mm, UP)[0] == pytest.approx(expected, rel=1e-9)


def test_behind_the_emitter_it_is_dark() -> None:
    assert irradiance(DOWN, [0.0, 0, 5.0], (0, 0, -1))[0] == 0.0


def test_paper_emission_takes_the_emitters_cosine_once_more() -> None:
    a = np.radians(30.0)
    point_mm = [1000.0 * np.sin(a), 0.0, -1000.0 * np.cos(a)]
    ratio = irradiance(DOWN, point_mm, UP, "paper") / irradiance(DOWN, point_mm, UP, "lambertian")
    assert ratio[0] == pytest.approx(np.cos(a), rel=1e-12)


unit_vectors = st.tuples(*[st.floats(-1, 1)] * 3).filter(lambda v: np.linalg.norm(v) > 0.1)


@given(way=unit_vectors, facing=unit_vectors, distance_mm=st.floats(40.0, 3000.0), lies=unit_vectors)
def test_polygon_and_gauss_points_agree_with_fine_quadrature_everywhere(
    way: tuple[float, ...], facing: tuple[float, ...], distance_mm: float, lies: tuple[float, ...]
) -> None:
    emitter = square((3.0, -2.0, 900.0), lies, side_mm=LED_SIDE_MM, flux_lm=1800.0)
    direction, normal = np.array(way) / np.linalg.norm(way), np.array(facing) / np.linalg.norm(facing)
    point_mm = emitter.centre_mm + distance_mm * direction
    half_mm = LED_SIDE_MM / np.sqrt(2)
    above = min(-direction @ normal, direction @ emitter.normal) * distance_mm - half_mm
    if above <= 0:
        return  # part of the square is below a horizon: quadrature would need the edge
    expected = by_quadrature(emitter, point_mm, normal, 12)
    assert irradiance(emitter, point_mm, normal)[0] == pytest.approx(expected, rel=1e-6)


@given(st.floats(0.0, 1.0), st.floats(0.0, 2 * np.pi), st.floats(0.11, 1.0))
def test_where_gauss_points_take_over_the_step_is_below_1e_6(away: float, around: float, above: float) -> None:
    tilt = np.arccos(1 - 0.9 * away)
    direction = np.array([np.sin(tilt) * np.cos(around), np.sin(tilt) * np.sin(around), -np.cos(tilt)])
    aside = np.cross(direction, [0.0, 1.0, 0.3])
    normal = -above * direction + np.sqrt(1 - above**2) * aside / np.linalg.norm(aside)
    near, far = (
        irradiance(DOWN, LED_SIDE_MM * FAR_SIDES * scale * direction, normal)[0] * scale**2
        for scale in (1 - 1e-9, 1 + 1e-9)
    )
    assert far == pytest.approx(near, rel=1e-6)
