"""Materials by Mitsuba's own plugins, with spectra of `appearance.matter`.

These are modelled: complex indices of metals, interference in films by reflectance at every angle, Kubelka and
Munk's layers, Fresnel surfaces with all internal reflections (Saunderson), GGX facets, polarisation by surfaces.
These are simplified: bodies under films are Lambertian, metals under lacquer have the absorption along the normal,
facets reflect once (docs/decisions/0013).
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial
from pathlib import Path
from typing import Annotated, Literal

import numpy as np
from pydantic import Field

from coupole.appearance.matter import brdf, gilding, kubelka_munk, lacquer, layered
from coupole.appearance.matter.baked_table import bake
from coupole.appearance.matter.glossy_face import InternalReflectance
from coupole.appearance.matter.pigments import from_opaque, opaque_reflectance
from coupole.appearance.optics import fresnel, indices
from coupole.appearance.optics.thin_film import Film, stack_power
from coupole.appearance.render.absorption import Absorption
from coupole.appearance.render.bands import Description
from coupole.appearance.render.equivalent import equivalent_index
from coupole.appearance.render.model import Index, Model, Positive, Roughness, Share
from coupole.appearance.render.refraction import IndexFile, Refraction, complex_index, real_index
from coupole.appearance.render.spectra import (
    Bole,
    Colouring,
    Constant,
    MeasuredPaint,
    Reflectance,
    coefficients,
    internal,
    matt,
)
from coupole.appearance.spectra.grid import BANDS, WAVELENGTHS_NM, Array, Complex

THINNEST_NM = 1e-3
Facets = Literal["ggx", "beckmann", "cook_torrance"]
"""Kind of facets. `beckmann`: Beckmann's slopes with Smith's shadowing; `cook_torrance`: the same slopes in
V-shaped grooves (Callet et al. 2010)."""
_LEAST_SHARE = 0.1
"""Least share of the paths for each part of a blended material."""
_LEAST_THROUGH = 1e-5
"""Share of the light that returns through a leaf. Below this share, the leaf hides its bole."""


class Diffuse(Model):
    """A Lambertian surface."""

    kind: Literal["diffuse"]
    reflectance: Reflectance


class Paint(Model):
    """A pigment in a glossy binder; with a thickness, as a layer over a ground (Kubelka-Munk, Saunderson)."""

    kind: Literal["paint"]
    pigment: Colouring
    """Reflectance of an opaque layer, or K and S. A measured reflectance is valid under the face; others are
    inside the binder."""
    thickness_mm: Positive | None = None
    ground: Reflectance = Constant(kind="constant", value=0.0)
    """Reflectance of the ground. A measured reflectance is the reflectance of the ground under a face of the same
    index; other reflectances are inside the binder.
    """
    scattering_per_mm: Positive = 30.0
    """Scattering of a pigment that is given by its reflectance; a paint file has its own."""
    index: Refraction = indices.BINDER
    roughness: Roughness = 0.25


class Lacquer(Model):
    """A clear glossy coat over a body: varnish, polished urushi."""

    kind: Literal["lacquer"]
    body: Reflectance = Constant(kind="constant", value=0.006)
    """Reflectance inside the lacquer. A measured reflectance was measured through the lacquer, unless the sample
    was bare.
    """
    index: Refraction = indices.URUSHI
    roughness: Roughness = 0.04


class Metal(Model):
    """A bare metal, or a metal at a depth in clear urushi."""

    kind: Literal["metal"]
    gold: Share = 1.0
    """Share of gold by atoms; the rest is silver."""
    index: IndexFile | None = None
    """Index of another metal, instead of gold and silver."""
    roughness: Roughness = 0.1
    """Alpha of GGX's or of Beckmann's slopes."""
    distribution: Facets = "ggx"
    depth_mm: Annotated[float, Field(ge=0)] | None = None
    """Depth under the lacquer's face; None for a metal in air."""
    face: bool = True
    """True if light that the face reflects is subtracted here; False if the scene has the face as a body of
    glass."""


class Gilt(Model):
    """Gold leaf on bole (Callet et al. 2010, Eq. 7, as defined in `coupole.appearance.matter.gilding`)."""

    kind: Literal["gilt"]
    thickness_nm: Annotated[float, Field(ge=0)] = 100.0
    gold: Share = 1.0
    index: IndexFile | None = None
    """Index of another metal's leaf."""
    holes: Annotated[float, Field(ge=0, le=0.3)] = 0.0
    """Share of nanoscopic holes, by volume (Maxwell Garnett)."""
    uncovered: Share = 0.0
    """Share of the surface left bare by cracks and large holes."""
    bole: Reflectance = Bole(kind="bole")
    """Reflectance of the bole inside its binder of egg white. A measured reflectance is taken as measured in air.
    """
    roughness: Roughness = 0.12
    bole_roughness: Roughness = 0.35


