"""From runs of the cell to samples, materials and what they miss, into a result folder.

Each view's samples and each fit are files of their own, whole or not there; a job that was killed goes on with the
first that is missing.
"""

from __future__ import annotations

import json
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from coupole.errors import InputError
from coupole.reflectance.extraction.extraction import extract_view, geometry_of
from coupole.reflectance.extraction.frames_for_check import write_frames
from coupole.reflectance.extraction.measured_run import MeasuredRun, MeasuredView, read_measured_run
from coupole.reflectance.extraction.radiance import Radiometry
from coupole.reflectance.inter_reflection import subtract
from coupole.reflectance.result_folder import begin, complete, read_settings
from coupole.reflectance.run_check import check_result
from coupole.reflectance.run_fits import fit_result
from coupole.reflectance.run_result import FRAMES, OBJECT, RunResult
from coupole.reflectance.run_result_files import write_object
from coupole.storage.disk_errors import disk_error
from coupole.storage.durable import sha256, write_synced

Said = Callable[[str, int, int], None]
HELD_OUT_EVERY, HELD_OUT_FIRST = 12, 4
"""Of the LEDs, if none are named: they are kept for the check."""


@dataclass(frozen=True)
class RunRequest:
    """What its user wants."""

    runs: tuple[Path, ...]
    mesh: Path | None = None
    calibrations: tuple[Path, ...] = ()
    left_out: tuple[int, ...] = ()
    """LEDs; empty for every twelfth."""
    scan_noise_um: float = 30.0
    memory_bytes: int = 2_000_000_000
    support_reflectance: float = 0.0
    """Of the disk, from which light comes to the object too."""
    keep_inter_reflection: bool = False
    """Do not take it off the samples."""


def reflectance_of(request: RunRequest, out: Path, *, say: Said = lambda step, done, of: None) -> dict[str, Any]:
    """Make the result, or what of it is missing; returns what `result.json` says.

    Raises InputError: runs without calibrations, of different objects or cameras, records that do not belong to
    them, a folder that holds another result; StorageError if a frame is damaged or the disk takes nothing.
    """
    begun_s = time.monotonic()
    extract_runs(request, out, say=say)
    fit_result(out, request.memory_bytes, say=say)
    return check_result(out, request.memory_bytes, begun_s=begun_s, say=say)


def extract_runs(request: RunRequest, out: Path, *, say: Said = lambda step, done, of: None) -> None:
    """The samples of all views. Raises as `reflectance_of`."""
    measured_runs = [read_measured_run(run, request.mesh, request.calibrations) for run in request.runs]
    _refuse_different(measured_runs)
    try:
        begin(out, _settings(request, measured_runs))
        first = measured_runs[0]
        complete(out / OBJECT, lambda path: write_object(path, first.corners_mm, first.base_from_support))
        _extract(measured_runs, out, read_settings(out)["left_out"], say)
        if read_settings(out)["subtracted"]:
            subtract(
                RunResult(out),
                paper=first.emission == "paper",
                support_reflectance=request.support_reflectance,
                say=say,
            )
    except OSError as error:
        raise disk_error(out, error) from error


def _refuse_different(measured_runs: Sequence[MeasuredRun]) -> None:
    first = measured_runs[0]
    for other in measured_runs[1:]:
        if not np.array_equal(first.corners_mm, other.corners_mm):
            raise InputError(
                f"{other.run.folder}: shows another object, or in another place, than {first.run.folder}"
            )
        if first.channels != other.channels:
            raise InputError(f"{other.run.folder}: was taken with another sensor than {first.run.folder}")


def _settings(request: RunRequest, measured_runs: Sequence[MeasuredRun]) -> dict[str, Any]:
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
        "emission": measured_runs[0].emission,
        "simulated": any(m.run.simulated for m in measured_runs),
        "channels": "".join(measured_runs[0].channels),
        "view_names": [_name(measured_runs, m, view) for m in measured_runs for view in m.views],
    }


def _extract(measured_runs: Sequence[MeasuredRun], out: Path, left_out: Sequence[int], say: Said) -> None:
    """Of all views samples, frames for the check, and what the report says."""
    for measured in measured_runs:
        prepared = None
        for view in measured.views:
            name = _name(measured_runs, measured, view)
            path, summary = out / "samples" / f"{name}.h5", out / "samples" / f"{name}.json"
            if not summary.exists():
                geometry, radiometry = prepared = prepared or (geometry_of(measured), Radiometry(measured))
                found = extract_view(measured, geometry, radiometry, view, path, say)
                frames = out / FRAMES / f"{name}.h5"
                complete(frames, partial(write_frames, radiometry, view, path, left_out))
                write_synced(summary, json.dumps(found))


def _name(measured_runs: Sequence[MeasuredRun], measured: MeasuredRun, view: MeasuredView) -> str:
    """Of a view's files: its own, with its run's before where there are several."""
    return view.name if len(measured_runs) == 1 else f"{measured.run.folder.name}-{view.name}"
