"""The showpiece: a carved and coloured plaque, as the true surface that simulated frames show.

It has the materials of the seeds: stone; blue paint with losses; gold leaf over red bole, which is worn on raised
places; black lacquer with a drawing of gold powder; woven cloth; and an inscription with strokes 0.3 mm wide. The
mesh that a plan names is a scan of the plaque (`tools/make_plaque_scan.py`). It has no detail that is finer than
its triangles.
"""

from __future__ import annotations

from functools import cache

import numpy as np
from numpy.typing import NDArray

from coupole.appearance.optics import indices
from coupole.appearance.shapes.triangles import Array, flat_normals, grid_faces
from sim.objects import appearance, fabric, plum_branch
from sim.objects import plaque_relief as relief
from sim.objects.carving import NOISE_SPREAD, noise
from sim.scene.surface import Material, Surface

STEP_MM = 0.1
"""Edge of the cells of the true surface: three across a stroke, seven across a thread."""
STONE, BLUE, GOLD, BOLE, LACQUER, POWDER, CLOTH, RED = range(8)
"""Rows of `materials()`."""
_GRAIN_MM = 0.22
"""Size of the grains of powder, or of small heaps of them."""
_WEAR_MM, _WEAR_SEED, _LOSS_SEED, _POWDER_SEED, _STONE_SEED = 1.2, 21, 22, 23, 24
_WORN_TO_BOLE, _WORN_TO_STONE, _LOST = 0.70, 1.35, 1.15
"""Thresholds of wear and loss, approximately as numbers of standard deviations."""


@cache
def materials() -> tuple[Material, ...]:
    """Stone, blue, gold leaf, bole, lacquer, gold powder, cloth and red of the inscription, in this order."""
    return (
        appearance.STONE,
        appearance.paint("blue_two_peaks_shape"),
        appearance.gilt(120.0, roughness=0.22),
        appearance.gilt(0.0, roughness=0.35),
        appearance.black_lacquer(0.06),
        appearance.metal("makie gold", indices.gold(), 0.35),
        fabric.LINEN,
        appearance.paint("orange_shape"),
    )


@cache
def plaque(step_mm: float = STEP_MM) -> Surface:
    """The closed plaque in its own frame (`sim.objects.plaque_relief`), of triangles with legs of `step_mm`.

    Each cell has one material, one tint, and one normal for shading: the normal of the heights at its corners.
    """
    width, depth = relief.PLAQUE_MM
    columns, rows = round(width / step_mm), round(depth / step_mm)
    x, y = np.meshgrid(
        np.linspace(-width / 2, width / 2, columns + 1), np.linspace(-depth / 2, depth / 2, rows + 1)
    )
    height = relief.height_mm(x, y)
    points = np.stack([x, y, height], axis=-1)
    corners, body = points.reshape(-1, 3)[grid_faces(rows, columns)], _body(points)
    middle_x, middle_y = (0.25 * (a[1:, 1:] + a[1:, :-1] + a[:-1, 1:] + a[:-1, :-1]).ravel() for a in (x, y))
    material = materials_at(middle_x, middle_y, _wear(height, step_mm))
    tint = tints_at(middle_x, middle_y, material)
    normals = np.repeat(_normals(height, step_mm), 2, axis=0)
    return Surface(
        np.concatenate([corners, body]),
        materials(),
        np.concatenate([np.repeat(material, 2), np.full(len(body), STONE)]).astype(np.int32),
        np.concatenate([np.repeat(tint, 2, axis=0), np.ones((len(body), 3))]).astype(np.float32),
        np.concatenate([normals, flat_normals(body)]),
    )


def _body(points: Array) -> Array:
    """Corners [n, 3, 3] of the walls below the rim of a grid of points [rows, columns, 3], and of the back."""
    rim = np.concatenate([points[0, :-1], points[:-1, -1], points[-1, :0:-1], points[:0:-1, 0]])
    foot = rim * [1.0, 1.0, 0.0]
    next_rim, next_foot, middle = np.roll(rim, -1, axis=0), np.roll(foot, -1, axis=0), np.zeros_like(rim)
    walls = ((rim, foot, next_foot), (rim, next_foot, next_rim), (middle, next_foot, foot))
    return np.concatenate([np.stack(corners, axis=1) for corners in walls])


