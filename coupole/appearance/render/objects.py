"""Objects of a scene file: triangles, each with a spectral material."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Annotated, Literal, assert_never

import numpy as np
from numpy.typing import NDArray
from pydantic import Field, model_validator

from coupole.appearance.matter import nashiji
from coupole.appearance.optics import indices
from coupole.appearance.render import arcature, church
from coupole.appearance.render.absorption import Urushi
from coupole.appearance.render.materials import Diffuse, Gilt, Glass, Lacquer, Material, Metal, Paint
from coupole.appearance.render.model import Pose, Positive, Roughness, Share
from coupole.appearance.render.panes import Pane
from coupole.appearance.render.pieces import Ball, Piece
from coupole.appearance.render.spectra import Constant, Shape
from coupole.appearance.render.stained_glass import Glazing, window
from coupole.appearance.render.urushi import Makie, Nashiji, makie_pieces, nashiji_pieces
from coupole.appearance.shapes import samples
from coupole.appearance.shapes.mesh_file import mesh_corners
from coupole.appearance.shapes.solids import relief
from coupole.appearance.shapes.triangles import rectangle, slab
from coupole.appearance.spectra.grid import Array

_PRINT = Diffuse(kind="diffuse", reflectance=Constant(kind="constant", value=0.035))
"""The black body of the wedges."""
_LEAD = Diffuse(kind="diffuse", reflectance=Constant(kind="constant", value=0.1))
_STONE = Diffuse(kind="diffuse", reflectance=Constant(kind="constant", value=0.45))
_NASHIJI_BODY_MM = 6.0
_DIP_MM = 0.01
_RELIEF_MM = 18.0
_STEP_MM, _GILT_ROW_MM, _PAINT_ROW_MM = 15.0, 30.0, 20.0


class Mesh(Pose):
    """Any mesh that trimesh reads; its colours are not used."""

    kind: Literal["mesh"]
    path: Path
    unit: Literal["mm", "m", "um"] = "mm"
    smooth: bool = False
    material: Material


class Plane(Pose):
    """A sheet in z = 0 around the origin, facing up."""

    kind: Literal["plane"]
    width_mm: Positive
    depth_mm: Positive
    material: Material


class Sphere(Pose):
    """A sphere that rests on z = 0."""

    kind: Literal["sphere"]
    radius_mm: Positive
    material: Material


class SculptedRelief(Pose):
    kind: Literal["sculpted_relief"]
    size_mm: Positive = 120.0
    triangles: Annotated[int, Field(ge=100, le=5_000_000)] = 100_000
    seed: int = 1
    material: Material


class GiltStepWedge(Pose):
    """Gold leaf of increasing thickness on bole, along x (Callet et al. 2010, section 5)."""

    kind: Literal["gilt_step_wedge"]
    thicknesses_nm: Annotated[tuple[Annotated[float, Field(ge=0)], ...], Field(min_length=1)] = samples.GILT_NM
    gold: Share = 1.0
    roughness: Roughness = 0.12


class PaintWedge(Pose):
    """A paint of increasing thickness along x, over white towards +y and over black towards -y."""

    kind: Literal["paint_wedge"]
    pigment: str = "blue_one_peak_shape"
    """Name of a shape."""
    thicknesses_mm: Annotated[tuple[Positive, ...], Field(min_length=1)] = samples.PAINT_MM
    scattering_per_mm: Positive = 8.0


class MakieTile(Pose):
    """Polished black urushi with a flower of sprinkled gold (Durikovic et al. 2002, section 4)."""

    kind: Literal["makie_tile"]
    side_mm: Positive = 60.0
    triangles: Annotated[int, Field(ge=100, le=2_000_000)] = 60_000
    petals: Annotated[int, Field(ge=1, le=64)] = 8
    seed: int = 1
    roughness: Roughness = 0.25


class NashijiSlab(Pose):
    """Gold flakes in clear lacquer over black (Durikovic et al. 2002, section 5); x and y go from 0 to the slab's
    size.

    Rays are refracted at the lacquer's face, which also reflects the lights. The rays are absorbed along their
    paths through the lacquer, and hit the flakes at their positions.
    """

    kind: Literal["nashiji_slab"]
    size_mm: tuple[Positive, Positive] = (20.0, 20.0)
    depth_mm: Positive = 0.4
    """Depth of the lacquer."""
    flakes_per_mm2: Positive = 6.0
    flake_radius_mm: Positive = 0.12
    tilt_deg: Annotated[float, Field(ge=0, lt=45)] = 8.0
    roughness: Roughness = 0.08
    seed: int = 1


class Arcature(Pose):
    """A gilded niche on a stone wall (`coupole.appearance.render.arcature`)."""

    kind: Literal["arcature"]
    radius_mm: Positive = 400.0
    height_mm: Positive = 600.0
    """Height from the sill to the springing of the arch."""
    depth_mm: Positive = 300.0
    gilt: Gilt = Gilt(kind="gilt")
    stone: Material = Diffuse(kind="diffuse", reflectance=Shape(kind="shape", name="dull_yellow_shape"))


class StainedGlass(Glazing, Pose):
    """A window of coloured panes in y = 0, upright: x across, z up from the sill."""

    kind: Literal["stained_glass"]
    width_mm: Positive
    height_mm: Positive
    lead: Material = _LEAD


class Church(Pose):
    """The inside of a small church (`coupole.appearance.render.church`): y along the nave, z up from the floor."""

    kind: Literal["church"]
    width_mm: Positive = 6000.0
    length_mm: Positive = 12000.0
    spring_mm: Positive = 5000.0
    """Height from the floor to the springing of the vault."""
    bays: Annotated[int, Field(ge=1, le=20)] = 3
    wall_mm: Positive = 600.0
    window_width_mm: Positive = 1000.0
    window_sill_mm: Positive = 1800.0
    window_spring_mm: Positive = 3800.0
    stone: Material = _STONE
    light_tiles: Material = _STONE
    dark_tiles: Material = Diffuse(kind="diffuse", reflectance=Constant(kind="constant", value=0.12))
    glazing: Glazing | None = None
    """Glazing of all windows; without it the windows are open."""
    lead: Material = _LEAD

    @model_validator(mode="after")
    def _fits(self) -> Church:
        top_mm = self.window_spring_mm + np.sqrt(0.75) * self.window_width_mm
        bay_mm = min(self.length_mm / self.bays, self.width_mm)
        if not self.window_sill_mm < self.window_spring_mm or top_mm >= self.spring_mm:
            raise ValueError(
                f"windows end {top_mm:.0f} mm high and must begin above their sill and end below `spring_mm`"
            )
        if self.window_width_mm >= 0.9 * bay_mm:
            raise ValueError(f"windows are too wide for bays of {bay_mm:.0f} mm: make them narrower")
        return self


LocalObject = (
    Mesh
    | Plane
    | SculptedRelief
    | GiltStepWedge
    | PaintWedge
    | MakieTile
    | Makie
    | NashijiSlab
    | Nashiji
    | Arcature
    | StainedGlass
    | Church
)
"""Objects of triangles."""
Object = Annotated[LocalObject | Sphere, Field(discriminator="kind")]


def pieces(thing: Object, folder: Path) -> list[Piece | Ball]:
    """The object's parts in the scene's frame; paths are relative to `folder`."""
    if isinstance(thing, Sphere):
        centre = thing.scene_from_thing() @ [0.0, 0.0, thing.radius_mm, 1.0]
        return [Ball(centre[:3], thing.radius_mm, thing.material)]
    return [placed_piece(piece, thing) for piece in _local(thing, folder)]


def _local(thing: LocalObject, folder: Path) -> list[Piece]:
    """Return the pieces in the object's own frame."""
    match thing:
        case Mesh():
            corners = mesh_corners(folder / thing.path, thing.unit)
            return [Piece(corners, thing.material, thing.smooth)]
        case Plane():
            return [Piece(rectangle(thing.width_mm, thing.depth_mm), thing.material)]
        case SculptedRelief():
            return [Piece(relief(thing.size_mm, thing.triangles, _RELIEF_MM, thing.seed), thing.material)]
        case GiltStepWedge():
            return _gilt_wedge(thing)
        case PaintWedge():
            panel = samples.stepped_panel(2, len(thing.thicknesses_mm), _STEP_MM, _PAINT_ROW_MM)
            return _panel(panel, _paint_fields(thing))
        case MakieTile():
            tile = samples.makie_tile(thing.side_mm, thing.triangles, thing.petals, thing.seed)
            black = Lacquer(kind="lacquer")
            gold = Metal(kind="metal", roughness=thing.roughness)
            return [Piece(tile.powder, gold), Piece(tile.ground, black), Piece(tile.body, black)]
        case NashijiSlab():
            return _nashiji(thing)
        case Makie() | Nashiji():
            return makie_pieces(thing, folder) if isinstance(thing, Makie) else nashiji_pieces(thing, folder)
        case Arcature():
            parts = arcature.arcature(thing.radius_mm, thing.height_mm, thing.depth_mm)
            return [Piece(parts.gilded_mm, thing.gilt, smooth=True), Piece(parts.stone_mm, thing.stone)]
        case StainedGlass():
            return _glazed_window(thing, thing.lead, thing.width_mm, thing.height_mm)
        case Church():
            return _church(thing)
        case _:
            assert_never(thing)


