"""The image of two crossing edges, fitted to the pixels of a window. This is the compiled part.

Let S_k be the image of edge k integrated over a pixel's square. Near a corner at q the values are

    (m + c ((2 S_1 - 1) (2 S_2 - 1) + r)) (1 + g (p - q))

for level m, contrast c and a gradient g of the light. A square pixel sees an edge with the angle a, blurred by a
Gaussian of sigma, as S(d) = [G(d + s) - G(d + t) - G(d - t) + G(d - s)] / (|cos a| |sin a|), where d is the
distance of pixel and edge, s and t are half the sum and the difference of |cos a| and |sin a|, and G'' is the
normal distribution (two boxes, then a Gaussian). A blur that is not Gaussian has a third cumulant k across the
edge and an excess e of kurtosis. It adds the next terms of Gram and Charlier's series: -k/6 of the third and e
sigma^4/24 of the fourth derivative of S. The term r is the effect of correlated blurs across both edges. It has
the terms up to c^3 of the tetrachoric series (Pearson 1900) for the sign's expectation over two normal variables
with the correlation c. For a round blur, c = n_1 n_2 of the edges' normals.
"""

from __future__ import annotations

import math

import numpy as np
from scipy.special import ndtr

from coupole.calibration.rotations import Floats
from coupole.kernels import kernel

UNKNOWNS, ROUND, OWN = 14, 9, 12
"""Numbers of unknowns: all; for one round Gaussian blur; for a symmetric blur of each edge's own, with their
correlation and kurtosis."""
(
    _X,
    _Y,
    _FIRST,
    _SECOND,
    _SIGMA,
    _LEVEL,
    _CONTRAST,
    _ALONG_X,
    _ALONG_Y,
    _SIGMA_2,
    _CORRELATION,
    _KURTOSIS,
    _SKEW,
    _SKEW_2,
) = range(UNKNOWNS)
SUMS = 5
_LEAST_PIXELS = 18
_MOST_STEPS = 40
_ABOUT_PX, _CLOSE_PX = 2e-3, 1e-4
"""Bounds of the last step of a fit: of the fit near the start, and of the fit near the found corner, which is a
hundredth of the noise of a corner."""
_WORST = 0.2
"""Largest rms residual, as a share of the contrast. If it is larger, the image does not show a corner."""
_LEAST_SIGMA_PX = 0.05
_THIN = 0.01
"""Least width of a box, for an edge along the pixels' rows."""
_MOST_CORRELATION, _MOST_KURTOSIS = 0.9, 1.5
_SECTORS = 64
_BELL_REACH, _BELLS_PER_SIGMA = 6.0, 32


def _bell_table() -> Floats:
    """Return [n, 4], at the places z from -6 to 6: the normal distribution, integrated twice, once and not at all,
    and its density."""
    z = np.arange(-_BELL_REACH * _BELLS_PER_SIGMA, _BELL_REACH * _BELLS_PER_SIGMA + 1) / _BELLS_PER_SIGMA
    below, bell = ndtr(z), np.exp(-0.5 * z * z) / np.sqrt(2.0 * np.pi)
    return np.column_stack([0.5 * ((z * z + 1.0) * below + z * bell), z * below + bell, below, bell])


_BELLS = _bell_table()


