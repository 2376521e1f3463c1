"""The result folder of runs: samples and materials of the object's triangles; docs/reference/result-folder.md."""

from __future__ import annotations

import json
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import h5py
import numpy as np
from numpy.typing import NDArray

from coupole.errors import InputError, Problem
from coupole.reflectance.triangle_fit import TriangleMaterials, TriangleSamples

SCHEMA = "coupole-reflectance-run/1"
ABOUT, REPORT, OBJECT = "result.json", "report.html", "object.h5"
FITS = {"ggx": "fits/ggx.h5", "ggx_normal": "fits/ggx_normal.h5"}
"""GGX with the mesh's normals, and with normals that are fitted too."""
_HEAD = ("triangles", "camera_mm", "leds", "led_positions_mm", "led_normals", "full_scales")
FIELDS = {
    "normals": "unit, base frame",
    "kd": "1/sr, by channel",
    "ks": "by channel; f = kd + ks D V",
    "alpha": "GGX's roughness",
    "residual": "weighted rms of the square roots that are left, as a share of sqrt(kd)",
}


@dataclass(frozen=True)
class ViewSamples:
    """A view's file of samples, without the samples."""

    path: Path
    view: str
    triangles: NDArray[np.int64]
    camera_mm: NDArray[np.float64]
    leds: NDArray[np.int64]
    led_mm: NDArray[np.float64]
    led_normals: NDArray[np.float64]
    full_scales: NDArray[np.float64]
    """[leds, channels] of the camera, that f cos_i E/Phi of 1 gives."""


