"""Corners of a board to a few thousandths of a pixel: a model of two crossing edges, fitted to RAW pixels.

About a corner at q the values are, with S_k the image of edge k integrated over a pixel's square,

    (m + c ((2 S_1 - 1) (2 S_2 - 1) + r)) (1 + g (p - q))

for level m, contrast c and a gradient g of the light. An edge under the angle a, blurred by a Gaussian of sigma,
is seen by a square pixel as S(d) = [G(d + s) - G(d + t) - G(d - t) + G(d - s)] / (|cos a| |sin a|), where d is the
distance of pixel and edge, s and t are half the sum and the difference of |cos a| and |sin a|, and G'' is the
normal distribution (two boxes, then a Gaussian). So sharp edges have no error that depends on their place between
pixels, and no colour needs to be interpolated: pixels of other colours are not used. The term r is the effect of
blur where edges do not cross at 90 degrees: of the sign's expectation over two normal variables with the
correlation k = n_1 n_2 of the edges' normals, the terms up to k^3 of the tetrachoric series (Pearson 1900).
"""

from __future__ import annotations

import math
import os
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from typing import Any

import numba
import numpy as np
from numpy.typing import NDArray
from scipy.special import ndtr

from coupole.calibration.rotations import Floats

_UNKNOWNS = 9
_LEAST_PIXELS = 24
_X, _Y, _FIRST, _SECOND, _SIGMA, _LEVEL, _CONTRAST, _ALONG_X, _ALONG_Y = range(_UNKNOWNS)
_MOST_STEPS = 40
_ABOUT_PX, _CLOSE_PX = 2e-3, 1e-4
"""Last steps of the fits about the start, and about the corner found: a hundredth of the noise of a corner."""
_FIRST_RADIUS_PX = 6.5
"""Largest radius of the window of the first fit, which only centres the second one's."""
_WORST = 0.2
"""Largest rms residual, as a share of the contrast: with a larger one the image is not that of a corner."""
_LEAST_SIGMA_PX = 0.05
_THIN = 0.01
"""Least width of a box: an edge along the pixels' rows."""
_SECTORS = 64
_PART = 16
"""Corners that a thread fits at a time."""
_REACH = 2.0
"""Half of a window that holds all pixels of both fits, in radii: each fit may move by half a radius."""
_BELL_REACH, _BELLS_PER_SIGMA = 6.0, 32


def _bell_table() -> Floats:
    """[n, 4] at the places z from -6 to 6: the normal distribution, integrated twice, once and not at all, and its
    density."""
    z = np.arange(-_BELL_REACH * _BELLS_PER_SIGMA, _BELL_REACH * _BELLS_PER_SIGMA + 1) / _BELLS_PER_SIGMA
    below, bell = ndtr(z), np.exp(-0.5 * z * z) / np.sqrt(2.0 * np.pi)
    return np.column_stack([0.5 * ((z * z + 1.0) * below + z * bell), z * below + bell, below, bell])


_BELLS = _bell_table()


@dataclass(frozen=True)
class Corners:
    """Corners as fitted."""

    pixels: Floats
    """[n, 2], centre of the first pixel (0, 0)."""
    fits: NDArray[np.bool_]
    """[n] False where no corner was found; `pixels` are then those of the start."""
    sigma_px: Floats
    """[n] blur of the image."""


def enough_pixels(mask_tile: NDArray[np.bool_], radius_px: float) -> bool:
    """Tell whether a window of that radius has enough pixels for a fit."""
    return bool(np.pi * radius_px**2 * mask_tile.mean() >= _LEAST_PIXELS)


def fit_corners(image: NDArray[Any], mask_tile: NDArray[np.bool_], rough: Floats, radius_px: float) -> Corners:
    """Corners about `rough` [n, 2] from the pixels within `radius_px`, of which there must be `enough_pixels`.

    `image` [H, W] are RAW values; `mask_tile` [h, w] is the mask of the pixels to use, a tile that repeats over
    the image.
    """
    first_radius_px = radius_px
    if radius_px > _FIRST_RADIUS_PX and enough_pixels(mask_tile, _FIRST_RADIUS_PX):
        first_radius_px = _FIRST_RADIUS_PX
    radii_px = (radius_px, first_radius_px)
    unknowns = np.full((len(rough), _UNKNOWNS), np.nan)
    mask, starts = np.ascontiguousarray(mask_tile), np.ascontiguousarray(rough, dtype=np.float64)
    # Compiled before threads call it: numba's types, looked up by several at once, fail at times.
    _fit_windows(image, mask, starts[:0], radii_px, unknowns[:0])
    with ThreadPoolExecutor(len(os.sched_getaffinity(0))) as pool:
        parts = (slice(first, first + _PART) for first in range(0, len(starts), _PART))
        list(pool.map(lambda part: _fit_windows(image, mask, starts[part], radii_px, unknowns[part]), parts))
    fits = np.isfinite(unknowns[:, _X])
    return Corners(np.where(fits[:, None], unknowns[:, :2], rough), fits, unknowns[:, _SIGMA].copy())


