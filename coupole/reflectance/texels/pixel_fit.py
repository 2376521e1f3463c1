"""Materials of single pixels: normal, kd, ks and alpha of each, with the material of its triangle as prior.

The fit is the same as for triangles (`coupole.reflectance.ggx_fit`), with one view and one channel, and begins at
the triangle's material. The prior is weak here. The influence of neighbours on a pixel is found afterwards, from
all of them (`coupole.reflectance.texels.neighbours`).
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from coupole.kernels import kernel
from coupole.kernels.lanes import LANES
from coupole.reflectance.ggx import UNKNOWNS, lobe, root_by_unknowns, tangents
from coupole.reflectance.ggx_fit import ROWS, fit_packs, pack
from coupole.reflectance.kernel_arrays import assign
from coupole.reflectance.material_uncertainty import FEWEST_GROUPS
from coupole.reflectance.normal_fit import CAUCHY
from coupole.reflectance.parts_in_threads import in_threads
from coupole.reflectance.triangle_fit import between, towards

Floats = NDArray[np.float64]

TILT, LOG_KS, LOG_ALPHA = math.radians(20.0), 1.5, 0.7
"""Standard deviations of a pixel's normal (each of two tilts) and of the logarithms of ks and alpha from the
values of its triangle. They are larger than all spreads that were seen, so that they have an effect only where the
samples give no information.
"""
FEWEST_OF_PIXEL = 8
"""Least number of samples of a pixel. Its triangle's material adds the missing information, and its uncertainty
shows how much."""
LEAST_KS = 1e-3
"""Least ks of a prior, as a share of kd."""
LEAST_COSINE = 0.05
"""Least cosine between view and prior normal; with less, the triangle's normal was fitted from other views."""
_SETTLED = 1e-4
_PART = 512


@dataclass(frozen=True)
class Lights:
    """LEDs to which a view's pixels are fitted, in the order of their groups."""

    columns: NDArray[np.int64]
    """[leds] places in the pixels' values."""
    places_mm: Floats
    """[leds, 3]"""
    group: NDArray[np.int64]
    """[leds] numbers of groups of neighbours, in rising order; errors in a group are alike."""
    camera_mm: Floats


@dataclass(frozen=True)
class Prior:
    """Prior materials of n pixels: the materials of their triangles, in the pixels' channels."""

    normals: Floats
    """[n, 3]"""
    kd: Floats
    ks: Floats
    alpha: Floats


@dataclass(frozen=True)
class PixelMaterials:
    """Materials of n pixels in their own channels; NaN with too few samples, or after a failed fit."""

    normals: Floats
    """[n, 3]"""
    logs: Floats
    """[n, 3] logarithms of kd, ks and alpha."""
    covariance: Floats
    """[n, 5, 5] covariance of tilts and logarithms, as for triangles."""


def fit_pixels(
    values: NDArray[np.float16], places_mm: NDArray[np.float32], lights: Lights, prior: Prior, threads: int | None
) -> PixelMaterials:
    """Fit n pixels to their values [n, LEDs of the view]."""
    count = len(values)
    normals, logs = np.full((count, 3), np.nan), np.full((count, 3), np.nan)
    covariance = np.full((count, UNKNOWNS, UNKNOWNS), np.nan)

    def fit(first: int) -> None:
        part = slice(first, min(first + _PART, count))
        pixel_values = np.ascontiguousarray(values[part][:, lights.columns].astype(np.float32))
        _fit_part(
            pixel_values, places_mm[part], lights.places_mm, lights.group, lights.camera_mm, prior.normals[part],
            prior.kd[part], prior.ks[part], prior.alpha[part], normals[part], logs[part], covariance[part],
        )  # fmt: skip

    in_threads(fit, count, part=_PART, threads=threads)
    return PixelMaterials(normals, logs, covariance)


