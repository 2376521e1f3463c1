"""Integrals of any BRDF over the hemisphere: total reflectance."""

from __future__ import annotations

import numpy as np

from coupole.appearance.matter.brdf import Brdf
from coupole.appearance.spectra.grid import Array


def directions(cosines: Array, azimuths: Array) -> Array:
    """Unit vectors [..., 3] at cosines to the normal and azimuths in radians."""
    sine = np.sqrt(np.maximum(0.0, 1.0 - cosines**2))
    return np.stack(np.broadcast_arrays(sine * np.cos(azimuths), sine * np.sin(azimuths), cosines), axis=-1)


def albedo(brdf: Brdf, cosines: Array, *, nodes: int = 64) -> Array:
    """Directional-hemispherical reflectance [n, bands] at n cosines of incidence.

    For a reciprocal BRDF this is also its radiance in a white furnace (radiance 1 from all directions). The
    integral uses a polar grid about the specular direction, with polar angles concentrated there, so that narrow
    lobes are resolved. It has `nodes` Gauss points of theta = (pi/2 + theta_i) u^3, and `nodes` midpoints of
    azimuth. The horizon cuts through the grid, which gives an error of about 1/nodes of the light reflected there.
    """
    u, weight = np.polynomial.legendre.leggauss(nodes)
    u, weight = 0.5 * (u + 1.0), 0.5 * weight
    phi = (np.arange(nodes) + 0.5) * 2.0 * np.pi / nodes
    totals = []
    for cosine in np.atleast_1d(cosines):
        wi = directions(np.asarray(cosine), np.asarray(0.0))
        widest = 0.5 * np.pi + np.arccos(cosine)
        theta, theta_weight = widest * u**3, weight * widest * 3.0 * u**2
        local = directions(np.cos(theta)[:, None], phi)
        wo = _about(np.array([-wi[0], 0.0, wi[2]]), local)
        solid_angle = (theta_weight * np.sin(theta))[:, None] * (2.0 * np.pi / nodes)
        share = brdf(np.broadcast_to(wi, wo.shape), wo) * (solid_angle * np.maximum(wo[..., 2], 0.0))[..., None]
        totals.append(share.sum(axis=(0, 1)))
    return np.asarray(totals)


def _about(axis: Array, local: Array) -> Array:
    """Return `local` vectors turned so that their z axis becomes `axis`, a unit vector in the plane y = 0."""
    x, z = local[..., 0], local[..., 2]
    return np.stack([axis[2] * x + axis[0] * z, local[..., 1], axis[2] * z - axis[0] * x], axis=-1)
