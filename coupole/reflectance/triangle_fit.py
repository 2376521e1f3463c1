"""GGX materials of triangles from the samples of all views, with the mesh's normal and with a fitted one.

The normal of the mesh is the prior of the fitted normal. Its variance comes from noise of the scanner's vertices.
For a triangle of area A this variance is about the variance of an equilateral triangle: 2 s^2 / a^2 with a^2 = 4 A
/ sqrt 3 (a plane through three points, each with an error s). The fit is that of `coupole.reflectance.normal_fit`,
computed by `coupole.reflectance.ggx_fit`.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, fields, replace

import numpy as np
from numpy.typing import NDArray

from coupole.kernels import kernel
from coupole.kernels.lanes import LANES
from coupole.reflectance.ggx import lobe, tangents
from coupole.reflectance.ggx_fit import ROWS, fit_packs, pack
from coupole.reflectance.kernel_arrays import assign
from coupole.reflectance.normal_fit import SPREAD_KS, USUAL_ALPHA, USUAL_KS, colours_from
from coupole.reflectance.parts_in_threads import in_threads

Floats = NDArray[np.float64]

FEWEST = 24
"""Least number of samples of a triangle: about five times the number of unknowns."""
USUAL = 0.1
"""Weight of the usual roughness and ks; a sample can have a weight of about 6. This prior decides where no sample
is near a highlight. Without this prior, one triangle in thousands was five times as bright as white between the
LEDs."""
_USUAL_MATERIAL = (USUAL_KS, USUAL_ALPHA, USUAL / SPREAD_KS**2, USUAL)
"""The usual material in the form of `ggx_fit.fit_packs`."""
MOST_KS = 1.0
"""Largest ks, because a surface cannot reflect more light than it receives."""
_STARTS = (0.08, 0.2, 0.45)
_FIRST_KS = 0.02
_TO_CHOOSE = 256
"""Approximate number of samples from which the best start is chosen."""
LEAST_KD = 1e-6
"""kd that a black surface is given, 1/sr, where a share of kd is needed."""
_CHOSEN, _SETTLED = 1e-4, 1e-5
"""A fit ends when a step lowers the cost by less than this share. The first number is for each start, the second
for the best start."""
HELD = 1e9
"""Stiffness of a normal that is not fitted."""
_PART = 256


@dataclass(frozen=True)
class TriangleSamples:
    """Samples of b triangles in v views; the samples of the views follow one another."""

    values: NDArray[np.float32]
    """[b, samples, channels] f cos_i, 1/sr, with the cosine at the mesh's normal; NaN where there is no sample."""
    led_mm: Floats
    """[samples, 3] positions of their LEDs."""
    view_of: NDArray[np.int64]
    """[samples]"""
    cameras_mm: Floats
    """[v, 3]"""
    centres_mm: Floats
    """[b, 3]"""
    normals: Floats
    """[b, 3] normals of the mesh."""
    areas_mm2: Floats
    """[b]"""

    def of_triangles(self, rows: NDArray[np.int64]) -> TriangleSamples:
        """Return the samples of some of the triangles."""
        of_all = ("values", "centres_mm", "normals", "areas_mm2")
        return replace(self, **{name: getattr(self, name)[rows] for name in of_all})


@dataclass(frozen=True)
class TriangleMaterials:
    """Materials of b triangles; NaN for triangles with too few samples."""

    normals: Floats
    kd: Floats
    """[b, channels] 1/sr."""
    ks: Floats
    alpha: Floats
    residual: Floats
    """Weighted rms of the residuals of the square roots, as a share of sqrt(kd)."""

    def at(self, triangles: NDArray[np.int64]) -> TriangleMaterials:
        """Return the materials of some of the triangles."""
        return TriangleMaterials(*(getattr(self, field.name)[triangles] for field in fields(self)))


def join_materials(parts: Sequence[TriangleMaterials]) -> TriangleMaterials:
    """Join the materials of blocks, one after the other."""
    names = [field.name for field in fields(TriangleMaterials)]
    return TriangleMaterials(*(np.concatenate([getattr(part, name) for part in parts]) for name in names))


def prior_stiffness(areas_mm2: Floats, noise_um: float) -> Floats:
    """Return 1 over the variance, rad^2, of normals of triangles whose vertices have the standard uncertainty
    `noise_um`."""
    side2_mm2 = 4.0 * areas_mm2 / math.sqrt(3.0)
    stiffness: Floats = side2_mm2 / (2.0 * (noise_um * 1e-3) ** 2)
    return stiffness


