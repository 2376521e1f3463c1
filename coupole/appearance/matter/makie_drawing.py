"""Drawings for makie: the share of powder at places on a plane, from a picture or a classic motif.

A drawing is a function of places [n, 2] in mm that returns shares [n], 0 to 1.
"""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Literal

import numpy as np

from coupole.appearance.spectra.grid import Array
from coupole.errors import InputError

Drawing = Callable[[Array], Array]
Motif = Literal["waves", "flowers"]
_RINGS = 4
_PETALS = 5
_HALF_LINE = 0.014
"""Half the width of a line, in periods."""


def motif(name: Motif, period_mm: float, edge_mm: float) -> Drawing:
    """A motif repeated every `period_mm`: blue-sea waves (seigaiha) or five-petalled flowers in staggered rows.

    Over the width `edge_mm` the share falls from 1 in the line to 0, because powder scatters beside the line.
    """
    distance = {"waves": _waves, "flowers": _flowers}[name]
    return lambda places_mm: np.clip(0.5 - distance(places_mm / period_mm) * period_mm / edge_mm, 0.0, 1.0)


def picture(path: Path, width_mm: float) -> Drawing:
    """Return a picture, `width_mm` wide, with its centre at the origin, upright along +y. Outside the picture the
    share is 0.

    Its alpha channel is the share if it has one (as `coupole makie` makes it), otherwise its grey value divided by
    white, so that white is metal. Values are used without a transfer function. Raises InputError.
    """
    share = _shares(path)
    rows, columns = share.shape

    def metal_share_at(places_mm: Array) -> Array:
        from scipy.ndimage import map_coordinates

        scale = columns / width_mm
        place = [0.5 * (rows - 1) - places_mm[:, 1] * scale, 0.5 * (columns - 1) + places_mm[:, 0] * scale]
        return np.asarray(np.clip(map_coordinates(share, place, order=1, cval=0.0), 0.0, 1.0))

    return metal_share_at


def _shares(path: Path) -> Array:
    """[rows, columns]."""
    from PIL import Image

    try:
        with Image.open(path) as image:
            if "A" in image.getbands():
                return np.asarray(image.getchannel("A"), dtype=float) / 255.0
            if image.mode.startswith("I"):
                return np.asarray(image, dtype=float) / 65535.0
            return np.asarray(image.convert("L"), dtype=float) / 255.0
    except (OSError, ValueError) as error:
        raise InputError(
            f"{path}: expected a picture (PNG, TIFF) that is white where there is metal; {error}"
        ) from error


def _waves(place: Array) -> Array:
    """Return the distance to the line, in periods, negative inside the line. The motif has rows of ringed disks;
    each row covers part of the row above it."""
    lowest = np.floor(4.0 * place[:, 1]) - 2.0
    distance, is_covered = np.full(len(place), np.inf), np.zeros(len(place), bool)
    for row in range(5):
        level = lowest + row
        across = np.mod(place[:, 0] - 0.5 * np.mod(level, 2.0) + 0.5, 1.0) - 0.5
        radius = np.hypot(across, place[:, 1] - 0.25 * level)
        takes = (radius <= 0.5) & ~is_covered
        to_ring = np.abs(np.mod((0.48 - radius) * 2.0 * _RINGS + 0.5, 1.0) - 0.5) / (2.0 * _RINGS)
        distance = np.where(takes, to_ring - _HALF_LINE, distance)
        is_covered |= takes
    return distance


def _flowers(place: Array) -> Array:
    """Return the distance to petals and hearts, in periods, negative inside them. Petals have a bare vein."""
    row = np.round(place[:, 1] / 0.75)
    x = np.mod(place[:, 0] - 0.5 * np.mod(row, 2.0) + 0.5, 1.0) - 0.5
    y = place[:, 1] - 0.75 * row
    r, phi = np.hypot(x, y), np.arctan2(y, x) + row
    step = 2.0 * np.pi / _PETALS
    beside = np.mod(phi + 0.5 * step, step) - 0.5 * step
    edge = 0.17 + 0.18 * np.abs(np.cos(0.5 * _PETALS * phi)) ** 0.7
    petal = np.maximum(np.maximum(r - edge, 0.10 - r), _HALF_LINE - np.abs(r * np.sin(beside)))
    return np.asarray(np.minimum(petal, r - 0.06))
