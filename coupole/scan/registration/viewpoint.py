"""Viewpoint of a scanner, and the space that it saw through.

A scan is the view of a scanner from one side: each ray ends at the first surface. So no point of another scan may
lie between the scanner and its surface. If one does, the two scans are placed wrongly (free-space violation;
Huber, Automatic Three-dimensional Modeling from Reality, 2002, section 4.2).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

Floats = NDArray[np.float64]
Stand = Literal["origin", "+x", "-x", "+y", "-y", "+z", "-z", "none"]
STANDS: tuple[Stand, ...] = ("origin", "+x", "-x", "+y", "-y", "+z", "-z", "none")

_MOST_FOLDED = 0.05
"""Greatest share of the picture's cells with two surfaces, for a possible viewpoint."""
_AS_GOOD = 0.005
_LEAST_FORWARD = 0.1
"""Length of the mean of all directions below which a scan covers all directions."""
_MOST_CELLS = 4_000_000


@dataclass(frozen=True)
class Viewpoint:
    """A scanner in the frame of its own scan: at the origin, or far away along an axis, with parallel rays."""

    stand: Stand

    def towards(self, points_mm: Floats) -> Floats:
        """[n, 3] unit vectors from points to the scanner."""
        if self.stand == "origin":
            away = np.linalg.norm(points_mm, axis=1, keepdims=True)
            return np.asarray(-points_mm / np.maximum(away, 1e-12))
        return np.broadcast_to(_axis(self.stand), points_mm.shape)

    def places_and_depths(self, points_mm: Floats) -> tuple[Floats, Floats]:
        """Places [n, 2] in the scanner's picture and depths [n] along its rays: radians and mm, or mm and mm."""
        if self.stand == "origin":
            depth = np.linalg.norm(points_mm, axis=1)
            x, y, z = points_mm.T
            return np.stack([np.arctan2(y, x), np.arcsin(np.clip(z / np.maximum(depth, 1e-12), -1, 1))], 1), depth
        axis = _axis(self.stand)
        across = [k for k in range(3) if axis[k] == 0]
        return points_mm[:, across], -points_mm @ axis


def _axis(stand: Stand) -> Floats:
    axis = np.zeros(3)
    axis["xyz".index(stand[1])] = 1.0 if stand[0] == "+" else -1.0
    return axis


class DepthPicture:
    """Picture of the scanner's view, in cells: the nearest and farthest depth in and around each."""

    def __init__(self, viewpoint: Viewpoint, points_mm: Floats, spacing_mm: float) -> None:
        self._viewpoint = viewpoint
        self._level = _level(points_mm) if viewpoint.stand == "origin" else np.eye(3)
        places, depths = viewpoint.places_and_depths(points_mm @ self._level)
        self._turn = _gap(places[:, 0]) if viewpoint.stand == "origin" else 0.0
        places = self._turned_places(places)
        self._low = places.min(axis=0)
        extent = places.max(axis=0) - self._low
        cell = 1.5 * (spacing_mm / np.median(depths) if viewpoint.stand == "origin" else spacing_mm)
        self._cell = max(cell, float(np.sqrt(np.prod(np.maximum(extent, cell)) / _MOST_CELLS)))
        self._shape = tuple(int(n) + 1 for n in extent / self._cell)
        flat, _ = self._cells(places)
        near = np.full(self._shape, np.inf)
        far = np.full(self._shape, -np.inf)
        np.minimum.at(near.reshape(-1), flat, depths)
        np.maximum.at(far.reshape(-1), flat, depths)
        self._own = near, far
        is_filled = np.isfinite(near)
        around = ndimage.uniform_filter(is_filled.astype(float), 3, mode="constant") > 0.99
        nearest = ndimage.minimum_filter(near, 3, mode="nearest")
        self._nearest = np.where(around, nearest, -np.inf).reshape(-1)

    def folded_share(self, step_mm: float) -> float:
        """Share of the cells in which surfaces are farther apart than a step along the ray."""
        near, far = self._own
        is_filled = np.isfinite(near)
        return float(np.mean(far[is_filled] - near[is_filled] > step_mm))

    def in_front(self, points_mm: Floats, least_mm: float) -> tuple[NDArray[np.bool_], NDArray[np.bool_]]:
        """Tell which points [n, 3] in this scan's frame lie in rays that ended at a surface, and which of these
        lie at least `least_mm` before it, in space that the scanner saw through."""
        places, depths = self._viewpoint.places_and_depths(points_mm @ self._level)
        flat, inside = self._cells(self._turned_places(places))
        nearest = np.where(inside, self._nearest[flat], -np.inf)
        is_seen = np.isfinite(nearest)
        return is_seen, is_seen & (depths < nearest - least_mm)

    def _turned_places(self, places: Floats) -> Floats:
        if self._viewpoint.stand != "origin":
            return places
        return np.stack([np.mod(places[:, 0] - self._turn, 2 * np.pi), places[:, 1]], axis=1)

    def _cells(self, places: Floats) -> tuple[NDArray[np.intp], NDArray[np.bool_]]:
        cells = np.floor((places - self._low) / self._cell).astype(np.intp)
        inside = np.all((cells >= 0) & (cells < np.array(self._shape)), axis=1)
        nearest_cells = np.clip(cells, 0, np.array(self._shape) - 1)
        return nearest_cells[:, 0] * self._shape[1] + nearest_cells[:, 1], inside


