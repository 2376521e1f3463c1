"""Urushi on a page: the mean over many grains or flakes, which does not flicker, however small they are.

Makie has, for each triangle, the share of its area that the drawing covers with metal. Nashiji has two layers:
the lacquer's face over the ground, and the lobe of its flakes. Seen from air, a flake's tilt turns its mirror
image n times as far as without the lacquer (Snell, for small angles). So the roughness of the lobe is n times
that of tilts and facets together. Its strength contains both passages of the face, the metal's reflectance
inside, and the mean of the Beer-Lambert law over depths. Flakes hide each other only through their covered share,
and no single flake sparkles; `coupole render` shows sparkles.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

from coupole.appearance.optics import fresnel, indices
from coupole.appearance.render import absorption, materials
from coupole.appearance.render.materials import Diffuse
from coupole.appearance.render.spectra import internal
from coupole.appearance.render.urushi import Makie, Nashiji, body_corners, makie_grains
from coupole.appearance.shapes.skin import grown, skin_of
from coupole.appearance.shapes.sprinkled import Grains
from coupole.appearance.spectra.grid import BANDS, Array
from coupole.errors import InputError
from coupole.exchange.look.scene_layers import ANGLES, COSINES, Layer

_TRIANGLES = 200_000
"""Approximate number of triangles of a body with a drawing."""
_FACE_ROUGHNESS = 0.02
_RADIUS_SPREAD = 0.3
"""`nashiji.Slab.radius_spread`: the mean area of flakes is larger than the area for the median radius."""


def coarse_grains(thing: Makie, folder: Path) -> Grains:
    """The drawing's shares on triangles as coarse as a page needs, in the object's frame. Raises InputError."""
    area_mm2 = float(skin_of(body_corners(thing.body, folder)).areas_mm2().sum())
    grain_mm = max(thing.grain_mm, float(np.sqrt(4.0 * area_mm2 / _TRIANGLES)))
    grains = makie_grains(thing.model_copy(update={"grain_mm": grain_mm}), folder)
    return Grains(grains.corners_mm, thing.density * grains.share)


def lacquered_corners(thing: Nashiji, folder: Path) -> Array:
    """[n, 3, 3] triangles of the lacquer's face, in the object's frame. Raises InputError."""
    return grown(skin_of(body_corners(thing.body, folder)), thing.depth_mm).corners_mm


def nashiji_layers(thing: Nashiji, folder: Path) -> tuple[Layer, Layer]:
    """The lacquer's face over the ground, and the flakes' lobe. Raises InputError."""
    if not isinstance(thing.ground, Diffuse):
        raise InputError(
            f"nashiji on a ground of kind {thing.ground.kind}: a page shows only grounds of kind diffuse"
        )
    cover, absorption_per_mm = _covered_share(thing), absorption.per_mm(thing.absorption, indices.URUSHI, folder)
    face = fresnel.reflectance(COSINES, indices.URUSHI)
    passing = 1.0 - face
    inside = np.sqrt(1.0 - (1.0 - COSINES**2) / indices.URUSHI**2)
    ground = internal(thing.ground.reflectance, folder, indices.URUSHI)
    index = np.full(BANDS, indices.URUSHI)
    body = (
        materials.under_face(ground, index)
        * (1.0 - cover) ** 2
        * np.exp(-2.0 * absorption_per_mm * thing.depth_mm)
    )
    coat = Layer(np.repeat(face[:, None], BANDS, axis=1), passing, body, _FACE_ROUGHNESS)
    metal = fresnel.reflectance(inside[:, None], materials.metal_of(thing.metal, folder) / indices.URUSHI)
    ways = 2.0 * absorption_per_mm * thing.depth_mm / inside[:, None]
    lobe = cover * passing[:, None] ** 2 * metal * -np.expm1(-ways) / ways
    tilt = np.tan(np.radians(thing.tilt_deg))
    roughness = min(1.0, indices.URUSHI * float(np.hypot(tilt, thing.metal.roughness)))
    return coat, Layer(lobe, np.ones(ANGLES), np.zeros(BANDS), roughness)


def _covered_share(thing: Nashiji) -> float:
    """Share of the surface that flakes cover, seen from above, for disks at random places."""
    area_mm2 = np.pi * thing.flake_radius_mm**2 * np.exp(2.0 * _RADIUS_SPREAD**2)
    return float(-np.expm1(-thing.flakes_per_mm2 * area_mm2))
