"""Contents of a page of a scene: its triangles, and tables of the reflectance of their layers under each
illuminant."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from coupole.appearance.optics import indices
from coupole.appearance.render import objects
from coupole.appearance.render.materials import Glass, Lacquer, Material, Metal
from coupole.appearance.render.objects import MakieTile, NashijiSlab
from coupole.appearance.render.panes import Pane
from coupole.appearance.render.pieces import Ball, Piece
from coupole.appearance.render.scene_file import PlainScene, Scene, remarks, with_plain_lights
from coupole.appearance.render.urushi import Makie, Nashiji
from coupole.appearance.shapes import samples
from coupole.appearance.shapes.solids import unit_sphere
from coupole.appearance.shapes.triangles import flat_normals
from coupole.appearance.spectra.grid import Array
from coupole.errors import InputError
from coupole.exchange.look.look_blocks import Look, block_of, octahedral
from coupole.exchange.look.look_of_runs import weld_corners
from coupole.exchange.look.scene_layers import (
    PATHS,
    SHOWN,
    Layer,
    chromaticity,
    flake_layers,
    layers_of,
    tables,
)
from coupole.exchange.look.scene_start import illuminants, start_of
from coupole.exchange.look.urushi_layers import coarse_grains, lacquered_corners, nashiji_layers

_BALL_PARTS = 48
"""A ball has 20 times the square of this number of triangles."""
_WHOLE = 65535
"""Code of a share of 1."""
_PATH = float(1.0 / np.sqrt(1.0 - indices.URUSHI**-2))
"""Longest path of light from the face to a depth, as a multiple of the depth."""


@dataclass(frozen=True)
class _Part:
    """Triangles of one material."""

    corners_mm: Array
    number: int
    casts: bool = True
    """False for a sheet on which other things stand."""
    share: Array | None = None
    """[n] share of the material's first layer, if each triangle has its own."""


