"""Motion of one scan to another: found by features without an initial pose, refined, and verified.

Motions come from KISS-Matcher (Lim, Kim, Shin, Sattler, Myung, ICRA 2025: Faster-PFH features, pruning by a graph
of consistent pairs, a solver by graduated non-convexity) and are refined by generalized ICP (Koide, small_gicp,
JOSS 2024). A motion is accepted on two conditions. Enough of the surfaces must lie on each other, with normals on
the same side. And almost no point of one scan may lie in the space that the other's scanner saw through.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from coupole.scan.registration.extra import registration_libraries
from coupole.scan.registration.prepared_scan import Cloud, PreparedScan
from coupole.scan.registration.viewpoint import Floats

LEAST_OVERLAP = 0.12
"""Least share of the smaller scan that must lie on the other one."""
MOST_CONTRADICTED = 0.02
"""Greatest share of the points in rays of the other scanner that may lie before its surface. Such points come from
noise at edges, not from a wrong pose."""
_LEAST_AGREED = 5
"""Least number of feature pairs that must agree on a motion before it is refined."""
_ROUGH_OVERLAP, _ROUGH_CONTRADICTED = 0.06, 0.15
"""Least overlap and greatest contradicted share of a motion that is refined on the fine clouds."""
_SAME_SIDE = 0.7
"""Least cosine between the normals of points that lie on each other."""
_COARSE_ITERATIONS, _FINE_ITERATIONS = 40, 12


@dataclass(frozen=True)
class Fit:
    """Measures of the agreement of two scans."""

    overlap: float
    """Share of the smaller scan's cells that lie on the other scan."""
    contradicted_share: float
    """Share of points, seen by the other scanner, that lie where it saw nothing; 0 if no viewpoint is known."""
    rms_mm: float
    """Root mean square distance along the normals, over the overlap."""
    places: int
    """Number of cells of the overlap, on the coarse grid."""

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
    """`features`, or `prediction` from poses that were known already."""


def match_by_features(first: Cloud, second: Cloud) -> tuple[Floats, int]:
    """Return `first_from_second` without an initial pose, and the number of feature pairs that agree on it."""
    _, kiss_matcher = registration_libraries()
    scale = 1.0 / first.pitch_mm  # the library's noise bounds assume cells of one unit
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
    """Return the motion after generalized ICP, in which points may at first be `reach_mm` apart."""
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
    """Return the cloud in the form of the library; it is stored with the cloud."""
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
    """Measure the agreement of two scans: points within `near_mm` along the normals count."""
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
    """Return the share of points that lie in the other scanner's rays, but before the surface where these ended:
    the larger share of both scans. Only every `every`-th point is tested."""
    there = second.coarse.points_mm[::every] @ first_from_second[:3, :3].T + first_from_second[:3, 3]
    back = (first.coarse.points_mm[::every] - first_from_second[:3, 3]) @ first_from_second[:3, :3]
    return max(_contradicted_share(first, there, near_mm), _contradicted_share(second, back, near_mm))


def _contradicted_share(seer: PreparedScan, points_mm: Floats, near_mm: float) -> float:
    if seer.picture is None:
        return 0.0
    in_view, before = seer.picture.in_front(points_mm, 2.0 * near_mm)
    return float(before.sum() / max(1, in_view.sum()))


def match(number_first: int, number_second: int, first: PreparedScan, second: PreparedScan) -> PairMotion | None:
    """Find the motion between two scans without prior knowledge; None if no accepted motion is found."""
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
    """Refine an approximate motion between two scans; None if the result is not accepted."""
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
