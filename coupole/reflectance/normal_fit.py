"""Normals from pictures under known lights: first by least squares over the middle ranks, then with a GGX
material.

The first fit is robust against shadows and highlights (Woodham 1980, with the darkest fifth and the brightest
fifth of a pixel's samples left out). The second fits normal, kd, ks and alpha together by Levenberg-Marquardt to
the square roots of the values, which have about equal noise. It uses Cauchy weights, so that outliers have little
effect.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, fields

import numpy as np
from numpy.typing import NDArray

from coupole.kernels import kernel
from coupole.reflectance.ggx import UNKNOWNS, lobe, root_by_unknowns, tangents
from coupole.reflectance.kernel_arrays import assign
from coupole.reflectance.parts_in_threads import in_threads

Floats = NDArray[np.float64]

RANKS = (0.2, 0.8)
_STARTS = (0.08, 0.2, 0.45)
"""Values of alpha from which fits start; the best result is kept."""
SHADOW_SHARE, SHADOW_QUANTILE = 0.05, 0.9
"""Samples below this share of a pixel's quantile are in shadow."""
CAUCHY = 0.05
"""Scale of the Cauchy weights, as a share of sqrt(kd)."""
USUAL_KS, SPREAD_KS, USUAL_ALPHA = math.log(0.04), 2.0, math.log(0.3)
"""Prior of the logarithms of ks and alpha, for materials in 1/sr: the ks of a dielectric within a factor of 7, and
alpha within a factor of 3."""
_MOST_STEPS = 40
_SETTLED = 1e-5
LEAST_ALPHA, _MOST_ALPHA = 0.02, 1.0
_FEWEST = 6
"""Least number of samples of a pixel."""
_BLOCK = 2000


@dataclass(frozen=True)
class PointMaterials:
    """Materials of n pixels; NaN for pixels with too few samples."""

    normals: Floats
    """[n, 3] unit."""
    kd: Floats
    ks: Floats
    alpha: Floats
    residual: Floats
    """Weighted rms of the residuals, which are differences of square roots, as a share of sqrt(kd)."""

    def at(self, pixels: slice) -> PointMaterials:
        """Return the materials of some of the pixels."""
        return PointMaterials(*(getattr(self, field.name)[pixels] for field in fields(self)))


def rank_normals(values: Floats, lights: Floats, ranks: tuple[float, float] = RANKS) -> tuple[Floats, Floats]:
    """Return unit normals [n, 3] and albedos [n] from values [n, lights] under lights [lights, 3] (unit vectors),
    by least squares over the samples in the middle ranks of each pixel."""
    count = values.shape[1]
    first, last = round(ranks[0] * count), max(round(ranks[1] * count), round(ranks[0] * count) + 3)
    order = np.argsort(values, axis=1)[:, first:last]
    rank_lights = lights[order]
    normal = np.einsum("nki,nkj->nij", rank_lights, rank_lights) + 1e-9 * np.eye(3)
    right = np.einsum("nki,nk->ni", rank_lights, np.take_along_axis(values, order, axis=1))
    scaled_normals = np.linalg.solve(normal, right[..., None])[..., 0]
    length = np.linalg.norm(scaled_normals, axis=1)
    return scaled_normals / np.maximum(length, 1e-300)[:, None], length


def fit_materials(values: Floats, lights: Floats, view: Floats, *, threads: int | None = None) -> PointMaterials:
    """Return normal and material of each pixel from values [n, lights] under lights [lights, 3]; `view` [3] points
    to the camera. All are unit vectors."""
    normals, albedo = rank_normals(values, lights)
    half = lights + view
    half /= np.linalg.norm(half, axis=1, keepdims=True)
    parameters = np.full((len(values), 7), np.nan)
    ordered_values = np.ascontiguousarray(values, dtype=np.float64)

    only_view = np.zeros(len(lights), np.int64)

    def fit(begin: int) -> None:
        part = slice(begin, begin + _BLOCK)
        least = SHADOW_SHARE * np.quantile(ordered_values[part], SHADOW_QUANTILE, axis=1)
        of_part = normals[part], albedo[part], least, parameters[part]
        _fit_all(ordered_values[part], lights, half, view[None], only_view, *of_part)

    in_threads(fit, len(values), part=_BLOCK, threads=threads)
    return PointMaterials(
        parameters[:, :3], parameters[:, 3], parameters[:, 4], parameters[:, 5], parameters[:, 6]
    )


