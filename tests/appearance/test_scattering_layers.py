"""Kubelka-Munk and four fluxes against matrix exponentials, an integration of the equations, and their limits."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.integrate import solve_bvp
from scipy.linalg import expm

from coupole.appearance.matter import four_flux, kubelka_munk
from coupole.appearance.matter.four_flux import Background, Layer

PER_MM = st.floats(0.0, 40.0)
SHARE = st.floats(0.0, 0.98)
THICKNESS = st.floats(1e-3, 0.2)


def equations(layer: Layer) -> np.ndarray:
    """Derivatives of l+, l-, L+, L- with z, as the paper's Eqs 1 to 4 have them."""
    k, s, s_i, s_j = (float(v) for v in (layer.absorption, layer.scattering, layer.forward, layer.backward))
    mu = float(layer.direct_absorption) + s_i + s_j
    return np.array([[-mu, 0, 0, 0], [0, mu, 0, 0], [s_i, s_j, -(k + s), s], [-s_j, -s_i, -s, k + s]])


def by_matrix_exponential(layer: Layer, below: Background) -> tuple[float, float]:
    """Diffuse and specular reflectance: the boundary conditions solved on the propagator of the four fluxes."""
    propagator = expm(equations(layer) * layer.thickness_mm)
    at_bottom = np.array(
        [[-below.specular, 1.0, 0.0, 0.0], [-below.directed_to_diffuse, 0.0, -below.diffuse, 1.0]]
    )
    up = np.linalg.solve(at_bottom @ propagator[:, [1, 3]], -at_bottom @ propagator[:, 0])
    return float(up[1]), float(up[0])


def test_a_layer_that_does_not_absorb_loses_nothing() -> None:
    rho, tau = kubelka_munk.layer(0.0, 30.0, 0.1)

    assert rho == pytest.approx(3.0 / 4.0)
    assert rho + tau == pytest.approx(1.0)


def test_a_layer_that_does_not_scatter_follows_beers_law() -> None:
    rho, tau = kubelka_munk.layer(8.0, 0.0, 0.25)

    assert rho == 0.0
    assert tau == pytest.approx(np.exp(-2.0))


def test_a_very_thick_layer_is_opaque_without_overflow() -> None:
    rho, tau = kubelka_munk.layer(5.0, 20.0, 1e6)

    assert rho == pytest.approx(kubelka_munk.opaque(0.25))
    assert tau == 0.0


@settings(deadline=None, max_examples=40)
@given(k=st.floats(0.01, 40.0), s=st.floats(0.01, 40.0), h=THICKNESS)
def test_the_layer_equals_the_hyperbolic_form(k: float, s: float, h: float) -> None:
    a = 1.0 + k / s
    b = np.sqrt(a**2 - 1.0)
    x = b * s * h
    denominator = a * np.sinh(x) + b * np.cosh(x)

    rho, tau = kubelka_munk.layer(k, s, h)

    assert rho == pytest.approx(np.sinh(x) / denominator, rel=1e-9)
    assert tau == pytest.approx(b / denominator, rel=1e-9)


@settings(deadline=None, max_examples=40)
@given(k=PER_MM, s=PER_MM, h=THICKNESS, ground=SHARE, more=st.floats(0.01, 1.0))
def test_more_absorption_never_makes_paint_lighter(
    k: float, s: float, h: float, ground: float, more: float
) -> None:
    before, after = (kubelka_munk.over(*kubelka_munk.layer(value, s, h), ground) for value in (k, k + more))

    assert after <= before + 1e-12
    assert 0.0 <= before <= 1.0


@settings(deadline=None)
@given(reflectance=st.floats(0.001, 0.999))
def test_reflectance_and_k_over_s_are_inverse(reflectance: float) -> None:
    assert kubelka_munk.opaque(kubelka_munk.k_over_s(reflectance)) == pytest.approx(reflectance, rel=1e-9)


