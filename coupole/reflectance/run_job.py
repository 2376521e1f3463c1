"""Job from runs of the cell to samples, materials and their errors, in a result folder.

Each view's samples and each fit are files of their own, whole or not there; a job that was killed goes on with the
first that is missing.
"""

from __future__ import annotations

import json
import time
from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache, partial
from pathlib import Path
from typing import Any
from uuid import uuid4

from coupole.errors import InputError
from coupole.reflectance.alignment.colmap_model import read_model
from coupole.reflectance.alignment.colmap_poses import read_poses
from coupole.reflectance.alignment.refined_geometry import ABOUT, read_refined, what_was_refined
from coupole.reflectance.block_work import Said, Workshop, silent, workshop
from coupole.reflectance.extraction.extraction import Geometry, extract_view, geometry_of
from coupole.reflectance.extraction.frames_for_check import write_frames
from coupole.reflectance.extraction.measured_run import (
    MeasuredRun,
    MeasuredView,
    read_measured_run,
    refuse_different,
)
from coupole.reflectance.extraction.radiance import Radiometry
from coupole.reflectance.inter_reflection import subtract
from coupole.reflectance.result_folder import SETTINGS, begin, complete, read_settings
from coupole.reflectance.run_check import check_result
from coupole.reflectance.run_fits import fit_result
from coupole.reflectance.run_result import FRAMES, OBJECT, RunResult
from coupole.reflectance.run_result_files import write_object
from coupole.storage.disk_errors import disk_error
from coupole.storage.durable import sha256, write_synced
from coupole.storage.run_json import RUN_JSON

HELD_OUT_EVERY, HELD_OUT_FIRST = 12, 4
"""Step and first place of the LEDs that are kept for the check, if none are named."""


@dataclass(frozen=True)
class RunRequest:
    """Request of a user for a result."""

    runs: tuple[Path, ...]
    mesh: Path | None = None
    calibrations: tuple[Path, ...] = ()
    left_out: tuple[int, ...] = ()
    """LEDs; empty for every twelfth."""
    scan_noise_um: float = 30.0
    memory_bytes: int = 2_000_000_000
    support_reflectance: float = 0.0
    """Reflectance of the disk, from which light comes to the object too."""
    keep_inter_reflection: bool = False
    """Do not take it off the samples."""
    refined_folder: Path | None = None
    """Folder of `coupole reflectance refine`: its poses, lens and mesh hold instead of the records' and scan's."""
    poses: Path | None = None
    """Folder of COLMAP's, of one run: its poses hold instead of the records'."""

    @property
    def sources(self) -> Sources:
        """Sources of the runs' geometry, by whole paths."""
        mesh, refined_path, poses = (
            path and path.resolve() for path in (self.mesh, self.refined_folder, self.poses)
        )
        return Sources(mesh, tuple(path.resolve() for path in self.calibrations), refined_path, poses)


@dataclass(frozen=True)
class Sources:
    """Files that give the runs' geometry, by whole paths."""

    mesh: Path | None
    records: tuple[Path, ...]
    refined_folder: Path | None
    poses: Path | None


def reflectance_of(
    request: RunRequest, out: Path, *, scheduler: str | None = None, say: Said = silent
) -> dict[str, Any]:
    """Make the result, or what of it is missing, in the workers of a `scheduler` if one is named; returns what
    `result.json` says.

    Raises InputError: runs without calibrations, of different objects or cameras, records that do not belong to
    them, a folder that holds another result, a scheduler that does not answer or whose workers do not see the
    folder; StorageError if a frame is damaged or the disk takes nothing.
    """
    begun_s = time.monotonic()
    extract_runs(request, out, scheduler=scheduler, say=say)
    fit_result(out, request.memory_bytes, scheduler=scheduler, say=say)
    return check_result(out, request.memory_bytes, begun_s=begun_s, say=say)


def extract_runs(request: RunRequest, out: Path, *, scheduler: str | None = None, say: Said = silent) -> None:
    """The samples of all views. Raises as `reflectance_of`."""
    token = uuid4().hex
    measured_runs = read_runs(request, token)
    try:
        with workshop(scheduler) as shop:
            begin(out, settings_of(request, token, measured_runs))
            first = measured_runs[0]
            complete(out / OBJECT, lambda path: write_object(path, first.corners_mm, first.base_from_support))
            shop.refuse_blind(out.resolve(), SETTINGS)
            _extract(request, token, measured_runs, out.resolve(), shop, say)
        settings = read_settings(out)
        if settings["subtracted"]:
            support = settings["support_reflectance"]
            subtract(RunResult(out), paper=settings["emission"] == "paper", support_reflectance=support, say=say)
    except OSError as error:
        raise disk_error(out, error) from error
    finally:
        forget()


def read_runs(request: RunRequest, token: str) -> list[MeasuredRun]:
    """Read the runs with their records. Raises as `reflectance_of`."""
    if request.poses is not None and (request.refined_folder is not None or len(request.runs) != 1):
        raise InputError("--poses: expected one run, and no --refined; COLMAP's images are named after its views")
    measured_runs = [_read_run(token, run, request.sources) for run in request.runs]
    refuse_different(measured_runs)
    return measured_runs


