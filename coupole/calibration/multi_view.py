"""Points in space from detections of several cameras of known pose, without known correspondences.

If two rays of different views pass close to each other, they give a candidate. It is accepted if enough other
views have a detection at its projection. Each detection is used once, by the candidate with the most views.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import combinations

import numpy as np

from coupole.calibration import optics
from coupole.calibration.optics import Intrinsics
from coupole.calibration.rotations import Floats, inverses
from coupole.errors import InputError

LEAST_VIEWS = 3
_NEWTON_STEPS = 12
_REFINEMENTS = 4


@dataclass(frozen=True)
class CameraView:
    """One picture: the camera's pose, and the pixels [n, 2] of the detections."""

    name: str
    base_from_camera: Floats
    pixels: Floats


@dataclass(frozen=True)
class SeenPoint:
    """One point and its detections: numbers of the views, and of the pixels in them."""

    base_mm: Floats
    views: tuple[int, ...]
    places: tuple[int, ...]
    rms_px: float


def unproject(pixels: Floats, intrinsics: Intrinsics) -> Floats:
    """Return unit directions [n, 3] in the camera frame that project to pixels [n, 2] (Newton's method).

    Raises InputError where the distortion cannot be inverted.
    """
    vector = intrinsics.vector()
    rays = np.concatenate([(pixels - vector[2:4]) / vector[:2], np.ones((len(pixels), 1))], axis=1)
    for _ in range(_NEWTON_STEPS):
        image = optics.project(rays, vector)
        rays[:, :2] += np.linalg.solve(image.by_point[:, :, :2], (pixels - image.pixels)[:, :, None])[:, :, 0]
    if len(pixels) and not np.abs(optics.project(rays, vector).pixels - pixels).max() < 1e-6:
        raise InputError("camera record: its distortion cannot be undone at the border of the image")
    directions: Floats = rays / np.linalg.norm(rays, axis=1, keepdims=True)
    return directions


def seen_points(
    views: Sequence[CameraView],
    intrinsics: Intrinsics,
    *,
    tolerance_px: float,
    depth_mm: tuple[float, float],
    least_views: int = LEAST_VIEWS,
) -> list[SeenPoint]:
    """Return points [base frame] on which at least `least_views` views agree within a tolerance. Points with the
    most views are first.

    `depth_mm`: least and largest distance in front of a camera.
    """
    vector, focal_px = intrinsics.vector(), float(intrinsics.fx)
    camera_from_base = inverses(np.array([view.base_from_camera for view in views]))
    rays = [
        unproject(view.pixels, intrinsics) @ view.base_from_camera[:3, :3].T
        if len(view.pixels)
        else np.zeros((0, 3))
        for view in views
    ]
    candidates = [
        _crossings(views[a], rays[a], views[b], rays[b], depth_mm, tolerance_px / focal_px)
        for a, b in combinations(range(len(views)), 2)
    ]
    points = np.concatenate(candidates) if candidates else np.zeros((0, 3))
    for _ in range(_REFINEMENTS):
        if not len(points):
            return []
        nearest, off_px = _nearest(points, views, camera_from_base, vector, depth_mm)
        agreeing = off_px <= tolerance_px
        points = _refined_points(points, nearest, agreeing, rays, views)
        enough = agreeing.sum(axis=1) >= least_views
        points = points[enough]
    nearest, off_px = _nearest(points, views, camera_from_base, vector, depth_mm)
    return _best_points(points, nearest, off_px, tolerance_px, least_views)


