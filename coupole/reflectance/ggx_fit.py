"""The fit of `coupole.reflectance.normal_fit.fit_from` for eight samples at once, with the same costs, steps and
stopping rule.

The derivatives of a trial step are computed together with its cost, because most trials are accepted. Cauchy's
cost takes one logarithm of a product over some samples instead of many logarithms.
"""

from __future__ import annotations

import math

import numpy as np

from coupole.kernels import kernel
from coupole.kernels.lanes import LANES, if_less, lanes, larger, load_row, root, store, total
from coupole.reflectance.ggx import UNKNOWNS, tangents
from coupole.reflectance.kernel_arrays import assign, assign_rows
from coupole.reflectance.normal_fit import (
    _MOST_STEPS,
    CAUCHY,
    _least_cosine,
    _move,
    _solve,
)

ROWS = 11
"""Rows of each pack of eight samples: the square root of the value, its light, half vector and view, and 1 for an
existing sample."""
_OFF = UNKNOWNS
_TOGETHER = 4
"""Number of packs whose values are multiplied in one product. The product must stay below the largest double, even
with an error of 1e4 scales in each sample."""


@kernel
def pack(roots, good, lights, half, views, view_of, packs):  # type: ignore[no-untyped-def]
    """Fill `packs` [n, 11, 8] with the samples `good`; return how many packs they fill. For the other arguments
    see `fit_from`."""
    count = (len(good) + LANES - 1) // LANES
    for number in range(count * LANES):
        lane = packs[number // LANES, :, number % LANES]
        if number < len(good):
            sample = good[number]
            lane[0], lane[10] = roots[number], 1.0
            for k in range(3):
                lane[1 + k], lane[4 + k], lane[7 + k] = (
                    lights[sample, k],
                    half[sample, k],
                    views[view_of[sample], k],
                )
        else:
            lane[:] = 0.0  # its light comes from nowhere
    return count


@kernel
def fit_packs(packs, views, unknowns, prior, stiffness, usual, settled_share):  # type: ignore[no-untyped-def]
    """Fit by Levenberg-Marquardt from `unknowns` in place, until a step lowers the cost by less than the share
    `settled_share`. Return cost and weighted rms, as `fit_from` does. `usual` is the prior of ks and roughness:
    two logarithms, and their weights (1 over the variance)."""
    scale = CAUCHY * math.exp(0.5 * unknowns[3])
    rows = np.empty((len(packs) * (UNKNOWNS + 1), LANES))
    matrix, right = np.empty((UNKNOWNS, UNKNOWNS)), np.empty(UNKNOWNS)
    new_matrix, new_right, trial = np.empty_like(matrix), np.empty_like(right), np.empty(6)
    cost, rms = _equations(packs, unknowns, prior, stiffness, usual, scale, rows, matrix, right)
    damping = 1e-2
    for _ in range(_MOST_STEPS):
        _move(unknowns, _solve(matrix, right, damping), trial)
        trial_cost, trial_rms = np.inf, 0.0
        if _least_cosine(trial, views) > 0.02:
            trial_cost, trial_rms = _equations(
                packs, trial, prior, stiffness, usual, scale, rows, new_matrix, new_right
            )
        if trial_cost < cost:
            gain = cost - trial_cost
            assign(unknowns, trial)
            assign_rows(matrix, new_matrix)
            assign(right, new_right)
            damping = max(damping * 0.2, 1e-9)
            cost, rms = trial_cost, trial_rms
            if gain < settled_share * (cost + gain):
                break
        else:
            damping *= 6.0
            if damping > 1e8:
                break
    return cost, rms / math.exp(0.5 * unknowns[3])


@kernel
def _equations(packs, unknowns, prior, stiffness, usual, scale, rows, matrix, right):  # type: ignore[no-untyped-def]
    """Write the normal equations of a step to `matrix` and `right`; return Cauchy's cost and the weighted rms."""
    t1, t2 = tangents(unknowns[0], unknowns[1], unknowns[2])
    cost, rms = _residuals(packs, unknowns, t1, t2, scale, rows)
    count = len(packs)
    for i in range(UNKNOWNS):
        for j in range(i + 1):
            matrix[i, j] = _product(rows, i * count, j * count, count)
        right[i] = -_product(rows, i * count, _OFF * count, count)
    off0, off1, off2 = unknowns[0] - prior[0], unknowns[1] - prior[1], unknowns[2] - prior[2]
    right[0] -= stiffness * (t1[0] * off0 + t1[1] * off1 + t1[2] * off2)
    right[1] -= stiffness * (t2[0] * off0 + t2[1] * off1 + t2[2] * off2)
    matrix[0, 0] += stiffness
    matrix[1, 1] += stiffness
    cost += stiffness * (off0 * off0 + off1 * off1 + off2 * off2)
    for k in range(2):
        more, weight = unknowns[4 + k] - usual[k], usual[2 + k]
        right[3 + k] -= weight * more
        matrix[3 + k, 3 + k] += weight
        cost += weight * more * more
    return cost, rms


@kernel
def _product(rows, first_row, second_row, count):  # type: ignore[no-untyped-def]
    products = lanes(0.0)
    for n in range(count):
        products += load_row(rows, first_row + n) * load_row(rows, second_row + n)
    return total(products)


@kernel
def _dot(vector, values, first):  # type: ignore[no-untyped-def]
    return (
        vector[0] * load_row(values, first)
        + vector[1] * load_row(values, first + 1)
        + vector[2] * load_row(values, first + 2)
    )


@kernel(error_model="numpy")
def _residuals(packs, unknowns, t1, t2, scale, rows):  # type: ignore[no-untyped-def]
    """Fill `rows` [6 packs, 8] with the residuals' derivatives by the unknowns, then the residuals, all times the
    square root of the weight. Return the sum of the logarithms, and the weighted rms. The formulas are those of
    `coupole.reflectance.ggx`."""
    normal = (unknowns[0], unknowns[1], unknowns[2])
    kd, ks, alpha = math.exp(unknowns[3]), math.exp(unknowns[4]), math.exp(unknowns[5])
    alpha2, rest, count = alpha * alpha, 1.0 - alpha * alpha, len(packs)
    squares, weights, product, logarithms = lanes(0.0), lanes(0.0), lanes(1.0), 0.0
    eight = np.empty((1, LANES))
    for n in range(count):
        samples = packs[n]
        cosine, nh, nv = _dot(normal, samples, 1), _dot(normal, samples, 4), _dot(normal, samples, 7)
        nl, nv = larger(cosine, 1e-9), larger(nv, 1e-9)
        t, a, b = 1.0 - nh * nh * rest, root(alpha2 + rest * nl * nl), root(alpha2 + rest * nv * nv)
        s, ab = nl * b + nv * a, a * b
        inverse = 1.0 / (t * s * ab)
        by_t, by_s, by_ab = inverse * s * ab, inverse * t * ab, inverse * t * s
        value = (0.5 / math.pi * alpha2) * by_t * by_t * by_s
        shine, value_by_s = ks * value, value * by_s
        modelled_root = root(nl * (kd + shine))
        off = (if_less(0.0, cosine, modelled_root, 0.0) - load_row(samples, 0)) / scale
        weight = 1.0 / (1.0 + off * off)
        share = root(weight)
        factor = if_less(0.0, cosine, share * (0.5 / scale) / modelled_root, 0.0)
        by_light = kd + shine - nl * ks * value_by_s * (b + nv * rest * nl * b * by_ab)
        by_view = -1.0 * nl * ks * value_by_s * (a + nl * rest * nv * a * by_ab)
        by_half = 4.0 * nl * nh * rest * by_t * shine
        by_alpha = value * (2.0 - 4.0 * alpha2 * nh * nh * by_t) - alpha2 * value_by_s * (
            nl * (1.0 - nv * nv) * a * by_ab + nv * (1.0 - nl * nl) * b * by_ab
        )
        for k, t12 in enumerate((t1, t2)):
            tilt = (
                by_light * _dot(t12, samples, 1)
                + by_view * _dot(t12, samples, 7)
                + by_half * _dot(t12, samples, 4)
            )
            store(factor * tilt, rows, k * count + n)
        store(factor * nl * kd, rows, 2 * count + n)
        store(factor * nl * shine, rows, 3 * count + n)
        store(factor * nl * ks * by_alpha, rows, 4 * count + n)
        store(off * share, rows, _OFF * count + n)
        squares += weight * off * off
        weights += weight * load_row(samples, 10)
        product = product * (1.0 + off * off)
        if n % _TOGETHER == _TOGETHER - 1 or n == count - 1:
            store(product, eight, 0)
            logarithms += math.log(eight[0, 0] * eight[0, 1] * eight[0, 2] * eight[0, 3])
            logarithms += math.log(eight[0, 4] * eight[0, 5] * eight[0, 6] * eight[0, 7])
            product = lanes(1.0)
    return logarithms, scale * math.sqrt(total(squares) / total(weights))
