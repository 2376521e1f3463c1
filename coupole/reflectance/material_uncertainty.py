"""Covariance of normals and materials of triangles, and the resulting uncertainty of values in any direction.

The fit solves equations of scores. A score is the sum, over the samples, of weight times derivative times
residual, plus the priors. Its covariance is H^-1 M H^-1, where H is the derivatives of the scores and M their
variance (Huber 1967). M comes from the residuals, which are summed by groups of neighbouring LEDs before they are
squared (Liang and Zeger 1986). Within a group, the errors of the material's form, of an LED's power and of a
shadow's edge are alike. So M contains noise, each LED's own power, and the error of the model. Two parts are
added: the scanner's noise, for normals that are held to the mesh; and the spread of the prior, where only the
usual roughness and ks determine them. The uncertainty that all LEDs share is a factor of kd and ks, and is kept
separately.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from coupole.kernels import kernel
from coupole.reflectance.ggx import UNKNOWNS, lobe, root_by_unknowns, tangents
from coupole.reflectance.kernel_arrays import assign_rows
from coupole.reflectance.normal_fit import CAUCHY, SPREAD_KS, colour_weight
from coupole.reflectance.parts_in_threads import in_threads
from coupole.reflectance.triangle_fit import (
    HELD,
    LEAST_KD,
    USUAL,
    TriangleMaterials,
    TriangleSamples,
    between,
    gather,
    prior_stiffness,
    towards,
)

Floats = NDArray[np.float64]

GROUPS = 8
"""Number of groups of LEDs in each view."""
FEWEST_GROUPS = 6
"""Least number of groups. Fewer groups say too little about errors that their samples
share; then single samples are used too."""
_LEAST_KS = 1e-3
"""Least ks that the derivatives assume, as a share of kd. With a smaller value, the covariance of the logarithm
would say nothing about a possible highlight."""
LEAST_KNOWN = 1e-2
"""1 over the variance of the logarithm of kd if the samples do not determine it."""
_PART = 256


@dataclass(frozen=True)
class MaterialUncertainty:
    """Uncertainty of the materials of b triangles; NaN for triangles without material."""

    covariance: Floats
    """[b, 5, 5] covariance of the `ggx.UNKNOWNS`, for the channels' mean."""
    u_kd: Floats
    """[b, channels] relative standard uncertainty."""
    u_ks: Floats


def groups_of(samples: TriangleSamples, middle_mm: Floats) -> NDArray[np.int64]:
    """[samples] group numbers: LEDs of a view form groups around some evenly spread LEDs, each LED with the
    nearest of these, as seen from the object's middle."""
    group = np.empty(len(samples.led_mm), np.int64)
    for view in np.unique(samples.view_of):
        view_samples = np.flatnonzero(samples.view_of == view)
        group[view_samples] = groups_of_leds(samples.led_mm[view_samples], middle_mm) + GROUPS * view
    return group


def groups_of_leds(led_mm: Floats, middle_mm: Floats) -> NDArray[np.int64]:
    """[leds] numbers, from 0, of the groups of neighbouring LEDs [leds, 3] of one view."""
    ways = led_mm - middle_mm
    ways /= np.linalg.norm(ways, axis=1, keepdims=True)
    centres, nearest = [0], np.full(len(ways), -np.inf)
    for _ in range(min(GROUPS, len(ways))):
        nearest = np.maximum(nearest, ways @ ways[centres[-1]])
        centres.append(int(np.argmin(nearest)))
    group: NDArray[np.int64] = np.argmax(ways @ ways[centres[:-1]].T, axis=1)
    return group