class OneFilm(Model):
    index: Refraction
    """Index of refraction; a file may have k as well."""
    thickness_nm: Positive


class Films(Model):
    """Transparent films over a metal or a dark glass: interference colours of patina, varnish, oxide."""

    kind: Literal["films"]
    films: Annotated[tuple[OneFilm, ...], Field(min_length=1, max_length=20)]
    gold: Share | None = 1.0
    """The metal underneath; None for something dark with the `index`."""
    index: Refraction = indices.BINDER
    roughness: Roughness = 0.05


class Glass(Model):
    """A transparent and smooth material. A closed body of this material refracts light, and absorbs it along its
    path.
    """

    kind: Literal["glass"]
    index: Index = indices.BINDER
    absorption: Absorption | None = None


Plain = Diffuse | Paint | Lacquer | Metal | Gilt | Films


def diffuse(spectral: Array) -> Description:
    return {"type": "diffuse", "reflectance": spectral}


def metal(
    index: Complex, roughness: float, factor: Array | float = 1.0, distribution: Facets = "ggx"
) -> Description:
    """Return a rough conductor of complex index [81] (relative to its surroundings), with its reflectance times
    `factor`."""
    share = np.broadcast_to(np.asarray(factor, dtype=float), BANDS).copy()
    if distribution == "cook_torrance":
        grooves = partial(
            brdf.cook_torrance, slope=roughness, fresnel=lambda c: share * fresnel.reflectance(c[..., None], index)
        )
        return {"type": "measured", "table": bake(grooves)}
    return {
        "type": "roughconductor",
        "distribution": distribution,
        "alpha": roughness,
        "eta": np.asarray(index.real),
        "k": np.asarray(index.imag),
        "specular_reflectance": share,
    }


def coated_body(body: InternalReflectance, index: Array, roughness: float) -> Description:
    """Return a body [81] inside a medium with a glossy face; the face itself reflects by its index [81] at 587.6
    nm.

    Mitsuba's polarised plastic (Baek et al. 2020) transmits light in once and out once. With all internal
    reflections the factor is body/(n^2 (1 - k2 body)), with k2 the face's reflectance for diffuse light from
    within: for light along the normal this agrees with Saunderson.
    """
    return {
        "type": "pplastic",
        "distribution": "ggx",
        "alpha": roughness,
        "int_ior": indices.at_d_line(index.astype(complex)),
        "ext_ior": 1.0,
        "diffuse_reflectance": under_face(body, index),
    }


def under_face(body: InternalReflectance, index: Array) -> Array:
    """[81] reflectance of a body under a face of index [81], with reflections between them and refraction."""
    return np.asarray(body.values / (index**2 * (1.0 - fresnel.diffuse_internal(index) * body.values)))


def paint_inside(paint: Paint, folder: Path) -> InternalReflectance:
    """[81] reflectance of a paint inside its binder."""
    index = real_index(paint.index, folder)
    if isinstance(paint.pigment, MeasuredPaint):
        pigment = coefficients(paint.pigment, folder, needs_mm=paint.thickness_mm is not None)
    else:
        pigment = from_opaque("", internal(paint.pigment, folder, index), paint.scattering_per_mm)
    if paint.thickness_mm is None:
        return opaque_reflectance(pigment)
    rho, tau = kubelka_munk.layer(pigment.absorption, pigment.scattering, paint.thickness_mm)
    ground = internal(paint.ground, folder, index)
    return InternalReflectance(kubelka_munk.over(rho, tau, ground.values))


def lacquer_body(material: Lacquer, folder: Path) -> InternalReflectance:
    """[81] reflectance of the body inside the lacquer."""
    return internal(material.body, folder, real_index(material.index, folder))


def gilt_of(material: Gilt, folder: Path) -> tuple[gilding.Gilt, Complex]:
    """Return the gilt and its leaf's index [81]."""
    index = metal_of(material, folder)
    if material.holes > 0.0:
        index = gilding.leaf_index(index, material.holes)
    bole = internal(material.bole, folder, indices.EGG_WHITE)
    return gilding.gilt(index, material.thickness_nm, bole, bare_share=material.uncovered), index