@kernel
def fit_all(windows, firsts, mask_tile, rough, skews, radii, many, results):  # type: ignore[no-untyped-def]
    """Fit corners [n] with `many` unknowns, for given third cumulants `skews` [n, 2] of the blurs.

    Places are within a window [h, w], whose first pixel is `firsts` [row, column] of the image, until the end.
    `results` is filled with the solutions [n, 14] (NaN if none was found), the normal matrices [n, 15, 15]
    bordered by residuals, the same with each pixel weighted by its value, and sums [n, 5] for the noise. The sums
    are: number of pixels, values, squared values, squared residuals, and squared residuals times the values.
    """
    solutions, normals, scaled_normals, sums = results
    radius, first_radius = radii
    rows = np.empty((UNKNOWNS + 2, windows.shape[1] * windows.shape[2]))
    for n in range(len(rough)):
        image, first_row, first_col = windows[n], firsts[n, 0], firsts[n, 1]
        mask = np.empty_like(mask_tile)
        for row in range(mask.shape[0]):
            for col in range(mask.shape[1]):
                mask[row, col] = mask_tile[(row + first_row) % mask.shape[0], (col + first_col) % mask.shape[1]]
        x, y = rough[n, 0] - first_col, rough[n, 1] - first_row
        unknowns = np.zeros(UNKNOWNS)
        unknowns[_X], unknowns[_Y] = x, y
        unknowns[_SKEW], unknowns[_SKEW_2] = skews[n]
        if not start_of(image, mask, radius, unknowns):
            continue
        # Again about the corner found: a window that is not centred on it would bias the result.
        if not _fit(image, mask, x, y, first_radius, unknowns, _ABOUT_PX, ROUND, rows):
            continue
        x, y = unknowns[_X], unknowns[_Y]
        if not _fit(image, mask, x, y, radius, unknowns, _CLOSE_PX, ROUND, rows):
            continue
        if many > ROUND:
            unknowns[_CORRELATION] = math.cos(unknowns[_FIRST] - unknowns[_SECOND])
            if not _fit(image, mask, x, y, radius, unknowns, _CLOSE_PX, many, rows):
                continue
        count = _rows(image, mask, x, y, radius, unknowns, many, rows)
        _products(rows, count, UNKNOWNS + 1, normals[n])
        for i in range(count):
            value, residual2 = rows[UNKNOWNS + 1, i], rows[UNKNOWNS, i] ** 2
            sums[n, 0] += 1.0
            sums[n, 1] += value
            sums[n, 2] += value * value
            sums[n, 3] += residual2
            sums[n, 4] += residual2 * value
            root = math.sqrt(max(value, 0.0))
            for k in range(UNKNOWNS + 1):
                rows[k, i] *= root
        _products(rows, count, UNKNOWNS + 1, scaled_normals[n])
        # A gradient of light shifts blurred edges: p F, blurred, is p F + sigma^2 grad F.
        spread2 = unknowns[_SIGMA] * unknowns[_SIGMA_2] + 1.0 / 12.0
        unknowns[_X] += spread2 * unknowns[_ALONG_X] + first_col
        unknowns[_Y] += spread2 * unknowns[_ALONG_Y] + first_row
        for k in range(UNKNOWNS):
            solutions[n, k] = unknowns[k]


@kernel
def start_of(image, mask_tile, radius, unknowns):  # type: ignore[no-untyped-def]
    """Find directions of both edges, level and contrast from the values around the corner. Returns False if there
    are not four sectors."""
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
    unknowns[_SIGMA], unknowns[_SIGMA_2], unknowns[_LEVEL] = 0.7, 0.7, level
    # After the first crossing a point is on the first edge's left and on the second one's right.
    unknowns[_CONTRAST] = -rises * contrast
    return True


@kernel
def _fit(image, mask_tile, x, y, radius, unknowns, close_px, many, rows):  # type: ignore[no-untyped-def]
    """Run Levenberg-Marquardt until a step is below `close_px`. Returns False if it diverges, or if the residual
    is too large."""
    products = np.empty((many + 1, many + 1))
    count = _equations(image, mask_tile, x, y, radius, unknowns, many, rows, products)
    damping = 1e-3
    for _ in range(_MOST_STEPS):
        damped_normal = products[:many, :many].copy()
        for k in range(many):
            damped_normal[k, k] *= 1.0 + damping
            damped_normal[k, k] += 1e-12
        step = np.linalg.solve(damped_normal, products[:many, many].copy())
        trial = unknowns.copy()
        trial[:many] += step
        trial[_SIGMA] = min(max(trial[_SIGMA], _LEAST_SIGMA_PX), 0.5 * radius)
        trial[_SIGMA_2] = min(max(trial[_SIGMA_2], _LEAST_SIGMA_PX), 0.5 * radius)
        if many == ROUND:
            trial[_SIGMA_2] = trial[_SIGMA]
            trial[_CORRELATION] = math.cos(trial[_FIRST] - trial[_SECOND])
        trial[_CORRELATION] = min(max(trial[_CORRELATION], -_MOST_CORRELATION), _MOST_CORRELATION)
        trial[_KURTOSIS] = min(max(trial[_KURTOSIS], -_MOST_KURTOSIS), _MOST_KURTOSIS)
        if math.hypot(trial[_X] - x, trial[_Y] - y) > 0.5 * radius or not np.all(np.isfinite(trial)):
            return False
        tried_products = np.empty((many + 1, many + 1))
        count = _equations(image, mask_tile, x, y, radius, trial, many, rows, tried_products)
        if tried_products[many, many] <= products[many, many]:
            change = math.hypot(trial[_X] - unknowns[_X], trial[_Y] - unknowns[_Y])
            unknowns[:] = trial
            products = tried_products
            damping *= 0.1
            if change < close_px:
                break
        else:
            damping *= 10.0
            if damping > 1e8:
                break
    return count > _LEAST_PIXELS and products[many, many] <= count * (_WORST * unknowns[_CONTRAST]) ** 2


