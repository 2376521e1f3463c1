"""The result folder of runs: samples and materials of the object's triangles; docs/reference/result-folder.md."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import h5py
import numpy as np
from numpy.typing import NDArray

from coupole.errors import InputError, Problem, reason
from coupole.intake.plain_data import read_json
from coupole.kernels import kernel
from coupole.reflectance.cluster_file import Clusters, read_clusters
from coupole.reflectance.extraction.frame_veils import GLARE, U_GLARE
from coupole.reflectance.fits import MATERIALS, SLICES
from coupole.reflectance.ggx import UNKNOWNS
from coupole.reflectance.triangle_fit import TriangleMaterials, TriangleSamples

SCHEMA = "coupole-reflectance-run/1"
ABOUT, REPORT, OBJECT = "result.json", "report.html", "object.h5"
FRAMES = "samples/frames"
"""Folder of the pictures with which the fits are compared."""
Block = slice | NDArray[np.int64]
"""Places of triangles, in rising order."""
INTER_REFLECTION = "inter_reflection"
"""Attribute of a file of samples from which inter-reflection was subtracted."""
CONTRADICTED = "contradicted"
"""Attribute of a file of samples: number of samples that were left out because they contradict others."""
SAMPLES = "samples"
"""Attribute of a file of samples: number of samples that are left."""
AS_MEASURED = "as_measured.h5"
"""File, in the folder, of the reflectance before inter-reflection was subtracted."""
U_OF_INTER_REFLECTION = 0.2
"""Relative standard uncertainty of the subtracted inter-reflection. For a simulated relief of white stone it was
0.15 to 0.19.
"""
MOST_ROWS = 1 << 16
LOWER = np.tril_indices(UNKNOWNS)
VARIANCES = [row * (row + 3) // 2 for row in range(UNKNOWNS)]
"""Places of the variances in the lower half of a covariance matrix."""
_HEAD = ("triangles", "camera_mm", "leds", "led_positions_mm", "led_normals", "full_scales")
_TOLD = {
    "software": dict,
    "runs": dict,
    "mae": dict,
    "emission": str,
    "scan_noise_um": int | float,
    "simulated": bool,
}
"""Keys of result.json that are read by more than its report, and their types."""
FIELDS = {
    "normals": "unit, base frame",
    "kd": "1/sr, by channel",
    "ks": "by channel; f = kd + ks D V",
    "alpha": "GGX's roughness",
    "residual": "weighted rms of the residuals of the values' square roots, as a share of sqrt(kd)",
}
UNCERTAIN = {
    "covariance": "lower half, row by row, of the covariance of tilts (rad) along two tangents of the "
    "normal and of the logarithms "
    "of kd, ks (the channels' mean) and alpha; without u_triangle and u_shared",
    "u_kd": "relative standard uncertainty by channel, without u_triangle and u_shared",
    "u_ks": "the same of ks",
}


@dataclass(frozen=True)
class ViewSamples:
    """A view's file of samples, without the samples themselves."""

    path: Path
    view: str
    inter_reflection: tuple[float, float] | None
    """Median and 95th percentile of the share of f that was subtracted as inter-reflection; None if nothing was
    subtracted."""
    contradicted_count: int | None
    """Number of samples that were left out because they contradict others; None before the search."""
    samples_left: int | None
    """Number of samples that remain after both steps."""
    triangles: NDArray[np.int64]
    camera_mm: NDArray[np.float64]
    leds: NDArray[np.int64]
    led_mm: NDArray[np.float64]
    led_normals: NDArray[np.float64]
    full_scales: NDArray[np.float64]
    """[leds, channels] share of the camera's range for f cos_i E/Phi = 1."""

    @property
    def names(self) -> NDArray[np.str_]:
        """[leds] the view's own name, repeated for each LED."""
        return np.full(len(self.leds), self.path.stem)


