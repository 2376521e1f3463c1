"""Clusters of triangles that look alike, and one material for each cluster from all its samples (Lucat et al.
2025, section 7: 1,000 materials for 400,000 triangles).

Each sample is turned into the frame of its own triangle, in which z is the fitted normal. Without this, normals
that are wrong by degrees would blur the pooled samples.
"""

from __future__ import annotations

import math
import warnings
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.cluster.vq import kmeans2, vq

from coupole.kernels import kernel
from coupole.reflectance.ggx import lobe
from coupole.reflectance.normal_fit import colours_from, fit_from
from coupole.reflectance.parts_in_threads import in_threads
from coupole.reflectance.triangle_fit import FEWEST, HELD, MOST_KS, USUAL, TriangleMaterials, TriangleSamples

Floats = NDArray[np.float64]

MOST_POOLED = 4096
"""Number of samples of a cluster that are kept for its fit."""
_LEAST_EACH = 8
_SLANT_COS = math.cos(math.radians(30.0))
_OFF_DEG = (0.0, 4.0, 8.0, 16.0, 32.0, 64.0)
"""Angles between half vector and normal at which materials are compared; lights and views are 30 degrees from the
normal."""
LEARNT_FROM = 20_000
"""Largest number of points from which the centres of clusters are found."""
_ROUNDS = 10
_DISTANCES = 1 << 23
"""Number of distances that are computed together."""


@dataclass(frozen=True)
class Pool:
    """Samples of k clusters, at most `MOST_POOLED` of each."""

    values: NDArray[np.float32]
    """[k, MOST_POOLED, channels] f cos_i."""
    lights: NDArray[np.float32]
    """[k, MOST_POOLED, 3] directions in the triangle's frame, whose z axis is its normal."""
    views: NDArray[np.float32]
    counts: NDArray[np.int64]
    """[k]"""


def empty_pool(clusters: int, channels: int) -> Pool:
    shape = (clusters, MOST_POOLED)
    values, lights, views = (np.empty((*shape, last), np.float32) for last in (channels, 3, 3))
    return Pool(values, lights, views, np.zeros(clusters, np.int64))


def looks(materials: TriangleMaterials) -> Floats:
    """[b, channels * 6] square roots of reflectance near the mirror direction."""
    root_reflectances = np.empty((len(materials.alpha), materials.kd.shape[1], len(_OFF_DEG)))
    _looks(materials.kd, materials.ks, materials.alpha, np.cos(np.radians(_OFF_DEG)), root_reflectances)
    return root_reflectances.reshape(len(root_reflectances), -1)


def clusters_of(features: Floats, count: int) -> NDArray[np.int64]:
    """[b] cluster of each of the points [b, n], by k-means: numbers from 0 to at most `count` - 1, without
    gaps."""
    random = np.random.default_rng(0)
    some = features
    if len(features) > LEARNT_FROM:
        some = features[random.choice(len(features), LEARNT_FROM, replace=False)]
    numbers = nearest_of(features, centres_of_points(some, count, random))
    return np.unique(numbers, return_inverse=True)[1].astype(np.int64)


