"""The file `fits/texel_clusters.h5`: materials that many texels share; docs/reference/result-folder.md."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path

import h5py
import numpy as np
from numpy.typing import NDArray

from coupole.errors import InputError
from coupole.reflectance.fits import TEXEL_CLUSTERS, TEXELS
from coupole.reflectance.run_result import RunResult, ViewSamples
from coupole.reflectance.texels.pixel_file import ViewTexels, read_view_texels
from coupole.storage.hdf5_file import hdf5_file

PATH = f"fits/{TEXEL_CLUSTERS}.h5"
_TOLD = {
    "kd": "of the clusters, 1/sr, by channel",
    "ks": "of the clusters, by channel; f = kd + ks D V",
    "alpha": "of the clusters, GGX's roughness",
    "members": "number of texels of a cluster",
}
Floats = NDArray[np.float64]


@dataclass(frozen=True)
class TexelClusters:
    """Materials that texels share, and the cluster of each texel."""

    kd: Floats
    """[clusters, channels]"""
    ks: Floats
    alpha: Floats
    members: NDArray[np.int64]
    """[clusters]"""
    cluster: dict[str, NDArray[np.int32]]
    """Key: name of a view's files; value: the cluster of each of its texels."""


def write_texel_clusters(path: Path, clusters: TexelClusters) -> None:
    """Write the file."""
    with hdf5_file(path, "w") as file:
        for name, description in _TOLD.items():
            values = getattr(clusters, name)
            stored_values = values if name == "members" else values.astype(np.float32)
            file.create_dataset(name, data=stored_values, track_times=False).attrs["told"] = description
        for name, numbers in clusters.cluster.items():
            of_view = file.create_dataset(f"cluster/{name}", data=numbers, track_times=False)
            of_view.attrs["told"] = f"of the texels of texels/{name}.h5"


def read_texel_clusters(folder: Path) -> TexelClusters:
    """Read the clusters of texels of a result. Raises InputError if there are none."""
    path = folder / PATH
    if not path.exists():
        raise InputError(f"{path}: is not there; {_remedy(folder)} makes it")
    with h5py.File(path, "r") as file:
        kd, ks, alpha = (file[name][()].astype(np.float64) for name in ("kd", "ks", "alpha"))
        numbers = {name: dataset[()] for name, dataset in file["cluster"].items()}
        return TexelClusters(kd, ks, alpha, file["members"][()], numbers)


def read_shared_texels(result: RunResult, view: ViewSamples) -> ViewTexels:
    """Read the texels of a view with their own normals and the materials of their clusters. The covariance is that
    of their own materials. Raises InputError if the result has no clusters, or those of other texels."""
    clusters, texels = read_texel_clusters(result.folder), read_view_texels(result, view)
    number = clusters.cluster.get(view.path.stem)
    if number is None or len(number) != len(texels.pixels):
        raise InputError(
            f"{result.folder / PATH}: belongs to other texels than those of the view {view.view}; "
            f"{_remedy(result.folder)} makes it again"
        )
    kd, ks, alpha = (values[number].astype(np.float32) for values in (clusters.kd, clusters.ks, clusters.alpha))
    return replace(texels, kd=kd, ks=ks, alpha=alpha)


READ_TEXELS = {TEXELS: read_view_texels, TEXEL_CLUSTERS: read_shared_texels}
"""Functions that read a view's texels, by the fits that have materials of texels."""


def describe_sharing(folder: Path) -> str:
    """Say how many materials the texels of a result share, and which command found them. Raises InputError if they
    share none."""
    members = read_texel_clusters(folder).members
    command = "`coupole reflectance cluster --texels`"
    return f"{members.sum():,} texels share {len(members):,} materials, which {command} found"


def _remedy(folder: Path) -> str:
    return f"`coupole reflectance cluster {folder} --texels`"