def colours(values: Floats, materials: PointMaterials, lights: Floats, view: Floats) -> tuple[Floats, Floats]:
    """Return kd and ks [n, 3] for values [n, lights, 3], with fixed normals and alpha, by least squares, not below
    0."""
    half = lights + view
    half /= np.linalg.norm(half, axis=1, keepdims=True)
    kd, ks = np.full((len(values), 3), np.nan), np.full((len(values), 3), np.nan)
    _fit_colours(
        values, materials.normals, materials.kd, materials.ks, materials.alpha, lights, half, view, kd, ks
    )
    return kd, ks


@kernel
def _fit_colours(values, normals, grey_kd, grey_ks, alphas, lights, half, view, kd, ks):  # type: ignore[no-untyped-def]
    views, only_view, indices = view.reshape(1, 3), np.zeros(len(lights), np.int64), np.arange(len(lights))
    grey = np.empty(3)
    for pixel in range(len(values)):
        if grey_kd[pixel] > 0.0:
            grey[0], grey[1], grey[2] = grey_kd[pixel], grey_ks[pixel], alphas[pixel]
            colours_from(
                values[pixel], indices, normals[pixel], grey, lights, half, views, only_view, kd[pixel], ks[pixel]
            )


@kernel
def colours_from(values, used_samples, normal, grey, lights, half, views, view_of, kd, ks):  # type: ignore[no-untyped-def]
    """Fill `kd` and `ks` [channels] from the samples `used_samples` of values [samples, channels]. Normal and
    `grey` (kd, ks, alpha) were fitted to the channels' means; samples have the weights of the last step of that
    fit."""
    n0, n1, n2 = normal
    channels = values.shape[1]
    sums = np.zeros((channels, 2))
    dd, ds, ss = 0.0, 0.0, 0.0
    for number in range(len(used_samples)):
        light = used_samples[number]
        nl = n0 * lights[light, 0] + n1 * lights[light, 1] + n2 * lights[light, 2]
        if nl <= 0.0:
            continue
        view = views[view_of[light]]
        nv = n0 * view[0] + n1 * view[1] + n2 * view[2]
        nh = n0 * half[light, 0] + n1 * half[light, 1] + n2 * half[light, 2]
        shine = nl * lobe(nl, nv, nh, grey[2])[0]
        weight = colour_weight(nl * grey[0] + shine * grey[1], values[light], grey[0])
        dd += weight * nl * nl
        ds += weight * nl * shine
        ss += weight * shine * shine
        for channel in range(channels):
            sums[channel, 0] += weight * nl * values[light, channel]
            sums[channel, 1] += weight * shine * values[light, channel]
    determinant = dd * ss - ds * ds
    for channel in range(channels):
        diffuse, specular = sums[channel, 0] / max(dd, 1e-30), 0.0
        if determinant > 1e-9 * dd * ss:
            both_d = (sums[channel, 0] * ss - sums[channel, 1] * ds) / determinant
            both_s = (sums[channel, 1] * dd - sums[channel, 0] * ds) / determinant
            if both_s > 0.0:
                diffuse, specular = both_d, both_s
            if both_d < 0.0:
                diffuse, specular = 0.0, sums[channel, 1] / ss
        kd[channel], ks[channel] = max(diffuse, 0.0), max(specular, 0.0)


@kernel
def colour_weight(model, values, grey_kd):  # type: ignore[no-untyped-def]
    """Return the weight of a sample in `colours_from`, for values [channels] and the value `model` of `grey`."""
    off = (math.sqrt(model) - math.sqrt(max(0.0, values.mean()))) / (CAUCHY * math.sqrt(grey_kd))
    return 1.0 / ((1.0 + off * off) * max(model, 1e-12))


@kernel
def _fit_all(values, lights, half, views, view_of, normals, albedo, least, parameters):  # type: ignore[no-untyped-def]
    for pixel in range(len(values)):
        sample = values[pixel]
        indices = np.flatnonzero(sample > max(least[pixel], 0.0))
        if len(indices) < _FEWEST or albedo[pixel] <= 0.0:
            continue
        roots = np.sqrt(sample[indices])
        best = np.inf
        for alpha in _STARTS:
            unknowns = np.empty(6)
            assign(unknowns[:3], normals[pixel])
            unknowns[3], unknowns[4], unknowns[5] = (
                math.log(albedo[pixel]),
                math.log(0.02 * albedo[pixel]),
                math.log(alpha),
            )
            if _least_cosine(unknowns, views) < 0.05:
                assign(unknowns[:3], views[0])
            cost, rms = fit_from(roots, indices, lights, half, views, view_of, unknowns, views[0], 0.0, 0.0)
            if cost < best:
                best = cost
                assign(parameters[pixel, :3], unknowns[:3])
                parameters[pixel, 3], parameters[pixel, 4] = math.exp(unknowns[3]), math.exp(unknowns[4])
                parameters[pixel, 5], parameters[pixel, 6] = math.exp(unknowns[5]), rms


