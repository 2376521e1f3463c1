"""Motion of one scan to another: found by features without a first guess, refined, and verified.

Motions come from KISS-Matcher (Lim, Kim, Shin, Sattler, Myung, ICRA 2025: Faster-PFH features, pruning by a
graph of consistent pairs, a solver by graduated non-convexity) and are refined by generalized ICP (Koide,
small_gicp, JOSS 2024). A motion counts only if enough of the surfaces lie on each other, with normals on the
same side, and if next to no point of one scan lies in the space that the other's scanner saw through.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from coupole.scan.registration.extra import registration_libraries
from coupole.scan.registration.prepared_scan import Cloud, PreparedScan
from coupole.scan.registration.viewpoint import Floats

LEAST_OVERLAP = 0.12
"""Share of the smaller scan that must lie on the other one."""
MOST_CONTRADICTED = 0.02
"""Share of the points in rays of the other scanner that may lie before its surface: edges of noise, not of
pose."""
_LEAST_AGREED = 5
"""Pairs of features that agree on a motion, below which it is not even refined."""
_ROUGH_OVERLAP, _ROUGH_CONTRADICTED = 0.06, 0.15
"""Least overlap and largest contradicted share of a motion that is worth refining on the fine clouds."""
_SAME_SIDE = 0.7
"""Cosine between normals of points that lie on each other."""
_COARSE_ITERATIONS, _FINE_ITERATIONS = 40, 12


@dataclass(frozen=True)
class Fit:
    """Measures of how well two scans lie on each other."""

    overlap: float
    """Share of the smaller scan's places that lie on the other scan."""
    contradicted_share: float
    """Share of points, seen by the other scanner, that lie where it saw nothing; 0 where neither viewpoint is
    known."""
    rms_mm: float
    """Root mean square distance along the normals, over the overlap."""
    places: int
    """Number of places of the overlap, on the coarse grid."""

    @property
    def holds(self) -> bool:
        return self.overlap >= LEAST_OVERLAP and self.contradicted_share <= MOST_CONTRADICTED


@dataclass(frozen=True)
class PairMotion:
    """`first_from_second`, 4x4 in mm, of two scans by their numbers."""

    first: int
    second: int
    first_from_second: Floats
    fit: Fit
    found_by: str
    """`features`, or `prediction` by poses that were known already."""


def match_by_features(first: Cloud, second: Cloud) -> tuple[Floats, int]:
    """`first_from_second` without a first guess, and the number of pairs of features that agree on it."""
    _, kiss_matcher = registration_libraries()
    scale = 1.0 / first.pitch_mm  # its noise bounds are made for cells of one unit
    matcher = kiss_matcher.KISSMatcher(kiss_matcher.KISSMatcherConfig(voxel_size=1.0, use_voxel_sampling=False))
    estimate = matcher.estimate(
        list((second.points_mm * scale).astype(np.float32)), list((first.points_mm * scale).astype(np.float32))
    )
    motion = np.eye(4)
    motion[:3, :3], motion[:3, 3] = estimate.rotation, np.asarray(estimate.translation).reshape(3) / scale
    return motion, int(matcher.get_num_final_inliers())


def refined_motion(
    first: Cloud, second: Cloud, first_from_second: Floats, reach_mm: float, iterations: int
) -> Floats:
    """The motion by generalized ICP, with points as far apart as `reach_mm` at first."""
    small_gicp, _ = registration_libraries()
    alignment = small_gicp.align(
        _gicp_cloud(first),
        _gicp_cloud(second),
        _tree(first),
        first_from_second,
        max_correspondence_distance=reach_mm,
        max_iterations=iterations,
        rotation_epsilon=1e-4,
        translation_epsilon=1e-2 * first.pitch_mm,
    )
    return np.asarray(alignment.T_target_source)


def _gicp_cloud(cloud: Cloud) -> Any:
    """The cloud as the library's own, kept beside it."""
    small_gicp, _ = registration_libraries()
    if "_library_cloud" not in cloud.__dict__:
        library_cloud = small_gicp.PointCloud(cloud.points_mm)
        small_gicp.estimate_covariances(library_cloud, num_neighbors=min(12, len(cloud.points_mm)))
        cloud.__dict__["_library_cloud"] = library_cloud
        cloud.__dict__["_library_tree"] = small_gicp.KdTree(library_cloud)
    return cloud.__dict__["_library_cloud"]