@dataclass(frozen=True)
class RunResult:
    """A result folder of runs, whole or in the making."""

    folder: Path

    @cached_property
    def corners_mm(self) -> NDArray[np.float32]:
        """[m, 3, 3] of all triangles of the mesh, base frame."""
        with h5py.File(self.folder / OBJECT, "r") as file:
            return np.asarray(file["corners_mm"])

    @cached_property
    def base_from_support(self) -> NDArray[np.float64]:
        with h5py.File(self.folder / OBJECT, "r") as file:
            return np.asarray(file["base_from_support"])

    @cached_property
    def areas_mm2(self) -> NDArray[np.float64]:
        """[m]"""
        corners = self.corners_mm.astype(np.float64)
        across = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
        areas: NDArray[np.float64] = 0.5 * np.linalg.norm(across, axis=1)
        return areas

    @property
    def files(self) -> list[Path]:
        return sorted((self.folder / "samples").glob("*.h5"))

    @cached_property
    def views(self) -> tuple[ViewSamples, ...]:
        return tuple(map(read_view_samples, self.files))

    @cached_property
    def triangles(self) -> NDArray[np.int64]:
        """All that any view sees, rising."""
        return np.unique(np.concatenate([view.triangles for view in self.views]))

    def blocks(self, budget_bytes: int) -> Iterator[slice]:
        """Places in `triangles` that are processed together within a budget of memory."""
        samples = sum(len(view.leds) for view in self.views)
        each = 64 * samples  # values, a model's, and what is copied between
        step = int(np.clip(budget_bytes // max(1, each), 64, 1 << 16))
        for first in range(0, len(self.triangles), step):
            yield slice(first, min(first + step, len(self.triangles)))

    def samples(self, block: slice) -> TriangleSamples:
        """Those of the triangles of a block, in all views that see one of them."""
        wanted = self.triangles[block]
        values: list[NDArray[np.float32]] = []
        led_mm: list[NDArray[np.float64]] = []
        view_of: list[NDArray[np.int64]] = []
        cameras: list[NDArray[np.float64]] = []
        centres, normals = np.zeros((len(wanted), 3)), np.zeros((len(wanted), 3))
        for view in self.views:
            if not (rows := _rows(view, wanted)):
                continue
            at = np.searchsorted(wanted, view.triangles[rows.start : rows.stop])
            with h5py.File(view.path, "r") as file:
                f = file["f"][rows.start : rows.stop]
                centres[at] = file["centres_mm"][rows.start : rows.stop]
                normals[at] = file["normals"][rows.start : rows.stop]
            mine = np.full((len(wanted), *f.shape[1:]), np.nan, np.float32)
            mine[at] = f * _cosines(centres[at], normals[at], view.led_mm)[..., None]
            values.append(mine)
            led_mm.append(view.led_mm)
            view_of.append(np.full(len(view.leds), len(cameras)))
            cameras.append(view.camera_mm)
        return TriangleSamples(
            np.concatenate(values, axis=1),
            np.concatenate(led_mm),
            np.concatenate(view_of),
            np.stack(cameras),
            centres,
            normals,
            self.areas_mm2[wanted],
        )

    def along_samples(self, block: slice, name: str) -> NDArray[Any]:
        """[samples, ...] what each sample of `samples(block)` has by its LED: `leds`, `led_normals`,
        `full_scales`."""
        wanted = self.triangles[block]
        return np.concatenate([getattr(view, name) for view in self.views if _rows(view, wanted)])

    def materials(self, name: str, block: slice = slice(None)) -> TriangleMaterials:
        """A fit by its name in `FITS`."""
        with h5py.File(self.folder / FITS[name], "r") as file:
            return TriangleMaterials(*(file[field][block].astype(np.float64) for field in FIELDS))


def read_view_samples(path: Path) -> ViewSamples:
    with h5py.File(path, "r") as file:
        return ViewSamples(
            path,
            str(file.attrs["view"]),
            *(
                file[name][()]
                for name in ("triangles", "camera_mm", "leds", "led_positions_mm", "led_normals", "full_scales")
            ),
        )


def read_about(folder: Path) -> dict[str, Any]:
    """result.json of a result of runs. Raises InputError if there is none."""
    path = folder / ABOUT
    try:
        about = json.loads(path.read_text(encoding="utf-8"))
    except (OSError, ValueError) as error:
        problem = Problem(str(path), 0, 0, "", "expected the result of `coupole reflectance`")
        raise InputError([problem]) from error
    if not isinstance(about, dict) or about.get("schema") != SCHEMA:
        raise InputError([Problem(str(path), 0, 0, "schema", f"expected {SCHEMA}")])
    return about


def _rows(view: ViewSamples, wanted: NDArray[np.int64]) -> range:
    """Of a view's file that hold rising numbers of triangles; none of them may lie between and not be wanted."""
    first, end = np.searchsorted(view.triangles, [wanted[0], wanted[-1] + 1])
    return range(int(first), int(end))


def _cosines(
    centres_mm: NDArray[np.float64], normals: NDArray[np.float64], leds_mm: NDArray[np.float64]
) -> NDArray[np.float32]:
    """[triangles, leds] of incidence."""
    across = np.sum(centres_mm * normals, axis=1)
    cosine = normals @ leds_mm.T - across[:, None]
    square = np.sum(leds_mm**2, axis=1) + np.sum(centres_mm**2, axis=1)[:, None] - 2 * centres_mm @ leds_mm.T
    found: NDArray[np.float32] = (cosine / np.sqrt(square)).astype(np.float32)
    return found


def write_object(path: Path, corners_mm: NDArray[np.float64], base_from_support: NDArray[np.float64]) -> None:
    """The mesh as it stood in the cell."""
    with h5py.File(path, "w") as file:
        data = file.create_dataset("corners_mm", data=corners_mm.astype(np.float32), track_times=False)
        data.attrs["told"] = "[triangles, corners, 3] mm, base frame"
        file.create_dataset("base_from_support", data=base_from_support, track_times=False)


def write_materials(path: Path, parts: Sequence[TriangleMaterials], triangles: NDArray[np.int64]) -> None:
    """A fit of all triangles, from those of blocks."""
    with h5py.File(path, "w") as file:
        file.create_dataset("triangles", data=triangles, track_times=False).attrs["told"] = "numbers in the mesh"
        for field, told in FIELDS.items():
            values = np.concatenate([getattr(part, field) for part in parts]).astype(np.float32)
            file.create_dataset(field, data=values, track_times=False).attrs["told"] = told