def covariances(
    samples: TriangleSamples,
    sample_mask: NDArray[np.bool_],
    materials: TriangleMaterials,
    noise_um: float,
    *,
    fitted_normals: bool,
    middle_mm: Floats,
    threads: int | None = None,
) -> MaterialUncertainty:
    """Return the covariances of materials that were fitted to the samples `sample_mask` [samples]; `noise_um` is
    the noise of the mesh's vertices, `middle_mm` the middle of the object."""
    prior = prior_stiffness(samples.areas_mm2, noise_um)
    stiffness = prior if fitted_normals else np.full(len(prior), HELD)
    group = groups_of(samples, middle_mm)
    order = np.flatnonzero(sample_mask)
    order = order[np.argsort(group[order], kind="stable")]
    grey = np.stack([materials.kd.mean(axis=1), materials.ks.mean(axis=1), materials.alpha], axis=1)
    grey[:, 0] = np.maximum(grey[:, 0], LEAST_KD)
    grey[:, 1] = np.maximum(grey[:, 1], _LEAST_KS * grey[:, 0])
    material_covariances = np.full((len(prior), UNKNOWNS, UNKNOWNS), np.nan)
    u_kd, u_ks = np.full(materials.kd.shape, np.nan), np.full(materials.kd.shape, np.nan)

    def fill(first: int) -> None:
        part = slice(first, first + _PART)
        _fill(
            samples.values[part], samples.led_mm, samples.view_of, samples.cameras_mm, samples.centres_mm[part],
            materials.normals[part], grey[part], materials.kd[part], materials.ks[part], stiffness[part],
            prior[part], order, group, material_covariances[part], u_kd[part], u_ks[part],
        )  # fmt: skip

    in_threads(fill, len(prior), part=_PART, threads=threads)
    return MaterialUncertainty(material_covariances, u_kd, u_ks)


def relative_uncertainty(
    samples: TriangleSamples, materials: TriangleMaterials, covariance: Floats
) -> NDArray[np.float32]:
    """[b, samples] relative standard uncertainty of the materials' values for the measured samples, without the
    part that all LEDs share; NaN where there is no value."""
    u_relative = np.full(samples.values.shape[:2], np.nan, np.float32)
    grey = np.stack([materials.kd.mean(axis=1), materials.ks.mean(axis=1), materials.alpha], axis=1)
    _relative(
        samples.led_mm, samples.view_of, samples.cameras_mm, samples.centres_mm, materials.normals, grey,
        covariance, u_relative,
    )  # fmt: skip
    return u_relative


@kernel
def _fill(  # type: ignore[no-untyped-def]
    values, led_mm, view_of, cameras_mm, centres_mm, normals, grey, kd, ks, normal_stiffness, prior, order,
    group, covariance, u_kd,
    u_ks,
):  # fmt: skip
    samples = values.shape[1]
    lights, half = np.empty((samples, 3)), np.empty((samples, 3))
    views, colours = np.empty((len(cameras_mm), 3)), np.empty((samples, values.shape[2]))
    good, roots = np.empty(samples, np.int64), np.empty(samples)
    for triangle in range(len(values)):
        if not grey[triangle, 2] > 0.0:
            continue
        n = gather(
            values[triangle], led_mm, view_of, cameras_mm, centres_mm[triangle], normals[triangle], order, colours,
            good, roots, lights, half, views,
        )  # fmt: skip
        bread, meat = np.zeros((UNKNOWNS, UNKNOWNS)), np.zeros((UNKNOWNS, UNKNOWNS))
        add_scores(
            roots[:n],
            good[:n],
            lights,
            half,
            views,
            view_of,
            group,
            normals[triangle],
            grey[triangle],
            bread,
            meat,
        )
        for tilt in range(2):
            bread[tilt, tilt] += normal_stiffness[triangle]
            meat[tilt, tilt] += normal_stiffness[triangle] * normal_stiffness[triangle] / prior[triangle]
        bread[2, 2] += LEAST_KNOWN
        meat[2, 2] += LEAST_KNOWN
        bread[3, 3] += USUAL / SPREAD_KS**2
        meat[3, 3] += USUAL / SPREAD_KS**2
        bread[4, 4] += USUAL
        meat[4, 4] += USUAL
        if not (np.isfinite(bread).all() and np.isfinite(meat).all()):
            continue  # a fit that ran off has no derivative: its uncertainty stays unknown
        inverse = np.linalg.inv(bread)
        assign_rows(covariance[triangle], inverse @ meat @ inverse.T)
        _colours(
            colours, good[:n], lights, half, views, view_of, group, normals[triangle], grey[triangle],
            kd[triangle], ks[triangle], covariance[triangle], u_kd[triangle], u_ks[triangle],
        )  # fmt: skip


