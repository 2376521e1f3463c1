"""Locates corners of a board to a few thousandths of a pixel: fits a model of two crossing edges to RAW pixels.

The model (`corner_kernel`) describes a square pixel behind a blurred lens. So sharp edges have no error that
depends on their place between pixels. No colour is interpolated, because pixels of other colours are not used.
Each edge has a blur of its own. Two things are found from all corners of an image together:

- noise: the variance a + b v of a pixel of value v, from the squared residuals. It gives each corner a covariance.
- asymmetry of the blur (coma): its third cumulant across an edge of normal n is K n n n. The four numbers of K are
  polynomials over the image, fitted to the residuals of all corners. Then the corners are fitted again with K. If
  K were found from a single corner, the noise of this corner would be a fifth larger. So a corner's place is the
  image of a point, which is taken as the centre of gravity of the blur.
"""

from __future__ import annotations

import os
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from coupole.calibration.lens.corner_kernel import OWN, ROUND, SUMS, UNKNOWNS, fit_all
from coupole.calibration.rotations import Floats

_LEAST_PIXELS = 24
_FIRST_RADIUS_PX = 6.5
"""Largest radius of the window of the first fit, which is only used to centre the window of the second fit."""
_PART = 16
"""Number of corners that a thread fits at a time."""
_REACH = 2.0
"""Half of a window that holds all pixels of both fits, in radii. Each fit may move the corner by half a radius."""
_ANGLES, _SIGMA, _SIGMA_2, _SKEWS = slice(2, 4), 4, 9, slice(12, 14)
_ROUNDS = 3
_LEAST_CORNERS = (12, 30, 60)
"""Least number of corners for an asymmetry that is constant, linear, or quadratic over the image."""
_CLEAR = 3.0
"""Least decrease of the squared residuals for an asymmetry, divided by their variance and the number of
coefficients."""
_FLOOR_PX = 3e-4
"""Error of the fit without noise if the blur is symmetric: rms, from `tools/prove_corners.py`."""
_SKEW_LEFT = 0.17
"""Error that remains after an asymmetry's correction in windows of 8 px, as a share of the correction, from the
same tool. In windows of 4.5 px nearly half remains, and the covariance does not include this."""
Blur = Literal["own", "round"]


@dataclass(frozen=True)
class Corners:
    """Corners as fitted."""

    pixels: Floats
    """[n, 2], centre of the first pixel (0, 0)."""
    fits: NDArray[np.bool_]
    """[n] False where no corner was found; `pixels` then has the start."""
    sigma_px: Floats
    """[n] blur of the image: geometric mean of the blurs across both edges."""
    covariance_px2: Floats
    """[n, 2, 2] covariance of the places; NaN where no corner was found."""


def enough_pixels(mask_tile: NDArray[np.bool_], radius_px: float) -> bool:
    """Tell whether a window of this radius has enough pixels for a fit."""
    return bool(np.pi * radius_px**2 * mask_tile.mean() >= _LEAST_PIXELS)


def fit_corners(
    image: NDArray[Any], mask_tile: NDArray[np.bool_], rough: Floats, radius_px: float, *, blur: Blur = "own"
) -> Corners:
    """Fit corners near `rough` [n, 2] to the pixels within `radius_px`, of which there must be `enough_pixels`.

    `image` [H, W] are RAW values; `mask_tile` [h, w] is the mask of the pixels to use, a tile that repeats over
    the image. With `round`, both edges have the same blur, and it is symmetric.
    """
    first_radius_px = radius_px
    if radius_px > _FIRST_RADIUS_PX and enough_pixels(mask_tile, _FIRST_RADIUS_PX):
        first_radius_px = _FIRST_RADIUS_PX
    many = OWN if blur == "own" else ROUND
    windows = _Windows(image, np.ascontiguousarray(mask_tile), (radius_px, first_radius_px), many)
    starts, skew = np.ascontiguousarray(rough, dtype=np.float64), np.zeros((len(rough), 2))
    corner_fits = _fit_in_threads(windows, starts, skew)
    for _ in range(_ROUNDS if blur == "own" else 0):
        more = _asymmetry(corner_fits, corner_fits.noise(many))
        if not more.any():
            break
        skew += more
        corner_fits = _fit_in_threads(windows, starts, skew)
    fits = np.isfinite(corner_fits.solutions[:, 0])
    pixels = np.where(fits[:, None], corner_fits.solutions[:, :2], rough)
    covariance = np.full((len(rough), 2, 2), np.nan)
    covariance[fits] = corner_fits.part(fits).covariance(corner_fits.noise(many), many)
    sigma_px = np.sqrt(corner_fits.solutions[:, _SIGMA] * corner_fits.solutions[:, _SIGMA_2])
    return Corners(pixels, fits, sigma_px, covariance)


