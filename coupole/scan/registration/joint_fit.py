"""Adjustment of all scans together: one least-squares fit of all overlaps, targets and control points, with
covariances.

Points of one scan are compared with the surface of another along its normals (Chen, Medioni, 1992). This is done
for all overlapping pairs at once, so that errors do not accumulate along chains (Bergevin et al., PAMI 18(5),
1996). Neighbouring points have errors in common, and a point counts in every pair of its scan. Therefore the
covariance is computed from sums over cells of space, not over points (`cell_errors`).
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import cho_factor, cho_solve

from coupole.errors import InputError
from coupole.scan.registration.cell_errors import Overlap, gradient_covariance
from coupole.scan.registration.control import Sighting, Sightings
from coupole.scan.registration.prepared_scan import Cloud, PreparedScan
from coupole.scan.registration.small_motions import inverse_of, moved_points, stepped_motion
from coupole.scan.registration.viewpoint import Floats

Say = Callable[[str, int, int], None]
Columns = NDArray[np.intp]

_MOST_ROUNDS, _LEAST_ROUNDS = 20, 2
_SETTLED_PITCHES = 3e-3
_SAME_SIDE = 0.7
_BESIDE_PITCHES = 0.7
"""Greatest lateral distance from the nearest point, relative to the pitch. A point farther away lies beyond a rim,
where there is no surface."""
_STEEP = 0.5
"""Least cosine of incidence, because a scanner's errors grow beyond 60 degrees from a surface's normal."""
_HUBER = 2.0
_CELLS_ACROSS = 12
"""Number of cells of space along the size of a scan; errors within a cell may be correlated."""
_LEAST_PAIRS = 30


@dataclass(frozen=True)
class JointFit:
    """Poses of connected scans, and their uncertainties."""

    common_from_scan: list[Floats]
    """4x4 mm; the common frame is that of the fixed scan, or of the control points."""
    covariance: Floats
    """[6 n, 6 n] covariance of steps (mm, rad) about the pivots, in the common frame; zero for the fixed scan."""
    overlap_covariance: Floats
    """[6 n, 6 n] part of the covariance from errors of overlaps; the rest is from targets, control points and
    sizes of scans."""
    pivots_mm: Floats
    """[n, 3] middle of each scan in the common frame."""
    noise_mm: float
    """Noise of one distance between two surfaces, as robust standard deviation."""
    rms_mm: float
    """Root mean square of the distances along normals, over all overlaps."""
    median_nearest_mm: float
    """Median distance from points to the nearest points of other scans, over all overlaps."""
    inflation: float
    """Standard uncertainties, relative to the uncertainties that independent errors of all points would give."""
    sightings: tuple[Sighting, ...]
    """Targets, with their residuals."""


def adjust(
    scans: Sequence[PreparedScan],
    pairs: Sequence[tuple[int, int]],
    common_from_scan: Sequence[Floats],
    fixed_scan: int,
    sightings: Sightings,
    say: Say,
) -> JointFit:
    """Adjust the poses of scans, which must be approximately right; `pairs` are numbers of scans that overlap.

    The scan `fixed_scan` stays fixed, unless there are control points. Raises InputError if nothing overlaps.
    """
    poses = [np.array(pose) for pose in common_from_scan]
    if sightings.is_anchored:
        onto = sightings.site_from_common(poses)
        poses = [onto @ pose for pose in poses]
    inflation = 1.0
    poses, state = _settled_poses(scans, pairs, poses, fixed_scan, sightings, inflation, say)
    if sightings.sightings and state.overlaps:  # the weight of a point relative to a target is known only now
        inflation = state.inflation()
        poses, state = _settled_poses(scans, pairs, poses, fixed_scan, sightings, inflation, say)
    every = np.concatenate([o.off_mm for o in state.overlaps] or [np.zeros(1)])
    nearest = np.concatenate([o.nearest_mm for o in state.overlaps] or [np.zeros(1)])
    overlap_covariance, other_covariance = state.covariances()
    return JointFit(
        poses,
        overlap_covariance + other_covariance,
        overlap_covariance,
        state.pivots,
        state.noise_mm,
        float(np.sqrt(np.mean(every**2))),
        float(np.median(nearest)),
        state.inflation(),
        sightings.with_distances(poses),
    )


@dataclass(frozen=True)
class _State:
    """The linear problem at some poses."""

    scans: Sequence[PreparedScan]
    overlaps: list[Overlap]
    pivots: Floats
    noise_mm: float
    targets_normal: Floats
    normal: Floats
    """Normal matrix with targets and prior knowledge: the error of a scan's position is smaller than its size."""
    gradient: Floats
    prior: Floats
    """[6 n]"""
    free: Columns
    inflation_used: float

    def step(self) -> Floats:
        step = np.zeros(len(self.gradient))
        step[self.free] = -cho_solve(
            cho_factor(self.normal[np.ix_(self.free, self.free)]), self.gradient[self.free]
        )
        return step

    def inflation(self) -> float:
        """Root of the mean ratio of two variances of the poses: the variance from sums over cells, divided by the
        variance for independent points.
        """
        if not self.overlaps:
            return 1.0
        points = self.normal - self.targets_normal
        bread = self._inverse(points * self.inflation_used**2)
        honest = bread @ (self._meat(bread, 1.0) + np.diag(self.prior)) @ bread
        return max(1.0, float(np.sqrt(np.median(np.diag(honest)[self.free] / np.diag(bread)[self.free]))))

    def covariances(self) -> tuple[Floats, Floats]:
        """[6 n, 6 n] covariances from errors of overlaps, and from errors of targets and prior knowledge."""
        bread = self._inverse(self.normal)
        meat = self._meat(bread, self.inflation_used)
        return bread @ meat @ bread, bread @ (self.targets_normal + np.diag(self.prior)) @ bread

    def _inverse(self, normal: Floats) -> Floats:
        """Return the inverse of a normal matrix [6 n, 6 n], with zeros for the fixed scan."""
        inverse = np.zeros_like(normal)
        inverse[np.ix_(self.free, self.free)] = np.linalg.inv(normal[np.ix_(self.free, self.free)])
        return inverse

    def _meat(self, bread: Floats, inflation: float) -> Floats:
        """[6 n, 6 n] covariance of the gradient, from sums over cells of space."""
        size_mm = float(np.median([scan.survey.size_mm for scan in self.scans])) / _CELLS_ACROSS
        weights = [_weights(overlap.off_mm, self.noise_mm) / inflation**2 for overlap in self.overlaps]
        return gradient_covariance(self.overlaps, weights, bread, size_mm)