@dataclass(frozen=True)
class RunResult:
    """A result folder of runs, complete or unfinished."""

    folder: Path

    @cached_property
    def corners_mm(self) -> NDArray[np.float32]:
        """[m, 3, 3] corners of all triangles of the mesh, base frame."""
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

    @cached_property
    def middle_mm(self) -> NDArray[np.float64]:
        """Middle of the triangles that any view sees."""
        return np.asarray(self.corners_mm[self.triangles].mean(axis=(0, 1), dtype=np.float64))

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
        """Summaries of each view from extraction."""
        files = sorted((self.folder / "samples").glob("*.json"))
        summaries = [read_json(path, allow_nan=True) for path in files]
        return [
            {
                **summary,
                INTER_REFLECTION: view.inter_reflection,
                CONTRADICTED: view.contradicted_count,
                SAMPLES: summary[SAMPLES] if view.samples_left is None else view.samples_left,
            }
            for summary, view in zip(summaries, self.views, strict=True)
        ]

    def refuse_unfinished(self, settings: dict[str, Any], *, fits: bool = False) -> None:
        """Raise InputError if the samples of a view, or a fit, are missing."""
        for name in settings["view_names"]:
            if not (self.folder / "samples" / f"{name}.json").exists():
                raise InputError(
                    f"{self.folder}: the samples of the view {name} are not there; to make them, give the same "
                    f"`coupole reflectance extract` again"
                )
        if settings["subtracted"] and any(view.inter_reflection is None for view in self.views):
            raise InputError(
                f"{self.folder}: inter-reflection is still in its samples; to subtract it, give the same "
                f"`coupole reflectance extract` again"
            )
        paths = [self.materials_path(name) for name in MATERIALS]
        paths += [self.slices_path(name, view) for name in SLICES for view in self.views]
        if fits and (missing := [path for path in paths if not path.exists()]):
            raise InputError(f"{missing[0]}: is not there; `coupole reflectance fit {self.folder}` makes it")

    @cached_property
    def triangles(self) -> NDArray[np.int64]:
        """Numbers of all triangles that any view sees, in rising order."""
        return np.unique(np.concatenate([view.triangles for view in self.views]))

    def blocks(self, budget_bytes: int, most: int = MOST_ROWS) -> Iterator[slice]:
        """Yield places in `triangles` that are processed together within a budget of memory, at most `most` of
        them."""
        return _parts(len(self.triangles), sum(len(view.leds) for view in self.views), budget_bytes, most)

    def view_blocks(self, view: ViewSamples, budget_bytes: int, most: int = MOST_ROWS) -> Iterator[slice]:
        """Yield rows of a view's file that are processed together, as `blocks` does for triangles."""
        return _parts(len(view.triangles), len(view.leds), budget_bytes, most)

    def samples(self, block: slice) -> TriangleSamples:
        """Return the samples of the triangles of a block, in all views that see one of these triangles."""
        triangles = self.triangles[block]
        values: list[NDArray[np.float32]] = []
        seeing = [view for view in self.views if _rows(view, triangles)]
        centres, normals = np.zeros((len(triangles), 3)), np.zeros((len(triangles), 3))
        for view in seeing:
            rows = _rows(view, triangles)
            at = np.searchsorted(triangles, view.triangles[rows.start : rows.stop])
            view_samples = self.view_samples(view, slice(rows.start, rows.stop))
            centres[at], normals[at] = view_samples.centres_mm, view_samples.normals
            all_of_them = np.full((len(triangles), *view_samples.values.shape[1:]), np.nan, np.float32)
            all_of_them[at] = view_samples.values
            values.append(all_of_them)
        return TriangleSamples(
            np.concatenate(values, axis=1),
            np.concatenate([view.led_mm for view in seeing]),
            np.concatenate([np.full(len(view.leds), number) for number, view in enumerate(seeing)]),
            np.stack([view.camera_mm for view in seeing]),
            centres,
            normals,
            self.areas_mm2[triangles],
        )

    def view_samples(
        self, view: ViewSamples, rows: slice, leds: NDArray[np.bool_] | None = None
    ) -> TriangleSamples:
        """Return the samples of some rows of a view's file, under some of its LEDs [leds]."""
        columns = np.arange(len(view.leds)) if leds is None else np.flatnonzero(leds)
        with h5py.File(view.path, "r") as file:
            values = file["f"][rows] if leds is None else file["f"][rows][:, columns]
            centres, normals = file["centres_mm"][rows], file["normals"][rows]
        values = values.astype(np.float32, order="C")
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

    def view_noise(self, view: ViewSamples, rows: slice, leds: NDArray[np.bool_]) -> NDArray[np.float64]:
        """[n, leds, channels] relative standard uncertainty of `view_samples` from noise, each LED's power, and
        the subtracted inter-reflection and glare."""
        columns = np.flatnonzero(leds)
        with h5py.File(view.path, "r") as file:
            noise = np.hypot(file["u_own"][rows][:, columns], file["led_u_own"][columns])
            if view.inter_reflection is not None:
                noise = np.hypot(noise, u_inter_reflection(file[INTER_REFLECTION][rows][:, columns]))
            if GLARE in file:
                noise = np.hypot(noise, np.nan_to_num(file[GLARE][rows][:, columns]) * file[U_GLARE][()][columns])
            return np.asarray(noise, np.float64)

    def direct_shares(self, view: ViewSamples, rows: slice, leds: NDArray[np.bool_]) -> NDArray[np.float32]:
        """[n, leds, channels] share of a triangle's light that came directly from the LED. It is NaN where there
        is no sample, and 1 everywhere if inter-reflection was left in the samples."""
        columns = np.flatnonzero(leds)
        if view.inter_reflection is None:
            return np.ones((rows.stop - rows.start, len(columns), self.channels), np.float32)
        with h5py.File(view.path, "r") as file:
            return np.asarray(1.0 - file[INTER_REFLECTION][rows][:, columns], np.float32)

    def u_triangles(self, block: slice) -> NDArray[np.float32]:
        """[n] relative standard uncertainty, mean of channels, that samples of a triangle share, from the
        responses of its pixels. Each view has different pixels of a triangle. NaN without a record of the
        response."""
        triangles = self.triangles[block]
        squares, views = np.zeros(len(triangles)), np.zeros(len(triangles))
        for view in self.views:
            if rows := _rows(view, triangles):
                at = np.searchsorted(triangles, view.triangles[rows.start : rows.stop])
                with h5py.File(view.path, "r") as file:
                    u_response = file["u_response"][rows.start : rows.stop]
                squares[at] += (
                    np.sum(np.where(np.isinf(u_response), 0.0, u_response) ** 2, axis=1) / u_response.shape[1] ** 2
                )
                views[at] += 1
        return np.sqrt(squares / views**2).astype(np.float32)

    @cached_property
    def u_shared(self) -> float:
        """Relative standard uncertainty that all samples share."""
        files = (h5py.File(view.path, "r") for view in self.views)
        return float(np.nanmean([np.nanmean(file["led_u_shared"][()]) for file in files]))

    def along_samples(self, block: slice, name: str) -> NDArray[Any]:
        """[samples, ...] one value for each sample of `samples(block)`. It is taken from `leds`, `led_normals`,
        `full_scales` (of the sample's LED) or `names` (of its view), as `name` says."""
        triangles = self.triangles[block]
        return np.concatenate([getattr(view, name) for view in self.views if _rows(view, triangles)])

    def materials_path(self, name: str) -> Path:
        return self.folder / "fits" / f"{name}.h5"

    def slices_path(self, name: str, view: ViewSamples) -> Path:
        return self.folder / "fits" / name / view.path.name

    def materials(self, name: str, block: Block = slice(None)) -> TriangleMaterials:
        """Read the materials of a fit by its name in `MATERIALS`."""
        with h5py.File(self.materials_path(name), "r") as file:
            return TriangleMaterials(*(_read_rows(file[field], block) for field in FIELDS))

    def material_covariances(self, name: str, block: Block = slice(None)) -> NDArray[np.float64]:
        """[n, 5, 5] covariances of a fit by its name in `MATERIALS`, in the form of
        `material_uncertainty.covariances`."""
        with h5py.File(self.materials_path(name), "r") as file:
            return whole_covariances(_read_rows(file["covariance"], block))

    @cached_property
    def clusters(self) -> Clusters:
        """The clusters of this result. Raises InputError if there are none."""
        return read_clusters(self.folder)

    def slices(self, name: str, view: ViewSamples, rows: slice = slice(None)) -> NDArray[np.float32]:
        """[n, channels, coefficients] coefficients for rows of a view's file, by a fit's name in `SLICES`. Raises
        InputError for a fit that an earlier version made.
        """
        path = self.slices_path(name, view)
        with h5py.File(path, "r") as file:
            if file["coefficients"].shape[-1] != SLICES[name].coefficients:
                raise InputError(f"{path}: an earlier version made it; make the result again")
            return np.asarray(file["coefficients"][rows], np.float32)


