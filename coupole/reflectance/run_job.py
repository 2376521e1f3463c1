"""Job from runs of the cell to a result folder with samples, materials and their errors.

Each view's samples and each fit are separate files, complete or missing. A job that was killed continues with the
first missing file.
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
from coupole.intake.plain_data import read_json
from coupole.plan.held_out import held_out_leds
from coupole.plan.shot_id import Led
from coupole.reflectance.alignment.colmap_model import read_model
from coupole.reflectance.alignment.colmap_poses import read_poses
from coupole.reflectance.alignment.refined_geometry import ABOUT, read_refined, what_was_refined
from coupole.reflectance.begun_beside import ViewBasis, adopt, clear_beside, frames_basis, is_taken, note_view
from coupole.reflectance.block_work import Said, Workshop, silent, workshop
from coupole.reflectance.discarded_frames import (
    discard_complete,
    is_for_discarding,
    prove_written,
    read_back_or_drop,
    refuse_without_frames,
)
from coupole.reflectance.extraction.extraction import Geometry, extract_view, forget_codes, geometry_of
from coupole.reflectance.extraction.frames_for_check import write_frames
from coupole.reflectance.extraction.measured_run import (
    MeasuredRun,
    MeasuredView,
    read_measured_run,
    refuse_different,
)
from coupole.reflectance.extraction.radiance import Radiometry
from coupole.reflectance.inter_reflection import subtract
from coupole.reflectance.light_paths import NOTHING_AHEAD, Ahead
from coupole.reflectance.result_folder import SETTINGS, begin, complete, read_settings
from coupole.reflectance.run_check import check_result
from coupole.reflectance.run_fits import fit_result
from coupole.reflectance.run_result import FRAMES, OBJECT, RunResult
from coupole.reflectance.run_result_files import write_object
from coupole.storage.discarding import discarded_views, incomplete_until
from coupole.storage.disk_errors import disk_error
from coupole.storage.durable import sha256, write_synced
from coupole.storage.run import Run
from coupole.storage.run_json import RUN_JSON
from coupole.storage.sample_proofs import proofs_of


@dataclass(frozen=True)
class RunRequest:
    """Request of a user for a result."""

    runs: tuple[Path, ...]
    mesh: Path | None = None
    calibrations: tuple[Path, ...] = ()
    left_out: tuple[int, ...] = ()
    """LEDs kept for the check; if it is empty, every twelfth LED."""
    scan_noise_um: float = 30.0
    memory_bytes: int = 2_000_000_000
    support_reflectance: float = 0.0
    """Reflectance of the disk, which reflects light to the object."""
    keep_inter_reflection: bool = False
    """True if inter-reflection is not subtracted from the samples."""
    refined_folder: Path | None = None
    """Folder of `coupole reflectance refine`. Its poses, lens and mesh are used instead of the values in records
    and scan."""
    poses: Path | None = None
    """COLMAP folder of one run. Its poses are used instead of the records' poses."""

    @property
    def sources(self) -> Sources:
        """Sources of the runs' geometry, by absolute paths."""
        mesh, refined_path, poses = (
            path and path.resolve() for path in (self.mesh, self.refined_folder, self.poses)
        )
        return Sources(mesh, tuple(path.resolve() for path in self.calibrations), refined_path, poses)

    @property
    def is_plain(self) -> bool:
        """True for a request that can also be processed beside an acquisition: one run, with its own mesh and
        records."""
        named_files = (self.mesh, self.calibrations, self.left_out, self.refined_folder, self.poses)
        return len(self.runs) == 1 and not any(named_files)


@dataclass(frozen=True)
class Sources:
    """Files that give the runs' geometry, by absolute paths."""

    mesh: Path | None
    records: tuple[Path, ...]
    refined_folder: Path | None
    poses: Path | None


def reflectance_of(
    request: RunRequest,
    out: Path,
    *,
    scheduler: str | None = None,
    say: Said = silent,
    ahead: Ahead = NOTHING_AHEAD,
) -> dict[str, Any]:
    """Make the result, or its missing parts, in the workers of a `scheduler` if one is named. Return the content
    of `result.json`. `ahead` has values that were computed before for the same object.

    Raises InputError for runs without calibrations, for runs of different objects or cameras, and for records that
    do not belong to the runs. It is also raised for a folder with another result, for a scheduler that does not
    answer, and for workers that do not see the folder. Raises StorageError if a frame is damaged or the disk
    cannot be written.
    """
    begun_s = time.monotonic()
    extract_runs(request, out, scheduler=scheduler, say=say, ahead=ahead)
    fit_result(out, request.memory_bytes, scheduler=scheduler, say=say)
    about = check_result(out, request.memory_bytes, begun_s=begun_s, say=say)
    clear_beside(out)
    return about