def _settled_poses(
    scans: Sequence[PreparedScan],
    pairs: Sequence[tuple[int, int]],
    poses: list[Floats],
    fixed_scan: int,
    sightings: Sightings,
    inflation: float,
    say: Say,
) -> tuple[list[Floats], _State]:
    pitch_mm = scans[0].fine.pitch_mm
    reach_mm = 3.0 * pitch_mm
    for turn in range(_MOST_ROUNDS):
        say("adjusting all scans together", turn, _MOST_ROUNDS)
        state = _state(scans, pairs, poses, fixed_scan, sightings, inflation, reach_mm)
        reach_mm = max(1.5 * pitch_mm, 5.0 * state.noise_mm)
        step = state.step().reshape(-1, 6)
        poses = [stepped_motion(pose, step[k], state.pivots[k]) for k, pose in enumerate(poses)]
        if turn >= _LEAST_ROUNDS and np.abs(step[:, :3]).max() < _SETTLED_PITCHES * pitch_mm:
            break
    say("adjusting all scans together", _MOST_ROUNDS, _MOST_ROUNDS)
    return poses, state


def _state(
    scans: Sequence[PreparedScan],
    pairs: Sequence[tuple[int, int]],
    poses: Sequence[Floats],
    fixed_scan: int,
    sightings: Sightings,
    inflation: float,
    reach_mm: float,
) -> _State:
    count = len(scans)
    pivots = np.array(
        [moved_points(p, s.coarse.points_mm).mean(axis=0) for s, p in zip(scans, poses, strict=True)]
    )
    overlaps = [o for pair in pairs for o in _overlaps(scans, poses, pivots, *pair, reach_mm)]
    if not overlaps and not sightings.sightings:
        raise InputError("the scans do not overlap: there is nothing to adjust")
    pitch_mm = scans[0].fine.pitch_mm
    noise_mm = pitch_mm
    if overlaps:
        noise_mm = 1.4826 * float(np.median(np.abs(np.concatenate([o.off_mm for o in overlaps]))))
    noise_mm = max(noise_mm, 1e-4 * pitch_mm)
    normal, gradient = np.zeros((6 * count, 6 * count)), np.zeros(6 * count)
    for overlap in overlaps:
        columns = overlap.columns
        weighted_derivatives = overlap.derivatives * (_weights(overlap.off_mm, noise_mm) / inflation**2)[:, None]
        normal[np.ix_(columns, columns)] += weighted_derivatives.T @ overlap.derivatives
        gradient[columns] += weighted_derivatives.T @ overlap.off_mm
    targets_normal, targets_gradient = sightings.normal_equations(poses, pivots)
    prior = np.concatenate([np.r_[np.full(3, scan.survey.size_mm**-2.0), np.ones(3)] for scan in scans])
    free = np.ones(6 * count, bool)
    if not sightings.is_anchored:
        free[6 * fixed_scan : 6 * fixed_scan + 6] = False
    return _State(
        scans,
        overlaps,
        pivots,
        noise_mm,
        targets_normal,
        normal + targets_normal + np.diag(prior),
        gradient + targets_gradient,
        prior,
        np.flatnonzero(free),
        inflation,
    )


