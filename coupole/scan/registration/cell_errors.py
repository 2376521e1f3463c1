"""Errors of overlaps, summed over cells of space, because errors that the points of a cell share do not average
out.

The covariance of a fit is computed from sums over cells (a sandwich estimator, clustered: Liang, Zeger, Biometrika
73(1), 1986). If there are about as many parameters as cells, the fit absorbs much of their errors. Therefore each
sum is computed as if the fit had not seen its cell (CR3, the jackknife by clusters: Bell, McCaffrey, Survey
Methodology 28(2), 2002).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from coupole.scan.registration.viewpoint import Floats


@dataclass(frozen=True)
class Overlap:
    """Points of the second scan that lie on the first, in the common frame."""

    first: int
    second: int
    derivatives: Floats
    """[n, 12] derivatives of the distances with respect to steps of the first and of the second scan."""
    off_mm: Floats
    """[n] distances along the normals of the first scan."""
    points_mm: Floats
    """[n, 3]"""
    nearest_mm: Floats
    """[n] distances to the nearest point of the first scan."""

    @property
    def columns(self) -> NDArray[np.intp]:
        """[12] indices of both scans' steps among the steps of all scans."""
        return np.concatenate([6 * scan + np.arange(6) for scan in (self.first, self.second)])


@dataclass(frozen=True)
class _CellPart:
    """Sums of one overlap over one cell."""

    columns: NDArray[np.intp]
    gradient: Floats
    """[12]"""
    normal: Floats
    """[12, 12]"""


def gradient_covariance(
    overlaps: Sequence[Overlap], weights: Sequence[Floats], inverse_normal: Floats, cell_mm: float
) -> Floats:
    """Return the covariance [6 n, 6 n] of the gradient of all overlaps, from its sums over cells of `cell_mm`.

    `weights` are the weights [points] of the squared distances of each overlap. `inverse_normal` is [6 n, 6 n],
    with zeros for a fixed scan.
    """
    covariance = np.zeros_like(inverse_normal)
    if not overlaps:
        return covariance
    for parts in _cells(overlaps, weights, cell_mm):
        columns, place = np.unique(np.concatenate([part.columns for part in parts]), return_inverse=True)
        gradient, normal = np.zeros(len(columns)), np.zeros((len(columns),) * 2)
        for number, part in enumerate(parts):
            at = place[12 * number : 12 * number + 12]
            gradient[at] += part.gradient
            normal[np.ix_(at, at)] += part.normal
        leverage = normal @ inverse_normal[np.ix_(columns, columns)]
        left_out = np.linalg.solve(np.eye(len(columns)) - leverage, gradient)
        covariance[np.ix_(columns, columns)] += np.outer(left_out, left_out)
    return covariance


def _cells(overlaps: Sequence[Overlap], weights: Sequence[Floats], cell_mm: float) -> list[list[_CellPart]]:
    keys = [np.floor(overlap.points_mm / cell_mm).astype(np.int64) for overlap in overlaps]
    low = np.min([key.min(axis=0) for key in keys], axis=0)
    span = np.max([key.max(axis=0) for key in keys], axis=0) - low + 1
    flat = np.array([span[1] * span[2], span[2], 1])
    cells: dict[int, list[_CellPart]] = {}
    for overlap, key, weight in zip(overlaps, keys, weights, strict=True):
        cell_of_point = (key - low) @ flat
        order = np.argsort(cell_of_point, kind="stable")
        distinct, starts = np.unique(cell_of_point[order], return_index=True)
        derivatives, columns = overlap.derivatives[order], overlap.columns
        weighted_derivatives = derivatives * weight[order][:, None]
        off_mm, ends = overlap.off_mm[order], [*starts[1:], len(order)]
        for cell, start, end in zip(distinct.tolist(), starts, ends, strict=True):
            part, at = weighted_derivatives[start:end].T, slice(start, end)
            cells.setdefault(cell, []).append(_CellPart(columns, part @ off_mm[at], part @ derivatives[at]))
    return list(cells.values())