def fit_triangles(
    samples: TriangleSamples, sample_mask: NDArray[np.bool_], noise_um: float | None, *, threads: int | None = None
) -> TriangleMaterials:
    """Fit materials to the samples `sample_mask` [samples]; normals are fitted if `noise_um` is given."""
    count, _, channels = samples.values.shape
    stiffness = np.full(count, HELD) if noise_um is None else prior_stiffness(samples.areas_mm2, noise_um)
    parameters = np.full((count, 5 + 2 * channels), np.nan)

    def fit(first: int) -> None:
        part = slice(first, min(first + _PART, count))
        _fit_part(
            samples.values[part], samples.led_mm, samples.view_of, samples.cameras_mm, samples.centres_mm[part],
            samples.normals[part], stiffness[part], noise_um is not None, np.flatnonzero(sample_mask),
            parameters[part],
        )  # fmt: skip

    in_threads(fit, count, part=_PART, threads=threads)
    parts = (
        parameters[:, :3],
        parameters[:, 5 : 5 + channels],
        parameters[:, 5 + channels :],
        parameters[:, 3],
        parameters[:, 4],
    )
    return TriangleMaterials(*map(np.ascontiguousarray, parts))  # functions are compiled for each layout


def recolour_materials(
    samples: TriangleSamples,
    sample_mask: NDArray[np.bool_],
    materials: TriangleMaterials,
    normals: Floats,
    *,
    threads: int | None = None,
) -> TriangleMaterials:
    """Return materials with other normals [b, 3]. kd and ks are fitted again to the samples `sample_mask`
    [samples]; roughness and residual stay."""
    kd, ks = materials.kd.copy(), materials.ks.copy()
    grey = np.stack([np.maximum(kd.mean(axis=1), LEAST_KD), ks.mean(axis=1), materials.alpha], axis=1)

    def fit(first: int) -> None:
        part = slice(first, first + _PART)
        _recolour(
            samples.values[part], samples.led_mm, samples.view_of, samples.cameras_mm, samples.centres_mm[part],
            normals[part], grey[part], np.flatnonzero(sample_mask), kd[part], ks[part],
        )  # fmt: skip

    in_threads(fit, len(kd), part=_PART, threads=threads)
    return TriangleMaterials(normals, kd, ks, materials.alpha, materials.residual)


def model_values(samples: TriangleSamples, materials: TriangleMaterials) -> NDArray[np.float32]:
    """[b, samples, channels] values of the materials for the measured samples; NaN without material."""
    modelled_values = np.full(samples.values.shape, np.nan, np.float32)
    _model(
        samples.led_mm, samples.view_of, samples.cameras_mm, samples.centres_mm, materials.normals, materials.kd,
        materials.ks, materials.alpha, modelled_values,
    )  # fmt: skip
    return modelled_values