@settings(deadline=None, max_examples=40)
@given(
    k=PER_MM, s=PER_MM, direct=PER_MM, forward=PER_MM, backward=PER_MM, h=THICKNESS, below=st.tuples(SHARE, SHARE)
)
def test_four_fluxes_agree_with_the_matrix_exponential(
    k: float, s: float, direct: float, forward: float, backward: float, h: float, below: tuple[float, float]
) -> None:
    layer = Layer(k, s, direct, forward, backward, h)
    background = Background(diffuse=below[0], directed_to_diffuse=0.4 * below[1], specular=0.5 * below[1])

    diffuse, specular = four_flux.reflectances(layer, background)

    assert (diffuse, specular) == pytest.approx(by_matrix_exponential(layer, background), abs=1e-8)


def test_four_fluxes_agree_with_an_integration_of_the_equations() -> None:
    layer, below = Layer(2.0, 12.0, 1.5, 9.0, 3.0, 0.08), Background(0.6, 0.1, 0.2)
    matrix = equations(layer)

    def misses(top: np.ndarray, bottom: np.ndarray) -> np.ndarray:
        return np.array(
            [top[0] - 1.0, top[2], bottom[1] - 0.2 * bottom[0], bottom[3] - 0.6 * bottom[2] - 0.1 * bottom[0]]
        )

    z = np.linspace(0.0, 0.08, 20)
    solution = solve_bvp(lambda _, flux: matrix @ flux, misses, z, np.ones((4, 20)), tol=1e-9)

    diffuse, specular = four_flux.reflectances(layer, below)
    assert diffuse == pytest.approx(solution.y[3, 0], abs=1e-7)
    assert specular == pytest.approx(solution.y[1, 0], abs=1e-7)


def test_the_papers_resonance_is_no_singularity() -> None:
    k, s = 3.0, 8.0
    resonant = np.sqrt(k * (k + 2.0 * s))
    exact, near = (
        four_flux.reflectances(Layer(k, s, mu - 5.0, 3.0, 2.0, 0.1), Background(0.5))[0]
        for mu in (resonant, resonant * (1.0 + 1e-7))
    )

    assert np.isfinite(exact)
    assert exact == pytest.approx(near, abs=1e-7)


def test_away_from_resonance_the_papers_p_and_q_give_the_same() -> None:
    k, s, direct, s_i, s_j, h = 2.0, 12.0, 1.5, 9.0, 3.0, 0.08
    mu, a = direct + s_i + s_j, 1.0 + k / s
    b = np.sqrt(a**2 - 1.0)
    p = (s_i * (mu + a * s) + s_j * s) / (mu**2 - (b * s) ** 2)
    q = (s_j * (a * s - mu) + s_i * s) / (mu**2 - (b * s) ** 2)
    rho, tau, up, down, passed = four_flux.response(Layer(k, s, direct, s_i, s_j, h))

    assert up == pytest.approx(rho * p - q * (1.0 - tau * passed), rel=1e-9)
    assert down == pytest.approx(p * (tau - passed) + rho * q * passed, rel=1e-9)


@settings(deadline=None, max_examples=40)
@given(s=PER_MM, forward=PER_MM, backward=PER_MM, h=THICKNESS)
def test_a_layer_that_absorbs_nothing_over_a_perfect_ground_sends_all_light_back(
    s: float, forward: float, backward: float, h: float
) -> None:
    diffuse, specular = four_flux.reflectances(Layer(0.0, s, 0.0, forward, backward, h), Background(1.0, 0.3, 0.7))

    assert diffuse + specular == pytest.approx(1.0, abs=1e-7)


def test_light_that_is_diffuse_at_once_behaves_as_two_fluxes() -> None:
    # Direct light that turns into forward diffuse light within a thousandth of the layer.
    diffuse, _ = four_flux.reflectances(Layer(3.0, 15.0, 0.0, 1e6, 0.0, 0.1), Background(0.4))

    assert diffuse == pytest.approx(kubelka_munk.over(*kubelka_munk.layer(3.0, 15.0, 0.1), 0.4), abs=1e-4)