def _church(thing: Church) -> list[Piece]:
    size = church.Size(**{name: getattr(thing, name) for name in church.Size.__dataclass_fields__})
    parts = church.church(size)
    pieces = [
        Piece(parts.stone_mm, thing.stone),
        Piece(parts.light_tiles_mm, thing.light_tiles),
        Piece(parts.dark_tiles_mm, thing.dark_tiles),
    ]
    for opening in parts.openings if thing.glazing else ():
        assert thing.glazing is not None
        window_pieces = _glazed_window(thing.glazing, thing.lead, opening.width_mm, opening.height_mm)
        pieces += [_moved_piece(piece, opening.church_from_window) for piece in window_pieces]
    return pieces


def _glazed_window(glazing: Glazing, lead: Material, width_mm: float, height_mm: float) -> list[Piece]:
    panes, cames = window(glazing, width_mm, height_mm)
    glass = [Piece(corners, Pane(colour=glazing.panes[letter])) for letter, corners in panes.items()]
    return [*glass, Piece(cames, lead)]


def _gilt_wedge(thing: GiltStepWedge) -> list[Piece]:
    steps: list[Material] = [
        Gilt(kind="gilt", thickness_nm=nm, gold=thing.gold, roughness=thing.roughness)
        for nm in thing.thicknesses_nm
    ]
    return _panel(samples.stepped_panel(1, len(steps), _STEP_MM, _GILT_ROW_MM), steps)


