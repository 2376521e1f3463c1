"""Layers over layers in one binder under one face, for light of any direction.

A ground is described by its reflectances for light inside the binder: diffuse to diffuse, directed to diffuse, and
directed to its mirror image. A layer over a ground is again a ground, so layers are added from the bottom up.
Layers have two fluxes (Kubelka and Munk) or four fluxes (Dumazet et al. 2008, section 3.4, with a path of directed
light that is 1/cos longer), are clear (Beer and Lambert), or are metal leaves (thin films). A face closes the
stack.

For light along one direction, this computation is the exact solution of the four-flux equations with the
reflections at the faces. Over directions, the emerging light is distributed as the entering light is accepted: f =
A(i) A(o)/(pi <A>). This keeps the reflectance A of each direction, and is reciprocal.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import ArrayLike

from coupole.appearance.matter import brdf, four_flux, kubelka_munk, layered
from coupole.appearance.optics.thin_film import Film, stack_power
from coupole.appearance.spectra.grid import BANDS, WAVELENGTHS_NM, Array, within

_GAUSS, _WEIGHTS = np.polynomial.legendre.leggauss(48)


@dataclass(frozen=True)
class Ground:
    """Reflectances inside the binder. Directed light has the cosines of `layered.COSINES` in air after
    refraction."""

    diffuse: Array
    """[bands], diffuse to diffuse."""
    directional: Array
    """[angles, bands], directed to diffuse."""
    mirror: Array
    """[angles, bands], directed to its mirror image."""
    roughness: float = 0.0
    """GGX alpha of the mirror's facets."""


@dataclass(frozen=True)
class Binder:
    """The medium of all layers."""

    index: float

    @property
    def cosines(self) -> Array:
        """[angles, 1] cosines, inside the binder, of light that comes from air at `layered.COSINES`."""
        sine2 = (1.0 - layered.COSINES**2) / self.index**2
        return np.asarray(np.sqrt(1.0 - sine2))[:, None]

    def matt(self, reflectance: ArrayLike) -> Ground:
        """Return a Lambertian ground with a reflectance [bands]."""
        g = np.broadcast_to(within("ground", reflectance, 0.0, 1.0), BANDS)
        flat = np.broadcast_to(g, (len(layered.COSINES), BANDS))
        return Ground(g, flat, np.zeros_like(flat))

    def mirroring(self, ground: Ground, share: ArrayLike, roughness: float) -> Ground:
        """Return the ground with an additional mirror reflectance for directed light; diffuse light is reflected
        by both."""
        mirror = np.broadcast_to(np.asarray(share, dtype=float), ground.directional.shape)
        within("ground and its mirror together", ground.diffuse + mirror.max(axis=0), 0.0, 1.0 + 1e-9)
        return Ground(ground.diffuse + self._mean(mirror), ground.directional, mirror, roughness)

    def two_flux(
        self, ground: Ground, absorption: ArrayLike, scattering: ArrayLike, thickness_mm: float
    ) -> Ground:
        """Add a layer that makes all light diffuse immediately (Kubelka and Munk)."""
        rho, tau = kubelka_munk.layer(absorption, scattering, thickness_mm)
        return self.matt(kubelka_munk.over(rho, tau, ground.diffuse))

    def four_flux(self, ground: Ground, layer: four_flux.Layer) -> Ground:
        """Add a layer of four fluxes; its directed coefficients apply along the path."""
        longer = 1.0 / self.cosines
        slanted_layer = replace(
            layer,
            direct_absorption=np.asarray(layer.direct_absorption) * longer,
            forward=np.asarray(layer.forward) * longer,
            backward=np.asarray(layer.backward) * longer,
        )
        background = four_flux.Background(ground.diffuse, ground.directional, ground.mirror)
        directed_reflectance, mirror = four_flux.reflectances(slanted_layer, background)
        rho, tau = kubelka_munk.layer(layer.absorption, layer.scattering, layer.thickness_mm)
        diffuse = np.broadcast_to(kubelka_munk.over(rho, tau, ground.diffuse), BANDS)
        return Ground(diffuse, directed_reflectance, mirror, ground.roughness)

    def clear(self, ground: Ground, absorption: ArrayLike, thickness_mm: float) -> Ground:
        """Add a layer without scattering. The path of diffuse light is twice as long, as in Kubelka and Munk's
        theory."""
        k = np.asarray(absorption, dtype=float)
        return self.four_flux(ground, four_flux.Layer(2.0 * k, 0.0, k, 0.0, 0.0, thickness_mm))

    def leaf(self, ground: Ground, films: Sequence[Film], roughness: float, bare_share: float = 0.0) -> Ground:
        """Add thin films of metal, with binder on both sides, on all but the share `bare_share` of the ground.

        The ground's own mirror image is treated as if it lay in the leaf's facets.
        """
        index = self.index
        cosines = self.cosines[:, 0]
        back, through = stack_power(cosines, WAVELENGTHS_NM, films, outside=index, substrate=index)
        mu, weight = 0.5 * (_GAUSS + 1.0), 0.5 * _WEIGHTS
        all_back, all_through = stack_power(mu, WAVELENGTHS_NM, films, outside=index, substrate=index)
        share = 2.0 * mu * weight
        rho, tau = share @ all_back, share @ all_through
        directed_reflectance = through * tau * ground.directional / (1.0 - rho * ground.diffuse)
        mirror = back + through**2 * ground.mirror / (1.0 - back * ground.mirror)
        diffuse = rho + tau**2 * ground.diffuse / (1.0 - rho * ground.diffuse)
        f = float(within("uncovered", bare_share, 0.0, 1.0))
        return Ground(
            (1.0 - f) * diffuse + f * ground.diffuse,
            (1.0 - f) * directed_reflectance + f * ground.directional,
            (1.0 - f) * mirror + f * ground.mirror,
            roughness,
        )

    def _mean(self, mirror: Array) -> Array:
        """[bands] mean for light from all directions inside: 2 mu dmu over the table's cosines. Beyond the
        critical angle, the last value of the table is used."""
        mu = 0.5 * (_GAUSS + 1.0)
        sine2 = np.minimum((1.0 - mu**2) * self.index**2, 1.0)
        values = layered.at_cosine(mirror, np.sqrt(1.0 - sine2))
        return np.asarray((_WEIGHTS * mu) @ values)


