"""The inside of a small church, as surroundings. It has walls with pointed windows, a pointed barrel vault on
ribs, and a floor.

x is across the nave, y along it (the altar's end is +y), z up; the origin is in the middle of the floor.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise

import numpy as np

from coupole.appearance.shapes.triangles import grid_faces, rectangle
from coupole.appearance.spectra.grid import Array

_ARC = 12
"""Number of segments of each half of a pointed arch."""
_RIB_WIDTH, _RIB_DEPTH = 0.05, 0.035
"""Width and depth of a rib, in widths of the nave."""
_TILES = 12
"""Number of tiles across the floor."""


@dataclass(frozen=True)
class Size:
    width_mm: float
    length_mm: float
    spring_mm: float
    """Height from the floor to where the vault begins."""
    bays: int
    wall_mm: float
    """Thickness of the walls, visible in the windows' reveals."""
    window_width_mm: float
    window_sill_mm: float
    window_spring_mm: float
    """Height from the floor to where a window's arch begins."""


@dataclass(frozen=True)
class Opening:
    """The outer opening of a window: `scene_from_window` places x across, z up from the sill, as seen from
    inside."""

    church_from_window: Array
    """[4, 4]."""
    width_mm: float
    height_mm: float


@dataclass(frozen=True)
class Church:
    """Corners [triangles, 3, 3], mm, and the openings that the walls surround."""

    stone_mm: Array
    light_tiles_mm: Array
    dark_tiles_mm: Array
    openings: tuple[Opening, ...]


def church(size: Size) -> Church:
    half, bay = 0.5 * size.width_mm, size.length_mm / size.bays
    outline = _pointed_arch(size.width_mm, size.spring_mm)
    stone, openings = [_vault(outline, size)], []
    bounds = [-0.5 * size.length_mm + n * bay for n in range(size.bays + 1)]
    for turned_deg, x in ((90.0, -half), (-90.0, half)):
        for y in bounds[:-1]:
            wall, reveal = _wall(bay, size.spring_mm, size)
            place = _upright(turned_deg, [x, y + 0.5 * bay, 0.0])
            stone.append(_place_corners(np.concatenate([wall, reveal]), place))
            openings.append(_opening(place, size))
    stone += [_rib(outline, y, size) for y in bounds]
    for turned_deg, y in ((180.0, -0.5 * size.length_mm), (0.0, 0.5 * size.length_mm)):
        wall, reveal = _wall(size.width_mm, size.spring_mm, size)
        place = _upright(turned_deg, [0.0, y, 0.0])
        stone.append(_place_corners(np.concatenate([wall, reveal, _gable(outline)]), place))
        openings.append(_opening(place, size))
    tiles = rectangle(size.width_mm, size.length_mm, _TILES, round(_TILES * size.length_mm / size.width_mm))
    number = np.arange(len(tiles)) // 2
    dark = (number % _TILES + number // _TILES) % 2 == 1
    return Church(np.concatenate(stone), tiles[~dark], tiles[dark], tuple(openings))


def _pointed_arch(width_mm: float, spring_mm: float) -> Array:
    """Return points [n, 2], x and z, of a pointed arch from left to right. The centre of each half is the other
    half's springing."""
    angle = np.linspace(0.0, np.pi / 3.0, _ARC + 1)
    right_arc = width_mm * np.stack([np.cos(angle) - 0.5, np.sin(angle)], axis=1)
    left_arc = right_arc * [-1.0, 1.0]
    whole = np.concatenate([left_arc, right_arc[-2::-1]])
    return np.asarray(whole + np.array([0.0, spring_mm]))


def _wall(width_mm: float, height_mm: float, size: Size) -> tuple[Array, Array]:
    """A wall in y = 0 with one window, seen from -y, and the window's reveal behind it."""
    half, side = 0.5 * size.window_width_mm, 0.5 * width_mm
    arch = _pointed_arch(size.window_width_mm, size.window_spring_mm)
    sill = size.window_sill_mm
    above = np.stack([arch[:, 0], np.full(len(arch), height_mm)], axis=1)
    low, high = np.array([[-half, 0.0], [half, 0.0]]), np.array([[-half, sill], [half, sill]])
    sides = [
        np.array([[start, z] for start in ends])
        for ends in ((-side, -half), (half, side))
        for z in (0.0, height_mm)
    ]
    wall = [
        _between(_at(arch), _at(above)),
        _between(_at(low), _at(high)),
        _between(_at(sides[0]), _at(sides[1])),
        _between(_at(sides[2]), _at(sides[3])),
    ]
    rim = np.concatenate([[[-half, sill]], arch, [[half, sill]], [[-half, sill]]])
    return np.concatenate(wall), _between(_at(rim), _at(rim, size.wall_mm))


def _gable(outline: Array) -> Array:
    """Return the surface that closes the vault at an end, in y = 0."""
    level = np.stack([outline[:, 0], np.full(len(outline), outline[0, 1])], axis=1)
    return _between(_at(level), _at(outline))


def _vault(outline: Array, size: Size) -> Array:
    ends = (-0.5 * size.length_mm, 0.5 * size.length_mm)
    return _between(_at(outline, ends[0]), _at(outline, ends[1]))


def _rib(outline: Array, y_mm: float, size: Size) -> Array:
    """A square rib under the vault, down to the floor along the walls."""
    half, deep = 0.5 * _RIB_WIDTH * size.width_mm, _RIB_DEPTH * size.width_mm
    whole = np.concatenate([[[outline[0, 0], 0.0]], outline, [[outline[-1, 0], 0.0]]])
    middle = np.array([0.0, size.spring_mm])
    inward = middle - whole
    inward[[0, -1], 1] = 0.0
    inner = whole + deep * inward / np.linalg.norm(inward, axis=1, keepdims=True)
    lines = [_at(whole, y_mm - half), _at(inner, y_mm - half), _at(inner, y_mm + half), _at(whole, y_mm + half)]
    return np.concatenate([_between(line, next_line) for line, next_line in pairwise(lines)])


def _opening(place: Array, size: Size) -> Opening:
    """Return the rectangle around the window, at its outside."""
    behind = np.eye(4)
    behind[:3, 3] = [0.0, size.wall_mm, size.window_sill_mm]
    top_mm = size.window_spring_mm + np.sqrt(0.75) * size.window_width_mm
    return Opening(place @ behind, size.window_width_mm, float(top_mm - size.window_sill_mm))


def _upright(turned_deg: float, at_mm: list[float]) -> Array:
    """Return a wall's frame, turned about z; at angle 0 the wall faces -y."""
    c, s = np.cos(np.radians(turned_deg)), np.sin(np.radians(turned_deg))
    pose = np.eye(4)
    pose[:2, :2], pose[:3, 3] = [[c, -s], [s, c]], at_mm
    return pose


def _place_corners(corners_mm: Array, place: Array) -> Array:
    return np.asarray(corners_mm @ place[:3, :3].T + place[:3, 3])


def _at(outline: Array, y_mm: float = 0.0) -> Array:
    return np.stack([outline[:, 0], np.full(len(outline), y_mm), outline[:, 1]], axis=1)


def _between(low: Array, high: Array) -> Array:
    """Triangles of the strip between two lines of n points."""
    return np.asarray(np.concatenate([low, high])[grid_faces(1, len(low) - 1)])
