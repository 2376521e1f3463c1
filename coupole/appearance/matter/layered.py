"""A rough sheet over a diffuse body: varnish or lacquer on paint, a gold leaf on bole.

The sheet is the interface between air and the body's medium: a bare surface, or thin films. Part of the light is
reflected by the sheet's facets (GGX); the rest enters, is scattered by the body and leaves again, partly after
reflection at the sheet's inner side. Energy is conserved by construction: light that is not reflected at an angle
enters or is absorbed there. The emerging light has the angular distribution of the sheet's transmittance, so that
the result is reciprocal.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from coupole.appearance.matter import brdf
from coupole.appearance.matter.glossy_face import InternalReflectance
from coupole.appearance.optics import thin_film
from coupole.appearance.spectra.grid import WAVELENGTHS_NM, Array, within

_ANGLES = 65
_FACETS = 32
_GAUSS, _GAUSS_WEIGHTS = np.polynomial.legendre.leggauss(48)
# Squares of equal steps: reflectance varies most at grazing incidence.
COSINES: Array = np.linspace(0.0, 1.0, _ANGLES) ** 2


@dataclass(frozen=True)
class Sheet:
    """A smooth sheet's reflectance and transmittance. Arrays [angles, bands] are for light from air."""

    reflectance: Array
    """Reflectance at `COSINES`."""
    transmittance: Array
    """Transmittance into the body's medium."""
    normal_reflectance: Array
    """[bands]."""
    internal_reflectance: Array
    """[bands] reflectance for diffuse light from the body."""
    internal_transmittance: Array
    """[bands] transmittance to air for diffuse light from the body. The sheet absorbs the rest."""


@dataclass(frozen=True)
class Coat:
    """A rough sheet, ready for `layered_brdf`."""

    sheet: Sheet
    roughness: float
    entering: Array
    """[angles, bands], share of light from each angle that reaches the body."""
    leaving: Array
    """[angles, bands], share of diffuse light from the body that leaves per projected solid angle, times pi."""


def sheet(films: Sequence[thin_film.Film], body_index: float) -> Sheet:
    """Return the sheet made by `films` over a body of real index > 1. The films are in order from the air inwards;
    none make a bare surface."""
    within("index of the body", body_index, 1.0 + 1e-9, 10.0)
    outwards = tuple(reversed(films))

    def from_air(cosines: Array) -> tuple[Array, Array]:
        return thin_film.stack_power(cosines, WAVELENGTHS_NM, films, substrate=body_index)

    def from_body(cosines: Array) -> tuple[Array, Array]:
        return thin_film.stack_power(cosines, WAVELENGTHS_NM, outwards, outside=body_index)

    mu, weight = 0.5 * (_GAUSS + 1.0), 0.5 * _GAUSS_WEIGHTS
    # Diffuse light from within: 2 mu dmu over the cosines in the body. Below the critical angle it goes over the
    # cosines in air, beyond it over the square root of what is missing to that angle: smooth in both parts.
    critical = np.sqrt(1.0 - 1.0 / body_index**2)
    passing, escaping = from_body(np.sqrt(critical**2 + (mu / body_index) ** 2))
    caught, _ = from_body(np.sqrt(critical**2 - (critical * mu) ** 2))
    share = 2.0 * mu * weight
    at_grazing = np.maximum(COSINES, 1e-9)
    reflectance, transmittance = from_air(at_grazing)
    return Sheet(
        reflectance=reflectance,
        transmittance=transmittance,
        normal_reflectance=reflectance[-1],
        internal_reflectance=share @ passing / body_index**2 + critical**2 * (share @ caught),
        internal_transmittance=share @ escaping / body_index**2,
    )


def coat(smooth: Sheet, roughness: float) -> Coat:
    """Return the sheet on a rough surface, in facets of GGX `roughness`.

    At each angle, the rough and the smooth sheet transmit the same share of the light that they do not reflect.
    """
    remainder = 1.0 - _facets(roughness) @ smooth.reflectance
    entering = remainder * smooth.transmittance / np.maximum(1.0 - smooth.reflectance, 1e-12)
    return Coat(smooth, roughness, entering, entering / np.maximum(_over_angles(entering), 1e-300))