def _tree(cloud: Cloud) -> Any:
    _gicp_cloud(cloud)
    return cloud.__dict__["_library_tree"]


def fit_of(first: PreparedScan, second: PreparedScan, first_from_second: Floats, near_mm: float) -> Fit:
    """Measure how well two scans lie on each other: points within `near_mm` along the normals count."""
    moved_mm = second.coarse.points_mm @ first_from_second[:3, :3].T + first_from_second[:3, 3]
    turned_normals = second.coarse.normals @ first_from_second[:3, :3].T
    reach_mm = 1.5 * first.coarse.pitch_mm
    away_mm, nearest = first.coarse.tree.query(moved_mm, distance_upper_bound=reach_mm)
    near_rows = np.flatnonzero(np.isfinite(away_mm))
    nearest = nearest[near_rows]
    normals = first.coarse.normals[nearest]
    off_mm = np.sum((moved_mm[near_rows] - first.coarse.points_mm[nearest]) * normals, axis=1)
    facing = np.sum(turned_normals[near_rows] * normals, axis=1)
    if first.viewpoint.stand == "none" or second.viewpoint.stand == "none":
        facing = np.abs(facing)
    on = (np.abs(off_mm) < near_mm) & (facing > _SAME_SIDE)
    places = int(on.sum())
    smaller = min(len(first.coarse.points_mm), len(second.coarse.points_mm))
    rms_mm = float(np.sqrt(np.mean(off_mm[on] ** 2))) if places else float("inf")
    return Fit(places / smaller, contradiction(first, second, first_from_second, near_mm), rms_mm, places)


def contradiction(
    first: PreparedScan, second: PreparedScan, first_from_second: Floats, near_mm: float, every: int = 1
) -> float:
    """Share of points that the other scanner sees by its rays, and that lie before the surface where these ended:
    the larger of both scans'. Only each `every`-th point is looked at."""
    there = second.coarse.points_mm[::every] @ first_from_second[:3, :3].T + first_from_second[:3, 3]
    back = (first.coarse.points_mm[::every] - first_from_second[:3, 3]) @ first_from_second[:3, :3]
    return max(_contradicted_share(first, there, near_mm), _contradicted_share(second, back, near_mm))


def _contradicted_share(seer: PreparedScan, points_mm: Floats, near_mm: float) -> float:
    if seer.picture is None:
        return 0.0
    in_view, before = seer.picture.in_front(points_mm, 2.0 * near_mm)
    return float(before.sum() / max(1, in_view.sum()))


def match(number_first: int, number_second: int, first: PreparedScan, second: PreparedScan) -> PairMotion | None:
    """The motion between two scans of which nothing is known, if one is found that holds."""
    guess, agreeing_count = match_by_features(first.coarse, second.coarse)
    if agreeing_count < _LEAST_AGREED:
        return None
    return improve(number_first, number_second, first, second, guess, "features")


def improve(
    number_first: int,
    number_second: int,
    first: PreparedScan,
    second: PreparedScan,
    guess: Floats,
    found_by: str,
) -> PairMotion | None:
    """The motion between two scans from one that is about right, if it holds."""
    pitch_mm = first.coarse.pitch_mm
    motion = refined_motion(first.coarse, second.coarse, guess, 2.5 * pitch_mm, _COARSE_ITERATIONS)
    fit = fit_of(first, second, motion, 0.7 * pitch_mm)
    if fit.overlap < _ROUGH_OVERLAP or fit.contradicted_share > _ROUGH_CONTRADICTED:
        return None
    motion = refined_motion(
        first.fine, second.fine, motion, 1.5 * first.fine.pitch_mm + fit.rms_mm, _FINE_ITERATIONS
    )
    fit = fit_of(first, second, motion, 0.7 * pitch_mm)
    return PairMotion(number_first, number_second, motion, fit, found_by) if fit.holds else None
