"""Reflectance distribution functions f(wi, wo), per steradian, at one point of a surface.

Directions are unit vectors [..., 3] away from the surface in its own frame, z along the normal: `wi` to the light,
`wo` to the eye. Results are [..., bands]; they are 0 where either direction is at or below the horizon. The
radiance reflected from a light of irradiance E (on a plane facing it) is f E wi_z. Other parameters are bound with
`functools.partial`, which makes each of these functions a `Brdf`.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numpy.typing import ArrayLike

from coupole.appearance.optics.fresnel import Fresnel
from coupole.appearance.spectra.grid import Array

Brdf = Callable[[Array, Array], Array]
LEAST_ROUGHNESS = 1e-3
"""Least roughness; below it the surface is a mirror, whose BRDF is not a function."""


def lambert(wi: Array, wo: Array, *, reflectance: ArrayLike) -> Array:
    """Perfectly diffuse surface: reflectance [bands] over pi."""
    return np.asarray(_above(wi, wo)[..., None] * np.atleast_1d(np.asarray(reflectance, dtype=float)) / np.pi)


def oren_nayar(wi: Array, wo: Array, *, reflectance: ArrayLike, roughness: float) -> Array:
    """Rough diffuse surfaces such as bole or plaster, in Fujii's form, which creates no energy.

    Oren and Nayar, SIGGRAPH 1994; Fujii, "A tiny improvement of Oren-Nayar reflectance model" (2012). `roughness`
    goes from 0 (Lambert) to 1.
    """
    up = wi[..., 2] * wo[..., 2]
    s = np.sum(wi * wo, axis=-1) - up
    t = np.where(s > 0.0, np.maximum(np.maximum(wi[..., 2], wo[..., 2]), 1e-9), 1.0)
    a = 1.0 / (np.pi + (np.pi / 2.0 - 2.0 / 3.0) * roughness)
    shape = _above(wi, wo) * a * (1.0 + roughness * s / t)
    return np.asarray(shape[..., None] * np.atleast_1d(np.asarray(reflectance, dtype=float)))


def ggx(wi: Array, wo: Array, *, roughness: float, fresnel: Fresnel) -> Array:
    """Facets with the GGX distribution and Smith's height-correlated shadowing; single reflection only.

    Walter et al., EGSR 2007; Heitz, JCGT 3(2), 2014, Eqs 72 and 99. `roughness` is alpha.
    """
    h, cos_h = half_vector(wi, wo)
    a2 = max(roughness, LEAST_ROUGHNESS) ** 2
    z_i, z_o, above = _cosines(wi, wo)
    d = a2 / (np.pi * (1.0 - h[..., 2] ** 2 * (1.0 - a2)) ** 2)
    # G/(4 z_i z_o) in one: with Smith's lambdas, 1 + L_i + L_o is the sum below over 2 z_i z_o.
    g = 0.5 / (z_o * np.sqrt(a2 + (1.0 - a2) * z_i**2) + z_i * np.sqrt(a2 + (1.0 - a2) * z_o**2))
    return np.asarray((above * d * g)[..., None] * fresnel(cos_h))


def cook_torrance(wi: Array, wo: Array, *, slope: float, fresnel: Fresnel) -> Array:
    """Beckmann facets with the root mean square slope `slope` in V-shaped grooves: F D G/(4 z_i z_o), where D
    includes 1/pi.

    Cook and Torrance, ACM TOG 1, 7 (1982), but normalised, because their F/pi without the 4 reflects four times
    too much.
    """
    h, cos_h = half_vector(wi, wo)
    m2 = max(slope, LEAST_ROUGHNESS) ** 2
    z_i, z_o, above = _cosines(wi, wo)
    z_h = np.maximum(h[..., 2], 1e-6)
    d = np.exp(-(1.0 / z_h**2 - 1.0) / m2) / (np.pi * m2 * z_h**4)
    g = np.minimum(1.0, 2.0 * z_h * np.minimum(z_i, z_o) / np.maximum(cos_h, 1e-9))
    return np.asarray((above * d * g / (4.0 * z_i * z_o))[..., None] * fresnel(cos_h))


def half_vector(wi: Array, wo: Array) -> tuple[Array, Array]:
    """Return the unit vector [..., 3] halfway between two directions, and the cosine [...] between it and each of
    them."""
    total = wi + wo
    length = np.maximum(np.linalg.norm(total, axis=-1, keepdims=True), 1e-12)
    h = total / length
    # |wi + wo| = 2 cos: exact, where the dot product would lose digits at grazing angles.
    return h, np.minimum(0.5 * length[..., 0], 1.0)


def _above(wi: Array, wo: Array) -> Array:
    return ((wi[..., 2] > 0.0) & (wo[..., 2] > 0.0)).astype(float)


def _cosines(wi: Array, wo: Array) -> tuple[Array, Array, Array]:
    """Return the cosines to the normal, limited to values above zero, and 1 where both directions are above the
    horizon."""
    return np.maximum(wi[..., 2], 1e-9), np.maximum(wo[..., 2], 1e-9), _above(wi, wo)
