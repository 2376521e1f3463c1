"""Shrinkage of materials, as far as neighbours agree: a pixel's material moves towards its triangle's material,
and a triangle's material towards the materials of the triangles around it.

In a window the spread of materials comes from the surface and from the fits. The part that the fits' covariances
do not explain is the surface's (empirical Bayes: Morris, Parametric empirical Bayes inference, 1983). Where the
surface is plain, this part is small, and pixels take the material of their triangle. Where the surface has detail,
pixels stay as they were fitted. The same is done for ks and roughness of triangles, which are uncertain with few
samples near a highlight; kd and the normal then change with them, by their covariance.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import uniform_filter

from coupole.kernels import kernel
from coupole.reflectance.ggx import UNKNOWNS, tangents
from coupole.reflectance.kernel_arrays import assign_rows
from coupole.reflectance.new_light.pictured_surface import in_strips
from coupole.reflectance.run_result import LOWER, VARIANCES

Singles = NDArray[np.float32]

WINDOW_PX = 17
"""Side of the window: it has some hundred pixels of each channel, from which the variation of the surface is
found."""
_ALIKE_PX = 5
"""Side of the window in which covariances are averaged, because eight groups of LEDs determine a single covariance
poorly."""
_BESIDE_PX = 3
"""Side of the window in which the mesh may turn."""
_LEAST = 1e-6
"""Least variance of the surface, so that no triangle is treated as exact."""
_FREE = 100.0
"""Variance of unknowns that are not shrunk."""
TRIANGLES_AROUND = 64
"""Number of triangles of a window, from which the variation of ks and roughness between triangles is found."""
_MOST_STEP = 1.0
"""Largest step of a triangle, because a failed fit cannot be corrected by a linear step."""
_OUTLIER = 9.0
"""Largest squared deviation that is used, as a multiple of the window's mean square; larger ones are reduced to
it."""


def lower_half(covariance: NDArray[np.float64]) -> Singles:
    """[..., 15] lower halves of [..., 5, 5], row by row."""
    return covariance[..., *LOWER].astype(np.float32)


def settle(
    deviation: Singles,
    covariance: Singles,
    is_fitted: NDArray[np.bool_],
    centre_covariance: Singles,
    bend: Singles | None = None,
) -> None:
    """Shrink, in place, the deviations [h, w, 5] of a view's pixels from their triangles (tilts, logarithms)
    towards 0, as far as their neighbours agree. Replace their covariances [h, w, 15, lower half row by row] by the
    covariances after the shrinkage. Only pixels with `is_fitted` [h, w] are used and changed. `centre_covariance`
    [h, w, 15] is the covariance of the triangles' materials. `bend` [h, w] is the variance of the triangles' tilts
    around a pixel (`bend_around`): where the mesh turns, a pixel sees more than its own triangle.
    """
    covariance[...] = mean_around(covariance, is_fitted, _ALIKE_PX)
    square = deviation**2
    np.minimum(square, np.float32(_OUTLIER) * mean_around(square, is_fitted, WINDOW_PX), out=square)
    surface = _surface(square, covariance[..., VARIANCES], is_fitted, WINDOW_PX)
    if bend is not None:
        surface[..., :2] += bend[..., None]
    _draw_rows(deviation, covariance, surface, is_fitted, centre_covariance)


def bend_around(normals: Singles, is_used: NDArray[np.bool_]) -> Singles:
    """[h, w] variance, rad^2, of each of two tilts among the unit normals [h, w, 3] next to a pixel."""
    mean = mean_around(normals, is_used, _BESIDE_PX)
    variance: Singles = 0.5 * np.maximum(1.0 - np.sum(mean**2, axis=-1), 0.0)
    return np.where(is_used, variance, np.float32(0.0))


def settle_triangles(logs: Singles, covariance: Singles, is_fitted: NDArray[np.bool_], side_px: int) -> Singles:
    """Shrink ks and roughness of triangles (`logs` [h, w, 2], seen pixel by pixel) towards their means in a
    window, as far as the neighbours agree. Return the steps [h, w, 5] by which the materials change. Replace the
    covariances [h, w, 15], in place, by the covariances after the shrinkage.
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
    """Return colours of triangles [h, w, channels] (logarithms, any sum), seen pixel by pixel and shrunk towards
    their means in a window, as far as the neighbours agree. `variance` [h, w] is the variance of kd's logarithm,
    which is used for colours too."""
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
    """[h, w, k] variances of the surface: mean squares in a window, minus the variances of the fits."""
    return np.maximum(mean_around(square - own_covariance, is_fitted, side_px), _LEAST).astype(np.float32)


def _draw_rows(
    deviation: Singles, covariance: Singles, surface: Singles, is_fitted: NDArray[np.bool_], centre: Singles
) -> None:
    in_strips(
        len(is_fitted),
        lambda rows: _draw(deviation[rows], covariance[rows], surface[rows], is_fitted[rows], centre[rows]),
    )


def mean_around(values: Singles, is_used: NDArray[np.bool_], side_px: int, *, default: float = 0.0) -> Singles:
    """[h, w, k] mean over the pixels of a window that are used [h, w]; `default` where there are none."""
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


@kernel(error_model="numpy")
def _draw(deviation, covariance, surface, is_fitted, centre):  # type: ignore[no-untyped-def]
    """Update each pixel's deviation and covariance by Kalman's equations, with the `surface`'s variances about 0.
    The covariance includes the uncertainty of the centre, as far as the pixel was shrunk towards it."""
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


@kernel
def tilts_from(normals, prior, tilts):  # type: ignore[no-untyped-def]
    """Fill `tilts` [n, 2] with the tilts of `normals` [n, 3] against `prior`, along the tangents of `normals`."""
    for n in range(len(normals)):
        t1, t2 = tangents(normals[n, 0], normals[n, 1], normals[n, 2])
        first, second = 0.0, 0.0
        for k in range(3):
            first -= t1[k] * prior[n, k]
            second -= t2[k] * prior[n, k]
        tilts[n, 0], tilts[n, 1] = first, second
