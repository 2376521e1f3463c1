"""Urushi on bodies of any shape: makie on it, nashiji under it (Durikovic et al. 2002, sections 4 and 5)."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Literal, assert_never

import numpy as np
from pydantic import Field

from coupole.appearance.matter import makie_drawing, nashiji
from coupole.appearance.matter.makie_drawing import Drawing
from coupole.appearance.optics import indices
from coupole.appearance.render.absorption import Absorption, Urushi
from coupole.appearance.render.materials import Diffuse, Glass, Lacquer, Material, Metal
from coupole.appearance.render.model import Model, Pose, Positive, Share
from coupole.appearance.render.pieces import Piece
from coupole.appearance.render.spectra import Constant
from coupole.appearance.shapes import sprinkled, turned
from coupole.appearance.shapes.mesh_file import mesh_and_uv, mesh_corners
from coupole.appearance.shapes.skin import grown, scatter_points, skin_of
from coupole.appearance.spectra.grid import Array
from coupole.errors import InputError

_CLEAR_MM = 0.01
"""Gap between flakes and both faces of the lacquer; the triangles of the faces lie about as far below the curved
surface."""
_MOST_GRAINS = 6_000_000
_MOST_FLAKES = 400_000


class Turned(Model):
    """A body turned on a lathe: `shapes.turned.turned_body`."""

    kind: Literal["turned"]
    profile_mm: Annotated[tuple[tuple[float, float], ...], Field(min_length=3)] = turned.BOWL_MM
    """Radius and height of points, from the middle of the inside over the rim to the middle of the foot."""


class Box(Model):
    """A box that rests on z = 0."""

    kind: Literal["box"]
    size_mm: tuple[Positive, Positive, Positive]
    edge_mm: Positive = 2.0
    """Radius of its edges."""


class MeshBody(Model):
    """A closed mesh that trimesh reads."""

    kind: Literal["mesh"]
    path: Path
    unit: Literal["mm", "m", "um"] = "mm"


Body = Annotated[Turned | Box | MeshBody, Field(discriminator="kind")]


class MotifDrawing(Model):
    kind: Literal["motif"]
    name: makie_drawing.Motif
    period_mm: Positive = 24.0
    edge_mm: Positive = 0.5
    """Distance over which the powder becomes sparse."""


class PictureDrawing(Model):
    """A drawing from a picture. White parts are metal; if the picture has an alpha channel, opaque parts are
    metal."""

    kind: Literal["picture"]
    path: Path
    width_mm: Positive
    """Width of the picture. With `uv` the picture covers the texture's square, and this value is not used."""


class Makie(Pose):
    """Metal powder, sprinkled in a drawing on a body of lacquer; `raised_mm` makes it takamakie."""

    kind: Literal["makie"]
    body: Body
    drawing: Annotated[MotifDrawing | PictureDrawing, Field(discriminator="kind")]
    wrapped: sprinkled.Wrapping = "sides"
    grain_mm: Positive = 0.35
    """Longest side of a grain; a grain is either powder or bare."""
    density: Share = 0.95
    """Share of powder where the drawing's share is 1."""
    raised_mm: Annotated[float, Field(ge=0, le=5)] = 0.0
    metal: Metal = Metal(kind="metal", roughness=0.25)
    lacquer: Lacquer = Lacquer(kind="lacquer")
    seed: int = 1


class Nashiji(Pose):
    """Metal flakes in absorbing lacquer all over a body, each with its depth and tilt under the curved face."""

    kind: Literal["nashiji"]
    body: Body
    depth_mm: Positive = 0.4
    """Depth of the lacquer over the body."""
    flakes_per_mm2: Positive = 3.0
    flake_radius_mm: Positive = 0.16
    tilt_deg: Annotated[float, Field(ge=0, lt=45)] = 8.0
    """Root mean square tilt of the flakes to the surface; a flake that is too steep for the lacquer is tilted
    less."""
    metal: Metal = Metal(kind="metal", gold=0.8, roughness=0.08)
    absorption: Absorption = Urushi(kind="urushi")
    ground: Material = Diffuse(kind="diffuse", reflectance=Constant(kind="constant", value=0.006))
    """Material of the body, inside the lacquer."""
    seed: int = 1


