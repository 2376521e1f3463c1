"""The surface of a state near given places: a quadric through its nearest points, with its uncertainty.

The idea is that of M3C2 (Lague, Brodu, Leroux, ISPRS J. 82, 2013): distances between local surfaces along the
local normal, with an uncertainty from the scatter of the points about each surface. Here the surfaces may be
curved, and colours are fitted with the shape.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from coupole.heritage.comparison.state_files import Floats

NEIGHBOURS = 24
_TERMS, _PLANE_TERMS = 6, 3
_FREEDOM_ALONE = NEIGHBOURS - _TERMS
FREEDOM = 3 * _FREEDOM_ALONE
"""Degrees of freedom of a scatter. Neighbouring fits share most of their points, which limits this number."""
_BATCH = 50_000
_MOST_BESIDE = 0.6
"""Largest distance of the neighbours' middle from the place, relative to their extent. If it is larger, the place
is at a rim, where the surface ends."""
_LEAST_COSINE, _BESIDE_LINE, _NEXT_TO_LINE = 0.5, 2.0, 6
"""Least cosine between normals, largest distance in spacings, and number of points. A surface is seen at a place
if a point with a similar normal lies near the line along the place's normal, and if the points next to this line
have similar normals on average."""
_RIDGE = 1e-9


@dataclass(frozen=True)
class SurfacePoints:
    """Points of a state."""

    points_mm: Floats
    """[m, 3]"""
    normals: Floats
    """[m, 3] unit."""
    is_outward: bool
    """False if the side to which the normals point is not known."""
    spacing_mm: float
    """Distance between neighbouring points."""

    def only(self, point_mask: NDArray[np.bool_]) -> SurfacePoints:
        """Return some of the points, given by a mask [m]."""
        return replace(self, points_mm=self.points_mm[point_mask], normals=self.normals[point_mask])

    def is_seen(self, near: NDArray[np.int64], from_line_mm: Floats, normals: Floats) -> NDArray[np.bool_]:
        """[n] True if the points `near` [n, k] places with normals [n, 3] are the surface there. `from_line_mm`
        [n, k] are their distances from the lines along the normals. In a hollow, if its ground was not measured,
        the nearest points belong to another wall."""
        cosines = np.einsum("nka,na->nk", self.normals[near], normals)
        if not self.is_outward:
            cosines = np.abs(cosines)
        facing_mm = np.where(cosines > _LEAST_COSINE, from_line_mm, np.inf).min(axis=1)
        next_points = np.argsort(from_line_mm, axis=1)[:, :_NEXT_TO_LINE]
        mean_cosines = np.take_along_axis(cosines, next_points, axis=1).mean(axis=1)
        return np.asarray((facing_mm < _BESIDE_LINE * self.spacing_mm) & (mean_cosines > _LEAST_COSINE))


@dataclass(frozen=True)
class LocalFits:
    """Values of a state's surface at places."""

    values: Floats
    """[n, c] height along the normal in mm, by a quadric, then the points' own values, by a plane; NaN where there
    is no surface."""
    scatter: Floats
    """[n, c, c] covariance of a point's values about the quadric, as the mean over this place and the places next
    to it."""
    leverage: Floats
    """[n, c] variance of a value, divided by the variance of one point."""
    is_seen: NDArray[np.bool_]
    """[n] True if the state's points near a place are the surface there, and not the surface of another wall."""

    @property
    def covariance(self) -> Floats:
        """[n, c, c] covariance of the values."""
        root = np.sqrt(self.leverage)
        return np.asarray(self.scatter * root[:, :, None] * root[:, None, :])


