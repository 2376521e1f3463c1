"""The result folder of runs: samples and materials of the object's triangles; docs/reference/result-folder.md."""

from __future__ import annotations

import json
import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any, ClassVar

import h5py
import numba
import numpy as np
from numpy.typing import NDArray

from coupole.errors import InputError, Problem
from coupole.reflectance.slice_basis import COUNT, HARMONICS, RADIAL, RESIDUAL, Basis, centres
from coupole.reflectance.triangle_fit import TriangleMaterials, TriangleSamples

SCHEMA = "coupole-reflectance-run/1"
ABOUT, REPORT, OBJECT = "result.json", "report.html", "object.h5"
MATERIALS = ("ggx", "ggx_normal")
"""Fits to the samples of all views: GGX with the mesh's normals, and with normals that are fitted too."""


@dataclass(frozen=True)
class SliceKind:
    """A fit to the samples of each view by itself."""

    basis: Basis
    over: str | None = None
    """The material that it is added to; it was fitted to what that left."""


SLICES = {
    "sh": SliceKind(HARMONICS),
    "rbf": SliceKind(RADIAL),
    "ggx_rbf": SliceKind(RESIDUAL, over="ggx_normal"),
}
FITS = (*MATERIALS, *SLICES)
CLUSTERS = "fits/clusters.h5"
MOST_ROWS = 1 << 16
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
class Clusters:
    """Materials that many triangles share."""

    OF_CLUSTERS: ClassVar = ("kd", "ks", "alpha", "residual")
    cluster: NDArray[np.int32]
    """[n] of all triangles of the fits; -1 for none."""
    borrowed: NDArray[np.bool_]
    """[n]"""
    kd: NDArray[np.float64]
    """[clusters, channels]"""
    ks: NDArray[np.float64]
    alpha: NDArray[np.float64]
    residual: NDArray[np.float64]

    def at(
        self, own: TriangleMaterials, mesh_normals: NDArray[np.float64], block: slice | NDArray[np.int64]
    ) -> TriangleMaterials:
        """Of triangles by their places in `RunResult.triangles`, with the normals of their `own` materials, or
        the mesh's where they borrow."""
        number, borrowed = self.cluster[block], self.borrowed[block, None]
        kd, ks, alpha, residual = (getattr(self, name)[number] for name in self.OF_CLUSTERS)
        alpha[number < 0] = np.nan
        normals = np.where(borrowed, mesh_normals, own.normals)
        return TriangleMaterials(normals, kd, ks, alpha, residual)


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
    def channels(self) -> int:
        with h5py.File(self.files[0], "r") as file:
            return int(file["f"].shape[2])

    @property
    def summaries(self) -> list[dict[str, Any]]:
        """What extraction said of each view."""
        files = sorted((self.folder / "samples").glob("*.json"))
        return [json.loads(path.read_text(encoding="utf-8")) for path in files]

    def refuse_unfinished(self, names: Sequence[str], *, fits: bool = False) -> None:
        """Raises InputError if the samples of a view of these names, or a fit, are missing."""
        for name in names:
            if not (self.folder / "samples" / f"{name}.json").exists():
                raise InputError(
                    f"{self.folder}: the samples of the view {name} are not there; `coupole reflectance extract`, "
                    "as it was begun, makes them"
                )
        paths = [self.materials_path(name) for name in MATERIALS]
        paths += [self.slices_path(name, view) for name in SLICES for view in self.views]
        if fits and (missing := [path for path in paths if not path.exists()]):
            raise InputError(f"{missing[0]}: is not there; `coupole reflectance fit {self.folder}` makes it")

    @cached_property
    def triangles(self) -> NDArray[np.int64]:
        """All that any view sees, rising."""
        return np.unique(np.concatenate([view.triangles for view in self.views]))

    def blocks(self, budget_bytes: int, most: int = MOST_ROWS) -> Iterator[slice]:
        """Places in `triangles` that are processed together within a budget of memory, `most` of them."""
        return _parts(len(self.triangles), sum(len(view.leds) for view in self.views), budget_bytes, most)

    def view_blocks(self, view: ViewSamples, budget_bytes: int, most: int = MOST_ROWS) -> Iterator[slice]:
        """The same of the rows of a view's file."""
        return _parts(len(view.triangles), len(view.leds), budget_bytes, most)

    def samples(self, block: slice) -> TriangleSamples:
        """Those of the triangles of a block, in all views that see one of them."""
        wanted = self.triangles[block]
        values: list[NDArray[np.float32]] = []
        seeing = [view for view in self.views if _rows(view, wanted)]
        centres, normals = np.zeros((len(wanted), 3)), np.zeros((len(wanted), 3))
        for view in seeing:
            rows = _rows(view, wanted)
            at = np.searchsorted(wanted, view.triangles[rows.start : rows.stop])
            mine = self.view_samples(view, slice(rows.start, rows.stop))
            centres[at], normals[at] = mine.centres_mm, mine.normals
            all_of_them = np.full((len(wanted), *mine.values.shape[1:]), np.nan, np.float32)
            all_of_them[at] = mine.values
            values.append(all_of_them)
        return TriangleSamples(
            np.concatenate(values, axis=1),
            np.concatenate([view.led_mm for view in seeing]),
            np.concatenate([np.full(len(view.leds), number) for number, view in enumerate(seeing)]),
            np.stack([view.camera_mm for view in seeing]),
            centres,
            normals,
            self.areas_mm2[wanted],
        )

    def view_samples(
        self, view: ViewSamples, rows: slice, leds: NDArray[np.bool_] | None = None
    ) -> TriangleSamples:
        """Those of some rows of a view's file, under some of its LEDs [leds]."""
        columns = np.arange(len(view.leds)) if leds is None else np.flatnonzero(leds)
        with h5py.File(view.path, "r") as file:
            values = (file["f"][rows] if leds is None else file["f"][rows, columns]).astype(np.float32)
            centres, normals = file["centres_mm"][rows], file["normals"][rows]
        _times_cosine(values, centres, normals, view.led_mm[columns])
        return TriangleSamples(
            values,
            view.led_mm[columns],
            np.zeros(len(columns), np.int64),
            view.camera_mm[None],
            centres,
            normals,
            self.areas_mm2[view.triangles[rows]],
        )

    def along_samples(self, block: slice, name: str) -> NDArray[Any]:
        """[samples, ...] what each sample of `samples(block)` has by its LED: `leds`, `led_normals`,
        `full_scales`."""
        wanted = self.triangles[block]
        return np.concatenate([getattr(view, name) for view in self.views if _rows(view, wanted)])

    def materials_path(self, name: str) -> Path:
        return self.folder / "fits" / f"{name}.h5"

    def slices_path(self, name: str, view: ViewSamples) -> Path:
        return self.folder / "fits" / name / view.path.name

    def materials(self, name: str, block: slice = slice(None)) -> TriangleMaterials:
        """A fit by its name in `MATERIALS`."""
        with h5py.File(self.materials_path(name), "r") as file:
            return TriangleMaterials(*(file[field][block].astype(np.float64) for field in FIELDS))

    @cached_property
    def clusters(self) -> Clusters:
        """Raises InputError if there are none."""
        path = self.folder / CLUSTERS
        if not path.exists():
            raise InputError(f"{path}: is not there; `coupole reflectance cluster {self.folder}` makes it")
        with h5py.File(path, "r") as file:
            return Clusters(
                file["cluster"][()],
                file["borrowed"][()],
                *(file[name][()].astype(np.float64) for name in Clusters.OF_CLUSTERS),
            )

    def slices(self, name: str, view: ViewSamples, rows: slice = slice(None)) -> NDArray[np.float32]:
        """[n, channels, coefficients] of rows of a view's file, by a fit's name in `SLICES`."""
        with h5py.File(self.slices_path(name, view), "r") as file:
            found: NDArray[np.float32] = file["coefficients"][rows]
            return found


