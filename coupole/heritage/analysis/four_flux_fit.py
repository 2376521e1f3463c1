"""Four fluxes of a film from its spectra under diffuse and under directional light (Dumazet et al. 2008, section
3.4).

K and S come from the diffuse spectra (`layer_fit`). Entering directional light is scattered into diffuse light,
upwards R_b and downwards T_cd, or reaches the ground unscattered, Tr = exp(-mu h). Over a diffusing ground g the
reflectance is

    R_cd(g) = R_b + tau g (T_cd + Tr)/(1 - rho g)

inside the binder. Two grounds give R_b and T_cd + Tr; the collimated transmittance Tr gives T_cd. R_b and T_cd are
linear in the scattering coefficients s_i and s_j at a given mu; k = mu - s_i - s_j. The paper's p and q are the
same two numbers, and diverge where mu = b S; the equations here do not diverge.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from coupole.appearance.matter import four_flux, kubelka_munk
from coupole.appearance.matter.glossy_face import Face
from coupole.appearance.spectra.grid import Array
from coupole.heritage.analysis import layer_fit
from coupole.heritage.analysis.layer_fit import Coefficients, Film

DRAWS = 150
"""Number of draws of all inputs, for uncertainties (JCGM 101)."""


@dataclass(frozen=True, eq=False)
class Directional:
    """Spectra of one film under light along the normal; [n], in air, gloss excluded."""

    over_black: Array
    over_white: Array
    transmittance: Array
    """Collimated transmittance of the film inside its binder: the share of light that passes unscattered."""


@dataclass(frozen=True, eq=False)
class FourFlux:
    """Coefficients for directional light, [n] per mm or for the layer, with standard uncertainties."""

    direct_absorption: Array
    """k: absorption of directional light."""
    forward: Array
    """s_i: scattering of directional light forwards."""
    backward: Array
    """s_j: scattering of directional light backwards."""
    u_direct_absorption: Array
    u_forward: Array
    u_backward: Array


def fit(black: Film, white: Film, directional: Directional, face: Face, noise: float, seed: int = 1) -> FourFlux:
    """Fit the four fluxes of one film over two grounds. Thickness, grounds and their uncertainties are taken from
    the diffuse `Film`s."""
    rng = np.random.default_rng(seed)
    n = len(black.reflectance)

    def with_draws(values: Array, u: Array | float) -> Array:
        """[(1 + DRAWS) n] values: as measured, then with random errors."""
        std = np.broadcast_to(np.asarray(u, dtype=float), n)
        noisy = values + std * rng.standard_normal((DRAWS, n))
        return np.concatenate([values[None], noisy]).ravel()

    films = [
        Film(
            with_draws(film.reflectance, noise),
            with_draws(_ground(film), film.u_ground),
            film.ground_name,
            0.0,
            1.0,
        )
        for film in (black, white)
    ]
    coefficients = layer_fit.fit(films, _repeat_face(face, DRAWS + 1), noise)
    light = Directional(
        with_draws(directional.over_black, noise),
        with_draws(directional.over_white, noise),
        np.clip(with_draws(directional.transmittance, noise), 1e-4, 1.0),
    )
    solutions = _solve_layer(coefficients, films, light, _repeat_face(face, DRAWS + 1)).reshape(3, DRAWS + 1, n)
    # Coefficients of the whole layer: those per mm follow from the thickness, the same in all bands of a draw.
    h = black.thickness_mm * np.ones(DRAWS + 1)
    h[1:] += black.u_thickness_mm * rng.standard_normal(DRAWS)
    solutions = solutions / h[None, :, None]
    u = 0.5 * np.subtract(*np.percentile(solutions[:, 1:], [84.13, 15.87], axis=1))
    return FourFlux(*solutions[:, 0], *u)


def _ground(film: Film) -> Array:
    assert film.ground is not None
    return film.ground


def _repeat_face(face: Face, times: int) -> Face:
    parts = (face.passing, face.inner, face.gloss)
    return Face(*(np.tile(part, times) if part.ndim else part for part in parts))


def _solve_layer(coefficients: Coefficients, films: list[Film], light: Directional, face: Face) -> Array:
    """Return k, s_i, s_j [3, n] for the whole layer."""
    k, s = np.maximum(coefficients.absorption, 0.0), coefficients.scattering
    rho, tau = kubelka_munk.layer(k, s, 1.0)
    inside = []
    for film, value in zip(films, (light.over_black, light.over_white), strict=True):
        # Light enters once as it came; what the face sends back is diffuse, as if it had come so.
        diffuse = kubelka_munk.over(rho, tau, _ground(film))
        inside.append((value - face.gloss) * (1.0 - face.inner * diffuse) / face.passing)
    gains = [tau * _ground(film) / (1.0 - rho * _ground(film)) for film in films]
    through = (inside[1] - inside[0]) / (gains[1] - gains[0])
    up, down = inside[0] - gains[0] * through, through - light.transmittance
    mu = -np.log(light.transmittance)
    forwards, backwards = (
        four_flux.response(four_flux.Layer(k, s, 0.0, mu * a, mu * (1.0 - a), 1.0)) for a in (1.0, 0.0)
    )
    determinant = forwards[2] * backwards[3] - forwards[3] * backwards[2]
    s_i = mu * (up * backwards[3] - down * backwards[2]) / determinant
    s_j = mu * (down * forwards[2] - up * forwards[3]) / determinant
    return np.stack([mu - s_i - s_j, s_i, s_j])
