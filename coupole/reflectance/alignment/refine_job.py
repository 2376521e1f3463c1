"""`coupole reflectance refine`: from runs to a folder with refined poses, lens and mesh, and a summary."""

from __future__ import annotations

import json
import os
import time
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import partial
from importlib.metadata import version
from pathlib import Path
from typing import Any

import numpy as np
import trimesh
from numpy.typing import NDArray

from coupole.errors import InputError
from coupole.geometry import apply, inverse
from coupole.plan.reading import read_plan
from coupole.preflight.object_shape import MM_PER_UNIT
from coupole.reflectance.alignment.matt_picture import Said, common_leds, matt_picture
from coupole.reflectance.alignment.refined_geometry import ABOUT, REFINED, SCHEMA, write_refined
from coupole.reflectance.alignment.refinement import Refined, refine
from coupole.reflectance.alignment.unknowns import Given, renumbered_triangles, welded_vertices
from coupole.reflectance.alignment.view_matches import Matches
from coupole.reflectance.extraction.measured_run import MeasuredRun, read_measured_run, refuse_different
from coupole.reflectance.extraction.pointing import STATED, Doubts, camera_covariance
from coupole.reflectance.extraction.radiance import Radiometry
from coupole.reflectance.result_folder import complete
from coupole.storage.disk_errors import disk_error
from coupole.storage.durable import make_folder, sha256, write_synced

Floats = NDArray[np.float64]
MESH = "mesh.ply"


@dataclass(frozen=True)
class RefineRequest:
    """Request of a user for a refinement."""

    runs: tuple[Path, ...]
    mesh: Path | None = None
    calibrations: tuple[Path, ...] = ()
    doubts: Doubts = STATED
    search_mm: float = 3.0
    """The largest disagreement of views for which the search is made, mm."""


def refine_runs(request: RefineRequest, out: Path, say: Said) -> dict[str, Any]:
    """Refine, write the folder, and return the content of `refined.json`.

    Raises InputError for fewer than two views, records of different cameras, views without common LEDs or texture,
    and an `out` that is a file or not empty. Raises StorageError if a frame is damaged or the disk cannot be
    written.
    """
    begun_s = time.monotonic()
    if out.exists() and not out.is_dir():
        raise InputError(f"{out} is a file: name a folder with --out")
    if out.exists() and any(out.iterdir()):
        raise InputError(f"{out} is not empty: name another folder with --out")
    runs = [read_measured_run(run, request.mesh, request.calibrations) for run in request.runs]
    refuse_different(runs)
    _refuse_other_cameras(runs)
    views = [(measured_run, view) for measured_run in runs for view in measured_run.views]
    if len(views) < 2:
        raise InputError(f"{request.runs[0]}: has one view; to compare views, two or more are needed")
    leds = common_leds([view for _, view in views])
    radiometry = {measured_run.run.folder: Radiometry(measured_run) for measured_run in runs}
    pictures = [
        matt_picture(measured_run, radiometry[measured_run.run.folder], view, leds, say)
        for measured_run, view in views
    ]
    geometry = given_by(runs, request.doubts)
    threads = len(os.sched_getaffinity(0))
    refinement = refine(geometry, pictures, request.doubts, request.search_mm, threads, say)
    names = [(measured_run.run.folder.name, view.name) for measured_run, view in views]
    about = {**_about(refinement, runs, names, leds, request), "seconds": round(time.monotonic() - begun_s, 3)}
    try:
        make_folder(out)
        any_simulated = any(measured_run.run.is_simulated for measured_run in runs)
        digest = sha256(runs[0].mesh_path)
        complete(out / MESH, partial(_write_mesh, refinement, runs[0]))
        complete(
            out / REFINED,
            lambda path: write_refined(path, refinement, names, pictures, digest, is_simulated=any_simulated),
        )
        write_synced(out / ABOUT, json.dumps(about, indent=1) + "\n")
    except OSError as error:
        raise disk_error(out, error) from error
    return about


def given_by(runs: Sequence[MeasuredRun], doubts: Doubts) -> Given:
    """Return the geometry of the runs of one camera and object, as records and scan state it."""
    first, prior = runs[0], runs[0].camera
    if prior.axis_sensitivity is not None:
        sensitivities = [measured_run.camera.axis_sensitivity for measured_run in runs]
        prior = replace(
            prior,
            axis_sensitivity=np.concatenate(
                [sensitivity for sensitivity in sensitivities if sensitivity is not None]
            ),
        )
    cameras = np.stack([view.base_from_camera for measured_run in runs for view in measured_run.views])
    covariance = camera_covariance(prior, cameras, doubts)
    triangles = renumbered_triangles(first.triangles)
    return Given(
        first.lens, prior.free, cameras, covariance, welded_vertices(first.corners_mm, triangles), triangles
    )


