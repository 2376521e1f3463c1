"""Files `texels/VIEW.h5` of a result folder: materials of a view's pixels; docs/reference/result-folder.md."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import h5py
import numpy as np
from numpy.typing import NDArray

from coupole.errors import InputError
from coupole.intake.plain_data import read_json
from coupole.reflectance.run_result import RunResult, ViewSamples

FOLDER, ABOUT = "texels", "texels.json"
Singles = NDArray[np.float32]

_TOLD = {
    "pixels": "places in the picture, row by row, rising",
    "normals": "unit, base frame",
    "kd": "1/sr, by channel; a pixel's own was fitted, the others are from pixels around it",
    "ks": "by channel; f = kd + ks D V",
    "alpha": "GGX's roughness",
    "covariance": "lower half, row by row, of tilts (rad) along two tangents of the normal and of the logarithms "
    "of kd, ks (of the pixel's own channel) and alpha; without u_pixel and u_shared",
}


@dataclass(frozen=True)
class ViewTexels:
    """Materials of n pixels of a view."""

    pixels: NDArray[np.int32]
    """[n] places in the picture, row by row, rising."""
    normals: Singles
    """[n, 3] unit, base frame."""
    kd: Singles
    """[n, channels] 1/sr."""
    ks: Singles
    alpha: Singles
    covariance: Singles
    """[n, 15] as `fits/*.h5` have it."""


def texels_path(result: RunResult, view: ViewSamples) -> Path:
    return result.folder / FOLDER / view.path.name


def write_view_texels(
    path: Path,
    texels: ViewTexels,
    view: str,
    size_px: tuple[int, int],
    u_pixel: NDArray[np.float64],
    u_shared: float,
    *,
    simulated: bool,
) -> None:
    """Write the pixels of a view whose pictures are `size_px` wide and high. `u_pixel` [channels] and `u_shared`
    are relative standard uncertainties of kd and ks: of single pixels' responses, and of the power of all LEDs."""
    with h5py.File(path, "w") as file:
        file.attrs["view"], file.attrs["size_px"], file.attrs["frame"] = view, size_px, "base of the robot"
        file.attrs["simulated"] = simulated
        for name, description in _TOLD.items():
            _dataset(file, name, getattr(texels, name), description)
        _dataset(file, "u_pixel", u_pixel, "relative standard uncertainty of kd and ks, of a pixel's own response")
        _dataset(file, "u_shared", u_shared, "the same, of the power of all LEDs")


def _dataset(file: h5py.File, name: str, values: Any, description: str) -> None:
    file.create_dataset(name, data=values, track_times=False).attrs["told"] = description


def has_texels(result: RunResult) -> bool:
    """Tell whether any view has texels."""
    return any(texels_path(result, view).exists() for view in result.views)


def views_with_texels(result: RunResult) -> list[ViewSamples]:
    """Return the views that have texels. Raises InputError if none has."""
    views = [view for view in result.views if texels_path(result, view).exists()]
    if not views:
        raise _none_of(result)
    return views


def _none_of(result: RunResult, of: str = "") -> InputError:
    command = f"coupole reflectance from RUN --out {result.folder} --texels auto"
    return InputError(f"{result.folder}: has no texels{of}; `{command}` makes them")


def read_view_texels(result: RunResult, view: ViewSamples) -> ViewTexels:
    """Raises InputError if the view has none."""
    path = texels_path(result, view)
    if not path.exists():
        raise _none_of(result, f" of the view {view.view}")
    with h5py.File(path, "r") as file:
        return ViewTexels(*(file[name][()] for name in _TOLD))


def read_texel_errors(folder: Path) -> dict[str, float | None]:
    """Mean absolute errors that the check found, by fit; empty without texels."""
    path = folder / FOLDER / ABOUT
    if not path.exists():
        return {}
    mae: dict[str, float | None] = read_json(path, allow_nan=True)["mae"]
    return mae


def texel_uncertainty(result: RunResult, view: ViewSamples) -> tuple[float, float]:
    """Relative standard uncertainties of kd and ks, means of channels: of a pixel's own response, and of all."""
    with h5py.File(texels_path(result, view), "r") as file:
        return float(np.mean(file["u_pixel"][()])), float(file["u_shared"][()])