@kernel
def _equations(image, mask_tile, x, y, radius, unknowns, many, rows, products):  # type: ignore[no-untyped-def]
    """Return the number of pixels. `products` [many + 1, many + 1] becomes the normal matrix, bordered by the
    right-hand side and the sum of squared residuals."""
    count = _rows(image, mask_tile, x, y, radius, unknowns, many, rows)
    if many < UNKNOWNS:
        rows[many, :count] = rows[UNKNOWNS, :count]
    _products(rows, count, many + 1, products)
    return count


@kernel(fastmath=True)
def _products(rows, count, many, products):  # type: ignore[no-untyped-def]
    """Fill in sums of products of the first `many` rows, over `count` pixels."""
    for i in range(many):
        for j in range(i + 1):
            total = 0.0
            for k in range(count):
                total += rows[i, k] * rows[j, k]
            products[i, j] = total
            products[j, i] = total


@kernel
def _rows(image, mask_tile, middle_x, middle_y, radius, unknowns, many, rows):  # type: ignore[no-untyped-def]
    """Return the number of pixels. `rows` [16, pixels] is filled with the derivatives with respect to the
    unknowns, the residuals, and the values of the model."""
    x, y, sigma, sigma_2 = unknowns[_X], unknowns[_Y], unknowns[_SIGMA], unknowns[_SIGMA_2]
    level, contrast, together = unknowns[_LEVEL], unknowns[_CONTRAST], unknowns[_CORRELATION]
    cos1, sin1 = math.cos(unknowns[_FIRST]), math.sin(unknowns[_FIRST])
    cos2, sin2 = math.cos(unknowns[_SECOND]), math.sin(unknowns[_SECOND])
    height, width = image.shape
    blur, blur_2 = math.sqrt(sigma * sigma + 1.0 / 12.0), math.sqrt(sigma_2 * sigma_2 + 1.0 / 12.0)
    count = 0
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
            edge_one, one_apart, one_sigma, one_third, one_fourth = _edge(apart1, abs(cos1), abs(sin1), sigma)
            edge_two, two_apart, two_sigma, two_third, two_fourth = _edge(apart2, abs(cos2), abs(sin2), sigma_2)
            edge_one += unknowns[_KURTOSIS] / 24.0 * one_fourth - unknowns[_SKEW] / 6.0 * one_third
            edge_two += unknowns[_KURTOSIS] / 24.0 * two_fourth - unknowns[_SKEW_2] / 6.0 * two_third
            light = 1.0 + unknowns[_ALONG_X] * right_x + unknowns[_ALONG_Y] * down_y
            crossing, by_together = _crossing(apart1 / blur, apart2 / blur_2, together)
            checks = edge_one * edge_two + crossing
            board, scale = level + contrast * checks, light * contrast
            by_one, by_two = scale * edge_two * one_apart, scale * edge_one * two_apart
            rows[_X, count] = by_one * sin1 + by_two * sin2 - board * unknowns[_ALONG_X]
            rows[_Y, count] = -by_one * cos1 - by_two * cos2 - board * unknowns[_ALONG_Y]
            rows[_FIRST, count], rows[_SECOND, count] = -by_one * along1, -by_two * along2
            rows[_LEVEL, count], rows[_CONTRAST, count] = light, light * checks
            rows[_ALONG_X, count], rows[_ALONG_Y, count] = board * right_x, board * down_y
            rows[_SIGMA, count], rows[_SIGMA_2, count] = scale * edge_two * one_sigma, scale * edge_one * two_sigma
            if many == ROUND:
                rows[_SIGMA, count] += rows[_SIGMA_2, count]
            rows[_CORRELATION, count] = scale * by_together
            rows[_KURTOSIS, count] = scale * (edge_two * one_fourth + edge_one * two_fourth) / 24.0
            rows[_SKEW, count] = -scale * edge_two * one_third / 6.0
            rows[_SKEW_2, count] = -scale * edge_one * two_third / 6.0
            rows[UNKNOWNS, count] = image[row, col] - board * light
            rows[UNKNOWNS + 1, count] = board * light
            count += 1
    return count


