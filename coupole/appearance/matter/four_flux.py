"""Two directional and two diffuse fluxes in a scattering layer (Dumazet et al. 2008, section 3.4).

With z downward, l the directional and L the diffuse fluxes, mu = k + s_i + s_j::

    l+' = -mu l+            L+' =  s_i l+ + s_j l- - (K + S) L+ + S L-
    l-' =  mu l-           -L-' =  s_j l+ + s_i l- - (K + S) L- + S L+

    l+(0) = 1    L+(0) = 0    l-(h) = r_s l+(h)    L-(h) = Rg L+(h) + Rcg l+(h)

The paper solves this with p and q, which diverge where mu = b S although the fluxes do not. Here the scattered
light is integrated with the layer's Green's function instead. If diffuse light starts at depth z downwards, the
layer alone sends the share sinh(bS(h-z))/A through its top and the share A(z)/A through its bottom, where A(z) = a
sinh(bSz) + b cosh(bSz) and A = A(h). For light going up, the two are exchanged. The integrals of these with
exp(-mu z) are divided differences of exponentials, finite everywhere.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from coupole.appearance.matter.kubelka_munk import decay
from coupole.appearance.spectra.grid import Array, within

_LEAST_X = 1e-5
"""Least value of x = bSh: a layer without absorption of diffuse light gets a very small absorption. The results
depend on x^2, so the error is 1e-10. This is as large as the rounding error of the differences divided by x."""


@dataclass(frozen=True)
class Layer:
    """A layer's coefficients per mm, [bands] or scalars, and its thickness."""

    absorption: ArrayLike
    """K, diffuse light."""
    scattering: ArrayLike
    """S: scattering of diffuse light from one direction to the other."""
    direct_absorption: ArrayLike
    """k, of directional light."""
    forward: ArrayLike
    """s_i: scattering of directional light into diffuse light of the same direction."""
    backward: ArrayLike
    """s_j: scattering of directional light into diffuse light of the opposite direction."""
    thickness_mm: ArrayLike


@dataclass(frozen=True)
class Background:
    """The background under the layer."""

    diffuse: ArrayLike = 0.0
    """Rg, diffuse to diffuse."""
    directed_to_diffuse: ArrayLike = 0.0
    """Rcg, directional to diffuse."""
    specular: ArrayLike = 0.0
    """r_s, of the mirror image."""


def reflectances(layer: Layer, background: Background) -> tuple[Array, Array]:
    """Diffuse and specular reflectance of the layer on its background, for directional light."""
    rho, tau, scattered_up, scattered_down, direct = response(layer)
    ground, to_diffuse, mirror = (
        np.asarray(v, dtype=float)
        for v in (background.diffuse, background.directed_to_diffuse, background.specular)
    )
    down = (scattered_down + scattered_up * mirror * direct + rho * to_diffuse * direct) / (1.0 - rho * ground)
    diffuse = scattered_up + scattered_down * mirror * direct + tau * (ground * down + to_diffuse * direct)
    return diffuse, mirror * direct**2


def response(layer: Layer) -> tuple[Array, Array, Array, Array, Array]:
    """Return five values of the layer alone: rho and tau for diffuse light; R_b and T_cd from directional to
    diffuse light, up and down; and Tr.

    Tr = exp(-mu h) is the share of directional light that passes.
    """
    k, s, k_direct, forward, backward, h = (
        within(name, getattr(layer, name), 0.0, 1e12)
        for name in ("absorption", "scattering", "direct_absorption", "forward", "backward", "thickness_mm")
    )
    m = (k_direct + forward + backward) * h
    x = np.maximum(np.sqrt(k * (k + 2.0 * s)) * h, _LEAST_X)
    # A/b, sinh/b and the integrals below have the common factor exp(x), which is omitted.
    shrink = np.exp(-x)
    a_over_b = (k + s) * h * decay(2.0 * x) + 0.5 * (1.0 + shrink**2)
    fading, growing = decay(m + x), decay(np.abs(m - x)) * np.exp(np.maximum(x - m, 0.0) - x)
    sinh_from_top = 0.5 * (fading - shrink * growing) / x
    cosh_from_top = 0.5 * (fading + shrink * growing)
    sinh_from_bottom = 0.5 * (growing - shrink * fading) / x
    cosh_from_bottom = 0.5 * (growing + shrink * fading)
    s_h, a_s_h = s * h, (k + s) * h
    up = backward * (a_s_h * sinh_from_top + cosh_from_top) + forward * s_h * sinh_from_top
    down = forward * (a_s_h * sinh_from_bottom + cosh_from_bottom) + backward * s_h * sinh_from_bottom
    rho, tau = s_h * decay(2.0 * x) / a_over_b, shrink / a_over_b
    return rho, tau, h * up / a_over_b, h * down / a_over_b, np.exp(-m)