@kernel
def add_scores(roots, good, lights, half, views, view_of, group, normal, grey, bread, meat):  # type: ignore[no-untyped-def]
    """Add the derivatives of the scores of samples to `bread`, and the scores' variance to `meat`; samples are in
    the order of their groups."""
    scale = CAUCHY * math.sqrt(grey[0])
    t1, t2 = tangents(normal[0], normal[1], normal[2])
    row, score = np.empty(UNKNOWNS), np.zeros(UNKNOWNS)
    single = np.zeros((UNKNOWNS, UNKNOWNS))
    groups, before = 0, -1
    for number in range(len(good)):
        sample = good[number]
        light, view = lights[sample], views[view_of[sample]]
        if normal[0] * light[0] + normal[1] * light[1] + normal[2] * light[2] <= 0.0:
            continue
        root = _root(normal, t1, t2, light, half[sample], view, grey, row)
        off = (root - roots[number]) / scale
        weight = 1.0 / (1.0 + off * off)
        if group[sample] != before:
            groups, before = groups + 1, group[sample]
            _add_square(score, meat)
            score[:] = 0.0
        bend = max(1.0 - off * off, 0.0) * weight * weight / (scale * scale)
        for i in range(UNKNOWNS):
            score[i] += weight * off * row[i] / scale
            for j in range(UNKNOWNS):
                bread[i, j] += bend * row[i] * row[j]
                single[i, j] += (weight * off / scale) ** 2 * row[i] * row[j]
    _add_square(score, meat)
    if groups < FEWEST_GROUPS:
        _add(single.reshape(-1), meat.reshape(-1))
    few = groups / max(groups - 1.0, 1.0) * (len(good) - 1.0) / max(len(good) - UNKNOWNS, 1.0)
    for i in range(UNKNOWNS):
        for j in range(UNKNOWNS):
            meat[i, j] *= few


