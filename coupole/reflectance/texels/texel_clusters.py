"""Clusters of texels: a few materials that the texels of all views share, and the cluster of each texel.

Texels that look alike are found as for triangles (`coupole.reflectance.clustering`). A result does not have the
values of texels, so a cluster's material is the mean of its texels' materials, in logarithms. Each texel has the
weight of its certainty: a pixel that saw no highlight says little of ks and roughness.

Texels are read part by part. Only the number of each texel's cluster is kept, 4 bytes a texel.
"""

from __future__ import annotations

import json
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from coupole.errors import InputError
from coupole.reflectance.block_work import Said, silent
from coupole.reflectance.clustering import LEARNT_FROM, centres_of_points, looks, nearest_of
from coupole.reflectance.fits import TEXEL_CLUSTERS, TEXELS
from coupole.reflectance.result_folder import complete, read_settings
from coupole.reflectance.run_clusters import FEWEST_CLUSTERS, MOST_CLUSTERS, USUAL_MEMBERS
from coupole.reflectance.run_result import RunResult
from coupole.reflectance.texels.pixel_file import TexelPart, count_view_texels, read_texel_parts
from coupole.reflectance.texels.texel_check import held_out_pictures, picture_maker
from coupole.reflectance.texels.texel_cluster_file import PATH, TexelClusters, write_texel_clusters
from coupole.storage.disk_errors import disk_error
from coupole.storage.durable import write_synced

ABOUT_TEXEL_CLUSTERS = "texel_clusters.json"
_LEAST_VARIANCE = 1e-6
"""Least variance of a logarithm, so that no texel decides alone."""
_BYTES = 1_000
"""Memory that a texel of a part takes, bytes: it is read, and its looks and distances are computed."""
Floats = NDArray[np.float64]


def cluster_texels(out: Path, count: int | None, memory_bytes: int, *, say: Said = silent) -> dict[str, Any]:
    """Find the clusters of `group_texels`. Write them, and return their errors in pictures of the LEDs that were
    left out.

    Raises InputError if a view has no texels, or if there are fewer texels than clusters; StorageError.
    """
    settings = read_settings(out)
    result = RunResult(out)
    result.refuse_unfinished(settings)
    clusters = group_texels(result, count, memory_bytes, say=say)
    try:
        complete(out / PATH, lambda path: write_texel_clusters(path, clusters))
        mae = _mae(result, say)
        report = {
            "clusters": len(clusters.alpha),
            "texels": int(clusters.members.sum()),
            "mae": mae,
            "mae_ratio": mae["clustered"] / mae["own"] if mae["own"] and mae["clustered"] else None,
        }
        write_synced(out / ABOUT_TEXEL_CLUSTERS, json.dumps(report, indent=1) + "\n")
    except OSError as error:
        raise disk_error(out, error) from error
    return report


