"""Layers over layers in one binder: paints, glazes of four fluxes, varnishes, gold leaf, and one face over all.

The physics is `coupole.appearance.matter.layer_stack`; Mitsuba reads it as a table (`baked_table`).
"""

from __future__ import annotations

from functools import partial
from pathlib import Path
from typing import Annotated, Literal

import numpy as np
from pydantic import Field, model_validator

from coupole.appearance.matter import four_flux, gilding
from coupole.appearance.matter.baked_table import bake
from coupole.appearance.matter.layer_stack import Binder, Ground, Stack, stack, stack_brdf
from coupole.appearance.matter.paint_file import read_paint
from coupole.appearance.matter.pigments import from_opaque
from coupole.appearance.optics import indices
from coupole.appearance.optics.thin_film import Film
from coupole.appearance.render.absorption import Absorption, PerMm, coefficient, per_mm
from coupole.appearance.render.bands import Description
from coupole.appearance.render.materials.plain import metal_index
from coupole.appearance.render.model import Model, Positive, Roughness, Share
from coupole.appearance.render.refraction import IndexFile, Refraction, complex_index, real_index
from coupole.appearance.render.spectra import (
    Colouring,
    Constant,
    MeasuredPaint,
    Reflectance,
    coefficients,
    internal,
)
from coupole.appearance.spectra.grid import WAVELENGTHS_NM, Array, Complex
from coupole.errors import InputError

_BLACK = Constant(kind="constant", value=0.0)


class Coefficients(Model):
    """Coefficients of four fluxes, per mm: K and S for diffuse light; k, s_i (forwards), s_j (backwards) for
    directed light."""

    kind: Literal["values"]
    absorption: PerMm
    scattering: PerMm
    direct_absorption: PerMm
    forward: PerMm
    backward: PerMm


FourFluxes = Annotated[Coefficients | MeasuredPaint, Field(discriminator="kind")]
"""Coefficients of four fluxes. A paint file has them if `coupole layer` was given spectra under directional
light."""


class FourFlux(Model):
    """A glaze: part of the light passes it unscattered, and returns from a glossy ground as its mirror image."""

    kind: Literal["four_flux"]
    coefficients: FourFluxes
    thickness_mm: Positive
    ground: Reflectance = _BLACK
    """Reflectance of the ground inside the binder; a measured reflectance was measured under a face of the same
    index."""
    ground_mirror: Share = 0.0
    """Reflectance of a glossy ground for directed light, in addition to `ground`."""
    ground_roughness: Roughness = 0.1
    index: Annotated[float, Field(ge=1.01, le=3)] = indices.BINDER
    roughness: Roughness = 0.05


class PaintLayer(Model):
    kind: Literal["paint"]
    pigment: Colouring
    thickness_mm: Positive
    scattering_per_mm: Positive = 30.0
    """Scattering of a pigment that is given by its reflectance; a paint file has its own."""


class GlazeLayer(Model):
    kind: Literal["four_flux"]
    coefficients: FourFluxes
    thickness_mm: Positive


class ClearLayer(Model):
    """A varnish, or a lacquer tinted by a dye: it absorbs, and does not scatter."""

    kind: Literal["clear"]
    absorption: Absorption
    thickness_mm: Positive


class Leaf(Model):
    """A leaf of gold, of an alloy with silver, or of another metal."""

    kind: Literal["leaf"]
    thickness_nm: Positive = 100.0
    gold: Share = 1.0
    index: IndexFile | None = None
    holes: Annotated[float, Field(ge=0, le=0.3)] = 0.0
    uncovered: Share = 0.0
    roughness: Roughness = 0.12


Layer = Annotated[PaintLayer | GlazeLayer | ClearLayer | Leaf, Field(discriminator="kind")]