def body_corners(body: Body, folder: Path) -> Array:
    """[n, 3, 3] corners of the body in mm; paths are relative to `folder`. Raises InputError."""
    match body:
        case Turned():
            return turned.turned_body(body.profile_mm)
        case Box():
            return turned.rounded_box(body.size_mm, body.edge_mm)
        case MeshBody():
            return mesh_corners(folder / body.path, body.unit)
        case _:
            assert_never(body)


def makie_grains(thing: Makie, folder: Path) -> sprinkled.Grains:
    """Return the body's surface, cut into grains, with the drawing's share on each. Raises InputError."""
    uv: Array | None = None
    if thing.wrapped == "uv":
        if not isinstance(thing.body, MeshBody):
            raise InputError(
                f"makie: a body of kind {thing.body.kind} has no texture coordinates; choose another `wrapped`"
            )
        corners, uv = mesh_and_uv(folder / thing.body.path, thing.body.unit)
    else:
        corners = body_corners(thing.body, folder)
    parts = sprinkled.parts_of(corners, thing.grain_mm)
    if (count := int(np.sum(parts**2))) > _MOST_GRAINS:
        raise InputError(
            f"makie: grains of {thing.grain_mm:g} mm make {count} triangles, more than {_MOST_GRAINS}; "
            "make them coarser"
        )
    return sprinkled.grains(
        corners, uv, parts, _drawing(thing, folder), wrapping=thing.wrapped, raised_mm=thing.raised_mm
    )


def makie_pieces(thing: Makie, folder: Path) -> list[Piece]:
    """Return powder and bare lacquer, in the object's frame. Raises InputError."""
    grains = makie_grains(thing, folder)
    powder = np.random.default_rng(thing.seed).random(len(grains.share)) < thing.density * grains.share
    parts = ((powder, thing.metal, False), (~powder, thing.lacquer, True))
    return [
        Piece(grains.corners_mm[is_chosen], matter, smooth)
        for is_chosen, matter, smooth in parts
        if is_chosen.any()
    ]


def nashiji_pieces(thing: Nashiji, folder: Path) -> list[Piece]:
    """Return the body, the flakes, and the lacquer as a closed refracting and absorbing body around both, in the
    object's frame.

    Raises InputError.
    """
    skin = skin_of(body_corners(thing.body, folder))
    if (expected_flakes := thing.flakes_per_mm2 * float(skin.areas_mm2().sum())) > _MOST_FLAKES:
        raise InputError(
            f"nashiji: expected at most {_MOST_FLAKES} flakes, found {expected_flakes:.0f}; sprinkle fewer"
        )
    depth_mm = thing.depth_mm - 2.0 * _CLEAR_MM
    if depth_mm <= 0.0:
        raise InputError(f"nashiji: expected lacquer of more than {2 * _CLEAR_MM:g} mm, found {thing.depth_mm:g}")
    face = grown(skin, thing.depth_mm)
    middle = grown(skin, 0.5 * thing.depth_mm)
    area_mm2 = float(middle.areas_mm2().sum())
    flat = nashiji.flakes(
        nashiji.Slab(
            size_mm=(1.0, area_mm2),
            depth_mm=depth_mm,
            flakes_per_mm2=thing.flakes_per_mm2,
            flake_radius_mm=thing.flake_radius_mm,
            tilt_deg=thing.tilt_deg,
            seed=thing.seed,
            flattens=True,
        )
    )
    places, frames = scatter_points(middle, len(flat.centres_mm), np.random.default_rng(thing.seed))
    tops = places + (0.5 * thing.depth_mm - _CLEAR_MM) * frames[:, :, 2]
    points, faces = nashiji.triangulate(nashiji.settle_flakes(flat, tops, frames), around=8, along=2)
    gold = thing.metal.model_copy(update={"depth_mm": 0.0, "face": False})
    clear = Glass(kind="glass", index=indices.URUSHI, absorption=thing.absorption)
    return [
        Piece(skin.corners_mm, thing.ground, smooth=True),
        Piece(points[faces], gold),
        Piece(face.corners_mm, clear, smooth=True),
    ]


def _drawing(thing: Makie, folder: Path) -> Drawing:
    match thing.drawing:
        case MotifDrawing():
            return makie_drawing.motif(thing.drawing.name, thing.drawing.period_mm, thing.drawing.edge_mm)
        case PictureDrawing():
            width_mm = 1.0 if thing.wrapped == "uv" else thing.drawing.width_mm
            return makie_drawing.picture(folder / thing.drawing.path, width_mm)
        case _:
            assert_never(thing.drawing)
