"""Materials of a result folder of `coupole reflectance` (docs/reference/result-folder.md): f = kd + ks D V by
channel, GGX's D and the height-correlated V.
"""

from __future__ import annotations

import contextlib
from collections.abc import Sequence
from functools import partial
from pathlib import Path

import h5py
import numpy as np

from coupole.appearance.matter import brdf
from coupole.appearance.matter.brdf import Brdf
from coupole.appearance.spectra.grid import Array
from coupole.errors import InputError

_CLUSTERS = "clusters"
_LOBES = 12
"""Number of groups into which the roughnesses of triangles are sorted."""


def read_result(
    folder: Path, fit: str = "ggx", *, cluster: int | None = None, triangles: Sequence[int] | None = None
) -> Brdf:
    """[..., 3] BRDF of one cluster, or of the mean over triangles, given by their numbers in the mesh (all by
    default).

    A mean is over the triangles' f, each about its own normal, with the lobes in `_LOBES` groups of similar
    roughness. `fit` is a fit of the result that has a material for each triangle. Raises InputError.
    """
    if cluster is not None:
        kd, ks, alpha = _read_materials(folder, _CLUSTERS)[1:]
        if not 0 <= cluster < len(kd):
            raise InputError(f"{folder}: cluster: expected 0 to {len(kd) - 1}, found {cluster}")
        rows = np.array([cluster])
    else:
        fits = _fits_of_triangles(folder)
        if fits and fit not in fits:
            raise InputError(f"{folder}: fit: expected one of {', '.join(fits)}; found {fit}")
        numbers, kd, ks, alpha = _read_materials(folder, fit)
        is_known = np.isfinite(alpha) & np.isfinite(kd).all(axis=1) & np.isfinite(ks).all(axis=1)
        rows = np.flatnonzero(is_known if triangles is None else is_known & np.isin(numbers, triangles))
        if not len(rows):
            raise InputError(f"{folder}: expected triangles with a material, found none; choose other triangles")
    order = rows[np.argsort(alpha[rows])]
    lobes = [
        (ks[part].sum(axis=0) / len(order), float(np.average(alpha[part], weights=ks[part].sum(axis=1) + 1e-12)))
        for part in np.array_split(order, min(_LOBES, len(order)))
    ]
    return partial(_mixed_brdf, kd=kd[order].mean(axis=0), lobes=lobes)


def _mixed_brdf(wi: Array, wo: Array, *, kd: Array, lobes: Sequence[tuple[Array, float]]) -> Array:
    total = brdf.lambert(wi, wo, reflectance=np.pi * kd)
    for ks, alpha in lobes:
        total = total + ks * brdf.ggx(wi, wo, roughness=alpha, fresnel=lambda c: np.ones((*np.shape(c), 1)))
    return total


def _fits_of_triangles(folder: Path) -> list[str]:
    """Return the names of the fits that have a material for each triangle; a result of pictures has none."""
    names = []
    for path in sorted((folder / "fits").glob("*.h5")):
        with contextlib.suppress(OSError), h5py.File(path, "r") as file:
            if {"triangles", "kd"} <= file.keys():
                names.append(path.stem)
    return names


def _read_materials(folder: Path, name: str) -> tuple[Array, Array, Array, Array]:
    """Return the numbers [n] of triangles (or of the clusters themselves, with `clusters`), kd and ks [n, 3],
    alpha [n]."""
    path = folder / "fits" / f"{name}.h5"
    if not path.is_file():
        does = "cluster" if name == _CLUSTERS else "fit"
        raise InputError(f"{path}: is not there; `coupole reflectance {does} {folder}` makes it")
    try:
        with h5py.File(path, "r") as file:
            kd, ks, alpha = (file[key][()].astype(float) for key in ("kd", "ks", "alpha"))
            numbers = np.asarray(file["triangles"][()] if name != _CLUSTERS else range(len(alpha)), float)
    except (OSError, KeyError) as error:
        raise InputError(f"{path}: expected kd, ks and alpha of a fit: {error}; make it anew") from error
    if kd.ndim != 2 or kd.shape[1] not in (1, 3):
        raise InputError(f"{path}: expected one or three channels, found {kd.shape}")
    wide = np.ones((1, 3)) if kd.shape[1] == 1 else np.ones(1)
    return numbers, kd * wide, ks * wide, alpha