def settings_of(request: RunRequest, token: str, measured_runs: Sequence[MeasuredRun]) -> dict[str, Any]:
    """Return what a result of a request is begun with."""
    frames = [frame for m in measured_runs for view in m.views for frame in view.frames]
    leds = sorted({frame.led for frame in frames if frame.led is not None})
    left_out = list(request.left_out) or leds[HELD_OUT_FIRST::HELD_OUT_EVERY]
    if wrong := sorted(set(left_out) - set(leds)):
        raise InputError(f"--leave-out: no frame under LED {wrong[0]} in these runs")
    return {
        "left_out": left_out,
        "subtracted": not (request.keep_inter_reflection or all(m.direct_light_alone for m in measured_runs)),
        "support_reflectance": request.support_reflectance,
        "scan_noise_um": request.scan_noise_um,
        "runs": {m.run.folder.name: dict(m.frames.inputs) for m in measured_runs},
        "records": [{kind: sha256(path) for kind, path in m.records.items()} for m in measured_runs],
        "mesh": sha256(measured_runs[0].mesh_path),
        "refined": None if request.refined_folder is None else what_was_refined(request.refined_folder),
        **_pose_summary(request, token),
        "emission": measured_runs[0].emission,
        "simulated": any(m.run.is_simulated for m in measured_runs),
        "channels": "".join(measured_runs[0].channels),
        "view_names": [view_file_name(measured_runs, m, view) for m in measured_runs for view in m.views],
    }


def _pose_summary(request: RunRequest, token: str) -> dict[str, Any]:
    """Return what a result says of poses by COLMAP."""
    if request.poses is None:
        return {}
    return {"poses": read_poses(request.poses, _read_records(token, request.runs[0], request.sources)).summary()}


@dataclass(frozen=True)
class _View:
    """A block of extraction: one view's samples, a file."""

    run: Path
    view: str
    path: Path
    left_out: tuple[int, ...]


def _extract(
    request: RunRequest, token: str, measured_runs: Sequence[MeasuredRun], out: Path, shop: Workshop, say: Said
) -> None:
    """Samples of all views, and what the report says of each."""
    left_out = tuple(read_settings(out)["left_out"])
    remaining_views = [
        _View(
            run.resolve(),
            view.name,
            out / "samples" / f"{view_file_name(measured_runs, measured_run, view)}.h5",
            left_out,
        )
        for run, measured_run in zip(request.runs, measured_runs, strict=True)
        for view in measured_run.views
    ]
    remaining_views = [run_view for run_view in remaining_views if not run_view.path.with_suffix(".json").exists()]
    sources = request.sources
    for run_view in remaining_views:
        shop.refuse_blind(run_view.run, RUN_JSON)
    if sources.refined_folder is not None:
        shop.refuse_blind(sources.refined_folder, ABOUT)
    if sources.poses is not None:
        path = read_model(sources.poses).path
        shop.refuse_blind(path.parent, path.name)
    extract = partial(_extract_one, token, sources, shop.threads, shop.reporter(say))
    for number, (run_view, summary) in enumerate(
        zip(remaining_views, shop.map(extract, remaining_views), strict=True), start=1
    ):
        write_synced(run_view.path.with_suffix(".json"), json.dumps(summary))
        say("views", number, len(remaining_views))
    shop.everywhere(forget)


def _extract_one(
    token: str,
    sources: Sources,
    threads: int | None,
    say: Said,
    task: _View,
) -> dict[str, Any]:
    """Write the files of a view's samples and frames for the check; what the report says of them."""
    measured_run, geometry, radiometry = prepare_run(token, task.run, sources)
    view = next(view for view in measured_run.views if view.name == task.view)
    summary = extract_view(measured_run, geometry, radiometry, view, task.path, say, threads=threads)
    frames = task.path.parents[1] / FRAMES / task.path.name
    complete(frames, partial(write_frames, radiometry, view, task.path, task.left_out, threads))
    return summary


@lru_cache(maxsize=1)
def prepare_run(token: str, run: Path, sources: Sources) -> tuple[MeasuredRun, Geometry, Radiometry]:
    """Return what all views of a run share, made once in each process and job (`token`)."""
    measured_run = _read_run(token, run, sources)
    return measured_run, geometry_of(measured_run), Radiometry(measured_run)


@lru_cache(maxsize=16)
def _read_run(token: str, run: Path, sources: Sources) -> MeasuredRun:
    measured_run = _read_records(token, run, sources)
    if sources.poses is not None:
        return read_poses(sources.poses, measured_run).of(measured_run)
    return (
        measured_run if sources.refined_folder is None else read_refined(sources.refined_folder).of(measured_run)
    )


@lru_cache(maxsize=16)
def _read_records(_token: str, run: Path, sources: Sources) -> MeasuredRun:
    """Read a run by the records alone."""
    return read_measured_run(run, sources.mesh, sources.records)


def forget() -> None:
    prepare_run.cache_clear()
    _read_run.cache_clear()
    _read_records.cache_clear()


def view_file_name(measured_runs: Sequence[MeasuredRun], measured_run: MeasuredRun, view: MeasuredView) -> str:
    """Return the name of a view's files: its own, with its run's before where there are several."""
    return view.name if len(measured_runs) == 1 else f"{measured_run.run.folder.name}-{view.name}"