def _refuse_other_cameras(measured_runs: Sequence[MeasuredRun]) -> None:
    """Raise InputError for runs with different records of the camera."""
    first = measured_runs[0]
    for other_run in measured_runs[1:]:
        if sha256(first.records["hand-eye"]) != sha256(other_run.records["hand-eye"]):
            raise InputError(
                f"{other_run.run.folder} and {first.run.folder} name different hand-eye records; only one camera "
                "can be refined: name the record of this camera with --calibrations"
            )


def _write_mesh(refinement: Refined, measured_run: MeasuredRun, path: Path) -> None:
    """Write the refined mesh in the unit and frame of the given mesh, without the vertices that no triangle
    uses."""
    plan = read_plan(measured_run.run.plan_path, measured_run.run.rig_path).plan
    assert plan.object is not None  # read_measured_run refuses runs without
    base_from_object = measured_run.base_from_support @ plan.object.support_from_object.matrix()
    vertices_mm = apply(inverse(base_from_object), refinement.unknowns.vertices_at(refinement.steps))
    vertices = vertices_mm / MM_PER_UNIT[plan.object.mesh_unit]
    mesh = trimesh.Trimesh(vertices, refinement.unknowns.prior_geometry.triangles, process=False)
    path.write_bytes(trimesh.exchange.ply.export_ply(mesh))


def _about(
    refinement: Refined,
    runs: Sequence[MeasuredRun],
    names: Sequence[tuple[str, str]],
    leds: Sequence[int],
    request: RefineRequest,
) -> dict[str, Any]:
    unknowns, u = refinement.unknowns, refinement.uncertainties
    stated_u = np.sqrt(np.diag(unknowns.covariance))
    edge_mm = _mean_edge_mm(unknowns.prior_geometry)
    shape = refinement.steps[unknowns.shape]
    cameras = []
    for number, name in enumerate(names):
        columns = unknowns.camera(number)
        camera_steps = {"moved": refinement.steps[columns], "u": u[columns], "stated_u": stated_u[columns]}
        cameras.append(
            {"run": name[0], "view": name[1]} | {key: _mm_deg(six) for key, six in camera_steps.items()}
        )
    return {
        "schema": SCHEMA,
        "software": {name: version(name) for name in ("coupole", "numpy", "numba", "scipy")},
        "simulated": any(measured_run.run.is_simulated for measured_run in runs),
        "inputs": {m.run.folder.name: dict(m.frames.inputs) for m in runs},
        "mesh_sha256": sha256(runs[0].mesh_path),
        "leds": list(leds),
        "search_mm": request.search_mm,
        "disagreement": {
            "before": _disagreement(refinement.before, edge_mm),
            "after": _disagreement(refinement.after, edge_mm),
        },
        "lens": {
            name: {"moved": float(refinement.steps[i]), "u": float(u[i]), "stated_u": float(stated_u[i])}
            for i, name in enumerate(unknowns.names[unknowns.lens])
        },
        "cameras": cameras,
        "mesh": {
            "moved": _mm_deg(refinement.steps[unknowns.mesh]),
            "u": _mm_deg(u[unknowns.mesh]),
            "stated_u": _mm_deg(stated_u[unknowns.mesh]),
            "shape_rms_mm": float(np.sqrt(np.mean(shape**2))),
            "shape_median_u_mm": float(np.median(u[unknowns.shape])),
            "shape_stated_u_mm": request.doubts.shape_mm,
            "scale_mm": request.doubts.scale_mm,
        },
        "noise_factor": refinement.noise_factor,
        "rejected": refinement.rejected_count,
        "unknowns": unknowns.count,
        "determined": refinement.determined_count,
        "chi2_of_steps": refinement.chi2_of_steps,
    }


def _disagreement(matches: Matches, edge_mm: float) -> dict[str, float | int]:
    apart_mm = matches.apart_mm
    apart_px = 2 * np.linalg.norm(matches.matched_blocks - matches.expected_blocks, axis=1)
    return {
        "matches": len(apart_mm),
        "median_mm": float(np.median(apart_mm)),
        "percentile_95_mm": float(np.percentile(apart_mm, 95)),
        "median_px": float(np.median(apart_px)),
        "median_edges": float(np.median(apart_mm)) / edge_mm,
    }


def _mean_edge_mm(prior_geometry: Given) -> float:
    corners = prior_geometry.vertices_mm[prior_geometry.triangles]
    return float(np.linalg.norm(corners - np.roll(corners, 1, axis=1), axis=2).mean())


def _mm_deg(six: Floats) -> list[float]:
    """Return steps or uncertainties in mm and degrees."""
    return [*map(float, six[:3]), *map(float, np.degrees(six[3:]))]