def _overlaps(
    scans: Sequence[PreparedScan],
    poses: Sequence[Floats],
    pivots: Floats,
    scan_number: int,
    other_number: int,
    reach_mm: float,
) -> list[Overlap]:
    """Return the points of each of two scans that lie on the surface of the other."""
    signless = "none" in (scans[scan_number].viewpoint.stand, scans[other_number].viewpoint.stand)
    overlaps = []
    for first, second in ((scan_number, other_number), (other_number, scan_number)):
        first_from_second = inverse_of(poses[first]) @ poses[second]
        normals, off_mm, points, nearest_mm = distances(
            scans[first].fine, scans[second].fine, first_from_second, reach_mm, signless=signless
        )
        if len(off_mm) >= _LEAST_PAIRS:
            normals, points = normals @ poses[first][:3, :3].T, moved_points(poses[first], points)
            derivatives = np.concatenate(
                [
                    -normals,
                    -np.cross(points - pivots[first], normals),
                    normals,
                    np.cross(points - pivots[second], normals),
                ],
                axis=1,
            )
            overlaps.append(Overlap(first, second, derivatives, off_mm, points, nearest_mm))
    return overlaps


def distances(
    first: Cloud, second: Cloud, first_from_second: Floats, reach_mm: float, *, signless: bool
) -> tuple[Floats, Floats, Floats, Floats]:
    """Return for points of the second scan near the first one: normals [n, 3] there, distances along these [n],
    points [n, 3] in the first scan's frame, and distances to its points [n]."""
    moved_mm = moved_points(first_from_second, second.points_mm)
    away_mm, nearest = first.tree.query(moved_mm, distance_upper_bound=reach_mm)
    hit = np.flatnonzero(np.isfinite(away_mm))
    facing = np.sum((second.normals[hit] @ first_from_second[:3, :3].T) * first.normals[nearest[hit]], axis=1)
    hit = hit[(np.abs(facing) if signless else facing) > _SAME_SIDE]
    off_mm = np.sum((moved_mm[hit] - first.points_mm[nearest[hit]]) * first.normals[nearest[hit]], axis=1)
    beside = away_mm[hit] ** 2 - off_mm**2 < (_BESIDE_PITCHES * first.pitch_mm) ** 2
    steep = np.minimum(first.incidence[nearest[hit]], second.incidence[hit])
    keep = beside & (steep > _STEEP)
    if keep.sum() < _LEAST_PAIRS:
        keep = beside
    hit, off_mm = hit[keep], off_mm[keep]
    return first.normals[nearest[hit]], off_mm, moved_mm[hit], away_mm[hit]


def _weights(off_mm: Floats, noise_mm: float) -> Floats:
    return np.asarray(np.minimum(1.0, _HUBER * noise_mm / np.maximum(np.abs(off_mm), 1e-12)) / noise_mm**2)
