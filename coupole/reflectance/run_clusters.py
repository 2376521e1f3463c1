"""Clusters of a result of runs: a few materials for all triangles, also for triangles with too few samples."""

from __future__ import annotations

import json
from collections.abc import Callable, Sequence
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from coupole.errors import InputError
from coupole.reflectance.cluster_file import CLUSTERS, Clusters, write_clusters
from coupole.reflectance.clustering import (
    clusters_of,
    empty_pool,
    fit_pool,
    looks,
    nearest_cluster,
    pool_samples,
)
from coupole.reflectance.fits import GGX_NORMAL
from coupole.reflectance.pair_harmonics import USUAL_DEGREES, fit_pairs, pair_values
from coupole.reflectance.result_folder import complete, read_settings
from coupole.reflectance.run_pictures import held_out
from coupole.reflectance.run_result import FIELDS, RunResult, ViewSamples
from coupole.reflectance.triangle_fit import TriangleMaterials, model_values
from coupole.storage.disk_errors import disk_error
from coupole.storage.durable import write_synced

Said = Callable[[str, int, int], None]
ABOUT_CLUSTERS = "clusters.json"
FEWEST_TO_BORROW = 4
"""Least number of samples that determine the cluster of a triangle."""
USUAL_MEMBERS, FEWEST_CLUSTERS, MOST_CLUSTERS = 400, 16, 1000
"""Usual number of members of a cluster, and bounds on the number of clusters. They are used if the number of
clusters is not given. The numbers are the paper's, but small objects have at least `FEWEST_CLUSTERS`
clusters.
"""
_FROM = GGX_NORMAL.name
_WAYS = ("own", "clustered", "harmonics", "borrowed")
"""Ways to predict the values of a triangle; each is compared separately."""


def cluster_result(
    out: Path,
    count: int | None,
    memory_bytes: int,
    *,
    degrees: int = USUAL_DEGREES,
    without_view: str | None = None,
    say: Said = lambda step, done, of: None,
) -> dict[str, Any]:
    """Find at most `count` materials for all triangles, and harmonics of pairs of directions up to `degrees`.
    Write them, and return their errors under the LEDs that were left out. A left-out view gives no samples, and
    its errors are also returned separately. Normals, and the triangles that look alike, still come from all views.

    Raises InputError if samples or fits are missing, or if there is no such view; StorageError.
    """
    settings = read_settings(out)
    result = RunResult(out)
    result.refuse_unfinished(settings, fits=True)
    if without_view is not None and without_view not in settings["view_names"]:
        raise InputError(
            f"--without-view: expected one of {', '.join(settings['view_names'])}; got {without_view}"
        )
    materials = result.materials(_FROM)
    cluster = _clusters_that_look_alike(materials, count)
    members = np.bincount(cluster[cluster >= 0])
    pool = empty_pool(len(members), materials.kd.shape[1])
    random = np.random.default_rng(0)
    for block in result.blocks(memory_bytes):
        sample_mask = _sample_mask(result, block, settings["left_out"], without_view)
        samples, normals = result.samples(block), materials.normals[block]
        pool_samples(pool, samples, sample_mask, normals, cluster[block], members, random)
        say("pool samples", block.stop, len(cluster))
    fits = fit_pool(pool, _medians(materials, cluster, len(members)))
    harmonics = fit_pairs(pool, degrees)
    is_borrowed = _borrow(result, fits, cluster, settings["left_out"], without_view, memory_bytes, say)
    clusters = Clusters(
        cluster.astype(np.int32), is_borrowed, fits.kd, fits.ks, fits.alpha, fits.residual, harmonics
    )
    try:
        complete(out / CLUSTERS, lambda path: write_clusters(path, clusters, members))
        report = {
            "clusters": len(members),
            "triangles": int(np.count_nonzero(cluster >= 0)),
            "borrowed": int(np.count_nonzero(is_borrowed)),
            "without": int(np.count_nonzero(cluster < 0)),
            "harmonics": harmonics.shape[1],
            "without_view": without_view,
            **_left_out_errors(result, settings, without_view, memory_bytes, say),
        }
        write_synced(out / ABOUT_CLUSTERS, json.dumps(report, indent=1) + "\n")
    except OSError as error:
        raise disk_error(out, error) from error
    return report