def extract_runs(
    request: RunRequest,
    out: Path,
    *,
    scheduler: str | None = None,
    say: Said = silent,
    ahead: Ahead = NOTHING_AHEAD,
) -> None:
    """Make the samples of all views. Raises as `reflectance_of`."""
    token = uuid4().hex
    measured_runs = read_runs(request, token)
    for measured_run in measured_runs:
        refuse_without_frames(measured_run.run, out)
    try:
        with workshop(scheduler) as shop:
            settings = settings_of(request, token, measured_runs)
            adopt(
                out, settings, _bases(measured_runs, settings["left_out"]), discarded_views(measured_runs[0].run)
            )
            begin(out, settings)
            complete(out / OBJECT, partial(_write_object, measured_runs[0]))
            shop.refuse_blind(out.resolve(), SETTINGS)
            _extract(request, token, measured_runs, out.resolve(), shop, say)
        if discards(request, measured_runs[0].run, out):
            discard_complete(measured_runs[0].run, out, say)
        subtract_from(out, say, ahead)
    except OSError as error:
        raise disk_error(out, error) from error
    finally:
        forget()


def subtract_from(out: Path, say: Said, ahead: Ahead) -> None:
    """Subtract inter-reflection from the samples of a result, if its settings say so. Raises OSError."""
    settings = read_settings(out)
    if settings["subtracted"]:
        is_paper, support = settings["emission"] == "paper", settings["support_reflectance"]
        subtract(RunResult(out), paper=is_paper, support_reflectance=support, say=say, ahead=ahead)


def extract_beside(run: Path, view_name: str, out: Path, say: Said = silent) -> str:
    """Make the samples of a complete view of a run that is still being acquired, with the run's own mesh and
    records. Existing files stay if they agree with the view's frames. A result that was begun with all frames of
    its runs stays too. Raises as `reflectance_of`.

    Returns the digest of the samples if the view's frames may be discarded for them: the samples were just read
    back and are as written. Otherwise returns an empty text.
    """
    if (out / SETTINGS).exists():
        return ""
    request, token = RunRequest((run,)), uuid4().hex
    opened_run = Run(run)
    if view_name in discarded_views(opened_run):
        return ""
    is_final = not incomplete_until(opened_run, view_name)  # before its frames are read
    gives_frames = is_final and discards(request, opened_run, out)
    try:
        (measured_run,) = read_runs(request, token)
        view = next((view for view in measured_run.views if view.name == view_name), None)
        if view is None:  # dark frames or panels alone
            return ""
        left_out = tuple(held_out_leds(expected_leds(measured_run.run)))
        basis = ViewBasis(frames_basis(measured_run.frames, view_name), left_out)
        file_name = view_file_name([measured_run], measured_run, view)
        if is_taken(out, file_name, basis):
            digest = read_back_or_drop(out, file_name) if gives_frames else ""
            if digest or not gives_frames:
                return digest
        path = out / "samples" / f"{file_name}.h5"
        path.with_suffix(".json").unlink(missing_ok=True)
        note_view(out, run.name, settings_of(request, token, [measured_run]), file_name, basis)
        complete(out / OBJECT, partial(_write_object, measured_run))
        task = _View(run.resolve(), view_name, path, left_out)
        summary, digest = _extract_one(token, request.sources, None, say, task)
        write_synced(path.with_suffix(".json"), json.dumps(summary))
        if gives_frames:
            prove_written(out, file_name, digest)
    except OSError as error:
        raise disk_error(out, error) from error
    else:
        return digest if gives_frames else ""
    finally:
        forget()


def discards(request: RunRequest, run: Run, out: Path) -> bool:
    """Tell whether frames of a run are discarded once the result of a request has their samples."""
    return request.is_plain and is_for_discarding(run, out)


def _write_object(measured_run: MeasuredRun, path: Path) -> None:
    write_object(path, measured_run.corners_mm, measured_run.base_from_support)


def expected_leds(run: Run) -> set[int]:
    """Return the LEDs of all views. If LEDs are chosen in the run, these are the LEDs chosen so far."""
    return {shot.light.id for shot in run.expected_shots() if isinstance(shot.light, Led)}