def materials_at(x: Array, y: Array, wear: Array) -> NDArray[np.int64]:
    """Row of `materials()` [n] at places [n] of the plaque; `wear` [n] is 0 on average, and high on heights."""
    material = np.full(x.shape, STONE)
    in_roundel, on_flower = relief.in_roundel(x, y), relief.in_flower(x, y)
    in_bay = (np.abs(x) < 30.7) & (y > -25.6) & (y < 35.6)
    on_rope = ~in_roundel & (np.hypot(x - relief.ROUNDEL[0], y - relief.ROUNDEL[1]) < relief.ROUNDEL[2] + 4.0)
    material[in_bay & ~in_roundel & ~on_rope & ~on_flower] = BLUE
    gilt = on_flower & in_bay & ~in_roundel & ~on_rope
    gilt |= relief.on_bar(x, y) & (relief.edge_distance(x, y) > 6.0)
    gilt |= relief.bead_mm(x, y)[1]
    material[in_roundel] = _in_roundel(x[in_roundel], y[in_roundel])
    gilt |= material == GOLD
    loss = noise(x, y, 3.0, _LOSS_SEED) + 0.5 * noise(x, y, 0.7, _LOSS_SEED + 40) + 0.25 * wear
    material[(material == BLUE) & (loss > _LOST)] = STONE
    material[gilt] = np.select([wear[gilt] > _WORN_TO_STONE, wear[gilt] > _WORN_TO_BOLE], [STONE, BOLE], GOLD)
    in_lacquer = relief.in_lacquer(x, y)
    share = plum_branch.powder_share(*relief.panel_place(x[in_lacquer], y[in_lacquer]))
    material[in_lacquer] = np.where(_grains(x[in_lacquer], y[in_lacquer]) < share, POWDER, LACQUER)
    material[relief.in_cloth(x, y) & (relief.edge_distance(x, y) > 6.0)] = CLOTH
    material[relief.cut_distance(x, y) < 0.5 * relief.STROKE_MM] = RED
    return material


def tints_at(x: Array, y: Array, material: NDArray[np.int64]) -> Array:
    """[n, 3] factors of the diffuse reflectance: mottled stone and paint, dyed stripes of the cloth."""
    mottling = 0.94 + 0.04 * noise(x, y, 4.0, _STONE_SEED) + 0.035 * noise(x, y, 0.6, _STONE_SEED + 40)
    tint = np.repeat(np.clip(mottling, 0.6, 1.06)[:, None], 3, axis=1)
    west, east, _, _ = relief.CLOTH_MM
    from_middle = np.abs(x - 0.5 * (west + east)) / (0.5 * (east - west))
    is_madder = (material == CLOTH) & (((from_middle > 0.55) & (from_middle < 0.80)) | (from_middle < 0.16))
    tint[is_madder] *= [0.85, 0.22, 0.22]
    is_indigo = (material == CLOTH) & (from_middle > 0.24) & (from_middle < 0.36)
    tint[is_indigo] *= [0.20, 0.30, 0.62]
    return tint


def _in_roundel(x: Array, y: Array) -> NDArray[np.int64]:
    """Return materials within the roundel: gilded nimbus, hair and hem; blue field with gold stars, and cloak."""
    head, cloak = relief.head_mm(x, y), relief.cloak_mm(x, y)
    from_nimbus = np.hypot(x - relief.NIMBUS[0], y - relief.NIMBUS[1])
    material = np.full(x.shape, BLUE)
    material[_star(x, y)] = GOLD
    material[from_nimbus < relief.NIMBUS[2]] = GOLD
    is_head = (head > relief.FIELD_MM) & (head > cloak)
    material[is_head] = STONE
    is_cloak = (cloak > relief.FIELD_MM - 0.3) & ~is_head
    material[is_cloak] = BLUE
    material[is_cloak & relief.on_hem(x, y)] = GOLD
    return material


def _grains(x: Array, y: Array) -> Array:
    """Return uniform random values [n], 0 to 1; all places in a grain of powder have the same value. A place has
    gold if its value is below the share of gold."""
    from scipy.special import ndtr

    return np.asarray(ndtr(noise(x, y, _GRAIN_MM, _POWDER_SEED) / NOISE_SPREAD))


def _star(x: Array, y: Array) -> NDArray[np.bool_]:
    """Six-pointed stars in staggered rows."""
    row = np.round(y / 3.6)
    u = np.mod(x - 2.1 * np.mod(row, 2.0) + 2.1, 4.2) - 2.1
    v = y - 3.6 * row
    r, phi = np.hypot(u, v), np.arctan2(v, u)
    return np.asarray(r < 0.30 + 0.55 * np.abs(np.cos(3.0 * phi)) ** 4)


def _wear(height: Array, step_mm: float) -> Array:
    """Return the wear [cells] of a grid of heights: the height of a place above its surroundings, and chance."""
    from scipy.ndimage import gaussian_filter

    out_mm = height - gaussian_filter(height, _WEAR_MM / step_mm, mode="nearest")
    middle = 0.25 * (out_mm[1:, 1:] + out_mm[1:, :-1] + out_mm[:-1, 1:] + out_mm[:-1, :-1])
    rows, columns = middle.shape
    y, x = np.mgrid[:rows, :columns] * step_mm
    chance = 0.55 * noise(x, y, 2.2, _WEAR_SEED) + 0.45 * noise(x, y, 0.5, _WEAR_SEED + 40)
    return np.asarray((0.8 * middle + chance).ravel())


def _normals(height: Array, step_mm: float) -> Array:
    """[cells, 3] unit normals of a grid of heights."""
    along_x = 0.5 * (height[1:, 1:] - height[1:, :-1] + height[:-1, 1:] - height[:-1, :-1]) / step_mm
    along_y = 0.5 * (height[1:, 1:] - height[:-1, 1:] + height[1:, :-1] - height[:-1, :-1]) / step_mm
    normals = np.stack([-along_x, -along_y, np.ones_like(along_x)], axis=-1).reshape(-1, 3)
    return np.asarray(normals / np.linalg.norm(normals, axis=1, keepdims=True))