def read_view_samples(path: Path) -> ViewSamples:
    with h5py.File(path, "r") as file:
        return ViewSamples(
            path,
            str(file.attrs["view"]),
            *(file[name][()] for name in _HEAD),
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


def _parts(count: int, samples: int, budget_bytes: int, most: int) -> Iterator[slice]:
    each = 64 * samples  # values, a model's, and what is copied between
    step = int(np.clip(budget_bytes // max(1, each), 64, most))
    for first in range(0, count, step):
        yield slice(first, min(first + step, count))


def _rows(view: ViewSamples, wanted: NDArray[np.int64]) -> range:
    """Of a view's file that hold rising numbers of triangles; none of them may lie between and not be wanted."""
    first, end = np.searchsorted(view.triangles, [wanted[0], wanted[-1] + 1])
    return range(int(first), int(end))


@numba.njit(cache=True, nogil=True)
def _times_cosine(values, centres_mm, normals, led_mm):  # type: ignore[no-untyped-def]
    """Multiply values [triangles, leds, channels] with the cosines of incidence."""
    for triangle in range(len(values)):
        centre, normal = centres_mm[triangle], normals[triangle]
        for led in range(len(led_mm)):
            x, y, z = led_mm[led, 0] - centre[0], led_mm[led, 1] - centre[1], led_mm[led, 2] - centre[2]
            cosine = (x * normal[0] + y * normal[1] + z * normal[2]) / math.sqrt(x * x + y * y + z * z)
            for channel in range(values.shape[2]):
                values[triangle, led, channel] *= cosine


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


def begin_slices(file: h5py.File, kind: SliceKind, view: ViewSamples, channels: int) -> h5py.Dataset:
    """Describe a fit of a view in a new file; where its coefficients [triangles, channels, COUNT] go."""
    shape = (len(view.triangles), channels, COUNT)
    data = file.create_dataset("coefficients", shape, np.float32, fillvalue=np.nan, track_times=False)
    data.attrs["told"] = "[triangles of the view, channels, coefficients] 1/sr; NaN where too few samples are"
    data.attrs["basis"] = (
        "real spherical harmonics, orthonormal, degrees 0 to 9, order by order"
        if kind.basis.harmonic
        else "-r to each of `centres`, then 1, x, y, z"
    )
    data.attrs["frame"] = "z the mesh's normal, x towards the camera along the surface"
    data.attrs["added_to"] = kind.over or ""
    if not kind.basis.harmonic:
        file.create_dataset("centres", data=centres(), track_times=False)
    return data