@kernel
def _colours(  # type: ignore[no-untyped-def]
    sample_colours, good, lights, half, views, view_of, group, normal, grey, kd, ks, covariance, u_kd, u_ks
):
    """Fill `u_kd` and `u_ks` with the relative uncertainties of each channel's kd and ks. One part comes from
    their own least squares (`normal_fit.colours_from`), with fixed normal and roughness. The other is the part
    that normal and roughness add to the channels' mean."""
    channels = len(kd)
    bread, meat = np.zeros((2, 2)), np.zeros((channels + 1, 2, 2))
    score, row = np.zeros((channels + 1, 2)), np.empty(2)
    single = np.zeros((channels + 1, 2, 2))
    off, part = np.empty(channels + 1), np.empty(2)
    groups, before = 0, -1
    for number in range(len(good)):
        sample = good[number]
        light, view = lights[sample], views[view_of[sample]]
        nl = normal[0] * light[0] + normal[1] * light[1] + normal[2] * light[2]
        if nl <= 0.0:
            continue
        nv = normal[0] * view[0] + normal[1] * view[1] + normal[2] * view[2]
        nh = normal[0] * half[sample, 0] + normal[1] * half[sample, 1] + normal[2] * half[sample, 2]
        row[0], row[1] = nl, nl * lobe(nl, nv, nh, grey[2])[0]
        weight = colour_weight(row[0] * grey[0] + row[1] * grey[1], sample_colours[sample], grey[0])
        if group[sample] != before:
            groups, before = groups + 1, group[sample]
            for channel in range(channels + 1):
                _add_square(score[channel], meat[channel])
            score[:] = 0.0
        off[channels] = 0.0
        for channel in range(channels):
            off[channel] = sample_colours[sample, channel] - row[0] * kd[channel] - row[1] * ks[channel]
            off[channels] += off[channel] / channels
        for i in range(2):
            for j in range(2):
                bread[i, j] += weight * row[i] * row[j]
        for channel in range(channels + 1):
            for i in range(2):
                part[i] = weight * off[channel] * row[i]
                score[channel, i] += part[i]
            _add_square(part, single[channel])
    for channel in range(channels + 1):
        _add_square(score[channel], meat[channel])
    if groups < FEWEST_GROUPS:
        _add(single.reshape(-1), meat.reshape(-1))
    bread[0, 0] += 1e-12
    bread[1, 1] += 1e-9 * bread[0, 0]
    inverse = np.linalg.inv(bread)
    mean = inverse @ meat[channels] @ inverse
    more_kd = max(covariance[2, 2] - mean[0, 0] / grey[0] ** 2, 0.0)
    more_ks = max(covariance[3, 3] - mean[1, 1] / grey[1] ** 2, 0.0)
    for channel in range(channels):
        alone = inverse @ meat[channel] @ inverse
        u_kd[channel] = math.sqrt(alone[0, 0] / max(kd[channel], 1e-9) ** 2 + more_kd)
        u_ks[channel] = math.sqrt(alone[1, 1] / max(ks[channel], 1e-9) ** 2 + more_ks)


@kernel
def _add(single, meat):  # type: ignore[no-untyped-def]
    for i in range(len(meat)):
        meat[i] += single[i]


@kernel
def _add_square(score, meat):  # type: ignore[no-untyped-def]
    for i in range(len(score)):
        for j in range(len(score)):
            meat[i, j] += score[i] * score[j]


@kernel
def _root(normal, t1, t2, light, half, view, grey, row):  # type: ignore[no-untyped-def]
    nv = normal[0] * view[0] + normal[1] * view[1] + normal[2] * view[2]
    v1 = t1[0] * view[0] + t1[1] * view[1] + t1[2] * view[2]
    v2 = t2[0] * view[0] + t2[1] * view[1] + t2[2] * view[2]
    return root_by_unknowns(normal, t1, t2, light, half, nv, v1, v2, grey[0], grey[1], grey[2], row)


@kernel
def _relative(led_mm, view_of, cameras_mm, centres_mm, normals, grey, covariance, u_relative):  # type: ignore[no-untyped-def]
    views, light, half, row = np.empty((len(cameras_mm), 3)), np.empty(3), np.empty(3), np.empty(UNKNOWNS)
    for triangle in range(len(u_relative)):
        normal = normals[triangle]
        if not grey[triangle, 2] > 0.0:
            continue
        t1, t2 = tangents(normal[0], normal[1], normal[2])
        for view in range(len(cameras_mm)):
            towards(centres_mm[triangle], cameras_mm[view], views[view])
        for sample in range(u_relative.shape[1]):
            view = views[view_of[sample]]
            towards(centres_mm[triangle], led_mm[sample], light)
            between(light, view, half)
            nl = normal[0] * light[0] + normal[1] * light[1] + normal[2] * light[2]
            nv = normal[0] * view[0] + normal[1] * view[1] + normal[2] * view[2]
            if nl <= 0.0 or nv <= 0.0:
                continue
            root = _root(normal, t1, t2, light, half, view, grey[triangle], row)
            variance = 0.0
            for i in range(UNKNOWNS):
                for j in range(UNKNOWNS):
                    variance += row[i] * covariance[triangle, i, j] * row[j]
            u_relative[triangle, sample] = 2.0 * math.sqrt(max(variance, 0.0)) / root
