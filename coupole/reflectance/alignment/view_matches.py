"""Disagreement of two views about the place of a spot on the surface, by registration of their pictures on the
mesh.

A window of one view's picture is compared with the other view's picture, warped by the mesh into the first view.
The best whole shift has the greatest correlation. Gauss-Newton steps with gain and offset refine it (Lucas and
Kanade, IJCAI 1981). They also give its covariance, from the window's gradients and the residual.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, fields
from itertools import product

import numpy as np
from numpy.typing import NDArray

from coupole.kernels import kernel
from coupole.reflectance.alignment.view_surface import ViewSurface

Floats = NDArray[np.float64]
Said = Callable[[str, int, int], None]

SMALLEST_HALF, LARGEST_HALF, WINDOWS_ACROSS = 6, 16, 64
"""A window has 2 half + 1 blocks on a side. `half` is 1/64 of a picture's width, within bounds."""
MOST_PLACES = 4000
MOST_REACH = 48
"""Number of blocks that are searched in each direction."""
LEAST_CORRELATION = 0.7
_LEAST_SHARE = 0.8
"""Least share of a window's blocks that both views must show."""
_MARGIN = 3
"""Blocks around the searched area, for interpolation."""
_HIDDEN_BEYOND = 4.0
"""Largest distance, in blocks that face the view, between a place and the surface that the other view sees there.
Beyond it the place is hidden."""
_STEPS = 25
_SETTLED = 1e-3
_MOST_FINER = 1.5
"""Largest distance in blocks from the best whole shift to the refined one."""
_WORST_U = 0.5
"""Largest standard uncertainty of a shift in its worst direction, in blocks. A window above it has too little
texture."""


@dataclass(frozen=True)
class Matches:
    """Spots of the surface, each seen by a reference view and another view."""

    reference: NDArray[np.int64]
    other: NDArray[np.int64]
    """[n] numbers of views."""
    blocks: Floats
    """[n, 2] block of the spot in the reference's picture."""
    points_mm: Floats
    """[n, 3] place of the spot by the reference, on a plane through the mesh around it, base frame."""
    normals: Floats
    """[n, 3] normals of these planes."""
    matched_blocks: Floats
    """[n, 2] block of the other view that shows the spot."""
    expected_blocks: Floats
    """[n, 2] block of the other view that shows the spot by the geometry."""
    covariance: Floats
    """[n, 2, 2] covariance of `matched_blocks`, in squared blocks, from noise and texture."""
    shifts_mm: Floats
    """[n, 3] shifts from the spot's place by the reference to its place by the other view."""

    @property
    def apart_mm(self) -> Floats:
        """[n]"""
        lengths_mm: Floats = np.linalg.norm(self.shifts_mm, axis=1)
        return lengths_mm

    def some(self, match_mask: NDArray[np.bool_]) -> Matches:
        return Matches(*(getattr(self, attribute.name)[match_mask] for attribute in fields(self)))