@kernel
def _fit_part(values, led_mm, view_of, cameras_mm, centres_mm, normals, stiffness, free, used_samples, parameters):  # type: ignore[no-untyped-def]
    count, samples, channels = values.shape
    lights, half = np.empty((samples, 3)), np.empty((samples, 3))
    views = np.empty((len(cameras_mm), 3))
    good, roots = np.empty(samples, np.int64), np.empty(samples)
    colours, packs = np.empty((samples, channels)), np.empty((samples // LANES + 1, ROWS, LANES))
    grey = np.empty(3)
    for triangle in range(count):
        normal, normal_stiffness = normals[triangle], stiffness[triangle]
        n = gather(
            values[triangle], led_mm, view_of, cameras_mm, centres_mm[triangle], normal, used_samples, colours,
            good,
            roots, lights, half, views,
        )  # fmt: skip
        if n < FEWEST:
            continue
        start = _best_start(roots[:n], good[:n], lights, half, views, view_of, normal, normal_stiffness, packs)
        count = pack(roots[:n], good[:n], lights, half, views, view_of, packs)
        _, rms = fit_packs(packs[:count], views, start, normal, normal_stiffness, _USUAL_MATERIAL, _SETTLED)
        assign(parameters[triangle, :3], start[:3] if free else normal)
        parameters[triangle, 3], parameters[triangle, 4] = math.exp(start[5]), rms
        kd, ks = parameters[triangle, 5 : 5 + channels], parameters[triangle, 5 + channels :]
        for k in range(3):
            grey[k] = math.exp(start[3 + k])
        colours_from(colours, good[:n], parameters[triangle, :3], grey, lights, half, views, view_of, kd, ks)
        for channel in range(channels):
            ks[channel] = min(ks[channel], MOST_KS)


@kernel
def _recolour(values, led_mm, view_of, cameras_mm, centres_mm, normals, grey, used_samples, kd, ks):  # type: ignore[no-untyped-def]
    count, samples, channels = values.shape
    lights, half, views = np.empty((samples, 3)), np.empty((samples, 3)), np.empty((len(cameras_mm), 3))
    good, roots, colours = np.empty(samples, np.int64), np.empty(samples), np.empty((samples, channels))
    for triangle in range(count):
        if not grey[triangle, 2] > 0.0:
            continue
        normal = normals[triangle]
        n = gather(
            values[triangle], led_mm, view_of, cameras_mm, centres_mm[triangle], normal, used_samples, colours,
            good,
            roots, lights, half, views,
        )  # fmt: skip
        colours_from(
            colours, good[:n], normal, grey[triangle], lights, half, views, view_of, kd[triangle], ks[triangle]
        )
        for channel in range(channels):
            ks[triangle, channel] = min(ks[triangle, channel], MOST_KS)


@kernel
def gather(  # type: ignore[no-untyped-def]
    values, led_mm, view_of, cameras_mm, centre_mm, normal, used_samples, colours, good, roots, lights, half, views
):
    """Fill the arrays with one triangle's samples and directions, and return their number. A camera that does not
    see the triangle is placed on its normal, so that it excludes no normal."""
    seeing = np.zeros(len(cameras_mm), np.bool_)
    for view in range(len(cameras_mm)):
        towards(centre_mm, cameras_mm[view], views[view])
    n = 0
    for number in range(len(used_samples)):
        sample = used_samples[number]
        grey = 0.0
        for channel in range(values.shape[1]):
            colours[sample, channel] = values[sample, channel]
            grey += colours[sample, channel] / values.shape[1]
        if not grey > 0.0:
            continue
        towards(centre_mm, led_mm[sample], lights[sample])
        between(lights[sample], views[view_of[sample]], half[sample])
        seeing[view_of[sample]] = True
        good[n], roots[n] = sample, math.sqrt(grey)
        n += 1
    for view in range(len(cameras_mm)):
        if not seeing[view]:
            assign(views[view], normal)
    return n


@kernel
def _best_start(roots, good, lights, half, views, view_of, normal, stiffness, packs):  # type: ignore[no-untyped-def]
    """Return, approximately, the end of the best of the starts, from some of the samples; `packs` is working
    memory."""
    kd = _first_kd(roots, good, lights, normal)
    step = max(1, len(good) // _TO_CHOOSE)
    count = pack(roots[::step], good[::step], lights, half, views, view_of, packs)
    unknowns, best_unknowns, best = np.empty(6), np.empty(6), np.inf
    for alpha in _STARTS:
        assign(unknowns[:3], normal)
        unknowns[3], unknowns[4], unknowns[5] = math.log(kd), math.log(_FIRST_KS * kd), math.log(alpha)
        cost, _ = fit_packs(packs[:count], views, unknowns, normal, stiffness, _USUAL_MATERIAL, _CHOSEN)
        if cost < best:
            best = cost
            assign(best_unknowns, unknowns)
    return best_unknowns


@kernel
def _first_kd(roots, good, lights, normal):  # type: ignore[no-untyped-def]
    """Return the median of value over cosine, because few samples are highlights."""
    ratios = np.empty(len(good))
    for n in range(len(good)):
        light = lights[good[n]]
        cosine = light[0] * normal[0] + light[1] * normal[1] + light[2] * normal[2]
        ratios[n] = roots[n] * roots[n] / max(cosine, 0.02)
    return max(np.median(ratios), 1e-9)


@kernel
def towards(place, target, direction):  # type: ignore[no-untyped-def]
    x, y, z = target[0] - place[0], target[1] - place[1], target[2] - place[2]
    length = math.sqrt(x * x + y * y + z * z)
    direction[0], direction[1], direction[2] = x / length, y / length, z / length


@kernel
def between(light, view, half):  # type: ignore[no-untyped-def]
    x, y, z = light[0] + view[0], light[1] + view[1], light[2] + view[2]
    length = math.sqrt(x * x + y * y + z * z)
    half[0], half[1], half[2] = x / length, y / length, z / length


@kernel
def _model(led_mm, view_of, cameras_mm, centres_mm, normals, kd, ks, alpha, modelled_values):  # type: ignore[no-untyped-def]
    count, samples, channels = modelled_values.shape
    views, light, half = np.empty((len(cameras_mm), 3)), np.empty(3), np.empty(3)
    for triangle in range(count):
        n = normals[triangle]
        if not alpha[triangle] > 0.0:
            continue
        for view in range(len(cameras_mm)):
            towards(centres_mm[triangle], cameras_mm[view], views[view])
        for sample in range(samples):
            view = views[view_of[sample]]
            towards(centres_mm[triangle], led_mm[sample], light)
            between(light, view, half)
            nl = n[0] * light[0] + n[1] * light[1] + n[2] * light[2]
            nv = n[0] * view[0] + n[1] * view[1] + n[2] * view[2]
            nh = n[0] * half[0] + n[1] * half[1] + n[2] * half[2]
            shine = lobe(nl, nv, nh, alpha[triangle])[0] if nl > 0.0 and nv > 0.0 else 0.0
            for channel in range(channels):
                modelled_values[triangle, sample, channel] = max(nl, 0.0) * (
                    kd[triangle, channel] + ks[triangle, channel] * shine
                )


@kernel
def turned_normals(normals, tilts):  # type: ignore[no-untyped-def]
    """Return unit normals [n, 3] after tilts [n, 2] along their tangents."""
    new_normals = np.empty_like(normals)
    for n in range(len(normals)):
        t1, t2 = tangents(normals[n, 0], normals[n, 1], normals[n, 2])
        square = 0.0
        for k in range(3):
            new_normals[n, k] = normals[n, k] + tilts[n, 0] * t1[k] + tilts[n, 1] * t2[k]
            square += new_normals[n, k] ** 2
        new_normals[n] /= np.sqrt(square)
    return new_normals
