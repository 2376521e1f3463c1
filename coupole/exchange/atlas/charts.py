"""Charts: parts of a mesh that can be projected on a plane without folds, for textures.

A chart grows from a triangle to its neighbours while their directions stay close to its own. Directions are means
over some rings of neighbours; otherwise the noise of a scan would cut the mesh into single triangles. A chart is
projected along its direction. So lengths shrink at most by the cosine of a triangle's slope (`_LEAST_FACING`).
"""

from __future__ import annotations

import math

import numba
import numpy as np
from numpy.typing import NDArray

from coupole.kernels import kernel

Floats = NDArray[np.float64]
Integers = NDArray[np.int32]

_ROUNDS = 12
"""Rings of neighbours over which directions are averaged."""
_MOST_TURN = math.cos(math.radians(40.0))
_LEAST_FACING = math.cos(math.radians(70.0))
_LEAST_FACING_MERGED = math.cos(math.radians(86.0))
"""Cosines of three greatest angles: between mean directions within a chart; between a single triangle and the
plane of its chart while the chart grows; and the same angle while small charts are merged into their neighbours.
"""
_LEAST_TRIANGLES = 64
"""Fewest triangles of a chart; smaller ones are merged into their neighbours."""
_MOST_SHARE = 1 / 100
"""Largest share of all triangles in a chart. This limit keeps charts round, so that their rectangles are well
filled.
"""
_MERGE_PASSES, _ROUNDINGS = 6, 3


def neighbours_of(triangles: NDArray[np.integer]) -> Integers:
    """[n, 3] the triangle across each edge of triangles [n, 3] (from corner k to the next); -1 at a border, and
    where more than two triangles meet."""
    count = len(triangles)
    ends = np.sort(np.stack([triangles, np.roll(triangles, -1, axis=1)], axis=2).reshape(-1, 2), axis=1)
    edges = ends[:, 0].astype(np.int64) * (int(triangles.max(initial=0)) + 1) + ends[:, 1]
    order = np.argsort(edges, kind="stable")
    sorted_edges = edges[order]
    same = sorted_edges[1:] == sorted_edges[:-1]
    is_pair = same & ~np.append(False, same[:-1]) & ~np.append(same[1:], False)
    first, second = order[:-1][is_pair], order[1:][is_pair]
    beyond = np.full(3 * count, -1, np.int32)
    beyond[first], beyond[second] = second // 3, first // 3
    return beyond.reshape(count, 3)


def double_areas(corners_mm: Floats) -> Floats:
    """[n, 3] normals of triangles [n, 3, 3]; their length is twice the triangle's area."""
    return np.asarray(np.cross(corners_mm[:, 1] - corners_mm[:, 0], corners_mm[:, 2] - corners_mm[:, 0]))


def unit(vectors: NDArray[np.floating]) -> Floats:
    """[..., 3] the vectors with length 1; vectors of length 0 stay 0."""
    return np.asarray(vectors / np.maximum(np.linalg.norm(vectors, axis=-1, keepdims=True), 1e-300))


def cut_charts(corners_mm: Floats, neighbours: Integers) -> Integers:
    """[n] the chart of each triangle [n, 3, 3], from 0.

    Charts are round, so that their rectangles are well filled. They grow one by one, and then `_ROUNDINGS` times
    all together from their middles (Lloyd, 1982).
    """
    normals, means = unit(double_areas(corners_mm)), _mean_normals(corners_mm, neighbours)
    most = max(int(_MOST_SHARE * len(normals)), _LEAST_TRIANGLES)
    no_seeds = np.empty(0, np.int64)
    chart, axes = _grow(normals, means, neighbours, no_seeds, most)
    for _ in range(_ROUNDINGS):
        chart, axes = _grow(normals, means, neighbours, _middles(corners_mm, chart), most)
    _merge(normals, neighbours, chart, axes)
    return parts_of(neighbours, chart)


def _middles(corners_mm: Floats, chart: Integers) -> NDArray[np.int64]:
    """The triangle that is nearest to the middle of each larger chart."""
    centres_mm, sizes = corners_mm.mean(axis=1), np.bincount(chart)
    middles = np.stack([np.bincount(chart, column) for column in centres_mm.T], axis=1) / sizes[:, None]
    distance = np.linalg.norm(centres_mm - middles[chart], axis=1)
    order = np.lexsort((distance, chart))
    firsts = order[np.searchsorted(chart[order], np.arange(len(sizes)))]
    return np.asarray(firsts[sizes >= _LEAST_TRIANGLES])


def chart_axes(corners_mm: Floats, chart: Integers) -> Floats:
    """[charts, 3] unit directions: the mean of the triangles' normals of each chart, weighted by area."""
    sums = [np.bincount(chart, column) for column in double_areas(corners_mm).T]
    return unit(np.stack(sums, axis=1))


