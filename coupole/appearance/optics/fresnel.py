"""Reflection at one smooth interface, dielectric or metal.

Complex indices are n + i k with k >= 0, for fields exp(-i omega t), so that waves decay into the material. The
incident medium is transparent. Source of the formulas: Born and Wolf, Principles of Optics, sections 1.5 and 14.2.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numpy.typing import ArrayLike

from coupole.appearance.spectra.grid import Array, Complex

Fresnel = Callable[[Array], Array]
"""Reflectance [..., bands] at cosines [...] of the angle of incidence, for the facets of a BRDF."""

_NODES, _WEIGHTS = np.polynomial.legendre.leggauss(64)


def cos_inside(cos_outside: ArrayLike, outside: ArrayLike, inside: ArrayLike) -> Complex:
    """Cosine of the refracted ray (Snell); complex in absorbing media and under total reflection.

    The root is the wave that decays in the second medium (or, if neither decays, that travels forward).
    """
    n1, n2 = np.asarray(outside, dtype=complex), np.asarray(inside, dtype=complex)
    sin2 = 1.0 - np.asarray(cos_outside, dtype=complex) ** 2
    cosine: Complex = np.sqrt(1.0 - (n1 / n2) ** 2 * sin2)
    wave = n2 * cosine
    # A root on the real axis is decided by its real part: its imaginary part is rounding.
    fades = np.where(np.abs(wave.imag) > 1e-12 * np.abs(wave), wave.imag, wave.real) >= 0.0
    return np.where(fades, cosine, -cosine)


def amplitudes(
    cos_outside: ArrayLike, cos_in: ArrayLike, outside: ArrayLike, inside: ArrayLike
) -> tuple[Complex, Complex, Complex, Complex]:
    """Return r_s, r_p, t_s, t_p of the interface; all arguments broadcast and may be complex."""
    c1, c2 = np.asarray(cos_outside, dtype=complex), np.asarray(cos_in, dtype=complex)
    n1, n2 = np.asarray(outside, dtype=complex), np.asarray(inside, dtype=complex)
    s, p = n1 * c1 + n2 * c2, n2 * c1 + n1 * c2
    return (n1 * c1 - n2 * c2) / s, (n2 * c1 - n1 * c2) / p, 2.0 * n1 * c1 / s, 2.0 * n1 * c1 / p


def reflectance(cos_outside: ArrayLike, inside: ArrayLike, outside: ArrayLike = 1.0) -> Array:
    """Share of unpolarised light that the interface reflects; arguments broadcast."""
    r_s, r_p, _, _ = amplitudes(cos_outside, cos_inside(cos_outside, outside, inside), outside, inside)
    return np.asarray(0.5 * (np.abs(r_s) ** 2 + np.abs(r_p) ** 2))


def of_index(inside: ArrayLike) -> Fresnel:
    """Return the reflectance of the interface from air to an index [bands], as a function of the cosine for
    `brdf`."""
    index = np.atleast_1d(np.asarray(inside, dtype=complex))
    return lambda cosine: reflectance(np.asarray(cosine)[..., None], index)


def diffuse_external(inside: ArrayLike) -> Array:
    """Reflectance of the interface for diffuse (Lambertian) light from air: 2 times the integral of R(mu) mu."""
    mu = 0.5 * (_NODES + 1.0)
    index = np.asarray(inside, dtype=complex)[..., None]
    return np.asarray(reflectance(mu, index) @ (_WEIGHTS * mu))


def diffuse_internal(inside: ArrayLike) -> Array:
    """Reflectance of the interface for diffuse light from within, total reflection included.

    It is 1 - (1 - external)/n^2, because in equilibrium both directions transmit the same power. The material is
    transparent, with real index n >= 1.
    """
    index = np.asarray(inside, dtype=float)
    return np.asarray(1.0 - (1.0 - diffuse_external(index)) / index**2)