def whole_covariances(lower: NDArray[np.floating]) -> NDArray[np.float64]:
    """[n, 5, 5] matrices from their lower halves [n, 15], row by row."""
    covariances = np.empty((len(lower), UNKNOWNS, UNKNOWNS))
    covariances[:, *LOWER] = lower
    covariances[:, *LOWER[::-1]] = lower
    return covariances


def _read_rows(data: h5py.Dataset, block: Block) -> NDArray[np.float64]:
    """Read rows of a dataset. Given a list of rows, h5py would read them one by one."""
    if isinstance(block, slice):
        return np.asarray(data[block], np.float64)
    if not len(block):
        return np.empty((0, *data.shape[1:]))
    first = int(block[0])
    return np.asarray(data[first : int(block[-1]) + 1][block - first], np.float64)


def u_inter_reflection(share: NDArray[np.float16]) -> NDArray[np.float64]:
    """Relative standard uncertainty of samples after the given share of them was subtracted as
    inter-reflection."""
    fraction = share.astype(np.float64)
    return np.asarray(U_OF_INTER_REFLECTION * fraction / (1.0 - fraction))


def read_view_samples(path: Path) -> ViewSamples:
    with h5py.File(path, "r") as file:
        share = file.attrs.get(INTER_REFLECTION)
        return ViewSamples(
            path,
            str(file.attrs["view"]),
            None if share is None else (float(share[0]), float(share[1])),
            None if CONTRADICTED not in file.attrs else int(file.attrs[CONTRADICTED]),
            None if SAMPLES not in file.attrs else int(file.attrs[SAMPLES]),
            *(file[name][()] for name in _HEAD),
        )