def _clusters_that_look_alike(materials: TriangleMaterials, count: int | None) -> NDArray[np.int64]:
    """Return [triangles], the cluster of each, or -1 where there is no material. Raises InputError if `count` is
    more than the number of materials."""
    is_fitted = np.isfinite(materials.alpha)
    most = int(np.count_nonzero(is_fitted))
    count = count or int(np.clip(most // USUAL_MEMBERS, FEWEST_CLUSTERS, MOST_CLUSTERS))
    if most < count:
        raise InputError(
            f"--clusters: expected at most {most}, the number of triangles with a material; got {count}"
        )
    cluster = np.full(len(is_fitted), -1, np.int64)
    cluster[is_fitted] = clusters_of(looks(materials.at(np.flatnonzero(is_fitted))), count)
    return cluster


def _sample_mask(
    result: RunResult, block: slice, left_out: list[int], without_view: str | None
) -> NDArray[np.bool_]:
    """[samples] of a block: True for samples that belong neither to a left-out LED nor to the left-out view."""
    led_in_use = ~np.isin(result.along_samples(block, "leds"), left_out)
    return np.asarray(led_in_use & (result.along_samples(block, "names") != without_view))


def _medians(materials: TriangleMaterials, cluster: NDArray[np.int64], count: int) -> TriangleMaterials:
    """[count] medians of the members of each cluster."""
    order = np.argsort(cluster, kind="stable")
    firsts = np.searchsorted(cluster[order], np.arange(count + 1))
    rows = [order[first:end] for first, end in pairwise(firsts)]

    def of(values: NDArray[np.float64]) -> NDArray[np.float64]:
        return np.stack([np.median(values[row], axis=0) for row in rows])

    return TriangleMaterials(*map(of, (getattr(materials, field) for field in FIELDS)))


def _borrow(
    result: RunResult,
    pool_materials: TriangleMaterials,
    cluster: NDArray[np.int64],
    left_out: list[int],
    without_view: str | None,
    memory_bytes: int,
    say: Said,
) -> NDArray[np.bool_]:
    """Give triangles without material the cluster that fits their few samples best, and return which triangles got
    one."""
    is_borrowed = np.zeros(len(cluster), np.bool_)
    for block in result.blocks(memory_bytes):
        lacking = np.flatnonzero(cluster[block] < 0)
        if len(lacking):
            sample_mask = _sample_mask(result, block, left_out, without_view)
            some = result.samples(block).of_triangles(lacking)
            nearest = nearest_cluster(some, sample_mask, pool_materials, FEWEST_TO_BORROW)
            cluster[block.start + lacking] = nearest
            is_borrowed[block.start + lacking] = nearest >= 0
        say("borrow", block.stop, len(cluster))
    return is_borrowed


def _left_out_errors(
    result: RunResult, settings: dict[str, Any], without_view: str | None, memory_bytes: int, say: Said
) -> dict[str, Any]:
    """Return mean absolute errors, in shares of the camera's range, under the LEDs that were left out: for all
    views, and for the left-out view."""
    report: dict[str, Any] = _mae(result, settings, result.views, memory_bytes, say)
    if without_view is not None:
        alone = [view for view in result.views if view.view == without_view]
        report["mae_of_view"] = _mae(result, settings, alone, memory_bytes, say)["mae"]
    own_mae, clustered_mae = report["mae"]["own"], report["mae"]["clustered"]
    return {**report, "mae_ratio": clustered_mae / own_mae if own_mae and clustered_mae else None}


def _mae(
    result: RunResult, settings: dict[str, Any], views: Sequence[ViewSamples], memory_bytes: int, say: Said
) -> dict[str, dict[str, float | None]]:
    """Return the errors of pictures by blocks of pixels, and of means of triangles. Triangles with a material of
    their own have errors of three predictions: by this material, by their cluster's material, and by the cluster's
    harmonics, where all three have a value. For triangles with a borrowed material, the prediction is by the
    borrowed material."""
    clusters = result.clusters
    pictures, triangles = ({name: [0.0, 0] for name in _WAYS} for _ in range(2))
    for view in views:
        for part in held_out(result, view, settings, memory_bytes):
            own_materials, is_borrowed = (
                result.materials(_FROM, part.places),
                clusters.borrowed[part.places][:, None, None],
            )
            cluster_values = (
                model_values(part.samples, clusters.at(own_materials, part.samples.normals, part.places))
                * part.share
            )
            number = np.where(is_borrowed[:, 0, 0], -1, clusters.cluster[part.places])
            by_pairs = pair_values(part.samples, own_materials.normals, number, clusters.harmonics)
            values_of_ways = _alike(
                model_values(part.samples, own_materials) * part.share, cluster_values, by_pairs * part.share
            )
            values_of_ways["borrowed"] = np.where(is_borrowed, cluster_values, np.nan)
            for name, values in values_of_ways.items():
                _add(triangles[name], values - part.samples.values * part.share)
                for channel, (_, measured_values) in enumerate(part.blocks):
                    _add(pictures[name], part.pixels(values, channel) - measured_values)
            say(f"check of clusters in {view.view}", part.rows.stop, len(view.triangles))
    mae, of_triangles = (
        {name: total / count if count else None for name, (total, count) in sums.items()}
        for sums in (pictures, triangles)
    )
    return {"mae": mae, "mae_of_triangles": of_triangles}


def _alike(*values: NDArray[np.floating]) -> dict[str, NDArray[np.floating]]:
    """Return the predicted values of all ways but the last, where each of these ways has a value. Below the
    horizon of the fitted normal, harmonics have no value but GGX has one."""
    all_do = np.logical_and.reduce([np.isfinite(way_values) for way_values in values])
    return {
        name: np.where(all_do, way_values, np.nan) for name, way_values in zip(_WAYS[:-1], values, strict=True)
    }


def _add(sums: list[float], off: NDArray[np.floating]) -> None:
    """Add the differences' magnitudes to a sum, and their number to a count."""
    is_finite = np.isfinite(off)
    sums[0] += float(np.abs(off[is_finite]).sum())
    sums[1] += int(np.count_nonzero(is_finite))