@kernel
def fit_from(roots, used_samples, lights, half, views, view_of, unknowns, prior, stiffness, usual):  # type: ignore[no-untyped-def]
    """Fit `unknowns` (normal, log kd, log ks, log alpha) by Levenberg-Marquardt in place; return cost and weighted
    rms.

    `roots` are square roots of the samples `used_samples`; `lights` and half vectors `half` are [samples, 3].
    `view_of` [samples] gives each sample's row of `views` [v, 3]. The normal is held to `prior` by `stiffness`,
    the inverse of its variance in rad^2. Roughness and ks are held to usual values by `usual`, so that no
    highlight is invented where no sample could show it.
    """
    scale = CAUCHY * math.exp(0.5 * unknowns[3])
    matrix, right = np.empty((UNKNOWNS, UNKNOWNS)), np.empty(UNKNOWNS)
    trial = np.empty(6)
    cost, rms = _equations(
        roots, used_samples, lights, half, views, view_of, unknowns, prior, stiffness, usual, scale, matrix, right
    )
    damping = 1e-2
    for _ in range(_MOST_STEPS):
        step = _solve(matrix, right, damping)
        _move(unknowns, step, trial)
        if _least_cosine(trial, views) > 0.02:
            trial_cost, trial_rms = _cost(
                roots, used_samples, lights, half, views, view_of, trial, prior, stiffness, usual, scale
            )
        else:
            trial_cost, trial_rms = np.inf, 0.0
        if trial_cost < cost:
            gain = cost - trial_cost
            assign(unknowns, trial)
            damping = max(damping * 0.2, 1e-9)
            if gain < _SETTLED * cost:
                cost, rms = trial_cost, trial_rms
                break
            cost, rms = _equations(
                roots,
                used_samples,
                lights,
                half,
                views,
                view_of,
                unknowns,
                prior,
                stiffness,
                usual,
                scale,
                matrix,
                right,
            )
        else:
            damping *= 6.0
            if damping > 1e8:
                break
    return cost, rms / math.exp(0.5 * unknowns[3])


@kernel
def _least_cosine(normal, views):  # type: ignore[no-untyped-def]
    """Return the least cosine between the normal and the views."""
    least = 1.0
    for view in range(len(views)):
        cosine = normal[0] * views[view, 0] + normal[1] * views[view, 1] + normal[2] * views[view, 2]
        least = min(least, cosine)
    return least


@kernel
def _move(unknowns, step, trial):  # type: ignore[no-untyped-def]
    """Fill `trial` with the unknowns after a step: two tilts along the normal's tangents, then the logarithms."""
    n0, n1, n2 = unknowns[0], unknowns[1], unknowns[2]
    t1, t2 = tangents(n0, n1, n2)
    x = n0 + step[0] * t1[0] + step[1] * t2[0]
    y = n1 + step[0] * t1[1] + step[1] * t2[1]
    z = n2 + step[0] * t1[2] + step[1] * t2[2]
    length = math.sqrt(x * x + y * y + z * z)
    trial[0], trial[1], trial[2] = x / length, y / length, z / length
    trial[3] = unknowns[3] + min(1.0, max(-1.0, step[2]))
    trial[4] = unknowns[4] + min(2.0, max(-2.0, step[3]))
    log_alpha = unknowns[5] + min(0.7, max(-0.7, step[4]))
    trial[5] = min(math.log(_MOST_ALPHA), max(math.log(LEAST_ALPHA), log_alpha))


@kernel
def _cost(roots, used_samples, lights, half, views, view_of, unknowns, prior, stiffness, usual, scale):  # type: ignore[no-untyped-def]
    """Return Cauchy's cost, and the weighted rms of the residuals."""
    n0, n1, n2 = unknowns[0], unknowns[1], unknowns[2]
    kd, ks, alpha = math.exp(unknowns[3]), math.exp(unknowns[4]), math.exp(unknowns[5])
    to_view = views[:, 0] * n0 + views[:, 1] * n1 + views[:, 2] * n2
    cost = stiffness * ((n0 - prior[0]) ** 2 + (n1 - prior[1]) ** 2 + (n2 - prior[2]) ** 2)
    cost += usual * ((unknowns[5] - USUAL_ALPHA) ** 2 + ((unknowns[4] - USUAL_KS) / SPREAD_KS) ** 2)
    squares, weights = 0.0, 0.0
    for number in range(len(used_samples)):
        light = used_samples[number]
        nl = n0 * lights[light, 0] + n1 * lights[light, 1] + n2 * lights[light, 2]
        model = 0.0
        if nl > 0.0:
            nh = n0 * half[light, 0] + n1 * half[light, 1] + n2 * half[light, 2]
            model = math.sqrt(nl * (kd + ks * lobe(nl, to_view[view_of[light]], nh, alpha)[0]))
        off = (model - roots[number]) / scale
        cost += math.log1p(off * off)
        weight = 1.0 / (1.0 + off * off)
        squares += weight * off * off
        weights += weight
    return cost, scale * math.sqrt(squares / weights)