def read_about(folder: Path) -> dict[str, Any]:
    """Read result.json of a result of runs. Raises InputError if there is none, or if it lacks required keys."""
    path = folder / ABOUT
    try:
        about = read_json(path, allow_nan=True)
    except (OSError, InputError) as error:
        problem = Problem(str(path), 0, 0, "", f"expected the result of `coupole reflectance`; {reason(error)}")
        raise InputError([problem]) from error
    if not isinstance(about, dict) or about.get("schema") != SCHEMA:
        raise InputError([Problem(str(path), 0, 0, "schema", f"expected {SCHEMA}")])
    remedy = f"`coupole reflectance check {folder}` writes it again"
    wrong = [name for name, kind in _TOLD.items() if not isinstance(about.get(name), kind)]
    if "software" not in wrong and "coupole" not in about["software"]:
        wrong.append("software: coupole")
    if wrong:
        raise InputError(
            [Problem(str(path), 0, 0, name, f"is missing or of another kind; {remedy}") for name in wrong]
        )
    return about


def _parts(count: int, samples: int, budget_bytes: int, most: int) -> Iterator[slice]:
    triangle_bytes = 64 * samples  # values, a model's, and what is copied between
    step = int(np.clip(budget_bytes // max(1, triangle_bytes), 64, most))
    step = -(-count // -(-count // step)) if count else step  # all alike
    for first in range(0, count, step):
        yield slice(first, min(first + step, count))


def _rows(view: ViewSamples, triangles: NDArray[np.int64]) -> range:
    """Return the rows of a view's file that hold the triangles `triangles`, given in rising order. No other
    triangle may lie between them."""
    first, end = np.searchsorted(view.triangles, [triangles[0], triangles[-1] + 1])
    return range(int(first), int(end))


@kernel
def _times_cosine(values, centres_mm, normals, led_mm):  # type: ignore[no-untyped-def]
    """Multiply values [triangles, leds, channels] with the cosines of incidence."""
    for triangle in range(len(values)):
        centre, normal = centres_mm[triangle], normals[triangle]
        for led in range(len(led_mm)):
            x, y, z = led_mm[led, 0] - centre[0], led_mm[led, 1] - centre[1], led_mm[led, 2] - centre[2]
            cosine = (x * normal[0] + y * normal[1] + z * normal[2]) / math.sqrt(x * x + y * y + z * z)
            for channel in range(values.shape[2]):
                values[triangle, led, channel] *= cosine