def centres_of_points(points: Floats, count: int, random: np.random.Generator) -> Floats:
    """[at most `count`, n] centres of clusters of the points [b, n], by k-means. A centre may have no point."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", UserWarning)  # of clusters that lost all their points: they are left out
        centres, _ = kmeans2(points, min(count, len(points)), iter=_ROUNDS, minit="points", rng=random)
    return np.asarray(centres, np.float64)


def nearest_of(points: Floats, centres: Floats) -> NDArray[np.int64]:
    """[b] number of the nearest centre of each of the points [b, n]."""
    step = max(1, _DISTANCES // len(centres))  # vq keeps the distances of all points to all centres
    parts = [vq(points[first : first + step], centres)[0] for first in range(0, len(points), step)]
    return np.concatenate(parts).astype(np.int64)


def pool_samples(
    pool: Pool,
    samples: TriangleSamples,
    sample_mask: NDArray[np.bool_],
    normals: Floats,
    cluster: NDArray[np.int64],
    members: NDArray[np.int64],
    random: np.random.Generator,
) -> None:
    """Add samples of triangles with fitted `normals` [b, 3] to the pools of their clusters [b] (-1 for none). The
    triangles of a cluster, whose number is `members` [k], contribute equally."""
    most_each = np.maximum(_LEAST_EACH, MOST_POOLED // np.maximum(members, 1))
    order = random.permutation(np.flatnonzero(sample_mask))
    _pool(
        samples.values, samples.led_mm, samples.view_of, samples.cameras_mm, samples.centres_mm, normals, cluster,
        most_each, order, pool.values, pool.lights, pool.views, pool.counts,
    )  # fmt: skip


def fit_pool(pool: Pool, starts: TriangleMaterials) -> TriangleMaterials:
    """[k] materials of clusters, fitted from `starts` [k]; a cluster with too small a pool keeps its start."""
    count, channels = len(pool.counts), pool.values.shape[2]
    parameters = np.concatenate([starts.kd, starts.ks, starts.alpha[:, None], np.full((count, 1), np.nan)], axis=1)

    enough = np.flatnonzero(pool.counts >= FEWEST)

    def fit(place: int) -> None:
        number = enough[place]
        some = slice(0, pool.counts[number])
        _fit_one(
            pool.values[number, some].astype(np.float64), pool.lights[number, some].astype(np.float64),
            pool.views[number, some].astype(np.float64), parameters[number],
        )  # fmt: skip

    in_threads(fit, len(enough))
    kd, ks = parameters[:, :channels], np.minimum(parameters[:, channels : 2 * channels], MOST_KS)
    parts = np.tile([0.0, 0.0, 1.0], (count, 1)), kd, ks, parameters[:, -2], parameters[:, -1]
    return TriangleMaterials(*map(np.ascontiguousarray, parts))  # functions are compiled for each layout


def nearest_cluster(
    samples: TriangleSamples, sample_mask: NDArray[np.bool_], materials: TriangleMaterials, fewest: int
) -> NDArray[np.int64]:
    """Return [b], for each triangle the cluster whose material fits its samples best, with the mesh's normal; -1
    for fewer than `fewest` samples."""
    nearest = np.full(len(samples.values), -1, np.int64)
    _nearest(
        samples.values, samples.led_mm, samples.view_of, samples.cameras_mm, samples.centres_mm, samples.normals,
        np.flatnonzero(sample_mask), materials.kd, materials.ks, materials.alpha, fewest, nearest,
    )  # fmt: skip
    return nearest


@kernel
def _looks(kd, ks, alpha, off_cos, root_reflectances):  # type: ignore[no-untyped-def]
    for n in range(len(alpha)):
        for k in range(len(off_cos)):
            shine = lobe(_SLANT_COS, _SLANT_COS, off_cos[k], alpha[n])[0]
            for channel in range(kd.shape[1]):
                root_reflectances[n, channel, k] = math.sqrt(kd[n, channel] + ks[n, channel] * shine)


@kernel
def axes_about(normal, axes):  # type: ignore[no-untyped-def]
    """Fill `axes` [3, 3] with rows x, y, z of a frame about a normal (Duff et al. 2017)."""
    x, y, z = normal
    sign = 1.0 if z >= 0.0 else -1.0
    a = -1.0 / (sign + z)
    b = x * y * a
    axes[0, 0], axes[0, 1], axes[0, 2] = 1.0 + sign * x * x * a, sign * b, -sign * x
    axes[1, 0], axes[1, 1], axes[1, 2] = b, sign + y * y * a, -y
    axes[2, 0], axes[2, 1], axes[2, 2] = x, y, z


@kernel
def turned_to(axes, place, target, direction):  # type: ignore[no-untyped-def]
    d0, d1, d2 = target[0] - place[0], target[1] - place[1], target[2] - place[2]
    length = math.sqrt(d0 * d0 + d1 * d1 + d2 * d2)
    for k in range(3):
        direction[k] = (axes[k, 0] * d0 + axes[k, 1] * d1 + axes[k, 2] * d2) / length


@kernel
def _pool(  # type: ignore[no-untyped-def]
    values,
    led_mm,
    view_of,
    cameras_mm,
    centres_mm,
    normals,
    cluster,
    most_each,
    order,
    pool_values,
    lights,
    views,
    counts,
):
    axes = np.empty((3, 3))
    for triangle in range(len(values)):
        number, count = cluster[triangle], 0
        if number < 0:
            continue
        axes_about(normals[triangle], axes)
        for sample in order:
            place = counts[number]
            if count == most_each[number] or place == pool_values.shape[1]:
                break
            all_positive = True
            for channel in range(values.shape[2]):
                all_positive &= values[triangle, sample, channel] > 0.0
            if not all_positive:
                continue
            pool_values[number, place] = values[triangle, sample]
            turned_to(axes, centres_mm[triangle], led_mm[sample], lights[number, place])
            turned_to(axes, centres_mm[triangle], cameras_mm[view_of[sample]], views[number, place])
            count += 1
            counts[number] += 1


@kernel
def _fit_one(values, lights, views, parameters):  # type: ignore[no-untyped-def]
    """Fit one material (kd, ks, alpha, residual) in place, starting from its values."""
    count, channels = values.shape
    half, roots, grey = np.empty((count, 3)), np.empty(count), np.zeros(2)
    for n in range(count):
        x, y, z = lights[n, 0] + views[n, 0], lights[n, 1] + views[n, 1], lights[n, 2] + views[n, 2]
        length = math.sqrt(x * x + y * y + z * z)
        half[n, 0], half[n, 1], half[n, 2] = x / length, y / length, z / length
        views[n, 2] = max(views[n, 2], 0.03)  # a view below a fitted normal forbids no step
        roots[n] = math.sqrt(np.sum(values[n]) / channels)
    for channel in range(channels):
        grey[0] += parameters[channel] / channels
        grey[1] += parameters[channels + channel] / channels
    z_axis, indices = np.array([0.0, 0.0, 1.0]), np.arange(count)
    unknowns = np.array([0.0, 0.0, 1.0, 0.0, 0.0, math.log(parameters[2 * channels])])
    unknowns[3], unknowns[4] = math.log(max(grey[0], 1e-9)), math.log(max(grey[1], 1e-6))
    _, rms = fit_from(roots, indices, lights, half, views, indices, unknowns, z_axis, HELD, USUAL)
    colours_from(
        values, indices, z_axis, np.exp(unknowns[3:6]), lights, half, views, indices, parameters[:channels],
        parameters[channels : 2 * channels],
    )  # fmt: skip
    parameters[2 * channels], parameters[2 * channels + 1] = math.exp(unknowns[5]), rms


@kernel
def _nearest(  # type: ignore[no-untyped-def]
    values, led_mm, view_of, cameras_mm, centres_mm, normals, used_samples, kd, ks, alpha, fewest, nearest_clusters
):
    axes, light, view = np.empty((3, 3)), np.empty(3), np.empty(3)
    misses = np.empty(len(alpha))
    for triangle in range(len(values)):
        axes_about(normals[triangle], axes)
        misses[:] = 0.0
        count = 0
        for sample in used_samples:
            value = values[triangle, sample]
            if np.isnan(value).all():
                continue
            turned_to(axes, centres_mm[triangle], led_mm[sample], light)
            turned_to(axes, centres_mm[triangle], cameras_mm[view_of[sample]], view)
            if light[2] <= 0.0 or view[2] <= 0.0:
                continue
            count += 1
            length = math.sqrt((light[0] + view[0]) ** 2 + (light[1] + view[1]) ** 2 + (light[2] + view[2]) ** 2)
            for number in range(len(alpha)):
                shine = lobe(light[2], view[2], (light[2] + view[2]) / length, alpha[number])[0]
                for channel in range(len(value)):
                    if not math.isnan(value[channel]):
                        modelled_value = light[2] * (kd[number, channel] + ks[number, channel] * shine)
                        misses[number] += (math.sqrt(modelled_value) - math.sqrt(max(value[channel], 0.0))) ** 2
        if count >= fewest:
            nearest_clusters[triangle] = np.argmin(misses)