@dataclass(frozen=True)
class Stack:
    """A ground under a face, ready for `stack_brdf`. Tables are [angles, bands] at `layered.COSINES`."""

    coat: layered.Coat
    body: Array
    """Share of light from an angle that returns as diffuse light."""
    mirror: Array
    """Share that returns as the ground's mirror image."""
    mean_body: Array
    """[bands] mean of `body` for light from all directions."""
    mirror_roughness: float
    """Roughness of the mirror image, as seen from air."""


def stack(binder: Binder, ground: Ground, roughness: float, films: Sequence[Film] = ()) -> Stack:
    """Return all layers under the binder's face, or under `films` of metal that lie on it."""
    sheet = layered.sheet(films, binder.index)
    coat = layered.coat(sheet, roughness)
    inner, out = stack_power(
        binder.cosines[:, 0], WAVELENGTHS_NM, tuple(reversed(films)), outside=binder.index, substrate=1.0
    )
    again = 1.0 / (1.0 - inner * ground.mirror)
    diffuse_again = 1.0 / (1.0 - sheet.internal_reflectance * ground.diffuse)
    body = coat.entering * again * ground.directional * sheet.internal_transmittance * diffuse_again
    mirror = sheet.transmittance * out * ground.mirror * again
    mu = 0.5 * (_GAUSS + 1.0)
    mean = np.asarray((_WEIGHTS * mu) @ layered.at_cosine(body, mu))
    return Stack(coat, body, mirror, mean, _seen_roughness(ground.roughness, roughness, binder.index))


def stack_brdf(wi: Array, wo: Array, *, stack: Stack) -> Array:
    """Return the sum of the face's gloss, the ground's mirror image, and diffuse light: f [..., bands], 1/sr."""
    coat = stack.coat
    total = brdf.ggx(
        wi, wo, roughness=coat.roughness, fresnel=lambda c: layered.at_cosine(coat.sheet.reflectance, c)
    )
    if stack.mirror.any():
        total = total + brdf.ggx(
            wi, wo, roughness=stack.mirror_roughness, fresnel=lambda c: layered.at_cosine(stack.mirror, c)
        )
    above = ((wi[..., 2] > 0.0) & (wo[..., 2] > 0.0))[..., None]
    parts = layered.at_cosine(stack.body, wi[..., 2]) * layered.at_cosine(stack.body, wo[..., 2])
    return np.asarray(total + above * parts / (np.pi * np.maximum(stack.mean_body, 1e-12)))


def _seen_roughness(mirror: float, face: float, index: float) -> float:
    """Return the roughness of facets under a rough face, as seen from air near the normal.

    Refraction makes their slopes `index` times as steep, and each of two passages through the face adds its slopes
    times (index - 1)/2; independent slopes add by squares.
    """
    return float(min(1.0, np.hypot(index * mirror, np.sqrt(0.5) * (index - 1.0) * face)))
