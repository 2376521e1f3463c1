"""Files `texels/VIEW.h5` of a result folder: materials of a view's pixels, or of texels of several pixels;
docs/reference/result-folder.md."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import h5py
import numpy as np
from numpy.typing import NDArray

from coupole.errors import InputError
from coupole.intake.plain_data import read_json
from coupole.reflectance.run_result import VARIANCES, RunResult, ViewSamples
from coupole.reflectance.texels.texel_size import TexelSize
from coupole.reflectance.triangle_fit import TriangleMaterials
from coupole.storage.hdf5_file import hdf5_file

FOLDER, ABOUT = "texels", "texels.json"
Singles = NDArray[np.float32]

_TOLD = {
    "pixels": "numbers of the pixels in the picture, counted row by row, in rising order",
    "normals": "unit, base frame",
    "kd": "1/sr, by channel; the pixel's own channel was fitted, the other channels are from pixels around it",
    "ks": "by channel; f = kd + ks D V",
    "alpha": "GGX's roughness",
    "covariance": "lower half, row by row, of the covariance of tilts (rad) along two tangents of the "
    "normal and of the logarithms "
    "of kd, ks (of the pixel's own channel) and alpha; without u_pixel and u_shared",
}
_TOLD_OF_SEVERAL = _TOLD | {
    "pixels": "places in the picture, row by row, of each texel's first pixel",
    "kd": "1/sr, by channel; all channels were measured",
    "covariance": "lower half, row by row, of the covariance of tilts (rad) along two tangents of the "
    "normal and of the logarithms "
    "of kd, ks (the channels' mean) and alpha; without u_pixel and u_shared",
}
_ASKED, _SIDE, _PIXEL = "texel_mm", "side_px", "pixel_mm"
"""Attributes of files of texels with a requested size."""
_OF_PIXEL = "texel_of_pixel"


@dataclass(frozen=True)
class ViewTexels:
    """Materials of n texels of a view: of single pixels, or of squares of them."""

    pixels: NDArray[np.int32]
    """[n] places in the picture, row by row, in rising order. For squares they are the first pixel of each, in the
    order of the squares."""
    normals: Singles
    """[n, 3] unit, base frame."""
    kd: Singles
    """[n, channels] 1/sr."""
    ks: Singles
    alpha: Singles
    covariance: Singles
    """[n, 15] lower halves, as in `fits/*.h5`."""
    texel_of_pixel: NDArray[np.int32] | None = None
    """[h, w] number of a pixel's texel, -1 for none; None for single pixels."""
    side_px: int = 1
    """Number of pixels across a texel."""

    def in_picture(self, shape: tuple[int, ...]) -> NDArray[np.int32]:
        """[h, w] number of a pixel's texel; -1 for none."""
        if self.texel_of_pixel is not None:
            return self.texel_of_pixel
        number = np.full(shape, -1, np.int32)
        number.reshape(-1)[self.pixels] = np.arange(len(self.pixels))
        return number


@dataclass(frozen=True)
class TexelFileHead:
    """Facts in a file of texels, besides the texels themselves."""

    view: str
    size_px: tuple[int, int]
    """Width and height of its pictures."""
    asked_size: TexelSize
    pixel_mm: float
    """Width of a pixel on the surface."""
    u_pixel: NDArray[np.float64]
    """[channels] relative standard uncertainty of kd and ks, from the responses of a texel's pixels."""
    u_shared: float
    """Relative standard uncertainty of kd and ks from the power of all LEDs."""
    is_simulated: bool


def texels_path(result: RunResult, view: ViewSamples) -> Path:
    return result.folder / FOLDER / view.path.name


def write_view_texels(path: Path, texels: ViewTexels, head: TexelFileHead) -> None:
    """Write the texels of a view."""
    is_of_several = texels.texel_of_pixel is not None
    with hdf5_file(path, "w") as file:
        file.attrs["view"], file.attrs["size_px"] = head.view, head.size_px
        file.attrs["frame"], file.attrs["simulated"] = "base of the robot", head.is_simulated
        if head.asked_size.mm is not None:
            file.attrs[_ASKED], file.attrs[_SIDE] = head.asked_size.mm, texels.side_px
            file.attrs[_PIXEL] = head.pixel_mm
        for name, description in (_TOLD_OF_SEVERAL if is_of_several else _TOLD).items():
            _dataset(file, name, getattr(texels, name), description)
        if is_of_several:
            numbers = file.create_dataset(
                _OF_PIXEL, data=texels.texel_of_pixel, compression="gzip", shuffle=True, track_times=False
            )
            numbers.attrs["told"] = "[h, w] number of the texel that a pixel belongs to, -1 for none"
        of_pixel = "relative standard uncertainty of kd and ks, from a pixel's own response"
        of_several = "relative standard uncertainty of kd and ks, from the responses of a texel's pixels"
        _dataset(file, "u_pixel", head.u_pixel, of_several if is_of_several else of_pixel)
        _dataset(file, "u_shared", head.u_shared, "the same, from the power of all LEDs")


