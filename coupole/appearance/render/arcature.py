"""A niche under a round arch, gilded inside (Callet et al. 2010, figure 9), in which a low sun makes a caustic.

Its opening is in the plane y = 0 and faces -y; x is horizontal, z up from the sill, the back wall is at
y = depth. Gold covers jambs and arch; back wall, sill and the wall around the opening are stone.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from coupole.appearance.shapes.triangles import grid_faces
from coupole.appearance.spectra.grid import Array

_SEGMENTS = 192
_MARGIN = 0.45
"""Width of the wall around the opening, in radii."""


@dataclass(frozen=True)
class Niche:
    """Corners [triangles, 3, 3], mm; triangles face the inside of the niche, or the viewer."""

    gilded_mm: Array
    stone_mm: Array


def arcature(radius_mm: float, height_mm: float, depth_mm: float) -> Niche:
    """Return a niche of half width `radius_mm` with an arch that begins `height_mm` above the sill."""
    angle = np.linspace(np.pi, 0.0, _SEGMENTS + 1)
    arch = np.stack([radius_mm * np.cos(angle), height_mm + radius_mm * np.sin(angle)], axis=1)
    outline = np.concatenate([[[-radius_mm, 0.0]], arch, [[radius_mm, 0.0]]])
    gilded_mm = _between(_at(outline, depth_mm), _at(outline, 0.0))
    left_mm, right_mm, top_mm = (
        -radius_mm * (1 + _MARGIN),
        radius_mm * (1 + _MARGIN),
        height_mm + radius_mm * (1 + _MARGIN),
    )
    above = np.stack([arch[:, 0], np.full(len(arch), top_mm)], axis=1)
    corners = [[-radius_mm, 0.0], [radius_mm, 0.0]]
    stone = [
        _fan(_at(outline, depth_mm), np.array([0.0, depth_mm, 0.5 * height_mm])),
        _between(_at(np.array(corners), 0.0), _at(np.array(corners), depth_mm)),
        _between(_at(arch, 0.0), _at(above, 0.0)),
        *(_upright(start, end, top_mm) for start, end in ((left_mm, -radius_mm), (radius_mm, right_mm))),
    ]
    return Niche(gilded_mm, np.concatenate(stone))


def _at(outline: Array, y_mm: float) -> Array:
    """Return points [n, 3] from an outline [n, 2] of x and z."""
    return np.stack([outline[:, 0], np.full(len(outline), y_mm), outline[:, 1]], axis=1)


def _upright(left: float, right: float, top: float) -> Array:
    """A rectangle of the front wall."""
    return _between(*(_at(np.array([[left, z], [right, z]]), 0.0) for z in (0.0, top)))


def _between(low: Array, high: Array) -> Array:
    """Triangles of the strip between two lines of n points."""
    return np.concatenate([low, high])[grid_faces(1, len(low) - 1)]


def _fan(rim: Array, middle: Array) -> Array:
    """Return triangles from a closed rim, clockwise as seen by the viewer, to a point inside it; they face the
    viewer."""
    after = np.roll(rim, -1, axis=0)
    return np.stack([after, rim, np.broadcast_to(middle, rim.shape)], axis=1)