def match_views(views: Sequence[ViewSurface], search_mm: float, threads: int, say: Said) -> Matches:
    """Compare, at each place, all views with the view that sees it in the greatest detail, over shifts of up to
    `search_mm`. The windows of a view do not overlap."""
    half = int(np.clip(views[0].picture.shape[1] / WINDOWS_ACROSS, SMALLEST_HALF, LARGEST_HALF))
    places = [_places(number, views, half) for number in range(len(views))]
    total = sum(len(part.blocks) for part in places)
    every = max(1, -(-total // MOST_PLACES))
    some = [part.every_nth(every) for part in places]
    jobs = [(a, b) for a, b in product(range(len(views)), repeat=2) if a != b]
    pair_matches: list[Matches] = []
    with ThreadPoolExecutor(threads) as pool:
        for part in pool.map(lambda pair: _match_pair(views, some[pair[0]], pair, half, search_mm), jobs):
            pair_matches.append(part)
            say("pairs of views", len(pair_matches), len(jobs))
    return Matches(*(np.concatenate([getattr(part, f.name) for part in pair_matches]) for f in fields(Matches)))


@dataclass(frozen=True)
class _Places:
    """Windows of a view at places that no other view sees in more detail."""

    blocks: NDArray[np.int64]
    """[n, 2] middles of windows: column, row."""
    points_mm: Floats
    normals: Floats
    detail: Floats
    """[n, views] blocks per square millimetre; 0 for views that do not see the place."""

    def every_nth(self, every: int) -> _Places:
        return _Places(self.blocks[::every], self.points_mm[::every], self.normals[::every], self.detail[::every])


def _places(number: int, views: Sequence[ViewSurface], half: int) -> _Places:
    """Return windows side by side, each with the plane through the mesh in it."""
    view, side = views[number], 2 * half + 1
    height, width = view.picture.shape
    blocks, middles, normals = [], [], []
    for row, column in product(range(half, height - half, side), range(half, width - half, side)):
        points = view.points_mm[row - half : row + half + 1, column - half : column + half + 1].reshape(-1, 3)
        points = points[np.isfinite(points[:, 0])].astype(np.float64)
        if len(points) < _LEAST_SHARE * side**2:
            continue
        middle = points.mean(axis=0)
        normal = np.linalg.svd(points - middle, full_matrices=False)[2][2]
        towards = np.sign(normal @ (view.base_from_camera[:3, 3] - middle))
        blocks.append((column, row))
        middles.append(middle)
        normals.append(towards * normal)
    at, planes = np.array(blocks, np.int64).reshape(-1, 2), np.array(normals).reshape(-1, 3)
    points_mm = _on_planes(view, at.astype(float), np.array(middles).reshape(-1, 3), planes)
    nearest = view.points_mm[at[:, 1], at[:, 0]].astype(np.float64)
    detail = np.stack([surface.detail(nearest, planes) for surface in views], axis=1)
    best = (detail[:, number] > 0) & (detail.argmax(axis=1) == number)
    return _Places(at[best], points_mm[best], planes[best], detail[best])


def _on_planes(view: ViewSurface, blocks: Floats, points_mm: Floats, normals: Floats) -> Floats:
    """[n, 3] points where rays of blocks meet planes through points."""
    ways, eye = view.rays(blocks), view.base_from_camera[:3, 3]
    far = np.sum((points_mm - eye) * normals, axis=1) / np.sum(ways * normals, axis=1)
    places_mm: Floats = eye + far[:, None] * ways
    return places_mm


def _match_pair(
    views: Sequence[ViewSurface], places: _Places, pair: tuple[int, int], half: int, search_mm: float
) -> Matches:
    first, second = views[pair[0]], views[pair[1]]
    candidates = np.flatnonzero(places.detail[:, pair[1]] > 0)
    reach = np.ceil(search_mm * np.sqrt(places.detail[candidates, pair[0]]))
    shifts = [
        _shift(first, second, places.blocks[place], half, min(max(int(blocks), 2), MOST_REACH))
        for place, blocks in zip(candidates, reach, strict=True)
    ]
    at = candidates[[estimate is not None for estimate in shifts]]
    shift = np.array([estimate[0] for estimate in shifts if estimate is not None]).reshape(-1, 2)
    covariance = np.array([estimate[1] for estimate in shifts if estimate is not None]).reshape(-1, 2, 2)
    points, normals, blocks = places.points_mm[at], places.normals[at], places.blocks[at].astype(float)
    matched_mm = _on_planes(first, blocks + shift, points, normals)
    matched_px, computed_px = second.project(matched_mm), second.project(points)
    steps = [_on_planes(first, blocks + step, points, normals) for step in np.eye(2)]
    by_shift = np.stack([second.project(step) - computed_px for step in steps], axis=-1)
    covariance = by_shift @ covariance @ np.swapaxes(by_shift, 1, 2)
    reference, other_view = (np.full(len(at), number, np.int64) for number in pair)
    return Matches(
        reference, other_view, blocks, points, normals, matched_px, computed_px, covariance, matched_mm - points
    )


def _shift(
    first: ViewSurface, second: ViewSurface, middle: NDArray[np.int64], half: int, reach: int
) -> tuple[Floats, Floats] | None:
    """[2] shift in blocks of a window of the first view in the second view, and its covariance [2, 2]; None if the
    windows are too unlike or have too little texture."""
    column, row = map(int, middle)
    window = slice(row - half, row + half + 1), slice(column - half, column + half + 1)
    template, points_mm = first.picture[window], first.points_mm[(*window, 0)]
    lens = second.lens.vector()
    second_picture = _warped_picture(
        first.points_mm, row, column, half + reach + _MARGIN, second.picture, second.points_mm,
        second.base_from_camera, lens,
    )  # fmt: skip
    best, right, down = _best_shift(template, points_mm, second_picture, reach)
    at_border = max(abs(right), abs(down)) >= reach  # the true one may lie beyond
    if best < LEAST_CORRELATION or at_border:
        return None
    good, x, y, covariance = _finer(template, points_mm, second_picture, reach, right, down)
    if not good or np.linalg.eigvalsh(covariance)[1] > _WORST_U**2:
        return None
    return np.array([x, y]), covariance


@kernel
def _warped_picture(points, row, column, half, other_picture, other_points, pose, lens):  # type: ignore[no-untyped-def]
    """[side, side] values of the other view at the places of the first view's blocks; NaN where it has none."""
    side = 2 * half + 1
    values, inside = np.full((side, side), np.nan), np.empty(3)
    fx, fy, cx, cy, k1, k2, p1, p2, k3 = lens
    for j in range(side):
        for i in range(side):
            y, x = row - half + j, column - half + i
            if not (0 <= y < points.shape[0] and 0 <= x < points.shape[1]) or not np.isfinite(points[y, x, 0]):
                continue
            for k in range(3):
                inside[k] = 0.0
                for m in range(3):
                    inside[k] += pose[m, k] * (points[y, x, m] - pose[m, 3])
            if inside[2] <= 0.0:
                continue
            u, v = inside[0] / inside[2], inside[1] / inside[2]
            r2 = u * u + v * v
            g = 1.0 + r2 * (k1 + r2 * (k2 + r2 * k3))
            across = fx * (u * g + 2 * p1 * u * v + p2 * (r2 + 2 * u * u)) + cx
            down = fy * (v * g + p1 * (r2 + 2 * v * v) + 2 * p2 * u * v) + cy
            near_x, near_y = int(np.round(across)), int(np.round(down))
            if 2 <= near_x < other_picture.shape[1] - 2 and 2 <= near_y < other_picture.shape[0] - 2:
                off = 0.0
                for k in range(3):
                    off += (other_points[near_y, near_x, k] - points[y, x, k]) ** 2
                if off < (_HIDDEN_BEYOND * inside[2] / fx) ** 2:  # not if it is NaN
                    values[j, i] = _cubic(other_picture, across, down)
    return values


@kernel
def _cubic(values, x, y):  # type: ignore[no-untyped-def]
    """Interpolate by Keys' kernel (IEEE Trans. ASSP 29, 1981; a = -1/2) from 4 x 4 values."""
    left_column, top = int(np.floor(x)) - 1, int(np.floor(y)) - 1
    total = 0.0
    for j in range(4):
        line = 0.0
        for i in range(4):
            line += _keys(x - (left_column + i)) * values[top + j, left_column + i]
        total += _keys(y - (top + j)) * line
    return total


@kernel
def _keys(far):  # type: ignore[no-untyped-def]
    s = abs(far)
    if s <= 1.0:
        return (1.5 * s - 2.5) * s * s + 1.0
    return ((-0.5 * s + 2.5) * s - 4.0) * s + 2.0


@kernel
def _best_shift(template, reference_points_mm, warped_picture, reach):  # type: ignore[no-untyped-def]
    """Return the greatest correlation over whole shifts, and its shift."""
    side = len(template)
    best, right, down = -1.0, 0, 0
    for dy in range(-reach, reach + 1):
        for dx in range(-reach, reach + 1):
            n, a, b, aa, bb, ab = 0, 0.0, 0.0, 0.0, 0.0, 0.0
            for j in range(side):
                for i in range(side):
                    p, q = template[j, i], warped_picture[_MARGIN + reach + dy + j, _MARGIN + reach + dx + i]
                    if np.isfinite(q) and np.isfinite(reference_points_mm[j, i]):
                        n += 1
                        a += p
                        b += q
                        aa += p * p
                        bb += q * q
                        ab += p * q
            if n < _LEAST_SHARE * side * side:
                continue
            variance_product = (aa - a * a / n) * (bb - b * b / n)
            if variance_product > 0.0 and (ab - a * b / n) > best * np.sqrt(variance_product):
                best, right, down = (ab - a * b / n) / np.sqrt(variance_product), dx, dy
    return best, right, down


@kernel
def _finer(template, reference_points_mm, warped_picture, reach, right, down):  # type: ignore[no-untyped-def]
    """Refine a whole shift; return whether the steps converged, the shift, and its covariance [2, 2]."""
    side, first = len(template), _MARGIN + reach
    x, y, gain, offset = float(right), float(down), 1.0, 0.0
    is_converged, change = False, np.zeros(4)
    for step in range(_STEPS):
        normal, rhs, square_sum, count = np.zeros((4, 4)), np.zeros(4), 0.0, 0
        for j in range(side):
            for i in range(side):
                at_x, at_y = first + x + i, first + y + j
                q = _cubic(warped_picture, at_x, at_y)
                slope_x = _cubic(warped_picture, at_x + 0.5, at_y) - _cubic(warped_picture, at_x - 0.5, at_y)
                slope_y = _cubic(warped_picture, at_x, at_y + 0.5) - _cubic(warped_picture, at_x, at_y - 0.5)
                if not np.isfinite(q + slope_x + slope_y + reference_points_mm[j, i]):
                    continue
                off = template[j, i] - gain * q - offset
                row = (gain * slope_x, gain * slope_y, q, 1.0)
                for k in range(4):
                    rhs[k] += row[k] * off
                    for m in range(4):
                        normal[k, m] += row[k] * row[m]
                square_sum += off * off
                count += 1
        if count < _LEAST_SHARE * side * side or not _invert(normal):
            break
        if is_converged:
            return True, x, y, normal[:2, :2] * (square_sum / (count - 4))
        for k in range(4):
            change[k] = 0.0
            for m in range(4):
                change[k] += normal[k, m] * rhs[m]
        x, y, gain, offset = x + change[0], y + change[1], gain + change[2], offset + change[3]
        if max(abs(x - right), abs(y - down)) > _MOST_FINER:
            break
        is_converged = step > 0 and max(abs(change[0]), abs(change[1])) < _SETTLED
    return False, x, y, np.zeros((2, 2))


@kernel
def _invert(matrix):  # type: ignore[no-untyped-def]
    """Invert a positive definite matrix in place (Gauss and Jordan); return False if it is not positive
    definite."""
    for k in range(len(matrix)):
        pivot = matrix[k, k]
        if not pivot > 0.0:
            return False
        matrix[k, k] = 1.0
        for j in range(len(matrix)):
            matrix[k, j] /= pivot
        for i in range(len(matrix)):
            if i != k:
                factor = matrix[i, k]
                matrix[i, k] = 0.0
                for j in range(len(matrix)):
                    matrix[i, j] -= factor * matrix[k, j]
    return True
