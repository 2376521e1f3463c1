"""The word of neighbours on a pixel: its material lies about that of its triangle, and that one about those beside
it, as far as all around it do.

In a window the spread of materials is that of the surface and that of the fits; what the fits' covariances do
not explain is the surface's (empirical Bayes: Morris, Parametric empirical Bayes inference, 1983). Where the
surface is plain little is left, and pixels become as their triangles are; where it has detail they stay as they
were fitted. The same holds for ks and roughness of triangles, which few samples near a highlight say badly; kd and
normal follow by their covariance with them.
"""

from __future__ import annotations

import numba
import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import uniform_filter

from coupole.reflectance.ggx import UNKNOWNS, tangents
from coupole.reflectance.kernel_arrays import assign_rows
from coupole.reflectance.new_light.pictured_surface import in_strips
from coupole.reflectance.run_result import LOWER, VARIANCES

Singles = NDArray[np.float32]

WINDOW_PX = 17
"""Side of the window: some hundred pixels of each channel say how the surface varies."""
_ALIKE_PX = 5
"""Side of the window in which covariances are averaged: eight groups of LEDs alone say little of one."""
_LEAST = 1e-6
"""Least variance of the surface, so that no triangle is taken for exact."""
_FREE = 100.0
"""Variance of what is not drawn anywhere."""
TRIANGLES_AROUND = 64
"""Triangles of a window that say how ks and roughness vary from one to the other."""
_MOST_STEP = 1.0
"""Largest step of a triangle: a fit that failed has no straight way to where it should have ended."""
_OUTLIER = 9.0
"""Square of the largest deviation, over the window's mean square, that counts in full."""


def lower_half(covariance: NDArray[np.float64]) -> Singles:
    """[..., 15] of [..., 5, 5], row by row."""
    return covariance[..., *LOWER].astype(np.float32)


def settle(
    deviation: Singles, covariance: Singles, is_fitted: NDArray[np.bool_], centre_covariance: Singles
) -> None:
    """Draw the deviations [h, w, 5] of a view's pixels from their triangles (tilts, logarithms) towards 0 as far
    as their neighbours agree, and set their covariances [h, w, 15, lower half row by row] to what is left; in
    place. Only pixels that are `is_fitted` [h, w] are used and changed. `centre_covariance` [h, w, 15] is that of
    what they are drawn to.
    """
    covariance[...] = mean_around(covariance, is_fitted, _ALIKE_PX)
    square = deviation**2
    np.minimum(square, np.float32(_OUTLIER) * mean_around(square, is_fitted, WINDOW_PX), out=square)
    surface = _surface(square, covariance[..., VARIANCES], is_fitted, WINDOW_PX)
    _draw_rows(deviation, covariance, surface, is_fitted, centre_covariance)


def settle_triangles(logs: Singles, covariance: Singles, is_fitted: NDArray[np.bool_], side_px: int) -> Singles:
    """Return the steps [h, w, 5] by which materials of triangles change, seen pixel by pixel, when ks and
    roughness (`logs` [h, w, 2]) are drawn to their means in a window as far as the neighbours agree; set the
    covariances [h, w, 15] to what is left, in place.
    """
    weight = (1.0 / np.maximum(covariance[..., VARIANCES[3:]], _LEAST)).astype(np.float32)
    middle = mean_around(weight * logs, is_fitted, side_px) / np.maximum(
        mean_around(weight, is_fitted, side_px), _LEAST
    )
    deviation = np.zeros((*is_fitted.shape, UNKNOWNS), np.float32)
    deviation[..., 3:] = logs - middle
    surface = np.full(deviation.shape, _FREE, np.float32)
    around = mean_around(deviation[..., 3:] ** 2, is_fitted, side_px)
    square = np.minimum(deviation[..., 3:] ** 2, np.float32(_OUTLIER) * around)
    surface[..., 3:] = _surface(square, covariance[..., VARIANCES[3:]], is_fitted, side_px)
    before, of_middle = deviation.copy(), np.zeros_like(covariance)
    of_middle[..., VARIANCES[3:]] = 1.0 / (
        np.maximum(mean_around(weight, is_fitted, side_px), _LEAST) * TRIANGLES_AROUND
    )
    _draw_rows(deviation, covariance, surface, is_fitted, of_middle)
    step: Singles = np.clip(deviation - before, -_MOST_STEP, _MOST_STEP)
    return step


