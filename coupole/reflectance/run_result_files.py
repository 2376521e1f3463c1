"""Writes the files of a result of runs, which `run_result` reads."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import h5py
import numpy as np
from numpy.typing import NDArray

from coupole.errors import InputError
from coupole.reflectance.fits import ViewFit
from coupole.reflectance.material_uncertainty import MaterialUncertainty
from coupole.reflectance.run_result import FIELDS, LOWER, UNCERTAIN, ViewSamples
from coupole.reflectance.slice_basis import centres
from coupole.reflectance.triangle_fit import TriangleMaterials
from coupole.storage.hdf5_file import hdf5_file


def write_object(path: Path, corners_mm: NDArray[np.float64], base_from_support: NDArray[np.float64]) -> None:
    """Write the mesh as it was placed in the cell."""
    with hdf5_file(path, "w") as file:
        data = file.create_dataset("corners_mm", data=corners_mm.astype(np.float32), track_times=False)
        data.attrs["told"] = "[triangles, corners, 3] mm, base frame"
        file.create_dataset("base_from_support", data=base_from_support, track_times=False)


def write_materials(
    path: Path,
    parts: Sequence[TriangleMaterials],
    uncertain: Sequence[MaterialUncertainty],
    u_triangle: NDArray[np.float32],
    u_shared: float,
    triangles: NDArray[np.int64],
) -> None:
    """Write a fit of all triangles, joined from blocks. `u_triangle` [n] and `u_shared` are relative standard
    uncertainties of kd and ks: `u_triangle` belongs to each triangle alone, `u_shared` to all together."""
    with hdf5_file(path, "w") as file:
        file.create_dataset("triangles", data=triangles, track_times=False).attrs["told"] = "numbers in the mesh"
        for field, description in FIELDS.items():
            values = np.concatenate([getattr(part, field) for part in parts]).astype(np.float32)
            file.create_dataset(field, data=values, track_times=False).attrs["told"] = description
        for field, description in UNCERTAIN.items():
            values = np.concatenate([getattr(part, field) for part in uncertain]).astype(np.float32)
            if field == "covariance":
                values = values[:, *LOWER]
            file.create_dataset(field, data=values, track_times=False).attrs["told"] = description
        file.create_dataset("u_triangle", data=u_triangle, track_times=False).attrs["told"] = (
            "relative standard uncertainty of kd and ks from the responses of the triangle's pixels"
        )
        file.create_dataset("u_shared", data=u_shared, track_times=False).attrs["told"] = (
            "relative standard uncertainty of kd and ks from the power of all LEDs"
        )


def begin_slices(file: h5py.File, fit: ViewFit, view: ViewSamples, channels: int) -> h5py.Dataset:
    """Describe a fit of a view in a new file. Return the dataset for its coefficients [triangles, channels,
    ...]."""
    shape = (len(view.triangles), channels, fit.coefficients)
    data = file.create_dataset("coefficients", shape, np.float32, fillvalue=np.nan, track_times=False)
    data.attrs["told"] = "[triangles of the view, channels, coefficients] 1/sr; NaN where too few samples are"
    if fit.over is not None:
        data.attrs["last"] = "the share of the fit `added_to` that is in the sum"
    data.attrs["basis"] = (
        "real spherical harmonics, orthonormal, degrees 0 to 9, order by order"
        if fit.basis.harmonic
        else "the negative distance to each of `centres`, then 1, x, y, z"
    )
    data.attrs["frame"] = "z the mesh's normal, x towards the camera along the surface"
    data.attrs["added_to"] = fit.over.name if fit.over else ""
    if not fit.basis.harmonic:
        file.create_dataset("centres", data=centres(), track_times=False)
    return data


def refuse_without_uncertainty(path: Path, file: h5py.File) -> None:
    """Raise InputError for a file of materials that an earlier version made."""
    if "covariance" not in file:
        raise InputError(f"{path}: has no uncertainty, an earlier version made it; make the result again")