class Layers(Model):
    """Layers from the top to the bottom, in one binder; a leaf on top lies in air."""

    kind: Literal["layers"]
    layers: Annotated[tuple[Layer, ...], Field(min_length=1, max_length=20)]
    ground: Reflectance = _BLACK
    """Reflectance of the ground inside the binder; a measured reflectance was measured under a face of the same
    index."""
    index: Refraction = indices.BINDER
    roughness: Roughness = 0.05
    """Roughness of the face; a leaf on top has its own roughness."""

    @model_validator(mode="after")
    def _check_top_leaf(self) -> Layers:
        first = self.layers[0]
        if isinstance(first, Leaf) and first.uncovered:
            raise ValueError(
                "a leaf on top needs a varnish if parts of it are `uncovered`: take `kind: worn`, or varnish it"
            )
        return self


Coating = FourFlux | Layers


def coating_bsdf(material: Coating, folder: Path) -> Description:
    """Return one side of the coating for Mitsuba. Raises InputError."""
    return {"type": "measured", "table": bake(partial(stack_brdf, stack=stack_of(material, folder)))}


def stack_of(material: Coating, folder: Path) -> Stack:
    """Return the layers as a stack, ready for `stack_brdf`; paths are relative to `folder`. Raises InputError."""
    if isinstance(material, FourFlux):
        binder = Binder(material.index)
        below = binder.matt(internal(material.ground, folder, material.index).values)
        if material.ground_mirror:
            below = binder.mirroring(below, material.ground_mirror, material.ground_roughness)
        below = binder.four_flux(below, _glaze(material, folder))
        return stack(binder, below, material.roughness)
    index = real_index(material.index, folder)
    binder = Binder(indices.at_d_line(index.astype(complex)))
    below = binder.matt(internal(material.ground, folder, index).values)
    first = material.layers[0]
    on_top = first if isinstance(first, Leaf) else None
    for layer in reversed(material.layers[1:] if on_top else material.layers):
        below = _lay_on_ground(binder, layer, below, folder, index)
    if on_top:
        return stack(binder, below, on_top.roughness, [_film(on_top, folder)])
    return stack(binder, below, material.roughness)


def _lay_on_ground(binder: Binder, layer: Layer, below: Ground, folder: Path, index: Array) -> Ground:
    match layer:
        case PaintLayer():
            if isinstance(layer.pigment, MeasuredPaint):
                pigment = coefficients(layer.pigment, folder, needs_mm=True)
            else:
                pigment = from_opaque("", internal(layer.pigment, folder, index), layer.scattering_per_mm)
            return binder.two_flux(below, pigment.absorption, pigment.scattering, layer.thickness_mm)
        case GlazeLayer():
            return binder.four_flux(below, _glaze(layer, folder))
        case ClearLayer():
            return binder.clear(below, per_mm(layer.absorption, binder.index, folder), layer.thickness_mm)
        case Leaf():
            return binder.leaf(below, [_film(layer, folder)], layer.roughness, layer.uncovered)


def _film(leaf: Leaf, folder: Path) -> Film:
    index: Complex = complex_index(leaf.index, folder) if leaf.index is not None else metal_index(leaf.gold)
    return Film(gilding.leaf_index(index, leaf.holes) if leaf.holes else index, leaf.thickness_nm)


def _glaze(layer: FourFlux | GlazeLayer, folder: Path) -> four_flux.Layer:
    fluxes = layer.coefficients
    if isinstance(fluxes, Coefficients):
        names = ("absorption", "scattering", "direct_absorption", "forward", "backward")
        k, s, direct, forward, backward = (coefficient(getattr(fluxes, name), folder) for name in names)
    else:
        diffuse, paint = coefficients(fluxes, folder, needs_mm=True), read_paint(folder / fluxes.path)
        if missing := [name for name in ("k", "s_i", "s_j") if name not in paint.other]:
            raise InputError(
                f"{folder / fluxes.path}: expected k, s_i, s_j of four fluxes, found no {', '.join(missing)}; "
                "give `coupole layer` spectra under directional light, or take `kind: paint`"
            )
        k, s = diffuse.absorption, diffuse.scattering
        direct, forward, backward = (
            np.maximum(np.interp(WAVELENGTHS_NM, paint.wavelengths_nm, paint.other[name]), 0.0)
            for name in ("k", "s_i", "s_j")
        )
    return four_flux.Layer(k, s, direct, forward, backward, layer.thickness_mm)
