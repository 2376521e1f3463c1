"""Two diffuse fluxes in a scattering layer (Kubelka and Munk 1931; Dumazet et al. 2008, Eqs 5-7).

All reflectances are inside the binder; `glossy_face` converts measured reflectances to these, and back.

K and S are absorption and scattering per mm, h is the thickness in mm; all arguments broadcast. With a = 1 + K/S,
b = sqrt(a^2 - 1) and x = b S h, a layer reflects rho = sinh x/A and transmits tau = b/A, where A = a sinh x + b
cosh x. Here A is divided by b exp(x), and K/S is not formed, so that thick layers, layers without absorption and
layers without scattering need no special cases.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike

from coupole.appearance.spectra.grid import Array, within


def decay(x: ArrayLike) -> Array:
    """(1 - exp(-x))/x, which is 1 at 0: the mean of exp(-z) over 0 < z < x."""
    values = np.asarray(x, dtype=float)
    return np.where(values == 0.0, 1.0, -np.expm1(-values) / np.where(values == 0.0, 1.0, values))


def layer(absorption: ArrayLike, scattering: ArrayLike, thickness_mm: ArrayLike) -> tuple[Array, Array]:
    """Reflectance rho and transmittance tau of the layer alone, for diffuse light."""
    k, s, h = (within(*item, 0.0, 1e12) for item in (("K", absorption), ("S", scattering), ("h", thickness_mm)))
    x = np.sqrt(k * (k + 2.0 * s)) * h
    sinh = s * h * decay(2.0 * x)
    a_over_b = (k + s) * h * decay(2.0 * x) + 0.5 * (1.0 + np.exp(-2.0 * x))
    return sinh / a_over_b, np.exp(-x) / a_over_b


def over(rho: ArrayLike, tau: ArrayLike, background: ArrayLike) -> Array:
    """Return the reflectance of a layer (rho, tau) on a background with reflectance `background`."""
    rho, tau, ground = (
        np.asarray(rho, dtype=float),
        np.asarray(tau, dtype=float),
        np.asarray(background, dtype=float),
    )
    return np.asarray(rho + tau**2 * ground / (1.0 - rho * ground))


def opaque(k_over_s: ArrayLike) -> Array:
    """R_inf, the reflectance of an opaque layer.

    1/(a + b), which equals a - b without loss of digits for dark layers.
    """
    ratio = within("K/S", k_over_s, 0.0, 1e12)
    return np.asarray(1.0 / (1.0 + ratio + np.sqrt(ratio * (ratio + 2.0))))


def k_over_s(r_inf: ArrayLike) -> Array:
    """K/S of an opaque layer from its (internal) reflectance in 0 < R <= 1 (Callet et al. 2010, Eq. 6)."""
    r = within("R_inf", r_inf, np.finfo(float).tiny, 1.0)
    return np.asarray((1.0 - r) ** 2 / (2.0 * r))
