"""The file of a refinement, `refined.h5`, and how a run gets its geometry."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import h5py
import numpy as np
from numpy.typing import NDArray

from coupole.calibration.optics import NAMES, Intrinsics
from coupole.errors import InputError, reason
from coupole.intake.plain_data import read_json
from coupole.reflectance.alignment.refinement import Refined
from coupole.reflectance.alignment.unknowns import renumbered_triangles
from coupole.reflectance.extraction.measured_run import MeasuredRun
from coupole.reflectance.extraction.pointing import Pointing
from coupole.storage.durable import sha256
from coupole.storage.hdf5_file import hdf5_file

Floats = NDArray[np.float64]
REFINED, ABOUT = "refined.h5", "refined.json"
SCHEMA = "coupole-refinement/3"
PREVIEW_PX = 640
"""Largest width of a view's picture in the file."""
TOLD = {
    "lens": "fx, fy, cx, cy (px), k1, k2, p1, p2, k3",
    "views": "run and view",
    "base_from_camera": "[views, 4, 4] mm",
    "vertices_mm": "[n, 3] vertices that triangles use, in the mesh's order, base frame",
    "vertex_u_mm": "[n] standard uncertainty along the normal",
    "names": "names of the unknowns, with units; cameras by their places in `views`",
    "steps": "steps of the unknowns from the initial values of records and scan",
    "covariance": "covariance of the steps",
    "stated_covariance": "covariance of the unknowns without the pictures, from records and scan",
    "controls_mm": "[controls, 3] points at which `shape` is given, base frame",
    "middle_mm": "[3] point about which `mesh` turns, base frame",
}
MATCH_FIELDS = {
    "reference": "place in `views` of the view that sees the spot in the greatest detail",
    "other": "place in `views` of the view that is compared with it",
    "blocks": "[n, 2] column and row of blocks of 2 x 2 pixels in the reference",
    "points_mm": "place of the spot by the reference, base frame",
    "shifts_mm": "from `place` to the place of the same spot by the other view",
}


@dataclass(frozen=True)
class RefinedGeometry:
    """Poses, lens and mesh of a refinement."""

    path: Path
    lens: Intrinsics
    base_from_camera: dict[tuple[str, str], Floats]
    """Camera poses, by run and view."""
    vertices_mm: Floats
    mesh_sha256: str
    inputs: dict[str, dict[str, str]]
    """Name and SHA-256 of the files that were read, by run."""
    pointings: dict[tuple[str, str], Pointing]
    """Uncertainty of the directions in which the cameras look, by run and view."""

    def of(self, measured_run: MeasuredRun) -> MeasuredRun:
        """Return a run with this geometry. Raises InputError for a run, view or mesh that was not refined, and for
        a run that has changed since the refinement."""
        if sha256(measured_run.mesh_path) != self.mesh_sha256:
            raise InputError(
                f"{self.path}: a mesh other than {measured_run.mesh_path} was refined; name that with --mesh"
            )
        run = measured_run.run.folder.name
        if absent := [view.name for view in measured_run.views if (run, view.name) not in self.base_from_camera]:
            raise InputError(
                f"{self.path}: holds no pose of the view {absent[0]} of {run}; give all runs that you name to "
                f"`coupole reflectance refine`"
            )
        if self.inputs.get(run) != dict(measured_run.frames.inputs):
            raise InputError(
                f"{self.path}: {run} has other frames than when it was refined; refine it again by `coupole "
                "reflectance refine`, with another --out"
            )
        views = tuple(
            replace(
                view,
                base_from_camera=self.base_from_camera[run, view.name],
                pointing=self.pointings[run, view.name],
            )
            for view in measured_run.views
        )
        corners_mm = self.vertices_mm[renumbered_triangles(measured_run.triangles)]
        return replace(measured_run, lens=self.lens, views=views, corners_mm=corners_mm)


def read_refined(folder: Path) -> RefinedGeometry:
    """Read the geometry from a folder of `coupole reflectance refine`. Raises InputError if the folder holds
    none."""
    path = folder / REFINED
    if not path.exists():
        raise InputError(f"{path}: is not there; `coupole reflectance refine RUN... --out {folder}` makes it")
    try:
        with h5py.File(path, "r") as file:
            if file.attrs.get("schema") != SCHEMA:
                raise InputError(f"{path}: expected {SCHEMA}; refine again with this version")
            views = [tuple(name) for name in file["views"].asstr()[()]]
            lens = Intrinsics(**dict(zip(NAMES, map(float, file["lens"][()]), strict=True)))
            poses = dict(zip(views, file["base_from_camera"][()], strict=True))
            vertices_mm, digest = file["vertices_mm"][()], str(file.attrs["mesh_sha256"])
            covariance, middle_mm = file["covariance"][()], file["middle_mm"][()]
            pointings = _pointings(list(file["names"].asstr()[()]), covariance, middle_mm, views)
    except (OSError, KeyError, ValueError, TypeError) as error:
        raise InputError(
            f"{path}: expected the result of `coupole reflectance refine`: {reason(error)}"
        ) from error
    return RefinedGeometry(path, lens, poses, vertices_mm, digest, _stored_entry(folder, "inputs"), pointings)


