"""Layers that are worn off or cracked, and dust on them: two materials, each with a share of the surface."""

from __future__ import annotations

from typing import Annotated, Literal

import numpy as np
from pydantic import Field, model_validator

from coupole.appearance.render.bands import Description
from coupole.appearance.render.materials.coatings import Coating
from coupole.appearance.render.materials.measured_material import MeasuredMaterial
from coupole.appearance.render.materials.plain import Plain
from coupole.appearance.render.model import Model, Positive, Share
from coupole.appearance.render.spectra import Constant, Reflectance
from coupole.appearance.spectra.grid import Array

WORN, DUSTY = "worn", "dust"
"""Names of numbers at each vertex of a mesh: share of the ground that is visible, share that dust covers."""


class Uniform(Model):
    """A pattern that is too fine to be seen."""

    kind: Literal["uniform"]


class Cracks(Model):
    """Craquelure: cracks of one width between cells."""

    kind: Literal["cracks"]
    cell_mm: Positive
    """Mean size of a cell."""
    width_mm: Positive | None = None
    """Width of a crack; by default it follows from the `share`."""
    seed: int = 1


class Edges(Model):
    """Wear where the surface is convex."""

    kind: Literal["edges"]
    reach_mm: Positive
    """Distance within which the surface around a point decides whether the point is on an edge."""
    seed: int = 1


Solid = Annotated[Plain | Coating | MeasuredMaterial, Field(discriminator="kind")]


class Worn(Model):
    """A layer that is missing on a share of the surface, where another material is visible."""

    kind: Literal["worn"]
    over: Solid
    under: Solid
    share: Share | None = None
    """Share of the area where `under` is visible."""
    pattern: Annotated[Uniform | Cracks | Edges, Field(discriminator="kind")] = Uniform(kind="uniform")

    @model_validator(mode="after")
    def _one_measure(self) -> Worn:
        by_width = isinstance(self.pattern, Cracks) and self.pattern.width_mm is not None
        if by_width == (self.share is not None):
            raise ValueError("give either `share`, or `width_mm` of a pattern of cracks")
        return self


class Dusty(Model):
    """Dust that lies on a material; grains overlap at random."""

    kind: Literal["dusty"]
    over: Annotated[Plain | Coating | MeasuredMaterial | Worn, Field(discriminator="kind")]
    grams_per_m2: Annotated[float, Field(ge=0)]
    """Mass of dust per area on surfaces that face up."""
    settles: Literal["up", "everywhere"] = "up"
    """`up`: the mass is per area of ground plan, with z up, and surfaces that face down have no dust."""
    grain_um: Positive = 20.0
    """Diameter of a grain."""
    density_g_cm3: Positive = 2.0
    reflectance: Reflectance = Constant(kind="constant", value=0.35)
    """Reflectance of thick dust."""

    def covered_share(self, upward: Array) -> Array:
        """Return the share of the surface under grains, by the normals' upward components [n].

        Spheres in random places hide the share 1 - exp(-N a), where N a = 3 m/(2 density diameter) for the mass m
        per area.
        """
        lying = np.maximum(upward, 0.0) if self.settles == "up" else np.ones_like(upward)
        return -np.expm1(-1.5 * self.grams_per_m2 * lying / (self.density_g_cm3 * self.grain_um))


Weathered = Worn | Dusty


def needs_mesh(material: Weathered) -> bool:
    """Tell whether shares differ from place to place."""
    if isinstance(material, Dusty):
        return material.settles == "up" or (isinstance(material.over, Worn) and needs_mesh(material.over))
    return not isinstance(material.pattern, Uniform)


def blended_bsdf(material: Weathered, over: Description, under: Description) -> Description:
    """Return the material blended with `under`, by its share: one number, or numbers of the mesh."""
    weight: Description | float
    if isinstance(material, Worn):
        by_mesh, name, share = needs_mesh(material), WORN, material.share
    else:
        by_mesh, name, share = material.settles == "up", DUSTY, float(material.covered_share(np.ones(1))[0])
    weight = {"type": "mesh_attribute", "name": f"vertex_{name}"} if by_mesh else float(share or 0.0)
    return {"type": "blendbsdf", "weight": weight, "over": over, "under": under}