def group_texels(result: RunResult, count: int | None, memory_bytes: int, *, say: Said = silent) -> TexelClusters:
    """Find at most `count` materials for all texels of a result; by default one for each 400 texels, 16 to 1000.
    Raises InputError if a view has no texels, or if there are fewer texels than clusters."""
    totals = [count_view_texels(result, view) for view in result.views]
    most = sum(totals)
    count = count or int(np.clip(most // USUAL_MEMBERS, FEWEST_CLUSTERS, MOST_CLUSTERS))
    if most < count:
        raise InputError(f"--clusters: expected at most {most}, the texels; got {count}")
    most_rows = max(1, memory_bytes // _BYTES)
    centres = _centres(result, most, count, most_rows)
    sums, numbers = _Sums.empty(len(centres), result.channels), {}
    done_count = 0
    for view, total in zip(result.views, totals, strict=True):
        numbers[view.path.stem] = of_view = np.empty(total, np.int32)
        first = 0
        for part in read_texel_parts(result, view, most_rows):
            nearest = nearest_of(looks(part.materials), centres).astype(np.int32)
            of_view[first : first + len(nearest)] = nearest
            sums.add(nearest, part)
            first += len(nearest)
            done_count += len(nearest)
            say("cluster texels", done_count, most)
    return sums.clusters(numbers)


def _centres(result: RunResult, total: int, count: int, most_rows: int) -> Floats:
    """[clusters, features] centres of the looks of some of all texels, which are drawn from all views."""
    random = np.random.default_rng(0)
    chosen_places = np.arange(total)
    if total > LEARNT_FROM:
        chosen_places = np.sort(random.choice(total, LEARNT_FROM, replace=False))
    features, first = [], 0
    for view in result.views:
        for part in read_texel_parts(result, view, most_rows):
            end = first + len(part.materials.alpha)
            rows = (
                chosen_places[np.searchsorted(chosen_places, first) : np.searchsorted(chosen_places, end)] - first
            )
            features.append(looks(part.materials.at(rows)))
            first = end
    return centres_of_points(np.concatenate(features), count, random)


@dataclass(frozen=True)
class _Sums:
    """Weighted sums of the logarithms of texels' materials, by clusters."""

    logs: Floats
    """[clusters, 2 channels + 1] sums of the logarithms of kd, ks and alpha, times their weights."""
    weights: Floats
    """[clusters, 2 channels + 1]"""
    members: NDArray[np.int64]

    @classmethod
    def empty(cls, clusters: int, channels: int) -> _Sums:
        shape = (clusters, 2 * channels + 1)
        return cls(np.zeros(shape), np.zeros(shape), np.zeros(clusters, np.int64))

    def add(self, number: NDArray[np.int32], part: TexelPart) -> None:
        """Add texels with the numbers [n] of their clusters."""
        channels, count = part.materials.kd.shape[1], len(self.members)
        materials = np.column_stack([part.materials.kd, part.materials.ks, part.materials.alpha])
        weights = 1.0 / np.maximum(part.variances, _LEAST_VARIANCE).astype(np.float64)
        self.members[:] += np.bincount(number, minlength=count)
        for column, unknown in enumerate(np.repeat([0, 1, 2], [channels, channels, 1])):
            weight = weights[:, unknown]
            self.weights[:, column] += np.bincount(number, weight, count)
            self.logs[:, column] += np.bincount(number, weight * np.log(materials[:, column]), count)

    def clusters(self, numbers: dict[str, NDArray[np.int32]]) -> TexelClusters:
        """Return the clusters that have texels, numbered without gaps."""
        in_use = np.flatnonzero(self.members)
        new_number = np.full(len(self.members), -1, np.int32)
        new_number[in_use] = np.arange(len(in_use))
        means = np.exp(self.logs[in_use] / self.weights[in_use])
        channels = means.shape[1] // 2
        return TexelClusters(
            means[:, :channels],
            means[:, channels:-1],
            means[:, -1],
            self.members[in_use],
            {name: new_number[of_view] for name, of_view in numbers.items()},
        )


def _mae(result: RunResult, say: Said) -> dict[str, float | None]:
    """Return mean absolute errors, in shares of the camera's range, of pictures of left-out LEDs: by the texels'
    own materials, and by the materials of their clusters, in the pixels where both have a value."""
    sums, values = {"own": 0.0, "clustered": 0.0}, 0
    for number, view in enumerate(result.views, start=1):
        fits = {"own": TEXELS, "clustered": TEXEL_CLUSTERS}
        makers = {name: picture_maker(result, view, fit) for name, fit in fits.items()}
        for measured_picture, pictures in held_out_pictures(result, view, makers):
            has_both = np.isfinite(measured_picture) & np.logical_and.reduce(
                [picture > 0.0 for picture in pictures.values()]
            )
            values += int(np.count_nonzero(has_both))
            for name, picture in pictures.items():
                sums[name] += float(np.abs(picture - measured_picture)[has_both].sum(dtype=np.float64))
        say("check of clusters of texels", number, len(result.views))
    return {name: total / values if values else None for name, total in sums.items()}
