"""A window of coloured panes between lead cames, upright in the plane y = 0: x across, z up from its sill."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Annotated

import numpy as np
from pydantic import Field, model_validator

from coupole.appearance.render.model import Model, Positive
from coupole.appearance.render.panes import Colour
from coupole.appearance.shapes.triangles import grid_faces
from coupole.appearance.spectra.grid import Array

OPEN = "."
"""Sign in a layout that stands for an opening without glass."""


class Glazing(Model):
    """Panes in rows and columns."""

    layout: Annotated[tuple[Annotated[str, Field(min_length=1, max_length=200)], ...], Field(min_length=1)]
    """Rows from the top, with a letter for each pane; a dot is an opening without glass."""
    panes: dict[Annotated[str, Field(min_length=1, max_length=1)], Colour]
    """The glass of each letter."""
    came_mm: Positive = 8.0
    """Width of the lead between panes; around the window it is half of this."""

    @model_validator(mode="after")
    def _check_layout(self) -> Glazing:
        if len({len(row) for row in self.layout}) > 1:
            raise ValueError("the rows of `layout` differ in length: give each the same number of letters")
        if missing := sorted({*"".join(self.layout)} - {*self.panes, OPEN}):
            raise ValueError(f"`layout` has {', '.join(missing)}, which `panes` does not name: add these panes")
        return self


def window(glazing: Glazing, width_mm: float, height_mm: float) -> tuple[Mapping[str, Array], Array]:
    """Corners [n, 3, 3] of the panes of each letter, and of the cames."""
    rows, columns = len(glazing.layout), len(glazing.layout[0])
    half = 0.5 * glazing.came_mm
    across, up = _edges(width_mm, columns, half) - 0.5 * width_mm, _edges(height_mm, rows, half)
    panes: dict[str, list[Array]] = {}
    cames = [_sheet(across[2 * c : 2 * c + 2], up[[0, -1]]) for c in range(columns + 1)]
    for column in range(columns):
        inner = across[2 * column + 1 : 2 * column + 3]
        cames += [_sheet(inner, up[2 * row : 2 * row + 2]) for row in range(rows + 1)]
        for row, letters in enumerate(reversed(glazing.layout)):
            if letters[column] != OPEN:
                panes.setdefault(letters[column], []).append(_sheet(inner, up[2 * row + 1 : 2 * row + 3]))
    return {letter: np.concatenate(parts) for letter, parts in panes.items()}, np.concatenate(cames)


def _edges(length_mm: float, parts: int, half_mm: float) -> Array:
    """[2 (parts + 1)] places where cames begin and end; the cames at both ends have half the width."""
    middles = np.linspace(0.0, length_mm, parts + 1)
    edges = np.stack([middles - half_mm, middles + half_mm], axis=1).ravel()
    edges[0], edges[-1] = 0.0, length_mm
    return np.asarray(edges)


def _sheet(x_mm: Array, z_mm: Array) -> Array:
    """A rectangle that faces -y."""
    points = [[x, 0.0, z] for z in z_mm for x in x_mm]
    return np.array(points)[grid_faces(1, 1)]
