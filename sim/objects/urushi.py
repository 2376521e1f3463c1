"""Urushi: a makie tile and a nashiji slab (Durikovic et al. 2002), as virtual objects."""

from __future__ import annotations

import numpy as np

from coupole.appearance.matter import nashiji
from coupole.appearance.optics import indices
from coupole.appearance.shapes import samples
from coupole.appearance.shapes.triangles import slab
from sim.objects import appearance
from sim.objects.surfaces import joined_surface, of_material
from sim.scene.surface import Surface

_BODY_MM = 6.0
_LEVELS = 6
"""Number of depth levels of the flakes, each with its own metal: gold looks redder the deeper it lies."""


def makie_tile(side_mm: float = 60.0, *, triangles: int = 60_000, petals: int = 8, seed: int = 1) -> Surface:
    """A tile of polished black urushi standing on z = 0, with a flower of sprinkled gold on its face.

    The drawing: `appearance.shapes.samples.makie_tile`.
    """
    parts = samples.makie_tile(side_mm, triangles, petals, seed)
    powder = appearance.metal("makie gold", indices.gold(), 0.25)
    black = appearance.black_lacquer()
    return joined_surface(
        [
            of_material(parts.powder, powder),
            of_material(parts.ground, black),
            of_material(parts.body, black),
        ]
    )


def nashiji_slab(slab_of: nashiji.Slab | None = None) -> Surface:
    """Gold flakes on a body of dark lacquer standing on z = 0; x and y run from 0 to the slab's size.

    The clear lacquer above the flakes is not a surface: its absorption along the normal, and the transmittance of
    its face, are included in the flakes' reflectance by depth (`appearance.metal_in_lacquer`). Refraction, and the
    gloss of that face, are omitted: they require path tracing. Flakes at the rim extend beyond it.
    """
    flakes = nashiji.flakes(slab_of or nashiji.Slab())
    size_x, size_y = flakes.slab.size_mm
    body = slab(size_x, size_y, _BODY_MM) + np.array([0.5 * size_x, 0.5 * size_y, 0.0])
    parts = [of_material(body, appearance.black_lacquer())]
    points, faces = nashiji.triangulate(flakes, around=12, along=4)
    lift_mm = np.array([0.0, 0.0, _BODY_MM + flakes.slab.depth_mm])
    corners = (points + lift_mm)[faces].reshape(len(flakes.centres_mm), -1, 3, 3)
    depth_mm = -flakes.centres_mm[:, 2]
    level = np.minimum((depth_mm / flakes.slab.depth_mm * _LEVELS).astype(int), _LEVELS - 1)
    for k in np.unique(level):
        middle_mm = (k + 0.5) / _LEVELS * flakes.slab.depth_mm
        metal = appearance.metal_in_lacquer(
            f"gold flakes, {middle_mm:.2f} mm deep", indices.gold(), middle_mm, roughness=0.08
        )
        parts.append(of_material(corners[level == k].reshape(-1, 3, 3), metal))
    return joined_surface(parts)
