"""The file `fits/clusters.h5`: materials that many triangles share."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import ClassVar

import h5py
import numpy as np
from numpy.typing import NDArray

from coupole.errors import InputError
from coupole.reflectance.triangle_fit import TriangleMaterials
from coupole.storage.hdf5_file import hdf5_file

CLUSTERS = "fits/clusters.h5"
_TOLD = {
    "cluster": "cluster of each triangle of the fits; -1 for none",
    "borrowed": "whether a triangle borrows its cluster's material, because it has too few samples",
    "kd": "kd of the clusters, 1/sr, by channel",
    "ks": "ks of the clusters, by channel; f = kd + ks D V",
    "alpha": "alpha of the clusters (GGX's roughness)",
    "residual": "weighted rms residual of the square roots, as a share of sqrt(kd)",
    "harmonics": "[clusters, functions, channels] coefficients of harmonics of pairs of directions, 1/sr",
    "members": "number of triangles from which a cluster was formed",
}


@dataclass(frozen=True)
class Clusters:
    """Materials that many triangles share."""

    OF_CLUSTERS: ClassVar = ("kd", "ks", "alpha", "residual")
    cluster: NDArray[np.int32]
    """[n] cluster of each triangle of the fits; -1 for none."""
    borrowed: NDArray[np.bool_]
    """[n] True for a triangle that took its material from a cluster."""
    kd: NDArray[np.float64]
    """[clusters, channels]"""
    ks: NDArray[np.float64]
    alpha: NDArray[np.float64]
    residual: NDArray[np.float64]
    harmonics: NDArray[np.float32]
    """[clusters, functions, channels] coefficients of `pair_harmonics`, 1/sr."""

    def at(
        self, own_materials: TriangleMaterials, mesh_normals: NDArray[np.float64], block: slice | NDArray[np.int64]
    ) -> TriangleMaterials:
        """Return the materials of triangles, given by their places in `RunResult.triangles`. The normals are taken
        from `own_materials`; a triangle that borrows a material has the mesh's normal."""
        number, is_borrowed = self.cluster[block], self.borrowed[block, None]
        kd, ks, alpha, residual = (getattr(self, name)[number] for name in self.OF_CLUSTERS)
        alpha[number < 0] = np.nan
        normals = np.where(is_borrowed, mesh_normals, own_materials.normals)
        return TriangleMaterials(normals, kd, ks, alpha, residual)


def read_clusters(folder: Path) -> Clusters:
    """Read the clusters of a result of runs. Raises InputError if there is no such file."""
    path = folder / CLUSTERS
    if not path.exists():
        raise InputError(f"{path}: is not there; `coupole reflectance cluster {folder}` makes it")
    with h5py.File(path, "r") as file:
        if "harmonics" not in file:
            raise InputError(
                f"{path}: was made by an earlier version; run `coupole reflectance cluster {folder}` again"
            )
        kd, ks, alpha, residual = (file[name][()].astype(np.float64) for name in Clusters.OF_CLUSTERS)
        return Clusters(file["cluster"][()], file["borrowed"][()], kd, ks, alpha, residual, file["harmonics"][()])


def write_clusters(path: Path, clusters: Clusters, members: NDArray[np.int64]) -> None:
    """Write the file; `members` [clusters] is the number of triangles by which each cluster was found."""
    with hdf5_file(path, "w") as file:
        for name, description in _TOLD.items():
            values = members if name == "members" else getattr(clusters, name)
            stored_values = values.astype(np.float32) if name in Clusters.OF_CLUSTERS else values
            file.create_dataset(name, data=stored_values, track_times=False).attrs["told"] = description
