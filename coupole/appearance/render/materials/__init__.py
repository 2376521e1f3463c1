"""Materials of a scene file, by kind, as Mitsuba's plugins."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

from pydantic import Field

from coupole.appearance.render.bands import Description
from coupole.appearance.render.materials.coatings import Coating, FourFlux, Layers, coating_bsdf
from coupole.appearance.render.materials.measured_material import MeasuredMaterial, measured_bsdf
from coupole.appearance.render.materials.plain import (
    THINNEST_NM,
    Diffuse,
    Films,
    Gilt,
    Glass,
    Lacquer,
    Metal,
    Paint,
    Plain,
    diffuse,
    films_of,
    gilt_of,
    lacquer_body,
    metal_index,
    metal_of,
    paint_inside,
    plain_bsdf,
    under_face,
)
from coupole.appearance.render.materials.used_values import used_values
from coupole.appearance.render.materials.weathering import Dusty, Weathered, Worn, blended_bsdf
from coupole.appearance.render.spectra import matt

__all__ = [
    "THINNEST_NM",
    "Diffuse",
    "Dusty",
    "Films",
    "FourFlux",
    "Gilt",
    "Glass",
    "Lacquer",
    "Layers",
    "Material",
    "MeasuredMaterial",
    "Metal",
    "Paint",
    "Plain",
    "Worn",
    "bsdf",
    "films_of",
    "gilt_of",
    "lacquer_body",
    "metal_index",
    "metal_of",
    "paint_inside",
    "under_face",
    "used_values",
]

Material = Annotated[Plain | Coating | MeasuredMaterial | Weathered | Glass, Field(discriminator="kind")]


def bsdf(material: Material, folder: Path) -> Description:
    """Return the material for Mitsuba, with arrays [81] for spectra; paths of spectra are relative to `folder`."""
    if isinstance(material, Glass):
        return {"type": "dielectric", "int_ior": material.index, "ext_ior": 1.0}
    return {"type": "twosided", "material": _one_side(material, folder)}


def _one_side(material: Plain | Coating | MeasuredMaterial | Weathered, folder: Path) -> Description:
    if isinstance(material, Worn):
        return blended_bsdf(material, _one_side(material.over, folder), _one_side(material.under, folder))
    if isinstance(material, Dusty):
        dust = diffuse(matt(material.reflectance, folder).values)
        return blended_bsdf(material, _one_side(material.over, folder), dust)
    if isinstance(material, MeasuredMaterial):
        return measured_bsdf(material, folder)
    if isinstance(material, Coating):
        return coating_bsdf(material, folder)
    return plain_bsdf(material, folder)