def _level(points_mm: Floats) -> Floats:
    """[3, 3] axes in which the middle of the view lies on the horizon, because a picture by azimuth and elevation
    is distorted near the poles."""
    ways = points_mm / np.maximum(np.linalg.norm(points_mm, axis=1, keepdims=True), 1e-12)
    forward = ways.mean(axis=0)
    if np.linalg.norm(forward) < _LEAST_FORWARD:
        return np.eye(3)
    axes, _ = np.linalg.qr(np.column_stack([forward, np.eye(3)[np.argsort(np.abs(forward))[:2]].T]))
    return np.asarray(axes)


def _gap(azimuths: Floats) -> float:
    """Return an azimuth at which the scanner saw nothing, or saw the fewest points; the picture begins there."""
    counts, borders = np.histogram(np.mod(azimuths, 2 * np.pi), 360, (0, 2 * np.pi))
    return float(borders[int(np.argmin(counts))])


def folds(points_mm: Floats, normals: Floats | None, spacing_mm: float) -> dict[Stand, float]:
    """Return, for each possible viewpoint of a scan [n, 3], the share of the rays along which two surfaces lie.

    If normals [n, 3] show which side is out, they choose between the two ends of an axis. Otherwise it is the
    positive end, as in range images.
    """
    step_mm = 8 * spacing_mm
    fold_shares: dict[Stand, float] = {}
    ends: tuple[tuple[Stand, Stand], ...] = (("+x", "-x"), ("+y", "-y"), ("+z", "-z"))
    for stand, opposite in ends:
        fold_share = DepthPicture(Viewpoint(stand), points_mm, spacing_mm).folded_share(step_mm)
        is_turned = normals is not None and np.mean(normals @ _axis(stand) > 0) < 0.5
        fold_shares[opposite if is_turned else stand] = fold_share
    if float(np.linalg.norm(points_mm, axis=1).min()) > 20 * spacing_mm:
        fold_shares["origin"] = DepthPicture(Viewpoint("origin"), points_mm, spacing_mm).folded_share(step_mm)
    return fold_shares


def choose_viewpoints(folded_shares: Sequence[dict[Stand, float]]) -> list[Viewpoint]:
    """Return one viewpoint for each scan. All scans come from one scanner; so the viewpoint with the smallest
    share of folded rays over all scans is used, or the origin if it is as good. A scan that does not fit this
    viewpoint, because it was merged or moved, gets `none`."""
    common_stands = set.intersection(*(set(of_scan) for of_scan in folded_shares))
    total = {stand: float(np.median([of_scan[stand] for of_scan in folded_shares])) for stand in common_stands}
    best: Stand = min(total, key=lambda stand: (total[stand], stand)) if total else "none"
    if "origin" in total and total["origin"] <= max(_AS_GOOD, total.get(best, 1.0)):
        best = "origin"
    return [Viewpoint(best if of_scan.get(best, 1.0) <= _MOST_FOLDED else "none") for of_scan in folded_shares]