def _bases(measured_runs: Sequence[MeasuredRun], left_out: Sequence[int]) -> dict[str, ViewBasis]:
    return {
        view_file_name(measured_runs, m, view): ViewBasis(frames_basis(m.frames, view.name), tuple(left_out))
        for m in measured_runs
        for view in m.views
    }


def read_runs(request: RunRequest, token: str) -> list[MeasuredRun]:
    """Read the runs with their records. Raises as `reflectance_of`."""
    if request.poses is not None and (request.refined_folder is not None or len(request.runs) != 1):
        raise InputError("--poses: expected one run, and no --refined; COLMAP's images are named after its views")
    measured_runs = [_read_run(token, run, request.sources) for run in request.runs]
    refuse_different(measured_runs)
    return measured_runs


def settings_of(request: RunRequest, token: str, measured_runs: Sequence[MeasuredRun]) -> dict[str, Any]:
    """Return the settings with which a result of a request is begun."""
    frames = [frame for m in measured_runs for view in m.views for frame in view.frames]
    leds = sorted({frame.led for frame in frames if frame.led is not None})
    left_out = list(request.left_out) or held_out_leds(leds)
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
    """Return the entry of a result about poses by COLMAP."""
    if request.poses is None:
        return {}
    return {"poses": read_poses(request.poses, _read_records(token, request.runs[0], request.sources)).summary()}


@dataclass(frozen=True)
class _View:
    """A block of extraction: the samples of one view, which become one file."""

    run: Path
    view: str
    path: Path
    left_out: tuple[int, ...]

    @property
    def frames_path(self) -> Path:
        """File of the pictures for the check."""
        return self.path.parents[1] / FRAMES / self.path.name

    @property
    def is_whole(self) -> bool:
        return self.path.with_suffix(".json").exists() and self.frames_path.exists()


def _extract(
    request: RunRequest, token: str, measured_runs: Sequence[MeasuredRun], out: Path, shop: Workshop, say: Said
) -> None:
    """Make the samples of all views, and write the report's entry about each view beside its samples."""
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
    gives_frames = discards(request, measured_runs[0].run, out)
    for run_view in remaining_views if gives_frames else ():
        if not proofs_of(out, run_view.path.stem):  # killed before it was read back
            run_view.path.with_suffix(".json").unlink(missing_ok=True)
    remaining_views = [run_view for run_view in remaining_views if not run_view.is_whole]
    sources = request.sources
    for run_view in remaining_views:
        shop.refuse_blind(run_view.run, RUN_JSON)
    if sources.refined_folder is not None:
        shop.refuse_blind(sources.refined_folder, ABOUT)
    if sources.poses is not None:
        path = read_model(sources.poses).path
        shop.refuse_blind(path.parent, path.name)
    extract = partial(_extract_one, token, sources, shop.threads, shop.reporter(say))
    for number, (run_view, (summary, digest)) in enumerate(
        zip(remaining_views, shop.map(extract, remaining_views), strict=True), start=1
    ):
        write_synced(run_view.path.with_suffix(".json"), json.dumps(summary))
        if gives_frames and digest:
            prove_written(out, run_view.path.stem, digest)
        say("views", number, len(remaining_views))
    shop.everywhere(forget)


def _extract_one(
    token: str,
    sources: Sources,
    threads: int | None,
    say: Said,
    task: _View,
) -> tuple[dict[str, Any], str]:
    """Write the files of a view's samples and frames for the check. Return the report's entry about them, and the
    digest of the written samples, which is empty if they existed."""
    measured_run, geometry, radiometry = prepare_run(token, task.run, sources)
    view = next(view for view in measured_run.views if view.name == task.view)
    summary_path = task.path.with_suffix(".json")
    summary, digest = (
        (read_json(summary_path, allow_nan=True), "")
        if summary_path.exists()  # of samples whose pictures for the check alone are missing
        else extract_view(measured_run, geometry, radiometry, view, task.path, say, threads=threads)
    )
    forget_codes()
    complete(task.frames_path, partial(write_frames, radiometry, view, task.path, task.left_out, threads))
    return summary, digest


@lru_cache(maxsize=1)
def prepare_run(token: str, run: Path, sources: Sources) -> tuple[MeasuredRun, Geometry, Radiometry]:
    """Return the data that all views of a run share, made once in each process and job (`token`)."""
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
    """Return the name of a view's files: the view's name, preceded by the run's name if there are several runs."""
    return view.name if len(measured_runs) == 1 else f"{measured_run.run.folder.name}-{view.name}"