def _dataset(file: h5py.File, name: str, values: Any, description: str) -> None:
    file.create_dataset(name, data=values, track_times=False).attrs["told"] = description


def has_texels(result: RunResult) -> bool:
    """Tell whether any view has texels."""
    return any(texels_path(result, view).exists() for view in result.views)


def views_with_texels(result: RunResult) -> list[ViewSamples]:
    """Return the views that have texels. Raises InputError if no view has texels."""
    views = [view for view in result.views if texels_path(result, view).exists()]
    if not views:
        raise _none_of(result)
    return views


def _none_of(result: RunResult, of: str = "") -> InputError:
    command = f"coupole reflectance from RUN --out {result.folder} --texels auto"
    return InputError(f"{result.folder}: has no texels{of}; `{command}` makes them")


def read_view_texels(result: RunResult, view: ViewSamples) -> ViewTexels:
    """Read the texels of a view. Raises InputError if the view has none."""
    path = texels_path(result, view)
    if not path.exists():
        raise _none_of(result, f" of the view {view.view}")
    with h5py.File(path, "r") as file:
        numbers = file[_OF_PIXEL][()] if _OF_PIXEL in file else None
        texels = ViewTexels(*(file[name][()] for name in _TOLD))
        return replace(texels, texel_of_pixel=numbers, side_px=int(file.attrs.get(_SIDE, 1)))


@dataclass(frozen=True)
class TexelPart:
    """Materials of some texels of a view, in their order, without their pixels."""

    materials: TriangleMaterials
    variances: Singles
    """[n, 3] of the logarithms of kd, ks and alpha."""


def count_view_texels(result: RunResult, view: ViewSamples) -> int:
    """Return the number of a view's texels. Raises InputError if the view has none."""
    path = texels_path(result, view)
    if not path.exists():
        raise _none_of(result, f" of the view {view.view}")
    with h5py.File(path, "r") as file:
        return len(file["pixels"])


def read_texel_parts(result: RunResult, view: ViewSamples, most_rows: int) -> Iterator[TexelPart]:
    """Yield a view's texels in parts of at most `most_rows`, so that they never are in memory together."""
    with h5py.File(texels_path(result, view), "r") as file:
        for first in range(0, len(file["pixels"]), most_rows):
            rows = slice(first, first + most_rows)
            normals, kd, ks, alpha = (
                file[name][rows].astype(np.float64) for name in ("normals", "kd", "ks", "alpha")
            )
            materials = TriangleMaterials(normals, kd, ks, alpha, np.zeros_like(alpha))
            yield TexelPart(materials, file["covariance"][rows][:, VARIANCES[2:]])


def size_of_texels(folder: Path) -> TexelSize | None:
    """Return the requested size of the texels of a result folder; None without texels."""
    path = next(iter(sorted((folder / FOLDER).glob("*.h5"))), None)
    if path is None:
        return None
    with h5py.File(path, "r") as file:
        return TexelSize(float(file.attrs[_ASKED]) if _ASKED in file.attrs else None)


def refuse_other_size(folder: Path, size: TexelSize) -> None:
    """Raise InputError if a result folder has texels with another requested size."""
    there = size_of_texels(folder)
    if there is not None and there != size:
        raise InputError(
            f"--texels {size.text}: {folder} has texels of {there.in_words} already. `--texels {there.text}` "
            f"goes on with them. To make these texels instead, move the folder {folder / FOLDER} away: nothing "
            "else is made again"
        )


def read_texel_errors(folder: Path) -> dict[str, float | None]:
    """Read the mean absolute errors from the check, by fit; empty without texels."""
    path = folder / FOLDER / ABOUT
    if not path.exists():
        return {}
    mae: dict[str, float | None] = read_json(path, allow_nan=True)["mae"]
    return mae


def read_texel_widening(folder: Path) -> dict[str, Any] | None:
    """Read the widths of texels' intervals from the check, in the form of `result.json` for fits; None without
    them."""
    path = folder / FOLDER / ABOUT
    widening: dict[str, Any] | None = read_json(path, allow_nan=True).get("widening") if path.exists() else None
    return widening


def texel_uncertainty(result: RunResult, view: ViewSamples) -> tuple[float, float]:
    """Return relative standard uncertainties of kd and ks, as means of channels: from a pixel's own response, and
    the part that all pixels share."""
    with h5py.File(texels_path(result, view), "r") as file:
        return float(np.mean(file["u_pixel"][()])), float(file["u_shared"][()])