def what_was_refined(folder: Path) -> dict[str, Any]:
    """Return the entry of a result about the refinement that it was made with. Raises InputError if there is
    none."""
    return {"sha256": sha256(folder / REFINED), "disagreement": _stored_entry(folder, "disagreement")}


def write_refined(
    path: Path,
    refinement: Refined,
    views: Sequence[tuple[str, str]],
    pictures: Sequence[NDArray[np.float32]],
    mesh_sha256: str,
    is_simulated: bool,
) -> None:
    """Write the file; `views` are names of run and view."""
    unknowns, steps = refinement.unknowns, refinement.steps
    values = {
        "lens": unknowns.lens_at(steps).vector(),
        "base_from_camera": unknowns.cameras_at(steps),
        "vertices_mm": unknowns.vertices_at(steps),
        "vertex_u_mm": refinement.vertex_u_mm(),
        "steps": steps,
        "covariance": refinement.covariance,
        "stated_covariance": unknowns.covariance,
        "controls_mm": unknowns.controls_mm,
        "middle_mm": unknowns.middle_mm,
    }
    with hdf5_file(path, "w") as file:
        file.attrs.update(schema=SCHEMA, mesh_sha256=mesh_sha256, simulated=is_simulated)
        for name, data in values.items():
            file.create_dataset(name, data=data, track_times=False).attrs["told"] = TOLD[name]
        text = h5py.string_dtype()
        file.create_dataset("views", data=np.array(views, object), dtype=text, track_times=False)
        file.create_dataset("names", data=np.array(unknowns.names, object), dtype=text, track_times=False)
        for name in ("views", "names"):
            file[name].attrs["told"] = TOLD[name]
        for when, matches in (("before", refinement.before), ("after", refinement.after)):
            for name, description in MATCH_FIELDS.items():
                data = file.create_dataset(f"{when}/{name}", data=getattr(matches, name), track_times=False)
                data.attrs["told"] = description
        for number, picture in enumerate(pictures):
            data = file.create_dataset(f"pictures/{number}", data=_preview(picture), track_times=False)
            data.attrs["blocks"] = picture.shape
            data.attrs["told"] = "the picture by which the view was compared, scaled; its size was `blocks`"


def _pointings(
    names: list[str], covariance: Floats, middle_mm: Floats, views: Sequence[tuple[str, str]]
) -> dict[tuple[str, str], Pointing]:
    """Return the uncertainty of the directions in which the cameras look, from the covariance of the unknowns of
    these names."""
    of_lens = [place for place, name in enumerate(names) if name.removesuffix("_px") in NAMES]
    of_mesh = [place for place, name in enumerate(names) if name.startswith("mesh.")]
    free = tuple(names[place].removesuffix("_px") for place in of_lens)
    pointings = {}
    for number, view in enumerate(views):
        of_camera = [place for place, name in enumerate(names) if name.startswith(f"camera{number}.")]
        indices = [*of_lens, *of_camera, *of_mesh]
        pointings[view] = Pointing(free, covariance[np.ix_(indices, indices)], middle_mm)
    return pointings


def _stored_entry(folder: Path, name: str) -> Any:
    """Return the entry of `refined.json` with this name."""
    path = folder / ABOUT
    try:
        return read_json(path, allow_nan=True)[name]
    except (OSError, InputError, KeyError, TypeError) as error:
        raise InputError(f"{path}: expected the result of `coupole reflectance refine`") from error


def _preview(picture: NDArray[np.float32]) -> NDArray[np.uint8]:
    every = -(-picture.shape[1] // PREVIEW_PX)
    small = picture[::every, ::every]
    share = np.nan_to_num(small / np.nanpercentile(small, 99.5), nan=1.0)  # what is clipped is white
    preview: NDArray[np.uint8] = (255 * np.clip(share, 0, 1) ** 0.5).astype(np.uint8)
    return preview