def _panel(panel: samples.SteppedPanel, materials: Sequence[Material]) -> list[Piece]:
    fields = [Piece(corners, material) for corners, material in zip(panel.fields, materials, strict=True)]
    return [*fields, Piece(panel.body, _PRINT)]


def _paint_fields(thing: PaintWedge) -> list[Material]:
    """Return the paints in the order of the fields: row by row, black ground first, with the steps'
    thicknesses."""
    return [
        Paint(
            kind="paint",
            pigment=Shape(kind="shape", name=thing.pigment),
            thickness_mm=thickness_mm,
            ground=Constant(kind="constant", value=ground),
            scattering_per_mm=thing.scattering_per_mm,
        )
        for ground in (0.02, 0.90)
        for thickness_mm in thing.thicknesses_mm
    ]


def _nashiji(thing: NashijiSlab) -> list[Piece]:
    """Black body, flakes, and the clear lacquer as a closed refracting body around the flakes."""
    flakes = nashiji.flakes(
        nashiji.Slab(
            size_mm=thing.size_mm,
            depth_mm=thing.depth_mm,
            flakes_per_mm2=thing.flakes_per_mm2,
            flake_radius_mm=thing.flake_radius_mm,
            tilt_deg=thing.tilt_deg,
            seed=thing.seed,
        )
    )
    width, length = thing.size_mm
    black = Diffuse(kind="diffuse", reflectance=Constant(kind="constant", value=0.006))
    middle = np.array([0.5 * width, 0.5 * length, 0.0])
    parts = [Piece(slab(width, length, _NASHIJI_BODY_MM) + middle, black)]
    points, faces = nashiji.triangulate(flakes, around=12, along=4)
    top_mm = _NASHIJI_BODY_MM + thing.depth_mm
    corners = (points + np.array([0.0, 0.0, top_mm]))[faces].reshape(len(flakes.centres_mm), -1, 3, 3)
    gold = Metal(kind="metal", roughness=thing.roughness, depth_mm=0.0, face=False)
    parts.append(Piece(corners.reshape(-1, 3, 3), gold))
    return [*parts, _clear(width, length, thing.depth_mm, 2.0 * thing.flake_radius_mm)]


def _clear(width: float, length: float, thickness_mm: float, rim_mm: float) -> Piece:
    """Return the outer surface of the lacquer. It extends into the body, and is slightly wider than the slab,
    because flakes at the rim extend beyond it."""
    box = slab(width + 2 * rim_mm, length + 2 * rim_mm, thickness_mm + _DIP_MM)
    lift = np.array([0.5 * width, 0.5 * length, _NASHIJI_BODY_MM - _DIP_MM])
    return Piece(box + lift, Glass(kind="glass", index=indices.URUSHI, absorption=Urushi(kind="urushi")))


def placed_piece(piece: Piece, pose: Pose) -> Piece:
    """Move a piece from its object's frame into the scene's frame."""
    return _moved_piece(piece, pose.scene_from_thing())


def _moved_piece(piece: Piece, place: Array) -> Piece:
    rotation = place[:3, :3]
    corners: NDArray[np.float64] = piece.corners_mm @ rotation.T + place[:3, 3]
    normals = None if piece.normals is None else np.asarray(piece.normals @ rotation.T)
    return Piece(corners, piece.material, piece.smooth, normals)