def _fit_in_threads(windows: _Windows, starts: Floats, skew: Floats) -> _Fitted:
    corner_fits = _Fitted.empty(len(starts))
    # Compiled before threads call it: numba's types, looked up by several at once, fail at times.
    windows.fit(starts[:0], skew[:0], corner_fits.part(slice(0, 0)))
    with ThreadPoolExecutor(len(os.sched_getaffinity(0))) as pool:
        parts = (slice(first, first + _PART) for first in range(0, len(starts), _PART))
        list(pool.map(lambda part: windows.fit(starts[part], skew[part], corner_fits.part(part)), parts))
    return corner_fits


@dataclass(frozen=True)
class _Windows:
    """An image, and the way in which corners are fitted in it."""

    image: NDArray[Any]
    mask_tile: NDArray[np.bool_]
    radii_px: tuple[float, float]
    many: int

    def fit(self, rough: Floats, skew: Floats, corner_fits: _Fitted) -> None:
        """Fit corners [n] with a given asymmetry [n, 2]. Only the pixels that a fit can reach are converted."""
        shape = self.image.shape[:2]
        size_px = np.minimum(2 * int(_REACH * self.radii_px[0] + 2.0) + 1, shape)
        firsts = np.clip(np.rint(rough[:, ::-1]).astype(np.intp) - size_px // 2, 0, shape - size_px)
        windows = np.empty((len(rough), *size_px), np.float32)
        for window, (row, col) in zip(windows, firsts, strict=True):
            window[:] = self.image[row : row + size_px[0], col : col + size_px[1]]
        arrays = (corner_fits.solutions, corner_fits.normals, corner_fits.scaled_normals, corner_fits.sums)
        fit_all(windows, firsts, self.mask_tile, rough, skew, self.radii_px, self.many, arrays)


@dataclass(frozen=True)
class _Fitted:
    """Results of `corner_kernel.fit_all`: solutions [n, 14], normal matrices [n, 15, 15], plain and weighted by
    the pixels' values, and sums [n, 5]."""

    solutions: Floats
    normals: Floats
    scaled_normals: Floats
    sums: Floats

    @staticmethod
    def empty(count: int) -> _Fitted:
        matrices = np.zeros((2, count, UNKNOWNS + 1, UNKNOWNS + 1))
        return _Fitted(np.full((count, UNKNOWNS), np.nan), matrices[0], matrices[1], np.zeros((count, SUMS)))

    def part(self, rows: slice | NDArray[np.bool_]) -> _Fitted:
        return _Fitted(self.solutions[rows], self.normals[rows], self.scaled_normals[rows], self.sums[rows])

    def noise(self, many: int) -> tuple[float, float]:
        """Return a and b of the variance a + b v of a pixel of value v, not negative, from the squared residuals
        of all corners."""
        freedom = self.sums[:, 0] / np.maximum(self.sums[:, 0] - many, 1.0)
        count, value, value2 = np.maximum(self.sums[:, :3].sum(axis=0), 1e-30)
        square, by_value = (self.sums[:, 3:] * freedom[:, None]).sum(axis=0)
        value_spread = count * value2 - value**2
        b = (count * by_value - value * square) / value_spread if value_spread > 1e-9 * count * value2 else 0.0
        b = min(max(b, 0.0), square / value if value > 0.0 else 0.0)
        return (square - b * value) / count, b

    def covariance(self, noise: tuple[float, float], many: int) -> Floats:
        """Return [n, 2, 2], covariances of the places, px^2. If a corner's residuals are larger than this noise,
        its whole covariance is increased."""
        a, b = noise
        normal, scaled_normals = self.normals[:, :many, :many], self.scaled_normals[:, :many, :many]
        across = np.linalg.pinv(normal, hermitian=True)[:, :2]
        covariance = across @ (a * normal + b * scaled_normals) @ np.swapaxes(across, 1, 2)
        count, value, _, square, _ = self.sums.T
        expected_squares = np.maximum((a * count + b * value) * np.maximum(count - many, 1.0) / count, 1e-30)
        through = across @ self.normals[:, :many, _SKEWS]
        left_px = _SKEW_LEFT * np.einsum("nij,nj->ni", through, self.solutions[:, _SKEWS])
        covariance *= np.maximum(1.0, square / expected_squares)[:, None, None]
        return np.asarray(covariance + left_px[:, :, None] * left_px[:, None, :] + _FLOOR_PX**2 * np.eye(2))


def _asymmetry(corner_fits: _Fitted, noise: tuple[float, float]) -> Floats:
    """Return [n, 2], the changes of the third cumulants of the blur across both edges that the residuals show;
    zero if they are not clear."""
    none = np.zeros((len(corner_fits.solutions), 2))
    is_found = np.isfinite(corner_fits.solutions[:, 0])
    corners = corner_fits.part(is_found)
    if (count := len(corners.solutions)) < _LEAST_CORNERS[0]:
        return none
    free = slice(0, OWN)
    beside, residual_side = corners.normals[:, free, _SKEWS], corners.normals[:, :, -1]
    through = np.linalg.pinv(corners.normals[:, free, free], hermitian=True) @ beside
    information = corners.normals[:, _SKEWS, _SKEWS] - np.swapaxes(beside, 1, 2) @ through
    side = residual_side[:, _SKEWS] - np.einsum("nij,ni->nj", through, residual_side[:, free])
    design = _tensor_rows(corners.solutions, sum(count >= least for least in _LEAST_CORNERS) - 1)
    matrix = np.einsum("nik,nij,njl->kl", design, information, design)
    vector = np.einsum("nik,ni->k", design, side)
    scale = np.sqrt(np.maximum(np.diag(matrix), 1e-30))
    inverse = np.linalg.pinv(matrix / np.outer(scale, scale), rcond=1e-6, hermitian=True)
    coefficients = inverse @ (vector / scale) / scale
    a, b = noise
    variance = a + b * corners.sums[:, 1].sum() / corners.sums[:, 0].sum()
    if vector @ coefficients >= _CLEAR * len(coefficients) * max(variance, 1e-30):
        none[is_found] = design @ coefficients
    return none


def _tensor_rows(solutions: Floats, degree: int) -> Floats:
    """Return [n, 2, k], derivatives of the cumulants across the edges by the polynomials' coefficients."""
    # The distance of an edge grows along (-sin, cos).
    angles = solutions[:, _ANGLES]
    normal_x, normal_y = -np.sin(angles), np.cos(angles)
    tensor = np.stack([normal_x**3, normal_x**2 * normal_y, normal_x * normal_y**2, normal_y**3], axis=-1)
    places = solutions[:, :2] - solutions[:, :2].mean(axis=0)
    x, y = (places / max(float(np.abs(places).max()), 1.0)).T
    terms = np.stack([x**i * y**j for i in range(degree + 1) for j in range(degree + 1 - i)], axis=-1)
    rows = tensor[:, :, :, None] * terms[:, None, None, :]
    return np.asarray(rows.reshape(len(solutions), 2, -1))
