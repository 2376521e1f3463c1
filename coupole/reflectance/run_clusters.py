"""Clusters of a result of runs: a few materials for all triangles, and one for those that had too few samples."""

from __future__ import annotations

import json
from collections.abc import Callable
from itertools import pairwise
from pathlib import Path
from typing import Any

import h5py
import numpy as np
from numpy.typing import NDArray

from coupole.errors import InputError
from coupole.reflectance.clustering import (
    clusters_of,
    empty_pool,
    fit_pool,
    looks,
    nearest_cluster,
    pool_samples,
)
from coupole.reflectance.result_folder import complete, read_settings
from coupole.reflectance.run_pictures import held_out
from coupole.reflectance.run_result import CLUSTERS, FIELDS, Clusters, RunResult
from coupole.reflectance.triangle_fit import TriangleMaterials, model_values
from coupole.storage.disk_errors import disk_error
from coupole.storage.durable import write_synced

Said = Callable[[str, int, int], None]
ABOUT_CLUSTERS = "clusters.json"
FEWEST_TO_BORROW = 4
"""Samples that tell which cluster a triangle belongs to."""
USUAL_MEMBERS, FEWEST_CLUSTERS, MOST_CLUSTERS = 400, 16, 1000
"""Of clusters whose number is not given: as the paper has them, and some for small objects."""
_FROM = "ggx_normal"


def cluster_result(
    out: Path, count: int | None, memory_bytes: int, *, say: Said = lambda step, done, of: None
) -> dict[str, Any]:
    """Find at most `count` materials for all triangles, write them, and say what is missed with them under the
    LEDs that were left out. Raises InputError if samples or fits are not all there, StorageError."""
    settings = read_settings(out)
    result = RunResult(out)
    result.refuse_unfinished(settings, fits=True)
    materials = result.materials(_FROM)
    fitted = np.isfinite(materials.alpha)
    known = int(np.count_nonzero(fitted))
    count = count or int(np.clip(known // USUAL_MEMBERS, FEWEST_CLUSTERS, MOST_CLUSTERS))
    if known < count:
        raise InputError(f"--clusters: expected at most {known}, the triangles with a material; got {count}")
    cluster = np.full(len(fitted), -1, np.int64)
    cluster[fitted] = clusters_of(looks(materials.at(np.flatnonzero(fitted))), count)
    members = np.bincount(cluster[fitted])
    pool = empty_pool(len(members), materials.kd.shape[1])
    random = np.random.default_rng(0)
    for block in result.blocks(memory_bytes):
        used = ~np.isin(result.along_samples(block, "leds"), settings["left_out"])
        samples, normals = result.samples(block), materials.normals[block]
        pool_samples(pool, samples, used, normals, cluster[block], members, random)
        say("pool samples", block.stop, len(fitted))
    pooled = fit_pool(pool, _medians(materials, cluster, len(members)))
    borrowed = _borrow(result, pooled, cluster, settings["left_out"], memory_bytes, say)
    try:
        complete(out / CLUSTERS, lambda path: _write(path, pooled, cluster, borrowed, members))
        told = {
            "clusters": len(members),
            "triangles": int(np.count_nonzero(cluster >= 0)),
            "borrowed": int(np.count_nonzero(borrowed)),
            "without": int(np.count_nonzero(cluster < 0)),
            **_missed(result, settings, memory_bytes, say),
        }
        write_synced(out / ABOUT_CLUSTERS, json.dumps(told, indent=1) + "\n")
    except OSError as error:
        raise disk_error(out, error) from error
    return told


def _medians(materials: TriangleMaterials, cluster: NDArray[np.int64], count: int) -> TriangleMaterials:
    """[count] of the members of each cluster."""
    order = np.argsort(cluster, kind="stable")
    firsts = np.searchsorted(cluster[order], np.arange(count + 1))
    rows = [order[first:end] for first, end in pairwise(firsts)]

    def of(values: NDArray[np.float64]) -> NDArray[np.float64]:
        return np.stack([np.median(values[row], axis=0) for row in rows])

    return TriangleMaterials(*map(of, (getattr(materials, field) for field in FIELDS)))


def _borrow(
    result: RunResult,
    pooled: TriangleMaterials,
    cluster: NDArray[np.int64],
    left_out: list[int],
    memory_bytes: int,
    say: Said,
) -> NDArray[np.bool_]:
    """Give triangles without material the cluster that explains their few samples best; which ones got one."""
    borrowed = np.zeros(len(cluster), np.bool_)
    for block in result.blocks(memory_bytes):
        lacking = np.flatnonzero(cluster[block] < 0)
        if len(lacking):
            used = ~np.isin(result.along_samples(block, "leds"), left_out)
            some = result.samples(block).of_triangles(lacking)
            found = nearest_cluster(some, used, pooled, FEWEST_TO_BORROW)
            cluster[block.start + lacking] = found
            borrowed[block.start + lacking] = found >= 0
        say("borrow", block.stop, len(cluster))
    return borrowed


def _missed(result: RunResult, settings: dict[str, Any], memory_bytes: int, say: Said) -> dict[str, Any]:
    """Mean absolute errors, shares of the camera's range, under the LEDs that were left out: of triangles with a
    material of their own, by it and by their cluster's; of those that borrowed one."""
    clusters = result.clusters
    names = ("own", "clustered", "borrowed")
    pictures, triangles = ({name: [0.0, 0] for name in names} for _ in range(2))
    for view in result.views:
        for part in held_out(result, view, settings, memory_bytes):
            own, borrowed = result.materials(_FROM, part.places), clusters.borrowed[part.places][:, None, None]
            shared = model_values(part.samples, clusters.at(own, part.samples.normals, part.places)) * part.share
            made = {
                "own": model_values(part.samples, own) * part.share,
                "clustered": np.where(borrowed, np.nan, shared),
                "borrowed": np.where(borrowed, shared, np.nan),
            }
            for name, values in made.items():
                _add(triangles[name], values - part.samples.values * part.share)
                for channel, (_, measured) in enumerate(part.blocks):
                    _add(pictures[name], part.pixels(values, channel) - measured)
            say(f"check of clusters in {view.view}", part.rows.stop, len(view.triangles))
    mae, of_triangles = (
        {name: total / count if count else None for name, (total, count) in sums.items()}
        for sums in (pictures, triangles)
    )
    ratio = mae["clustered"] / mae["own"] if mae["own"] and mae["clustered"] else None
    return {"mae": mae, "mae_of_triangles": of_triangles, "mae_ratio": ratio}


def _add(sums: list[float], off: NDArray[np.floating]) -> None:
    """To the sum of magnitudes, and their number."""
    known = np.isfinite(off)
    sums[0] += float(np.abs(off[known]).sum())
    sums[1] += int(np.count_nonzero(known))


def _write(
    path: Path,
    pooled: TriangleMaterials,
    cluster: NDArray[np.int64],
    borrowed: NDArray[np.bool_],
    members: NDArray[np.int64],
) -> None:
    with h5py.File(path, "w") as file:
        data: dict[str, tuple[NDArray[Any], str]] = {
            "cluster": (cluster.astype(np.int32), "of the triangles of the fits; -1 for none"),
            "borrowed": (borrowed, "whether a triangle has its cluster's material for want of samples"),
            "members": (members, "triangles that a cluster was found by"),
        }
        for field in Clusters.OF_CLUSTERS:
            data[field] = (getattr(pooled, field).astype(np.float32), f"of the clusters: {FIELDS[field]}")
        for name, (values, told) in data.items():
            file.create_dataset(name, data=values, track_times=False).attrs["told"] = told
