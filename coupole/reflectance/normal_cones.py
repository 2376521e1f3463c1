"""Half angles of cones around normals from pictures: for 95 % of the pixels the true normal lies inside.

The true normals are not known, so the spread over groups of neighbouring lights is used instead. If the material's
form is wrong, or the surface reflects light onto itself, the two sides of the dome give different normals. Two
spreads are used. The fit's own covariance by groups (`material_uncertainty.add_scores`: Huber 1967, Liang and
Zeger 1986) distinguishes the pixels, but is far too small. The jackknife over the same groups of the plain robust
normal (`normal_fit.rank_normals`) has about the size of the fit's error; its 95 % quantile is taken in strata of
the first spread. Both spreads are added in quadrature.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from coupole.kernels import kernel
from coupole.reflectance.ggx import UNKNOWNS
from coupole.reflectance.material_uncertainty import add_scores, groups_of_leds
from coupole.reflectance.normal_fit import SHADOW_QUANTILE, SHADOW_SHARE, PointMaterials, rank_normals
from coupole.reflectance.parts_in_threads import in_threads

Floats = NDArray[np.float64]

LEVEL = 0.95
FEWEST_LIGHTS = 12
"""Least number of lights for which the spread over groups is evidence."""
_NORMAL_QUANTILE = math.sqrt(-math.log(1.0 - LEVEL))
"""Radius that contains 95 % of a two-dimensional normal distribution, divided by its rms radius."""
_STRATA = (0.25, 0.5, 0.75, 0.9, 0.97)
"""Quantiles of the fit's own spread that separate the strata."""
_SHRINK_PIXELS = 200.0
"""Number of pixels at which a stratum's quantile has half of the weight."""
_LEAST_KS = 1e-3
"""Least ks, as a share of kd, for which derivatives are meaningful."""
_LOOSE = (1.0, 1.0, 1e-2, 1e-3, 1e-3)
"""1 over the variances of unknown tilts (rad) and of unknown logarithms of kd, ks and alpha."""
_BLOCK = 2000


def spreads_deg(
    values: Floats, materials: PointMaterials, lights: Floats, view: Floats, *, threads: int | None = None
) -> tuple[Floats, Floats]:
    """Return the fit's own spread and the jackknife's spread, both [n] rms tilts in degrees; NaN without material.
    They come from grey values [n, lights] under lights [lights, 3] and from their materials. All directions are
    unit vectors."""
    group = groups_of_leds(lights.copy(), np.zeros(3))
    return (
        _fit_spread_deg(values, materials, lights, view, group, threads),
        _jackknife_deg(values, lights, group) + 0.0 * materials.kd,
    )


def cones_deg(fit_deg: Floats, jackknife_deg: Floats) -> Floats:
    """[n] half angles of 95 % cones, degrees, from the spreads of all pixels; NaN where the spreads are NaN."""
    is_known = np.isfinite(fit_deg) & np.isfinite(jackknife_deg)
    cones = np.full(len(fit_deg), np.nan)
    if is_known.any():
        fit_spread, jackknife = fit_deg[is_known], jackknife_deg[is_known]
        stratum = np.digitize(fit_spread, np.quantile(fit_spread, _STRATA))
        quantiles = np.array(
            [_shrunk_quantile(jackknife, stratum == number) for number in range(len(_STRATA) + 1)]
        )
        cones[is_known] = np.minimum(np.hypot(quantiles[stratum], _NORMAL_QUANTILE * fit_spread), 180.0)
    return cones


def _shrunk_quantile(values: Floats, in_stratum: NDArray[np.bool_]) -> float:
    """Return the quantile of a stratum, moved towards the quantile of all values if the stratum is small."""
    every = float(np.quantile(values, LEVEL))
    count = int(np.count_nonzero(in_stratum))
    if not count:
        return every
    return every + count / (count + _SHRINK_PIXELS) * (float(np.quantile(values[in_stratum], LEVEL)) - every)


def _jackknife_deg(values: Floats, lights: Floats, group: NDArray[np.int64]) -> Floats:
    """[n] jackknife standard deviation of the robust normals; each group of lights is left out in turn."""
    whole = rank_normals(values, lights)[0]
    square = np.zeros(len(values))
    numbers = np.unique(group)
    for number in numbers:
        is_other = group != number
        without = rank_normals(values[:, is_other], lights[is_other])[0]
        square += np.arccos(np.clip(np.sum(whole * without, axis=1), -1.0, 1.0)) ** 2
    jackknife_deg: Floats = np.degrees(np.sqrt(square * (len(numbers) - 1) / len(numbers)))
    return jackknife_deg


def _fit_spread_deg(
    values: Floats,
    materials: PointMaterials,
    lights: Floats,
    view: Floats,
    group: NDArray[np.int64],
    threads: int | None,
) -> Floats:
    """[n] rms tilt by the covariance of each pixel's fit."""
    half = lights + view
    half /= np.linalg.norm(half, axis=1, keepdims=True)
    order = np.argsort(group, kind="stable")
    grey = np.stack([materials.kd, np.maximum(materials.ks, _LEAST_KS * materials.kd), materials.alpha], axis=1)
    variance = np.full(len(values), np.nan)
    arrays = np.zeros(len(lights), np.int64), order, group, np.array(_LOOSE)

    def fill(begin: int) -> None:
        part = slice(begin, begin + _BLOCK)
        of_part = np.ascontiguousarray(values[part]), materials.normals[part], grey[part], variance[part]
        least = SHADOW_SHARE * np.quantile(of_part[0], SHADOW_QUANTILE, axis=1)
        _fill(*of_part, np.maximum(least, 0.0), lights, half, view[None], *arrays)

    in_threads(fill, len(values), part=_BLOCK, threads=threads)
    fit_deg: Floats = np.degrees(np.sqrt(variance))
    return fit_deg


@kernel
def _fill(values, normals, grey, variance, least, lights, half, views, view_of, order, group, loose):  # type: ignore[no-untyped-def]
    good, roots = np.empty(len(order), np.int64), np.empty(len(order))
    for pixel in range(len(values)):
        if not grey[pixel, 0] > 0.0:
            continue
        n = 0
        for light in order:
            if values[pixel, light] > least[pixel]:
                good[n], roots[n] = light, math.sqrt(values[pixel, light])
                n += 1
        bread, meat = np.zeros((UNKNOWNS, UNKNOWNS)), np.zeros((UNKNOWNS, UNKNOWNS))
        add_scores(
            roots[:n], good[:n], lights, half, views, view_of, group, normals[pixel], grey[pixel], bread, meat
        )
        for unknown in range(UNKNOWNS):
            bread[unknown, unknown] += loose[unknown]
            meat[unknown, unknown] += loose[unknown]
        if np.isfinite(bread).all() and np.isfinite(meat).all():
            inverse = np.linalg.inv(bread)
            covariance = inverse @ meat @ inverse.T
            variance[pixel] = covariance[0, 0] + covariance[1, 1]