def settle_colours(colours: Singles, variance: Singles, is_fitted: NDArray[np.bool_], side_px: int) -> Singles:
    """Return colours of triangles [h, w, channels] (logarithms, any sum), seen pixel by pixel and drawn to their
    means in a window as far as those around say. `variance` [h, w] is that of kd's logarithm, which colours have
    too."""
    own_variance = np.maximum(variance, _LEAST)[..., None]
    weight = (1.0 / own_variance).astype(np.float32)
    total = np.maximum(mean_around(weight, is_fitted, side_px), _LEAST)
    middle = mean_around(weight * colours, is_fitted, side_px) / total
    deviation = np.where(is_fitted[..., None], colours - middle, np.float32(0.0))
    square = np.minimum(deviation**2, np.float32(_OUTLIER) * mean_around(deviation**2, is_fitted, side_px))
    surface = np.maximum(mean_around(weight * (square - own_variance), is_fitted, side_px) / total, _LEAST)
    drawn_colours: Singles = (middle + deviation * surface / (surface + own_variance)).astype(np.float32)
    return drawn_colours


def _surface(square: Singles, own_covariance: Singles, is_fitted: NDArray[np.bool_], side_px: int) -> Singles:
    """[h, w, k] variances of the surface: mean squares in a window, without those of the fits."""
    return np.maximum(mean_around(square - own_covariance, is_fitted, side_px), _LEAST).astype(np.float32)


def _draw_rows(
    deviation: Singles, covariance: Singles, surface: Singles, is_fitted: NDArray[np.bool_], centre: Singles
) -> None:
    in_strips(
        len(is_fitted),
        lambda rows: _draw(deviation[rows], covariance[rows], surface[rows], is_fitted[rows], centre[rows]),
    )


def mean_around(values: Singles, is_used: NDArray[np.bool_], side_px: int, *, default: float = 0.0) -> Singles:
    """[h, w, k] mean over the pixels of a window that are used [h, w], whatever the others are; `default` where
    there are none."""
    weight = _window_sum(is_used.astype(np.float32), side_px)
    means = np.empty_like(values)
    for k in range(values.shape[-1]):
        plane = np.where(is_used, values[..., k], np.float32(0.0))
        total = _window_sum(plane, side_px)
        means[..., k] = np.where(weight > 0.5, total / np.maximum(weight, 1.0), default)
    return means


def _window_sum(plane: Singles, side_px: int) -> Singles:
    """[h, w] sums over a window around each pixel; mirrored at the edges."""
    return np.asarray(uniform_filter(plane, side_px, mode="mirror"), np.float32) * np.float32(side_px**2)


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _draw(deviation, covariance, surface, is_fitted, centre):  # type: ignore[no-untyped-def]
    """A pixel's deviation and covariance, given the `surface`'s variances about 0: Kalman's; and what 0 may itself
    be off, as far as the pixel was drawn to it."""
    own_covariance, whole = np.empty((UNKNOWNS, UNKNOWNS)), np.empty((UNKNOWNS, UNKNOWNS))
    rest, of_centre = np.empty((UNKNOWNS, UNKNOWNS)), np.empty((UNKNOWNS, UNKNOWNS))
    before = np.empty(UNKNOWNS)
    for row in range(is_fitted.shape[0]):
        for column in range(is_fitted.shape[1]):
            if not is_fitted[row, column]:
                continue
            place = 0
            for i in range(UNKNOWNS):
                before[i] = deviation[row, column, i]
                for j in range(i + 1):
                    own_covariance[i, j] = own_covariance[j, i] = covariance[row, column, place]
                    of_centre[i, j] = of_centre[j, i] = centre[row, column, place]
                    place += 1
            assign_rows(whole, own_covariance)
            for i in range(UNKNOWNS):
                whole[i, i] += surface[row, column, i]
            inverse = np.linalg.inv(whole)
            weighted_deviation = inverse @ before
            for i in range(UNKNOWNS):
                for j in range(UNKNOWNS):
                    rest[i, j] = (1.0 if i == j else 0.0) - surface[row, column, i] * inverse[i, j]
            assign_rows(whole, rest @ of_centre @ rest.T)
            place = 0
            for i in range(UNKNOWNS):
                deviation[row, column, i] = surface[row, column, i] * weighted_deviation[i]
                for j in range(i + 1):
                    covariance[row, column, place] = rest[i, j] * surface[row, column, j] + whole[i, j]
                    place += 1


@numba.njit(cache=True, nogil=True)
def tilts_from(normals, prior, tilts):  # type: ignore[no-untyped-def]
    """Fill `tilts` [n, 2] with those of normals [n, 3] from others, along the tangents of the first."""
    for n in range(len(normals)):
        t1, t2 = tangents(normals[n, 0], normals[n, 1], normals[n, 2])
        first, second = 0.0, 0.0
        for k in range(3):
            first -= t1[k] * prior[n, k]
            second -= t2[k] * prior[n, k]
        tilts[n, 0], tilts[n, 1] = first, second