@kernel
def _equations(  # type: ignore[no-untyped-def]
    roots, used_samples, lights, half, views, view_of, unknowns, prior, stiffness, usual, scale, matrix, right
):
    """Write the normal equations of a step to `matrix` and `right`; return cost and weighted rms."""
    n0, n1, n2 = unknowns[0], unknowns[1], unknowns[2]
    kd, ks, alpha = math.exp(unknowns[3]), math.exp(unknowns[4]), math.exp(unknowns[5])
    t1, t2 = tangents(n0, n1, n2)
    to_view = views[:, 0] * n0 + views[:, 1] * n1 + views[:, 2] * n2
    view_1 = views[:, 0] * t1[0] + views[:, 1] * t1[1] + views[:, 2] * t1[2]
    view_2 = views[:, 0] * t2[0] + views[:, 1] * t2[1] + views[:, 2] * t2[2]
    matrix[:], right[:] = 0.0, 0.0
    row = np.empty(UNKNOWNS)
    d0, d1, d2 = n0 - prior[0], n1 - prior[1], n2 - prior[2]
    cost, squares, weights = stiffness * (d0 * d0 + d1 * d1 + d2 * d2), 0.0, 0.0
    right[0] = -stiffness * (t1[0] * d0 + t1[1] * d1 + t1[2] * d2)
    right[1] = -stiffness * (t2[0] * d0 + t2[1] * d1 + t2[2] * d2)
    matrix[0, 0] = matrix[1, 1] = stiffness
    more_ks, more_alpha = (unknowns[4] - USUAL_KS) / SPREAD_KS, unknowns[5] - USUAL_ALPHA
    cost += usual * (more_alpha * more_alpha + more_ks * more_ks)
    right[3], right[4] = -usual * more_ks / SPREAD_KS, -usual * more_alpha
    matrix[3, 3], matrix[4, 4] = usual / SPREAD_KS**2, usual
    for number in range(len(used_samples)):
        light = used_samples[number]
        view = view_of[light]
        l0, l1, l2 = lights[light, 0], lights[light, 1], lights[light, 2]
        nl = n0 * l0 + n1 * l1 + n2 * l2
        if nl <= 0.0:
            off = -roots[number] / scale
            cost += math.log1p(off * off)
            continue
        model = root_by_unknowns(
            unknowns[:3], t1, t2, lights[light], half[light], to_view[view], view_1[view], view_2[view], kd, ks,
            alpha, row,
        )  # fmt: skip
        off = (model - roots[number]) / scale
        weight = 1.0 / (1.0 + off * off)
        cost += math.log1p(off * off)
        squares += weight * off * off
        weights += weight
        for i in range(UNKNOWNS):
            row[i] /= scale
        for i in range(UNKNOWNS):
            right[i] -= weight * row[i] * off
            for j in range(i + 1):
                matrix[i, j] += weight * row[i] * row[j]
    return cost, scale * math.sqrt(squares / max(weights, 1e-12))


@kernel
def _solve(matrix, right, damping):  # type: ignore[no-untyped-def]
    """Return the damped step, by Cholesky factors. Only the lower half of the matrix is filled."""
    factor, step = np.zeros((UNKNOWNS, UNKNOWNS)), np.empty(UNKNOWNS)
    for i in range(UNKNOWNS):
        for j in range(i + 1):
            total = matrix[i, j]
            if i == j:
                total += damping * (matrix[i, i] + 1e-9)
            for k in range(j):
                total -= factor[i, k] * factor[j, k]
            if i == j:
                factor[i, i] = math.sqrt(max(total, 1e-14))
            else:
                factor[i, j] = total / factor[j, j]
    for i in range(UNKNOWNS):
        total = right[i]
        for k in range(i):
            total -= factor[i, k] * step[k]
        step[i] = total / factor[i, i]
    for i in range(UNKNOWNS - 1, -1, -1):
        total = step[i]
        for k in range(i + 1, UNKNOWNS):
            total -= factor[k, i] * step[k]
        step[i] = total / factor[i, i]
    return step