def layered_brdf(wi: Array, wo: Array, *, coat: Coat, body: InternalReflectance) -> Array:
    """Return the sum of the coat's gloss and the light of the body [bands] through the coat."""
    gloss = brdf.ggx(wi, wo, roughness=coat.roughness, fresnel=lambda c: at_cosine(coat.sheet.reflectance, c))
    exchange = at_cosine(coat.entering, wi[..., 2]) * at_cosine(coat.leaving, wo[..., 2])
    above = ((wi[..., 2] > 0.0) & (wo[..., 2] > 0.0))[..., None]
    return gloss + above * exchange * emerging(coat.sheet, body) / np.pi


def emerging(sheet: Sheet, body: InternalReflectance) -> Array:
    """Return the share [bands] of the entering light that leaves again, after all reflections between sheet and
    body."""
    r = body.values
    return np.asarray(sheet.internal_transmittance * r / (1.0 - sheet.internal_reflectance * r))


def at_cosine(table: Array, cosines: Array) -> Array:
    """Return values [..., bands] of a table [angles, bands] at cosines [...]."""
    place = np.sqrt(np.clip(cosines, 0.0, 1.0)) * (_ANGLES - 1)
    low = np.minimum(place.astype(int), _ANGLES - 2)
    share = (place - low)[..., None]
    return np.asarray(table[low] * (1.0 - share) + table[low + 1] * share)


def _over_angles(table: Array) -> Array:
    """Return 2 times the integral of table(mu) mu over the cosine mu: [bands]."""
    mu = 0.5 * (_GAUSS + 1.0)
    return np.asarray(_GAUSS_WEIGHTS * mu @ at_cosine(table, mu))


def _facets(roughness: float) -> Array:
    """[angles, angles]: row i has the share of the light from angle i that GGX facets reflect, by local angle at
    the facet.

    The product of this table with a sheet's reflectances gives the reflectances of the rough sheet. Facets are
    weighted by their visible area (Heitz, "Sampling the GGX distribution of visible normals", JCGT 7(4), 2018).
    They are taken at Gauss points of a disk, each weighted with the shadowing G2/G1 of the reflected direction.
    """
    alpha = max(roughness, brdf.LEAST_ROUGHNESS)
    radius2, weight = np.polynomial.legendre.leggauss(_FACETS)
    radius2, weight = 0.5 * (radius2 + 1.0), 0.5 * weight
    phi = (np.arange(_FACETS) + 0.5) * 2.0 * np.pi / _FACETS
    table = np.zeros((_ANGLES, _ANGLES))
    for row, z in enumerate(np.maximum(COSINES, 1e-6)):
        wi = np.array([np.sqrt(1.0 - z * z), 0.0, z])
        stretched_way = np.array([alpha * wi[0], 0.0, z]) / np.hypot(alpha * wi[0], z)
        t1 = np.sqrt(radius2)[:, None] * np.cos(phi)
        t2 = np.sqrt(radius2)[:, None] * np.sin(phi)
        tilt = 0.5 * (1.0 + stretched_way[2])
        t2 = (1.0 - tilt) * np.sqrt(np.maximum(0.0, 1.0 - t1**2)) + tilt * t2
        t3 = np.sqrt(np.maximum(0.0, 1.0 - t1**2 - t2**2))
        # The disk's axes: t1 along y, t2 perpendicular to it and to the stretched direction.
        h = np.stack(
            [
                alpha * (t3 * stretched_way[0] - t2 * stretched_way[2]),
                alpha * t1,
                t3 * stretched_way[2] + t2 * stretched_way[0],
            ]
        )
        h /= np.linalg.norm(h, axis=0)
        cos_h = np.clip(np.tensordot(wi, h, 1), 0.0, 1.0)
        out = np.maximum(2.0 * cos_h * h[2] - z, 0.0)
        a_in, a_out = (np.sqrt(alpha**2 + (1.0 - alpha**2) * c**2) for c in (z, out))
        g2_over_g1 = np.where(out > 0.0, out * (a_in + z) / (z * a_out + out * a_in), 0.0)
        place = np.sqrt(cos_h) * (_ANGLES - 1)
        low = np.minimum(place.astype(int), _ANGLES - 2)
        share = place - low
        energy = g2_over_g1 * weight[:, None] / _FACETS
        np.add.at(table[row], low, energy * (1.0 - share))
        np.add.at(table[row], low + 1, energy * share)
    return table