def fit_locally(
    surface: SurfacePoints, values: Floats | None, places_mm: Floats, normals: Floats, reach_mm: float
) -> LocalFits:
    """Fit the points of a state, with values [m, c - 1] of their own, near places [n, 3] with normals [n, 3]."""
    tree = cKDTree(surface.points_mm)
    count = 1 + (0 if values is None else values.shape[1])
    fits = LocalFits(
        np.full((len(places_mm), count), np.nan),
        np.full((len(places_mm), count, count), np.nan),
        np.full((len(places_mm), count), np.nan),
        np.zeros(len(places_mm), np.bool_),
    )
    for first in range(0, len(places_mm), _BATCH):
        part = slice(first, first + _BATCH)
        batch = _fit_batch(tree, surface, values, places_mm[part], normals[part], reach_mm)
        fits.values[part], fits.scatter[part] = batch.values, batch.scatter
        fits.leverage[part], fits.is_seen[part] = batch.leverage, batch.is_seen
    around = cKDTree(places_mm)
    alone = fits.scatter.copy()
    for first in range(0, len(places_mm), _BATCH):
        part = slice(first, first + _BATCH)
        near = around.query(places_mm[part], min(NEIGHBOURS, len(places_mm)))[1]
        is_known = np.isfinite(alone[near, 0, 0])
        total = np.sum(np.where(is_known[:, :, None, None], alone[near], 0.0), axis=1)
        fits.scatter[part] = total / np.maximum(is_known.sum(axis=1), 1)[:, None, None]
    return fits


def _fit_batch(
    tree: cKDTree,
    surface: SurfacePoints,
    values: Floats | None,
    places: Floats,
    normals: Floats,
    reach_mm: float,
) -> LocalFits:
    """Fit near places [n, 3] alone; the scatter is found for each place by itself."""
    away, near = tree.query(places, NEIGHBOURS)
    offsets = np.asarray(tree.data)[near] - places[:, None]
    tangent, bitangent = _tangents(normals)
    x, y = np.einsum("nka,na->nk", offsets, tangent), np.einsum("nka,na->nk", offsets, bitangent)
    extent = np.sqrt(np.mean(x**2 + y**2, axis=1))
    there = (away[:, 0] < reach_mm) & (extent > 0)
    beside = np.hypot(x.mean(axis=1), y.mean(axis=1)) / np.where(extent > 0, extent, 1.0)
    there &= beside < _MOST_BESIDE
    is_seen = surface.is_seen(near, np.hypot(x, y), normals)
    scale = np.where(extent > 0, extent, 1.0)[:, None]
    x, y = x / scale, y / scale
    design = np.stack([np.ones_like(x), x, y, x * x, x * y, y * y], axis=2)
    height = np.einsum("nka,na->nk", offsets, normals)[:, :, None]
    fits = [_least_squares(design, height)]
    if values is not None:
        fits.append(_least_squares(design[:, :, :_PLANE_TERMS], values[near]))
    there_values, residuals = (np.concatenate([fit[k] for fit in fits], axis=-1) for k in (0, 1))
    scatter = np.einsum("nkc,nkd->ncd", residuals, residuals) / _FREEDOM_ALONE
    leverage = np.repeat(fits[-1][2][:, None], there_values.shape[1], axis=1)
    leverage[:, 0] = fits[0][2]
    return LocalFits(
        np.where(there[:, None], there_values, np.nan),
        np.where(there[:, None, None], scatter, np.nan),
        np.where(there[:, None], leverage, np.nan),
        is_seen,
    )


def _least_squares(design: Floats, observations: Floats) -> tuple[Floats, Floats, Floats]:
    """Return values [n, c] at the middle, residuals [n, k, c], and leverage [n], for designs [n, k, t] and values
    [n, k, c]."""
    normal = np.einsum("nki,nkj->nij", design, design) + _RIDGE * NEIGHBOURS * np.eye(design.shape[2])
    inverse = np.linalg.inv(normal)
    terms = inverse @ np.einsum("nki,nkc->nic", design, observations)
    return terms[:, 0], observations - design @ terms, inverse[:, 0, 0]


def _tangents(normals: Floats) -> tuple[Floats, Floats]:
    least = np.eye(3)[np.argmin(np.abs(normals), axis=1)]
    tangent = np.cross(normals, least)
    tangent /= np.linalg.norm(tangent, axis=1, keepdims=True)
    return tangent, np.cross(normals, tangent)
