"""Aligns a state with another by the unchanged parts: points that disagree by more than noise lose all weight.

Points to planes (Chen, Medioni, 1992) with Tukey's biweight, which has no influence beyond 4.685 standard
deviations (Beaton, Tukey, Technometrics 16(2), 1974). The standard deviation is estimated from the median
residual.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from coupole.errors import InputError
from coupole.heritage.comparison.state_files import Floats, State
from coupole.scan.registration.pair_matching import match_by_features, refined_motion
from coupole.scan.registration.prepared_scan import PLACE_SPACINGS, Cloud, thinned_cloud
from coupole.scan.registration.small_motions import moved_points, stepped_motion
from coupole.scan.registration.viewpoint import Viewpoint

_COARSE_POINTS, _FINE_POINTS = 4_000, 60_000
_ALIGNED_SHARE, _LEAST_SHARE = 0.6, 0.3
"""Least share of the coarse points that lie on the other state: for states that are already aligned, and for
states that can be aligned."""
_TUKEY = 4.685
_MOST_ROUNDS, _SETTLED = 60, 1e-6
_CELLS_ACROSS = 12
_FEATURES_AGREED = 5


@dataclass(frozen=True)
class Alignment:
    """Motion `before_from_after`, 4x4 in mm, with its covariance."""

    before_from_after: Floats
    covariance: Floats
    """[6, 6] covariance of a step (mm, rad) about `pivot_mm`."""
    pivot_mm: Floats
    noise_mm: float
    """Robust standard deviation of distances along normals."""
    is_given: bool
    """True if the states were already aligned in their files."""

    def uncertainty_mm(self, points_mm: Floats, normals: Floats) -> Floats:
        """[n] standard uncertainty of distances along normals [n, 3] at points [n, 3]."""
        rows = np.concatenate([normals, np.cross(points_mm - self.pivot_mm, normals)], axis=1)
        return np.asarray(np.sqrt(np.einsum("ni,ij,nj->n", rows, self.covariance, rows)))


def align(before: State, after: State) -> Alignment:
    """Find the motion between two states. Raises InputError if they do not look like the same object."""
    spacing_mm = max(before.spacing_mm, after.spacing_mm)
    fine = [_thin_state(state, spacing_mm, _FINE_POINTS) for state in (before, after)]
    coarse = [_thin_state(state, 2 * fine[0].pitch_mm, _COARSE_POINTS) for state in (before, after)]
    pitch_mm = max(cloud.pitch_mm for cloud in coarse)
    motion, is_given = np.eye(4), True
    if _share(coarse[0], coarse[1], motion, pitch_mm) < _ALIGNED_SHARE:
        is_given = False
        motion, agreement = match_by_features(*coarse)
        if agreement >= _FEATURES_AGREED:
            motion = refined_motion(coarse[0], coarse[1], motion, 2.5 * pitch_mm, 40)
        if agreement < _FEATURES_AGREED or _share(coarse[0], coarse[1], motion, pitch_mm) < _LEAST_SHARE:
            raise InputError(
                f"{before.name} and {after.name}: no motion brings {100 * _LEAST_SHARE:.0f} % or more of one onto "
                "the other. Is it another object, in another unit, or only a part of it?"
            )
    return _robust(fine[0], fine[1], motion, pitch_mm, is_given=is_given)


def _thin_state(state: State, pitch_mm: float, most: int) -> Cloud:
    pitch_mm = max(pitch_mm, PLACE_SPACINGS / 2 * state.spacing_mm)
    cloud = thinned_cloud(state.points_mm, pitch_mm, Viewpoint("none"), state.outward)
    while len(cloud.points_mm) > most:
        pitch_mm *= max(1.05, (len(cloud.points_mm) / most) ** 0.5)
        cloud = thinned_cloud(state.points_mm, pitch_mm, Viewpoint("none"), state.outward)
    return cloud


def _share(before: Cloud, after: Cloud, motion: Floats, pitch_mm: float) -> float:
    """Return the share of the points of the second state that lie on the first state, within half a cell along its
    normals."""
    moved_mm = moved_points(motion, after.points_mm)
    away, nearest = before.tree.query(moved_mm, distance_upper_bound=1.5 * pitch_mm)
    hit = np.isfinite(away)
    off = np.sum((moved_mm[hit] - before.points_mm[nearest[hit]]) * before.normals[nearest[hit]], axis=1)
    turned_normals = after.normals[hit] @ motion[:3, :3].T
    facing = np.abs(np.sum(turned_normals * before.normals[nearest[hit]], axis=1))
    return float(np.sum((np.abs(off) < 0.5 * pitch_mm) & (facing > 0.8)) / len(moved_mm))


def _robust(before: Cloud, after: Cloud, motion: Floats, reach_mm: float, *, is_given: bool) -> Alignment:
    pivot = before.points_mm.mean(axis=0)
    for _ in range(_MOST_ROUNDS):
        moved_mm = moved_points(motion, after.points_mm)
        away, nearest = before.tree.query(moved_mm, distance_upper_bound=max(reach_mm, 1.5 * before.pitch_mm))
        hit = np.flatnonzero(np.isfinite(away))
        normals = before.normals[nearest[hit]]
        off = np.sum((moved_mm[hit] - before.points_mm[nearest[hit]]) * normals, axis=1)
        noise_mm = max(1.4826 * float(np.median(np.abs(off))), 1e-6 * before.pitch_mm)
        weights = np.clip(1 - (off / (_TUKEY * noise_mm)) ** 2, 0, None) ** 2
        rows = np.concatenate([normals, np.cross(moved_mm[hit] - pivot, normals)], axis=1)
        normal = (rows * weights[:, None]).T @ rows
        normal += np.diag(np.full(6, 1e-12 * np.trace(normal)))
        step = -np.linalg.solve(normal, rows.T @ (weights * off))
        motion = stepped_motion(motion, step, pivot)
        reach_mm = 0.7 * reach_mm
        if reach_mm < before.pitch_mm and np.abs(step[:3]).max() < _SETTLED * before.pitch_mm:
            break
    size_mm = float(np.linalg.norm(np.ptp(before.points_mm, axis=0))) / _CELLS_ACROSS
    cells = np.unique(np.floor(moved_mm[hit] / size_mm).astype(np.int64), axis=0, return_inverse=True)[1].reshape(
        -1
    )
    pulls = np.stack([np.bincount(cells, column) for column in (rows * (weights * off)[:, None]).T], axis=1)
    bread = np.linalg.inv(normal)
    return Alignment(motion, bread @ (pulls.T @ pulls) @ bread, pivot, noise_mm, is_given)
