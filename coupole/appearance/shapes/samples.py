"""Bodies with faces of several materials: a panel of fields, a drawing of sprinkled powder."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from coupole.appearance.shapes.triangles import Array, cells_for, rectangle, skirt

GILT_NM = (0.0, 10.0, 20.0, 40.0, 70.0, 100.0, 150.0, 250.0)
"""Steps of a wedge of gold leaf, from bare bole to bulk gold; a beaten leaf has about 100 nm."""
PAINT_MM = (0.01, 0.02, 0.04, 0.08, 0.16, 0.32)
"""Steps of a wedge of paint."""
_PANEL_MM = 8.0
_TILE_MM = 6.0


@dataclass(frozen=True)
class SteppedPanel:
    """A plate that rests on z = 0, its top divided into fields."""

    fields: tuple[Array, ...]
    """Corners of each field: row by row along y, steps along x."""
    body: Array
    """Corners of the sides and the bottom."""


def stepped_panel(rows: int, steps: int, step_mm: float, row_mm: float) -> SteppedPanel:
    """Return a panel of `rows` by `steps` fields, 8 mm thick, around the z axis."""
    fields = []
    for row in range(rows):
        for step in range(steps):
            middle = [(step - (steps - 1) / 2) * step_mm, (row - (rows - 1) / 2) * row_mm, _PANEL_MM]
            fields.append(rectangle(step_mm, row_mm) + np.array(middle))
    return SteppedPanel(tuple(fields), skirt(np.concatenate(fields)))


@dataclass(frozen=True)
class MakieTile:
    """A tile that rests on z = 0, with a flower of sprinkled powder on its face; corners of each part."""

    powder: Array
    ground: Array
    body: Array
    face: Array
    """Powder and ground together."""
    share: Array
    """[n], expected share of powder on each triangle of the face."""


def makie_tile(side_mm: float, triangles: int, petals: int, seed: int) -> MakieTile:
    """Return a tile. The share of powder falls over the edge of the drawing from 95 % inside to none outside. Each
    triangle of the face is powder with this probability, else ground (Durikovic et al. 2002, section 4)."""
    columns, rows = cells_for(triangles, side_mm, side_mm)
    face = rectangle(side_mm, side_mm, columns, rows, z_mm=_TILE_MM)
    share = _drawing(face.mean(axis=1)[:, :2] / (0.5 * side_mm), petals)
    powder = np.random.default_rng(seed).random(len(face)) < share
    return MakieTile(face[powder], face[~powder], skirt(face), face, share)


def _drawing(place: Array, petals: int) -> Array:
    """Return the share of powder [n] at places [n, 2] of the face, which has coordinates -1 to 1. The drawing is a
    flower, its heart and a rim."""
    r, phi = np.hypot(*place.T), np.arctan2(*place.T[::-1])
    edge = 0.45 + 0.25 * np.abs(np.cos(0.5 * petals * phi))
    flower = (r > 0.16) & (r < edge) | (r < 0.10)
    outside = np.where(flower, 0.0, np.maximum(r - edge, 0.0))
    powder = 0.95 * np.exp(-((outside / 0.06) ** 2)) * (flower | (r > edge))
    rim = np.abs(place).max(axis=1) > 0.94
    return np.where(rim, 0.95, powder)