@kernel(error_model="numpy")
def _fit_part(  # type: ignore[no-untyped-def]
    values, places_mm, led_mm, group, camera_mm, prior_normals, prior_kd, prior_ks, prior_alpha, normals, logs,
    covariance
):  # fmt: skip
    count, leds = values.shape
    lights, half, views = np.empty((leds, 3)), np.empty((leds, 3)), np.empty((1, 3))
    only_view = np.zeros(leds, np.int64)
    good, roots = np.empty(leds, np.int64), np.empty(leds)
    packs, place = np.empty((leds // LANES + 1, ROWS, LANES)), np.empty(3)
    unknowns, grey, prior_weights = np.empty(6), np.empty(3), np.empty(UNKNOWNS)
    stiffness = 1.0 / TILT**2
    for pixel in range(count):
        normal = prior_normals[pixel]
        if not prior_alpha[pixel] > 0.0:
            continue
        for k in range(3):
            place[k] = places_mm[pixel, k]
        towards(place, camera_mm, views[0])
        if normal[0] * views[0, 0] + normal[1] * views[0, 1] + normal[2] * views[0, 2] < LEAST_COSINE:
            continue
        sample_count = 0
        for led in range(leds):
            if not np.isfinite(values[pixel, led]):
                continue
            towards(place, led_mm[led], lights[led])
            between(lights[led], views[0], half[led])
            good[sample_count], roots[sample_count] = led, math.sqrt(max(values[pixel, led], 0.0))
            sample_count += 1
        if sample_count < FEWEST_OF_PIXEL:
            continue
        assign(unknowns[:3], normal)
        pixel_roots, pixel_leds = roots[:sample_count], good[:sample_count]
        grey[0], grey[1], grey[2] = prior_kd[pixel], prior_ks[pixel], prior_alpha[pixel]
        _begin(unknowns, pixel_roots, pixel_leds, lights, half, views[0], grey)
        pack_count = pack(pixel_roots, pixel_leds, lights, half, views, only_view, packs)
        usual = (unknowns[4], unknowns[5], 1.0 / LOG_KS**2, 1.0 / LOG_ALPHA**2)
        fit_packs(packs[:pack_count], views, unknowns, normal, stiffness, usual, _SETTLED)
        assign(normals[pixel], unknowns[:3])
        assign(logs[pixel], unknowns[3:])
        for k in range(3):
            grey[k] = math.exp(unknowns[3 + k])
        grey[1] = max(grey[1], LEAST_KS * grey[0])
        for k, weight in enumerate((stiffness, stiffness, 1e-2, usual[2], usual[3])):
            prior_weights[k] = weight
        _leave_out_groups(
            pixel_roots, pixel_leds, lights, half, views[0], group, unknowns[:3], grey, prior_weights,
            covariance[pixel],
        )  # fmt: skip


@kernel(error_model="numpy")
def _leave_out_groups(  # type: ignore[no-untyped-def]
    roots, good, lights, half, view, group, normal, grey, prior_weights, covariance
):
    """Fill `covariance` from the steps that the fit would take without each group of LEDs in turn (Quenouille's
    jackknife, with Newton's step). Samples are in the order of their groups. Fewer than `FEWEST_GROUPS` groups say
    too little; then single samples are left out as well. Left NaN where the fit has run off."""
    scale = CAUCHY * math.sqrt(grey[0])
    t1, t2 = tangents(normal[0], normal[1], normal[2])
    nv, v1, v2 = _dot(normal, view), _dot(t1, view), _dot(t2, view)
    count = len(good)
    rows, bends, scores = np.zeros((count, UNKNOWNS)), np.zeros(count), np.zeros(count)
    information, squares = np.diag(prior_weights), np.diag(prior_weights)
    for number in range(count):
        light = lights[good[number]]
        if _dot(normal, light) <= 0.0:
            continue
        root = root_by_unknowns(
            normal, t1, t2, light, half[good[number]], nv, v1, v2, grey[0], grey[1], grey[2], rows[number]
        )
        off = (root - roots[number]) / scale
        weight = 1.0 / (1.0 + off * off)
        bends[number] = max(1.0 - off * off, 0.0) * weight * weight / (scale * scale)
        scores[number] = weight * off / scale
        add_product(bends[number], rows[number], rows[number], information)
    if not np.isfinite(information).all() or not np.isfinite(scores).all():
        return
    first, groups = 0, 0
    for number in range(1, count + 1):
        if number == count or group[good[number]] != group[good[first]]:
            groups += 1
            first = number
    whole = np.zeros((UNKNOWNS, UNKNOWNS))
    first = 0
    for number in range(1, count + 1):
        if number == count or group[good[number]] != group[good[first]]:
            _add_step(rows[first:number], bends[first:number], scores[first:number], information, whole)
            first = number
    if groups < FEWEST_GROUPS:
        for number in range(count):
            some = slice(number, number + 1)
            _add_step(rows[some], bends[some], scores[some], information, whole)
    inverse = np.linalg.inv(information)
    squares = inverse @ squares @ inverse
    for i in range(UNKNOWNS):
        for j in range(UNKNOWNS):
            covariance[i, j] = squares[i, j] + whole[i, j]


@kernel(error_model="numpy")
def _add_step(rows, bends, scores, information, whole):  # type: ignore[no-untyped-def]
    """Add the square of the step that the fit takes if some samples are left out."""
    rest, score = information.copy(), np.zeros(UNKNOWNS)
    for number in range(len(rows)):
        add_product(-bends[number], rows[number], rows[number], rest)
        for i in range(UNKNOWNS):
            score[i] += scores[number] * rows[number, i]
    step = np.linalg.solve(rest, score)
    add_product(1.0, step, step, whole)


@kernel
def _dot(first, second):  # type: ignore[no-untyped-def]
    return first[0] * second[0] + first[1] * second[1] + first[2] * second[2]


@kernel
def add_product(factor, first, second, matrix):  # type: ignore[no-untyped-def]
    for i in range(UNKNOWNS):
        for j in range(UNKNOWNS):
            matrix[i, j] += factor * first[i] * second[j]


@kernel(error_model="numpy")
def _begin(unknowns, roots, good, lights, half, view, prior):  # type: ignore[no-untyped-def]
    """Set the start to the prior's material (kd, ks, alpha), with the brightness of the samples."""
    kd, ks, alpha = prior[0], prior[1], prior[2]
    products, squares = 0.0, 0.0
    n0, n1, n2 = unknowns[0], unknowns[1], unknowns[2]
    nv = max(n0 * view[0] + n1 * view[1] + n2 * view[2], 0.05)
    for number in range(len(good)):
        light, middle = lights[good[number]], half[good[number]]
        nl = n0 * light[0] + n1 * light[1] + n2 * light[2]
        if nl <= 0.05:
            continue
        nh = n0 * middle[0] + n1 * middle[1] + n2 * middle[2]
        model = nl * (kd + ks * lobe(nl, nv, nh, alpha)[0])
        products += roots[number] * math.sqrt(model)
        squares += model
    ratio = max(products / squares, 0.03) if squares > 0.0 else 1.0
    unknowns[3] = math.log(kd) + 2.0 * math.log(ratio)
    unknowns[4], unknowns[5] = math.log(max(ks, LEAST_KS * kd)), math.log(alpha)
