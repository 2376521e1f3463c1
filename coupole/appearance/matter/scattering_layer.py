"""Diffuse light in a layer of grains by radiative transfer, instead of the two fluxes of Kubelka and Munk.

Radiances at `DIRECTIONS` cosines for each hemisphere are followed through the layer by doubling: the matrices of a
very thin layer are a series of second order, and the layer is made twice as thick 14 times (van de Hulst, "A new
look at multiple scattering", 1963; Hansen and Travis, Space Sci. Rev. 16, 1974, section 3). The grains scatter by
Henyey and Greenstein (Astrophys. J. 93, 1941), with the mean cosine as the only parameter. Light that a grain
scatters nearly straight on counts as not scattered (delta-M, Wiscombe, J. Atmos. Sci. 34, 1977).
"""

from __future__ import annotations

from functools import cache

import numpy as np
from numpy.polynomial import legendre

from coupole.appearance.spectra.grid import Array

DIRECTIONS = 10
"""Number of cosines for each hemisphere, at Gauss-Legendre points from 0 to 1."""
_DOUBLINGS = 14


def diffuse_response(absorption: Array, scattering: Array, mean_cosine: float) -> tuple[Array, Array]:
    """Reflectance and transmittance [n] of a layer under Lambertian light; absorption and scattering [n] are
    optical depths, `mean_cosine` is the mean cosine of one scattering, from 0 to 0.9."""
    cosines, weights, forward, backward = _directions(mean_cosine)
    straight_on = mean_cosine ** (2 * DIRECTIONS)
    optical_depth = np.asarray(scattering, float)[:, None, None] * (1.0 - straight_on)
    extinction = np.asarray(absorption, float)[:, None, None] + optical_depth
    unit = np.eye(DIRECTIONS)
    a = (extinction * unit - 0.5 * optical_depth * forward * weights) / cosines[:, None] / 2**_DOUBLINGS
    b = 0.5 * optical_depth * backward * weights / cosines[:, None] / 2**_DOUBLINGS
    reflection = b - 0.5 * (a @ b + b @ a)
    transmission = unit - a + 0.5 * (a @ a + b @ b)
    for _ in range(_DOUBLINGS):
        between = transmission @ np.linalg.inv(unit - reflection @ reflection)
        reflection = reflection + between @ reflection @ transmission
        transmission = between @ transmission
    flux = 2.0 * weights * cosines
    return np.asarray((flux @ reflection).sum(axis=-1)), np.asarray((flux @ transmission).sum(axis=-1))


@cache
def _directions(mean_cosine: float) -> tuple[Array, Array, Array, Array]:
    """Return cosines and weights [DIRECTIONS], and the phase function averaged over azimuth, into the same and
    into the other hemisphere [DIRECTIONS, DIRECTIONS]. Its mean over all directions is 1."""
    nodes, weights = legendre.leggauss(DIRECTIONS)
    cosines, weights = 0.5 * (nodes + 1.0), 0.5 * weights
    orders = np.arange(2 * DIRECTIONS)
    straight_on = mean_cosine ** (2 * DIRECTIONS)
    moments = (2 * orders + 1) * (mean_cosine**orders - straight_on) / (1.0 - straight_on)
    values = legendre.legvander(cosines, 2 * DIRECTIONS - 1)
    forward = (values * moments) @ values.T
    backward = (values * moments * (-1.0) ** orders) @ values.T
    return np.asarray(cosines), np.asarray(weights), np.asarray(forward), np.asarray(backward)
