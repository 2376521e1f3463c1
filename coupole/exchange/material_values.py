"""Values of a result's materials for pages and exports."""

from __future__ import annotations

from pathlib import Path

import h5py
import numpy as np
from numpy.typing import NDArray

from coupole.reflectance.run_result_files import refuse_without_uncertainty

Floats = NDArray[np.float64]
UNCERTAIN = ("u_kd", "u_ks", "u_normal", "u_alpha")
"""Names of standard uncertainties, in the order of files and pages."""
_FIRST_TILT, _SECOND_TILT, _ALPHA = 0, 2, 14
"""Indices of variances in the lower half of the covariance, row by row."""


def red_green_blue(values: Floats) -> Floats:
    """[n, 3] from [n, channels]; one channel becomes grey."""
    return values if values.shape[1] == 3 else np.repeat(values, 3, axis=1)


def standard_uncertainties(path: Path) -> dict[str, Floats]:
    """[n] standard uncertainties from all sources in a file of materials: `u_kd`, `u_ks` (relative, the channels'
    mean), `u_normal` (rad) and `u_alpha` (relative). Raises InputError if the file has none."""
    with h5py.File(path, "r") as file:
        refuse_without_uncertainty(path, file)
        lower = file["covariance"][()].astype(np.float64)
        same = np.hypot(file["u_triangle"][()], float(file["u_shared"][()]))
        uncertainties = {key: np.sqrt(np.mean(file[key][()] ** 2, axis=1) + same**2) for key in ("u_kd", "u_ks")}
    uncertainties["u_normal"] = np.sqrt(lower[:, _FIRST_TILT] + lower[:, _SECOND_TILT])
    uncertainties["u_alpha"] = np.sqrt(lower[:, _ALPHA])
    return {key: values.astype(np.float64) for key, values in uncertainties.items()}