def _fit_windows(
    image: NDArray[Any],
    mask_tile: NDArray[np.bool_],
    rough: Floats,
    radii_px: tuple[float, float],
    solutions: Floats,
) -> None:
    """Fit corners [n] into `solutions` [n, unknowns]; only the pixels that a fit can reach are converted."""
    size_px = np.minimum(2 * int(_REACH * radii_px[0] + 2.0) + 1, image.shape[:2])
    firsts = np.clip(np.rint(rough[:, ::-1]).astype(np.intp) - size_px // 2, 0, image.shape[:2] - size_px)
    windows = np.empty((len(rough), *size_px), np.float32)
    for window, (row, col) in zip(windows, firsts, strict=True):
        window[:] = image[row : row + size_px[0], col : col + size_px[1]]
    _fit_all(windows, firsts, mask_tile, rough, *radii_px, solutions)


@numba.njit(cache=True, nogil=True)
def _fit_all(windows, firsts, mask_tile, rough, radius, first_radius, solutions):  # type: ignore[no-untyped-def]
    """Places are within a window [h, w], whose first pixel is `firsts` [row, column] of the image, until the
    end."""
    for n in range(len(rough)):
        image, first_row, first_col = windows[n], firsts[n, 0], firsts[n, 1]
        mask = np.empty_like(mask_tile)
        for row in range(mask.shape[0]):
            for col in range(mask.shape[1]):
                mask[row, col] = mask_tile[(row + first_row) % mask.shape[0], (col + first_col) % mask.shape[1]]
        x, y = rough[n, 0] - first_col, rough[n, 1] - first_row
        unknowns = np.zeros(_UNKNOWNS)
        unknowns[_X], unknowns[_Y] = x, y
        if not _start(image, mask, radius, unknowns):
            continue
        # Again about the corner found: a window that is not centred on it would bias the result.
        fits = _fit(image, mask, x, y, first_radius, unknowns, _ABOUT_PX)
        if fits and _fit(image, mask, unknowns[_X], unknowns[_Y], radius, unknowns, _CLOSE_PX):
            # A gradient of light shifts blurred edges: p F, blurred, is p F + sigma^2 grad F.
            spread2 = unknowns[_SIGMA] ** 2 + 1.0 / 12.0
            unknowns[_X] += spread2 * unknowns[_ALONG_X] + first_col
            unknowns[_Y] += spread2 * unknowns[_ALONG_Y] + first_row
            for k in range(_UNKNOWNS):
                solutions[n, k] = unknowns[k]


@numba.njit(cache=True, nogil=True)
def _start(image, mask_tile, radius, unknowns):  # type: ignore[no-untyped-def]
    """Directions of both edges, level and contrast by the values around the corner; False without four sectors."""
    sums, counts = np.zeros(_SECTORS), np.zeros(_SECTORS)
    x, y = unknowns[_X], unknowns[_Y]
    for row in range(max(0, math.ceil(y - radius)), min(image.shape[0], math.floor(y + radius) + 1)):
        for col in range(max(0, math.ceil(x - radius)), min(image.shape[1], math.floor(x + radius) + 1)):
            far = math.hypot(col - x, row - y)
            if (
                far > radius
                or far < 0.4 * radius
                or not mask_tile[row % mask_tile.shape[0], col % mask_tile.shape[1]]
            ):
                continue
            angle = math.atan2(row - y, col - x) % (2.0 * math.pi)
            sector = int(angle / (2.0 * math.pi) * _SECTORS) % _SECTORS
            # Spread over neighbours, so that there is no gap where pixels are few.
            for step in range(-2, 3):
                weight = 3.0 - abs(step)
                sums[(sector + step) % _SECTORS] += weight * image[row, col]
                counts[(sector + step) % _SECTORS] += weight
    if counts.min() == 0.0:
        return False
    around = sums / counts
    level, contrast = 0.5 * (around.max() + around.min()), 0.5 * (around.max() - around.min())
    if contrast <= 0.0:
        return False
    crossings, many, rises = np.zeros(4), 0, 0.0
    for k in range(_SECTORS):
        here, there = around[k] - level, around[(k + 1) % _SECTORS] - level
        if (here > 0.0) != (there > 0.0):
            if many == 4:
                return False
            crossings[many] = (k + 0.5 + here / (here - there)) * 2.0 * math.pi / _SECTORS
            if many == 0:
                rises = 1.0 if there > 0.0 else -1.0
            many += 1
    if many != 4:
        return False
    for k in range(2):
        # Opposite crossings are one edge, seen from both sides.
        unknowns[_FIRST + k] = 0.5 * (crossings[k] + crossings[k + 2] - math.pi)
    unknowns[_SIGMA], unknowns[_LEVEL] = 0.7, level
    # After the first crossing a point is on the first edge's left and on the second one's right.
    unknowns[_CONTRAST] = -rises * contrast
    return True


@numba.njit(cache=True, nogil=True)
def _fit(image, mask_tile, x, y, radius, unknowns, close_px):  # type: ignore[no-untyped-def]
    """Levenberg-Marquardt until a step is below `close_px`; False if it diverges or the residual is too large."""
    squares, count, normal, right = _equations(image, mask_tile, x, y, radius, unknowns)
    damping = 1e-3
    for _ in range(_MOST_STEPS):
        damped_normal = normal.copy()
        for k in range(_UNKNOWNS):
            damped_normal[k, k] *= 1.0 + damping
            damped_normal[k, k] += 1e-12
        trial = unknowns + np.linalg.solve(damped_normal, right)
        trial[_SIGMA] = min(max(trial[_SIGMA], _LEAST_SIGMA_PX), 0.5 * radius)
        if math.hypot(trial[_X] - x, trial[_Y] - y) > 0.5 * radius or not np.all(np.isfinite(trial)):
            return False
        tried_squares, count, tried_normal, tried_right = _equations(image, mask_tile, x, y, radius, trial)
        if tried_squares <= squares:
            change = math.hypot(trial[_X] - unknowns[_X], trial[_Y] - unknowns[_Y])
            for k in range(_UNKNOWNS):
                unknowns[k] = trial[k]
            squares, normal, right = tried_squares, tried_normal, tried_right
            damping *= 0.1
            if change < close_px:
                break
        else:
            damping *= 10.0
            if damping > 1e8:
                break
    return count > 2 * _UNKNOWNS and squares <= count * (_WORST * unknowns[_CONTRAST]) ** 2


@numba.njit(cache=True, nogil=True)
def _equations(image, mask_tile, middle_x, middle_y, radius, unknowns):  # type: ignore[no-untyped-def]
    """Sum of squared residuals, number of pixels, normal matrix [9, 9] and right-hand side [9] of one step."""
    x, y, sigma = unknowns[_X], unknowns[_Y], unknowns[_SIGMA]
    level, contrast = unknowns[_LEVEL], unknowns[_CONTRAST]
    cos1, sin1 = math.cos(unknowns[_FIRST]), math.sin(unknowns[_FIRST])
    cos2, sin2 = math.cos(unknowns[_SECOND]), math.sin(unknowns[_SECOND])
    normal, right, slope = np.zeros((_UNKNOWNS, _UNKNOWNS)), np.zeros(_UNKNOWNS), np.empty(_UNKNOWNS)
    squares, count = 0.0, 0
    height, width = image.shape
    together = cos1 * cos2 + sin1 * sin2
    blur_px = math.sqrt(sigma * sigma + 1.0 / 12.0)
    for row in range(max(0, math.ceil(middle_y - radius)), min(height, math.floor(middle_y + radius) + 1)):
        for col in range(max(0, math.ceil(middle_x - radius)), min(width, math.floor(middle_x + radius) + 1)):
            if not mask_tile[row % mask_tile.shape[0], col % mask_tile.shape[1]]:
                continue
            if (col - middle_x) ** 2 + (row - middle_y) ** 2 > radius * radius:
                continue
            right_x, down_y = col - x, row - y
            # Distance on the left of an edge that points along (cos, sin), and how far along it.
            apart1, along1 = cos1 * down_y - sin1 * right_x, cos1 * right_x + sin1 * down_y
            apart2, along2 = cos2 * down_y - sin2 * right_x, cos2 * right_x + sin2 * down_y
            edge_one, one_apart, one_sigma = _edge(apart1, abs(cos1), abs(sin1), sigma)
            edge_two, two_apart, two_sigma = _edge(apart2, abs(cos2), abs(sin2), sigma)
            light = 1.0 + unknowns[_ALONG_X] * right_x + unknowns[_ALONG_Y] * down_y
            checks = edge_one * edge_two + _crossing(apart1 / blur_px, apart2 / blur_px, together)
            board = level + contrast * checks
            by_one, by_two = light * contrast * edge_two * one_apart, light * contrast * edge_one * two_apart
            slope[_X] = by_one * sin1 + by_two * sin2 - board * unknowns[_ALONG_X]
            slope[_Y] = -by_one * cos1 - by_two * cos2 - board * unknowns[_ALONG_Y]
            slope[_FIRST], slope[_SECOND] = -by_one * along1, -by_two * along2
            slope[_SIGMA] = light * contrast * (edge_two * one_sigma + edge_one * two_sigma)
            slope[_LEVEL], slope[_CONTRAST] = light, light * checks
            slope[_ALONG_X], slope[_ALONG_Y] = board * right_x, board * down_y
            residual = image[row, col] - board * light
            squares += residual * residual
            count += 1
            for i in range(_UNKNOWNS):
                right[i] += slope[i] * residual
                for j in range(i + 1):
                    normal[i, j] += slope[i] * slope[j]
    for i in range(_UNKNOWNS):
        for j in range(i):
            normal[j, i] = normal[i, j]
    return squares, count, normal, right


@numba.njit(cache=True, nogil=True)
def _crossing(a, b, together):  # type: ignore[no-untyped-def]
    """The rest r at a point `a` and `b` standard deviations of blur away from the edges."""
    squares = a * a + b * b
    if squares > 72.0:
        return 0.0
    series = 1.0 + together * a * b / 2.0 + together * together * (a * a - 1.0) * (b * b - 1.0) / 6.0
    return 2.0 / math.pi * math.exp(-0.5 * squares) * together * series


@numba.njit(cache=True, nogil=True)
def _edge(apart, wide, high, sigma):  # type: ignore[no-untyped-def]
    """2 S - 1 of an edge at distance `apart` from a pixel's middle, and its derivatives by that and by sigma."""
    wide, high = max(wide, _THIN), max(high, _THIN)
    outer, inner = 0.5 * (wide + high), 0.5 * (wide - high)
    if abs(apart) > outer + _BELL_REACH * sigma:
        return (1.0 if apart > 0.0 else -1.0), 0.0, 0.0
    value, by_apart, by_sigma, per_sigma = 0.0, 0.0, 0.0, 1.0 / sigma
    for k in range(4):
        sign = (1.0, -1.0, -1.0, 1.0)[k]
        twice, once, below = _integrals((apart + (outer, inner, -inner, -outer)[k]) * per_sigma)
        value += sign * twice
        by_apart += sign * once
        by_sigma += sign * below
    per_area = 2.0 / (wide * high)
    return per_area * sigma * sigma * value - 1.0, per_area * sigma * by_apart, per_area * sigma * by_sigma


@numba.njit(cache=True, nogil=True)
def _integrals(z):  # type: ignore[no-untyped-def]
    """Normal distribution at z, integrated twice, once and not at all: Taylor's series from the nearest place of
    the table, to 1e-10."""
    if z >= _BELL_REACH:
        return 0.5 * (z * z + 1.0), z, 1.0
    if z <= -_BELL_REACH:
        return 0.0, 0.0, 0.0
    place = int((z + _BELL_REACH) * _BELLS_PER_SIGMA + 0.5)
    there = place / _BELLS_PER_SIGMA - _BELL_REACH
    d = z - there
    twice, once, below, bell = _BELLS[place, 0], _BELLS[place, 1], _BELLS[place, 2], _BELLS[place, 3]
    slope, bend = -there * bell, (there * there - 1.0) * bell
    return (
        twice + d * (once + d * (below / 2.0 + d * (bell / 6.0 + d * (slope / 24.0 + d * bend / 120.0)))),
        once + d * (below + d * (bell / 2.0 + d * (slope / 6.0 + d * bend / 24.0))),
        below + d * (bell + d * (slope / 2.0 + d * bend / 6.0)),
    )