def split_off(neighbours: Integers, chart: Integers, is_expelled: NDArray[np.bool_]) -> Integers:
    """The charts [n] after the expelled triangles [n] have been moved to new charts, one for each connected
    part."""
    return parts_of(neighbours, np.where(is_expelled, chart + chart.max() + 1, chart).astype(np.int32))


def parts_of(neighbours: Integers, kind: Integers) -> Integers:
    """[n] number of each triangle's chart, from 0. A chart is a set of connected triangles of one `kind` [n]."""
    parts: Integers = _numbered_parts(neighbours, kind)
    return parts


def _mean_normals(corners_mm: Floats, neighbours: Integers) -> Floats:
    sums = double_areas(corners_mm)
    has_neighbour = (neighbours >= 0)[..., None]
    for _ in range(_ROUNDS):
        sums = sums + np.where(has_neighbour, sums[neighbours], 0.0).sum(axis=1)
        sums /= max(float(np.abs(sums).max(initial=0.0)), 1e-300)
    return unit(sums)


@kernel(error_model="numpy")
def _grow(normals, means, neighbours, seeds, most):  # type: ignore[no-untyped-def]
    """Charts [n] of triangles, and the directions [charts, 3] along which they grew. They grow from all seeds
    together, then one by one from the remaining triangles; each has up to `most` triangles."""
    count = len(normals)
    chart, axes = np.full(count, -1, np.int32), np.empty_like(normals)
    queue, last = np.empty(count, np.int32), 0
    for charts in range(len(seeds)):
        last = _begin(seeds[charts], charts, normals, means, chart, axes, queue, last)
    _fill_charts(normals, means, neighbours, chart, axes, queue, last, count)
    charts = len(seeds)
    for seed in range(count):
        if chart[seed] < 0:
            _begin(seed, charts, normals, means, chart, axes, queue, 0)
            _fill_charts(normals, means, neighbours, chart, axes, queue, 1, most)
            charts += 1
    return chart, axes[:charts].copy()


@kernel(error_model="numpy")
def _begin(seed, number, normals, means, chart, axes, queue, last):  # type: ignore[no-untyped-def]
    """Begin a chart with a triangle; return the length of the queue."""
    axes[number] = means[seed]
    if _dot(means[seed], normals[seed]) <= _LEAST_FACING:
        axes[number] = normals[seed]
    chart[seed], queue[last] = number, seed
    return last + 1


@kernel(error_model="numpy")
def _fill_charts(normals, means, neighbours, chart, axes, queue, last, most):  # type: ignore[no-untyped-def]
    """Add the neighbours of queued triangles to their charts, until `most` have been queued."""
    first = 0
    while first < last:
        triangle = queue[first]
        axis = axes[chart[triangle]]
        first += 1
        for k in range(3):
            neighbour = neighbours[triangle, k]
            if neighbour < 0 or chart[neighbour] >= 0 or last >= most:
                continue
            if _dot(axis, means[neighbour]) > _MOST_TURN and _dot(axis, normals[neighbour]) > _LEAST_FACING:
                chart[neighbour], queue[last] = chart[triangle], neighbour
                last += 1


@kernel(error_model="numpy")
def _merge(normals, neighbours, chart, axes):  # type: ignore[no-untyped-def]
    """Add the triangles of small charts to the largest neighbouring chart whose direction suits them."""
    for _ in range(_MERGE_PASSES):
        sizes = np.bincount(chart)
        for triangle in range(len(chart)):
            if sizes[chart[triangle]] >= _LEAST_TRIANGLES:
                continue
            best = chart[triangle]
            for k in range(3):
                neighbour = neighbours[triangle, k]
                if neighbour < 0 or sizes[chart[neighbour]] < max(_LEAST_TRIANGLES, sizes[best]):
                    continue
                if _dot(axes[chart[neighbour]], normals[triangle]) > _LEAST_FACING_MERGED:
                    best = chart[neighbour]
            chart[triangle] = best


@kernel
def _numbered_parts(neighbours, chart):  # type: ignore[no-untyped-def]
    """Return numbers [n] of charts, from 0, after each connected part of a chart was made a separate chart."""
    parts = np.full(len(chart), -1, np.int32)
    queue = np.empty(len(chart), np.int32)
    count = 0
    for seed in range(len(chart)):
        if parts[seed] >= 0:
            continue
        queue[0], parts[seed], first, last = seed, count, 0, 1
        while first < last:
            triangle = queue[first]
            first += 1
            for k in range(3):
                neighbour = neighbours[triangle, k]
                if neighbour >= 0 and parts[neighbour] < 0 and chart[neighbour] == chart[triangle]:
                    parts[neighbour], queue[last] = count, neighbour
                    last += 1
        count += 1
    return parts


@numba.njit(inline="always")
def _dot(a, b):  # type: ignore[no-untyped-def]
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]
