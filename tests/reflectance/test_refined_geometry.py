"""Refined meshes with vertices that no triangle uses, and runs that changed after they were refined."""

from __future__ import annotations

import json
from dataclasses import dataclass, replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import h5py
import numpy as np
import pytest
import trimesh
from numpy.typing import NDArray

from coupole.calibration.optics import Intrinsics
from coupole.calibration.posed_camera import CameraPrior
from coupole.errors import InputError
from coupole.reflectance.alignment import refine_job
from coupole.reflectance.alignment.refine_job import given_by
from coupole.reflectance.alignment.refined_geometry import ABOUT, REFINED, SCHEMA, read_refined
from coupole.reflectance.alignment.unknowns import Unknowns
from coupole.reflectance.extraction.pointing import STATED, Pointing
from coupole.storage.durable import sha256

VERTICES = np.array([[900, 900, 900], [0, 0, 0], [7, 7, 7], [4, 0, 0], [0, 4, 0], [4, 4, 0], [-5, 0, 0]], float)
TRIANGLES = np.array([[5, 3, 1], [1, 4, 5]], np.uint32)
"""Vertices 0, 2 and 6 belong to none."""
USED = [1, 3, 4, 5]
SHIFT = np.array([0.0, 0.0, 1.0])
INPUTS = (("vase/run.json", "aa"), ("vase/views/top.h5", "bb"))
LENS = Intrinsics(800.0, 800.0, 199.5, 149.5)


@dataclass(frozen=True)
class View:
    name: str
    base_from_camera: NDArray[np.float64]
    pointing: Pointing | None = None


@dataclass(frozen=True)
class Measured:
    """What is read of a `MeasuredRun`."""

    mesh_path: Path
    run: Any
    frames: Any
    views: tuple[View, ...]
    lens: Intrinsics
    camera: CameraPrior
    triangles: NDArray[np.uint32]
    corners_mm: NDArray[np.float64]


def measured_run(folder: Path) -> Any:
    mesh = folder / "scan.ply"
    mesh.write_text("a scan")
    run, frames = SimpleNamespace(folder=Path("vase")), SimpleNamespace(inputs=INPUTS)
    prior = CameraPrior(LENS, (), np.eye(4), np.eye(6) * 1e-4)
    return Measured(mesh, run, frames, (View("top", np.eye(4)),), LENS, prior, TRIANGLES, VERTICES[TRIANGLES])


def read(folder: Path, vertices_mm: NDArray[np.float64]) -> Any:
    """A refinement of the run."""
    with h5py.File(folder / REFINED, "w") as file:
        file.attrs.update(schema=SCHEMA, mesh_sha256=sha256(folder / "scan.ply"))
        file.create_dataset("views", data=np.array([("vase", "top")], object), dtype=h5py.string_dtype())
        file["lens"], file["base_from_camera"], file["vertices_mm"] = LENS.vector(), np.eye(4)[None], vertices_mm
        text, steps = h5py.string_dtype(), ("x_mm", "y_mm", "z_mm", "rx_rad", "ry_rad", "rz_rad")
        names = ["fx_px", *(f"{what}.{step}" for what in ("camera0", "mesh") for step in steps), "shape0_mm"]
        file.create_dataset("names", data=np.array(names, object), dtype=text)
        file["covariance"], file["middle_mm"] = np.diag(np.arange(1.0, 15.0)), np.array([1.0, 2.0, 3.0])
    (folder / ABOUT).write_text(json.dumps({"inputs": {"vase": dict(INPUTS)}}))
    return read_refined(folder)


def test_vertices_that_no_triangle_uses_are_not_refined(tmp_path: Path) -> None:
    measured = measured_run(tmp_path)
    given = given_by([measured], STATED)
    np.testing.assert_array_equal(given.vertices_mm, VERTICES[USED])
    np.testing.assert_array_equal(given.vertices_mm[given.triangles], measured.corners_mm)
    unknowns = Unknowns(given, STATED, given.vertices_mm[:1])
    np.testing.assert_allclose(unknowns.middle_mm, [2, 2, 0])
    moved = read(tmp_path, given.vertices_mm + SHIFT).of(measured)
    np.testing.assert_allclose(moved.corners_mm, measured.corners_mm + SHIFT)


def test_the_mesh_that_is_written_has_no_vertex_but_those_of_triangles(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    pose: Any = SimpleNamespace(matrix=lambda: np.eye(4))
    plan = SimpleNamespace(object=SimpleNamespace(support_from_object=pose, mesh_unit="mm"))
    monkeypatch.setattr(refine_job, "read_plan", lambda plan_path, rig_path: SimpleNamespace(plan=plan))
    measured = measured_run(tmp_path)
    given = given_by([measured], STATED)
    unknowns = Unknowns(given, STATED, given.vertices_mm[:1])
    refined: Any = SimpleNamespace(unknowns=unknowns, steps=np.zeros(unknowns.count))
    run = SimpleNamespace(plan_path=None, rig_path=None)
    of_run: Any = SimpleNamespace(run=run, base_from_support=np.eye(4), triangles=TRIANGLES)
    refine_job._write_mesh(refined, of_run, tmp_path / "mesh.ply")
    found = trimesh.load(tmp_path / "mesh.ply", process=False)
    np.testing.assert_allclose(found.vertices, VERTICES[USED], atol=1e-5)
    np.testing.assert_allclose(found.triangles, measured.corners_mm, atol=1e-5)


def test_a_run_with_other_frames_than_when_it_was_refined_is_refused(tmp_path: Path) -> None:
    measured = measured_run(tmp_path)
    refined = read(tmp_path, VERTICES[USED])
    resumed = replace(measured, frames=SimpleNamespace(inputs=(INPUTS[0], (INPUTS[1][0], "cc"))))
    with pytest.raises(InputError, match=r"vase has other frames than when it was refined; .* again"):
        refined.of(resumed)


def test_where_pixels_look_is_known_as_the_refinement_says(tmp_path: Path) -> None:
    measured = measured_run(tmp_path)
    refined = read(tmp_path, VERTICES[USED]).of(measured)
    (view,) = refined.views
    assert view.pointing.free == ("fx",)
    assert np.diag(view.pointing.covariance).tolist() == list(
        range(1, 14)
    )  # lens, its camera, the mesh; not the shape
    assert view.pointing.middle_mm.tolist() == [1.0, 2.0, 3.0]