class _Materials:
    """Different materials, in the order of their numbers."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self.layers: list[tuple[tuple[Layer, ...], bool]] = []
        self.names: list[str] = []
        self._numbers: dict[str, int] = {}

    def number(self, material: Material) -> int:
        key = material.model_dump_json()
        if key not in self._numbers:
            self._numbers[key] = self.add([layers_of(material, self.folder)], describe_material(material))
        return self._numbers[key]

    def add(self, layers: Sequence[tuple[Layer, ...]], name: str, *, is_drawn: bool = False) -> int:
        """Add several materials with one name; return the number of the first."""
        first = len(self.layers)
        self.layers += [(stack, is_drawn) for stack in layers]
        self.names += [name] * len(layers)
        return first


def look_of_scene(scene: Scene, folder: Path) -> Look:
    """Return the page's contents for a scene, whose paths are relative to `folder`. Raises InputError, which lists
    what a page can show."""
    scene = with_plain_lights(scene, folder)
    materials, face = _Materials(folder), None
    parts: list[_Part] = []
    for thing in scene.objects:
        if isinstance(thing, MakieTile):
            parts += _makie(thing, materials)
        elif isinstance(thing, NashijiSlab):
            if face:
                raise InputError(f"{scene.name}: has several nashiji_slab; a page shows {SHOWN}")
            slab_parts, face = _nashiji(thing, materials)
            parts += slab_parts
        elif isinstance(thing, Makie):
            parts.append(_sprinkled_part(thing, materials))
        elif isinstance(thing, Nashiji):
            parts.append(_lacquered_part(thing, materials))
        else:
            casts = thing.kind != "plane"
            parts += [_opaque(piece, materials, casts) for piece in objects.pieces(thing, folder)]
    powers = illuminants(scene, folder)
    corners_mm = np.concatenate([part.corners_mm for part in parts])
    places, triangles, origin_mm, step_mm = weld_corners(corners_mm.reshape(-1, 3))
    normals = flat_normals(corners_mm)
    normals[~normals.any(axis=1)] = (0.0, 0.0, 1.0)
    colour_tables = tables(materials.layers, powers, scene.observer)
    blocks: dict[str, NDArray[Any]] = {
        "places": places,
        "triangles": triangles,
        "normals": octahedral(normals),
        "material": _material_codes(parts),
        "tables": colour_tables.reshape(-1, *colour_tables.shape[-2:]),
    }
    about = _about(scene, folder, powers, materials) | {
        "triangles": len(triangles),
        "face": face,
        "box": [places.min(axis=0).tolist(), places.max(axis=0).tolist()],
        "casting_mm": _box([part for part in parts if part.casts] or parts),
        "origin_mm": origin_mm.tolist(),
        "step_mm": step_mm,
    }
    errors = {"places": f"{0.5e3 * step_mm:.2g} um in each coordinate", "normals": "0.004 degrees"}
    return Look(about, tuple(block_of(name, values) for name, values in blocks.items()), errors=errors)


def describe_material(material: Material) -> str:
    """Describe a material in a few words; default values are left out."""
    values = material.model_dump(mode="json", exclude_defaults=True)
    values.pop("kind", None)
    return f"{material.kind} {', '.join(f'{name} {_plain(value)}' for name, value in values.items())}".strip()


def _plain(value: Any) -> str:
    if isinstance(value, dict):
        return " ".join(str(part) for name, part in value.items() if name != "kind" or len(value) == 1)
    return str(value)


def _about(scene: PlainScene, folder: Path, powers: dict[str, Array], materials: _Materials) -> dict[str, Any]:
    start = start_of(scene, folder)
    lamps = [light.kind for light in scene.lights if light.kind in {"area", "leds"}]
    return {
        "kind": "scene",
        "scene": scene.name,
        "simulated": True,
        "software": {},
        "views": [],
        "start": start,
        "illuminants": {
            name: {"told": name, "xy": chromaticity(power, scene.observer)} for name, power in powers.items()
        },
        "materials": materials.names,
        "remarks": remarks(scene),
        "observer": scene.observer,
        "irradiance": float(np.pi),
        "unit": "1/sr",
        "told": {
            "Object": "a hypothesis: described and computed, never measured",
            "Colours": (
                f"computed from 81 bands, 380 to 780 nm, with the spectrum of each light; CIE {scene.observer} "
                "observer"
            ),
            "Light": "straight from lamps and from the upper half of the sky, with shadows of lamps; none from "
            "surface to surface, and no mirror images of other objects."
            + (
                " Lamps near by are replaced by distant disks that are equally strong at the camera's target."
                if lamps
                else ""
            ),
            "Shape": "flat triangles, also where the renderer smooths them",
        },
    }


def _opaque(piece: Piece | Ball, materials: _Materials, casts: bool) -> _Part:
    if isinstance(piece.material, Pane):
        raise InputError("a page has no light through coloured glass; leave `stained_glass` and glazing out")
    corners_mm = (
        piece.centre_mm + piece.radius_mm * unit_sphere(_BALL_PARTS)
        if isinstance(piece, Ball)
        else piece.corners_mm
    )
    return _Part(corners_mm, materials.number(piece.material), casts)


def _makie(thing: MakieTile, materials: _Materials) -> list[_Part]:
    """The drawing as shares of metal over lacquer, instead of single grains."""
    tile = samples.makie_tile(thing.side_mm, thing.triangles, thing.petals, thing.seed)
    metal = Metal(kind="metal", roughness=thing.roughness)
    black = Lacquer(kind="lacquer")
    layers = (*layers_of(metal, materials.folder), *layers_of(black, materials.folder))
    drawing = materials.add(
        [layers],
        f"{describe_material(metal)}, by its share of the area, over {describe_material(black)}",
        is_drawn=True,
    )
    face = objects.placed_piece(Piece(tile.face, black), thing).corners_mm
    body = objects.placed_piece(Piece(tile.body, black), thing).corners_mm
    return [_Part(face, drawing, share=tile.share), _Part(body, materials.number(black))]


def _sprinkled_part(thing: Makie, materials: _Materials) -> _Part:
    grains = coarse_grains(thing, materials.folder)
    layers = (*layers_of(thing.metal, materials.folder), *layers_of(thing.lacquer, materials.folder))
    drawing = materials.add(
        [layers],
        f"{describe_material(thing.metal)}, by its share, over {describe_material(thing.lacquer)}",
        is_drawn=True,
    )
    return _Part(
        objects.placed_piece(Piece(grains.corners_mm, thing.metal), thing).corners_mm, drawing, share=grains.share
    )


def _lacquered_part(thing: Nashiji, materials: _Materials) -> _Part:
    """Flakes as the mean over many flakes."""
    number = materials.add(
        [nashiji_layers(thing, materials.folder)], f"mean of flakes of {describe_material(thing.metal)} in urushi"
    )
    corners_mm = lacquered_corners(thing, materials.folder)
    return _Part(objects.placed_piece(Piece(corners_mm, thing.metal), thing).corners_mm, number)


def _nashiji(thing: NashijiSlab, materials: _Materials) -> tuple[list[_Part], dict[str, Any]]:
    """Flakes and the ground under the lacquer, and the lacquer's face, at which the page refracts light."""
    longest_mm = 2.0 * _PATH * thing.depth_mm
    rotation = thing.scene_from_thing()[:3, :3]
    parts, flakes = [], None
    for piece in objects.pieces(thing, materials.folder):
        assert isinstance(piece, Piece)
        if isinstance(piece.material, Glass):
            top_mm = float((piece.corners_mm @ rotation[:, 2]).max())
        elif isinstance(piece.material, Metal):
            if flakes is None:
                metal = piece.material
                name = f"gold flake, roughness {metal.roughness:g}, in urushi"
                flakes = materials.add(flake_layers(metal.gold, metal.roughness, longest_mm), name)
            parts.append(_Part(piece.corners_mm, flakes))
        elif not isinstance(piece.material, Pane):
            parts.append(_Part(piece.corners_mm, materials.number(piece.material)))
    face = {
        "normal": rotation[:, 2].tolist(),
        "height_mm": top_mm,
        "index": indices.URUSHI,
        "flakes": -1 if flakes is None else flakes,
        "paths": PATHS,
        "longest_mm": longest_mm,
        "body": parts[0].number,
    }
    return parts, face


def _box(parts: Sequence[_Part]) -> list[list[float]]:
    """Least and greatest coordinates."""
    corners_mm = np.concatenate([part.corners_mm.reshape(-1, 3) for part in parts])
    return [corners_mm.min(axis=0).tolist(), corners_mm.max(axis=0).tolist()]


def _material_codes(parts: Sequence[_Part]) -> NDArray[np.uint16]:
    """[n, 2] codes of triangles: number of the material, and code of the first layer's share."""
    blocks = []
    for part in parts:
        block = np.full((len(part.corners_mm), 2), _WHOLE, np.uint16)
        block[:, 0] = part.number
        if part.share is not None:
            block[:, 1] = np.rint(_WHOLE * np.clip(part.share, 0.0, 1.0))
        blocks.append(block)
    return np.concatenate(blocks)