def metal_of(material: Metal | Gilt, folder: Path) -> Complex:
    """[81] index of the metal, from the user's file if there is one."""
    if material.index is not None:
        return complex_index(material.index, folder)
    return metal_index(material.gold)


def films_of(material: Films, folder: Path) -> tuple[list[Film], Complex]:
    """Return the films, and the index [81] of the material under them."""
    films = [Film(complex_index(film.index, folder), film.thickness_nm) for film in material.films]
    base = complex_index(material.index, folder) if material.gold is None else metal_index(material.gold)
    return films, base


def metal_index(gold: float) -> Complex:
    """Return the index of Johnson and Christy's gold or silver, or of Rioux's alloys between them."""
    pure = {1.0: indices.gold, 0.0: indices.silver}
    return pure[gold]() if gold in pure else indices.gold_silver(gold)


def plain_bsdf(material: Plain, folder: Path) -> Description:
    """Return one side of the material, with arrays [81] for spectra; paths are relative to `folder`."""
    if isinstance(material, Diffuse):
        return diffuse(matt(material.reflectance, folder).values)
    if isinstance(material, Paint):
        return coated_body(paint_inside(material, folder), real_index(material.index, folder), material.roughness)
    if isinstance(material, Lacquer):
        return coated_body(lacquer_body(material, folder), real_index(material.index, folder), material.roughness)
    if isinstance(material, Metal):
        return _metal(material, folder)
    if isinstance(material, Films):
        films, base = films_of(material, folder)
        return metal(_equivalent(films, base), material.roughness)
    return _gilt(material, folder)


def _metal(material: Metal, folder: Path) -> Description:
    index = metal_of(material, folder)
    if material.depth_mm is None:
        return metal(index, material.roughness, distribution=material.distribution)
    inward = 1.0 - float(fresnel.reflectance(1.0, indices.URUSHI)) if material.face else 1.0
    transmittance = lacquer.transmittance(material.depth_mm, 1.0, lacquer.urushi_absorption())
    return metal(index / indices.URUSHI, material.roughness, (inward * transmittance) ** 2, material.distribution)


def seen_of_gilt(material: Gilt, folder: Path) -> tuple[bool, bool, bool]:
    """Tell whether the gilt's leaf is visible, whether its bole is visible (bare or through the leaf), and whether
    its bole is visible bare."""
    if not _has_leaf(material):
        return False, True, True
    is_bare = material.uncovered > 0.0
    return True, is_bare or _is_lit_through(_light_through(gilt_of(material, folder)[0])), is_bare


def _has_leaf(material: Gilt) -> bool:
    return material.thickness_nm >= THINNEST_NM and material.uncovered < 1.0


def _light_through(gilt: gilding.Gilt) -> Array:
    """[81] share of the light that goes through the leaf to the bole and back."""
    return np.asarray(gilt.leaf.transmittance[-1] * layered.emerging(gilt.leaf, gilt.bole))


def _is_lit_through(through: Array) -> bool:
    return bool(through.max() > _LEAST_THROUGH)


def _gilt(material: Gilt, folder: Path) -> Description:
    gilt, index = gilt_of(material, folder)
    bare = coated_body(gilt.bole, np.full(BANDS, indices.EGG_WHITE), material.bole_roughness)
    if not _has_leaf(material):
        return bare
    films = [Film(index, material.thickness_nm)]
    leaf = metal(_equivalent(films, indices.constant(indices.EGG_WHITE)), material.roughness)
    through = _light_through(gilt)
    if _is_lit_through(through):
        leaf = _sum(leaf, gilt.leaf.normal_reflectance, through)
    if material.uncovered == 0.0:
        return leaf
    return {"type": "blendbsdf", "weight": material.uncovered, "leaf": leaf, "bare": bare}


def _sum(mirror: Description, mirror_share: Array, through: Array) -> Description:
    """Return the sum of a metal and a Lambertian part.

    Mitsuba blends with the weight w for one part and 1 - w for the other, so each part is divided by its weight
    first. The weight is the same for all bands, so that they share their paths.
    """
    weight = float(np.clip(through.mean() / (through + mirror_share).mean(), _LEAST_SHARE, 1.0 - _LEAST_SHARE))
    stronger = {**mirror, "specular_reflectance": mirror["specular_reflectance"] / (1.0 - weight)}
    return {"type": "blendbsdf", "weight": weight, "mirror": stronger, "through": diffuse(through / weight)}


def _equivalent(films: Sequence[Film], substrate: Complex) -> Complex:
    return equivalent_index(
        lambda cosines: stack_power(cosines, WAVELENGTHS_NM, films, substrate=substrate)[0],
    )