@kernel
def _crossing(a, b, together):  # type: ignore[no-untyped-def]
    """Return the term r at a point that is `a` and `b` standard deviations of blur away from the edges, and its
    derivative by the correlation."""
    squares = a * a + b * b
    if squares > 72.0:
        return 0.0, 0.0
    bell, first, second = 2.0 / math.pi * math.exp(-0.5 * squares), a * b, (a * a - 1.0) * (b * b - 1.0)
    value = bell * together * (1.0 + together * first / 2.0 + together * together * second / 6.0)
    return value, bell * (1.0 + together * first + together * together * second / 2.0)


@kernel
def _edge(apart, wide, high, sigma):  # type: ignore[no-untyped-def]
    """Return 2 S - 1 for an edge at distance `apart` from a pixel's middle, its derivatives by the distance and by
    sigma, its third derivative by the distance, and its fourth derivative times sigma^4."""
    wide, high = max(wide, _THIN), max(high, _THIN)
    outer, inner = 0.5 * (wide + high), 0.5 * (wide - high)
    if abs(apart) > outer + _BELL_REACH * sigma:
        return (1.0 if apart > 0.0 else -1.0), 0.0, 0.0, 0.0, 0.0
    value, by_apart, by_sigma, third, fourth, per_sigma = 0.0, 0.0, 0.0, 0.0, 0.0, 1.0 / sigma
    for k in range(4):
        sign = (1.0, -1.0, -1.0, 1.0)[k]
        z = (apart + (outer, inner, -inner, -outer)[k]) * per_sigma
        twice, once, below, bell = _integrals(z)
        value += sign * twice
        by_apart += sign * once
        by_sigma += sign * below
        third += sign * bell
        fourth -= sign * bell * z
    area = 2.0 / (wide * high)
    area2 = area * sigma * sigma
    return (
        area2 * value - 1.0,
        area * sigma * by_apart,
        area * sigma * by_sigma,
        area * third * per_sigma,
        area2 * fourth,
    )


@kernel
def _integrals(z):  # type: ignore[no-untyped-def]
    """Return the normal distribution at z, integrated twice, once and not at all, and its density. It is computed
    by Taylor's series from the nearest place of the table, to 1e-10 (the density to 1e-7)."""
    if z >= _BELL_REACH:
        return 0.5 * (z * z + 1.0), z, 1.0, 0.0
    if z <= -_BELL_REACH:
        return 0.0, 0.0, 0.0, 0.0
    place = int((z + _BELL_REACH) * _BELLS_PER_SIGMA + 0.5)
    there = place / _BELLS_PER_SIGMA - _BELL_REACH
    d = z - there
    twice, once, below, bell = _BELLS[place, 0], _BELLS[place, 1], _BELLS[place, 2], _BELLS[place, 3]
    slope, bend = -there * bell, (there * there - 1.0) * bell
    return (
        twice + d * (once + d * (below / 2.0 + d * (bell / 6.0 + d * (slope / 24.0 + d * bend / 120.0)))),
        once + d * (below + d * (bell / 2.0 + d * (slope / 6.0 + d * bend / 24.0))),
        below + d * (bell + d * (slope / 2.0 + d * bend / 6.0)),
        bell + d * (slope + d * bend / 2.0),
    )
