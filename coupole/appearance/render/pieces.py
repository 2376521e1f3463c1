"""Pieces that objects consist of: triangles and balls, each of one material."""

from __future__ import annotations

from dataclasses import dataclass

from coupole.appearance.render.materials import Material
from coupole.appearance.render.panes import Pane
from coupole.appearance.spectra.grid import Array


@dataclass(frozen=True)
class Piece:
    """Triangles of one material."""

    corners_mm: Array
    """[triangles, 3, 3] corners in the scene's frame, counter-clockwise seen from outside."""
    material: Material | Pane
    smooth: bool = False
    """True for smooth shading."""
    normals: Array | None = None
    """[triangles, 3, 3] normals for smooth shading, one for each corner. The normals come from the body of which
    this piece is a part.
    """


@dataclass(frozen=True)
class Ball:
    """An exact sphere."""

    centre_mm: Array
    radius_mm: float
    material: Material
