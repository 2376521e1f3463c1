"""A result of `coupole reflectance` as a state: its mesh, and the colours of its fitted diffuse parts.

Colours are CIELAB under D65 of pi kd; its channels are taken as linear sRGB, as in the exports. Covariances come
from kd by channel, from its triangle's pixels, and from the LEDs' power, propagated by derivatives.
"""

from __future__ import annotations

from pathlib import Path

import h5py
import numpy as np
from numpy.typing import NDArray

from coupole.errors import ExtraMissing, InputError
from coupole.exchange.material_values import red_green_blue
from coupole.exchange.of_results.measured_surface import read_surface
from coupole.heritage.comparison.state_files import Colours, Floats, State
from coupole.scan.registration.prepared_scan import spacing

_STEP = 1e-4
"""Relative step for derivatives."""
_DARKEST = 1e-6


def read_result_state(folder: Path) -> State:
    """Read the mesh's triangles as points, at their middles. Raises InputError if there is no result with
    uncertainties, and ExtraMissing."""
    surface = read_surface(folder)
    corners = surface.vertices_mm[surface.triangles]
    across = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    lengths = np.linalg.norm(across, axis=1, keepdims=True)
    kept_triangles = np.flatnonzero((lengths[:, 0] > 0) | surface.has_material)
    middles = corners.mean(axis=1)[kept_triangles]
    kd, is_known = surface.kd[kept_triangles], surface.has_material[kept_triangles]
    if not is_known.any():
        raise InputError(f"{folder}: no triangle has a fitted material")
    lab = np.full((len(kept_triangles), 3), np.nan)
    covariance = np.full((len(kept_triangles), 3, 3), np.nan)
    rows = np.searchsorted(surface.result.triangles, kept_triangles[is_known])
    lab[is_known], covariance[is_known] = lab_of_kd(
        kd[is_known], *_uncertainties(surface.result.materials_path(surface.fit), rows)
    )
    return State(
        folder.name,
        middles,
        np.zeros((0, 3), np.int64),
        across[kept_triangles] / np.where(lengths[kept_triangles] > 0, lengths[kept_triangles], 1.0),
        Colours(lab, covariance),
        spacing(middles.astype(np.float32)),
        is_upright=True,
    )


def _uncertainties(path: Path, rows: NDArray[np.intp]) -> tuple[Floats, Floats]:
    """Return relative standard uncertainties of kd: [n, 3] for each channel alone, and [n] for the part that all
    channels share."""
    with h5py.File(path, "r") as file:
        alone = red_green_blue(file["u_kd"][()].astype(np.float64))[rows]
        common = np.hypot(file["u_triangle"][()].astype(np.float64), float(file["u_shared"][()]))[rows]
    return alone, common


def lab_of_kd(kd: Floats, u_alone: Floats, u_common: Floats) -> tuple[Floats, Floats]:
    """Return CIELAB [n, 3] of kd [n, 3] in 1/sr, and covariances [n, 3, 3]; uncertainties are relative. Raises
    ExtraMissing."""
    linear = np.maximum(np.pi * kd, _DARKEST)
    lab = _lab(linear)
    slopes = np.stack([(_lab(linear * (1 + _STEP * e)) - lab) / _STEP for e in np.eye(3)], axis=2)
    relative = u_common[:, None, None] ** 2 + np.eye(3) * u_alone[:, :, None] ** 2
    return lab, slopes @ relative @ slopes.transpose(0, 2, 1)


def _lab(linear: Floats) -> Floats:
    try:
        from skimage.color import xyz2lab
        from skimage.color.colorconv import xyz_from_rgb
    except ImportError as error:
        raise ExtraMissing(
            f"comparing needs scikit-image: pip install 'coupole[registration]' ({error})"
        ) from error
    return np.asarray(xyz2lab(linear @ xyz_from_rgb.T), np.float64)