def _crossings(
    a: CameraView,
    rays_a: Floats,
    b: CameraView,
    rays_b: Floats,
    depth_mm: tuple[float, float],
    tolerance_rad: float,
) -> Floats:
    """Return midpoints [n, 3] of all pairs of rays that intersect within the tolerance in pixels, at allowed
    depths."""
    apart = b.base_from_camera[:3, 3] - a.base_from_camera[:3, 3]
    cosine = rays_a @ rays_b.T
    along_a, along_b = (rays_a @ apart)[:, None], (rays_b @ apart)[None]
    sine2 = np.maximum(1 - cosine**2, 1e-12)
    s, t = (along_a - cosine * along_b) / sine2, (cosine * along_a - along_b) / sine2
    on_a = a.base_from_camera[:3, 3] + s[..., None] * rays_a[:, None]
    on_b = b.base_from_camera[:3, 3] + t[..., None] * rays_b[None]
    gap_mm = np.linalg.norm(on_a - on_b, axis=2)
    near, far = depth_mm
    good = (s > near) & (s < far) & (t > near) & (t < far) & (gap_mm < tolerance_rad * (s + t)) & (sine2 > 1e-4)
    return np.asarray((on_a[good] + on_b[good]) / 2)


def _nearest(
    points: Floats,
    views: Sequence[CameraView],
    camera_from_base: Floats,
    vector: Floats,
    depth_mm: tuple[float, float],
) -> tuple[np.ndarray[tuple[int, int], np.dtype[np.intp]], Floats]:
    """Find for each point and view the detection nearest to the point's projection [n, views], and its distance,
    px."""
    nearest = np.zeros((len(points), len(views)), np.intp)
    off_px = np.full((len(points), len(views)), np.inf)
    for number, view in enumerate(views):
        if not len(view.pixels):
            continue
        in_camera = points @ camera_from_base[number, :3, :3].T + camera_from_base[number, :3, 3]
        visible = (in_camera[:, 2] > depth_mm[0] / 2) & (in_camera[:, 2] < 2 * depth_mm[1])
        if not visible.any():
            continue
        pixels = optics.project(in_camera[visible], vector).pixels
        distances = np.linalg.norm(pixels[:, None] - view.pixels[None], axis=2)
        nearest[visible, number] = distances.argmin(axis=1)
        off_px[visible, number] = distances.min(axis=1)
    return nearest, off_px


def _refined_points(
    points: Floats,
    nearest: np.ndarray[tuple[int, int], np.dtype[np.intp]],
    agreeing: np.ndarray[tuple[int, int], np.dtype[np.bool_]],
    rays: Sequence[Floats],
    views: Sequence[CameraView],
) -> Floats:
    """Return the points nearest to all rays that agree (least squares of distances)."""
    normal, side = np.zeros((len(points), 3, 3)), np.zeros((len(points), 3))
    for number, view in enumerate(views):
        rows = np.flatnonzero(agreeing[:, number])
        if not len(rows):
            continue
        ray = rays[number][nearest[rows, number]]
        across = np.eye(3) - ray[:, :, None] * ray[:, None, :]
        normal[rows] += across
        side[rows] += across @ view.base_from_camera[:3, 3]
    solvable = agreeing.sum(axis=1) >= 2
    moved_points = points.copy()
    moved_points[solvable] = np.linalg.solve(normal[solvable], side[solvable][:, :, None])[:, :, 0]
    return moved_points


def _best_points(
    points: Floats,
    nearest: np.ndarray[tuple[int, int], np.dtype[np.intp]],
    off_px: Floats,
    tolerance_px: float,
    least_views: int,
) -> list[SeenPoint]:
    """Return candidates by number of views, then by residual. Each point has only detections that no earlier point
    uses."""
    agreeing = off_px <= tolerance_px
    rms_px = np.sqrt(np.where(agreeing, off_px, 0.0) ** 2).mean(axis=1)
    taken_pairs: set[tuple[int, int]] = set()
    agreeing_points = []
    for row in np.lexsort((rms_px, -agreeing.sum(axis=1))):
        pairs = [(int(v), int(nearest[row, v])) for v in np.flatnonzero(agreeing[row])]
        free = [pair for pair in pairs if pair not in taken_pairs]
        if len(free) < least_views or 2 * len(free) < len(pairs):
            continue
        taken_pairs.update(free)
        residual_px = float(np.sqrt(np.mean([off_px[row, v] ** 2 for v, _ in free])))
        agreeing_points.append(
            SeenPoint(points[row], tuple(v for v, _ in free), tuple(p for _, p in free), residual_px)
        )
    return agreeing_points
