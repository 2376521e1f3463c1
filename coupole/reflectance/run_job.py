"""From runs of the cell to samples, materials and what they miss, into a result folder.

Each view's samples and each fit are files of their own, whole or not there; a job that was killed goes on with the
first that is missing.
"""

from __future__ import annotations

import json
import resource
import sys
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from importlib.metadata import version
from pathlib import Path
from typing import Any

import h5py
import numpy as np
from numpy.typing import NDArray

from coupole.errors import InputError
from coupole.reflectance.extraction.extraction import extract_view, geometry_of
from coupole.reflectance.extraction.lamp_sight import lit_on
from coupole.reflectance.extraction.measured_run import MeasuredRun, read_measured_run
from coupole.reflectance.extraction.radiance import Radiometry
from coupole.reflectance.result_folder import begin, complete
from coupole.reflectance.run_result import ABOUT, FITS, OBJECT, SCHEMA, RunResult, write_materials, write_object
from coupole.reflectance.triangle_fit import TriangleSamples, fit_triangles, model_values
from coupole.storage.disk_errors import disk_error
from coupole.storage.durable import sha256, write_synced

Said = Callable[[str, int, int], None]
HELD_OUT_EVERY, HELD_OUT_FIRST = 12, 4
"""Of the LEDs, if none are named: they are kept for the check."""
PEAK_QUANTILE = 0.999
COVERAGE = 0.95
_NORMAL_QUANTILE = 1.96


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


@dataclass
class _Check:
    """Grows block by block: held-out samples of one representation."""

    absolute: float = 0.0
    square: float = 0.0
    count: int = 0
    measured: list[NDArray[np.float32]] = field(default_factory=list)

    def add(self, made: NDArray[np.float64], measured: NDArray[np.float64]) -> None:
        known = np.isfinite(measured) & np.isfinite(made)
        off = made[known] - measured[known]
        self.absolute += float(np.abs(off).sum())
        self.square += float(np.sum(off**2))
        self.count += off.size
        self.measured.append(measured[known][::16].astype(np.float32))

    @property
    def mae(self) -> float | None:
        return self.absolute / self.count if self.count else None

    @property
    def psnr_db(self) -> float | None:
        if not self.count:
            return None
        peak = float(np.quantile(np.concatenate(self.measured), PEAK_QUANTILE))
        return float(10 * np.log10(peak**2 / max(self.square / self.count, 1e-30)))


def fit_runs(request: RunRequest, out: Path, *, say: Said = lambda step, done, of: None) -> dict[str, Any]:
    """Make the result, or what of it is missing; returns what `result.json` says.

    Raises InputError: runs without calibrations, of different objects or cameras, records that do not belong to
    them, a folder that holds another result; StorageError if a frame is damaged or the disk takes nothing.
    """
    begun_s = time.monotonic()
    measured_runs = [read_measured_run(run, request.mesh, request.calibrations) for run in request.runs]
    _refuse_different(measured_runs)
    try:
        settings = _settings(request, measured_runs)
        begin(out, settings)
        first = measured_runs[0]
        complete(out / OBJECT, lambda path: write_object(path, first.corners_mm, first.base_from_support))
        views = _extract(measured_runs, out, say)
        result = RunResult(out)
        for name in FITS:
            if not (out / FITS[name]).exists():
                _fit(result, name, request, settings["left_out"], say)
        checks = _check(result, request, settings["left_out"], measured_runs[0].emission == "paper", say)
        about = _about(result, settings, views, checks, measured_runs, time.monotonic() - begun_s)
        write_synced(out / ABOUT, json.dumps(about, indent=1) + "\n")
    except OSError as error:
        raise disk_error(out, error) from error
    return about


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
        "scan_noise_um": request.scan_noise_um,
        "runs": {m.run.folder.name: dict(m.frames.inputs) for m in measured_runs},
        "records": [{kind: sha256(path) for kind, path in m.records.items()} for m in measured_runs],
        "mesh": sha256(measured_runs[0].mesh_path),
        "emission": measured_runs[0].emission,
    }


def _extract(measured_runs: Sequence[MeasuredRun], out: Path, say: Said) -> list[dict[str, Any]]:
    """Samples of all views; what the report says of each."""
    told = []
    for measured in measured_runs:
        prepared = None
        for view in measured.views:
            name = view.name if len(measured_runs) == 1 else f"{measured.run.folder.name}-{view.name}"
            path, summary = out / "samples" / f"{name}.h5", out / "samples" / f"{name}.json"
            if not summary.exists():
                prepared = prepared or (geometry_of(measured), Radiometry(measured))
                found = extract_view(measured, *prepared, view, path, say)
                write_synced(summary, json.dumps(found))
            told.append(json.loads(summary.read_text(encoding="utf-8")))
    return told


def _fit(result: RunResult, name: str, request: RunRequest, left_out: Sequence[int], say: Said) -> None:
    noise_um = None if name == "ggx" else request.scan_noise_um
    parts = []
    for block in result.blocks(request.memory_bytes):
        used = ~np.isin(result.along_samples(block, "leds"), left_out)
        parts.append(fit_triangles(result.samples(block), used, noise_um))
        say(f"fit {name}", block.stop, len(result.triangles))
    complete(result.folder / FITS[name], lambda path: write_materials(path, parts, result.triangles))


def _check(
    result: RunResult, request: RunRequest, left_out: Sequence[int], paper: bool, say: Said
) -> dict[str, _Check]:
    """Samples under the LEDs that were left out, in shares of the camera's range."""
    checks = {name: _Check() for name in FITS}
    for block in result.blocks(request.memory_bytes):
        samples = result.samples(block)
        held = np.isin(result.along_samples(block, "leds"), left_out)
        scales = result.along_samples(block, "full_scales")[held]
        some = TriangleSamples(
            samples.values[:, held],
            samples.led_mm[held],
            samples.view_of[held],
            samples.cameras_mm,
            samples.centres_mm,
            samples.normals,
            samples.areas_mm2,
        )
        led_normals = result.along_samples(block, "led_normals")[held]
        share = lit_on(some.centres_mm, some.led_mm, led_normals, paper)[..., None] * scales
        for name, check in checks.items():
            check.add(model_values(some, result.materials(name, block)) * share, some.values * share)
        say("check", block.stop, len(result.triangles))
    return checks


def _interval_percent(result: RunResult) -> dict[str, float] | None:
    """Median 95 % interval of samples by noise and the LEDs' power, without geometry. None without a record of
    the response, by which noise is known."""
    found = []
    for view in result.views:
        with h5py.File(view.path, "r") as file:
            step = max(1, len(view.triangles) // 2000)
            own = file["u_own"][::step]
            whole = np.sqrt(own**2 + file["led_u_own"][()] ** 2 + file["led_u_shared"][()] ** 2)
            found.append(whole[np.isfinite(own)])
    known = np.concatenate(found)
    if not len(known):
        return None
    half = 100.0 * _NORMAL_QUANTILE * float(np.median(known))
    return {"coverage": COVERAGE, "low": -half, "high": half}


def _median(values: NDArray[np.float64]) -> float | None:
    return float(np.median(values)) if len(values) else None


def _about(
    result: RunResult,
    settings: dict[str, Any],
    views: Sequence[dict[str, Any]],
    checks: dict[str, _Check],
    measured_runs: Sequence[MeasuredRun],
    seconds: float,
) -> dict[str, Any]:
    peak_bytes = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * (1 if sys.platform == "darwin" else 1024)
    left = {name: result.materials(name).residual for name in FITS}
    residual = {name: _median(values[np.isfinite(values)]) for name, values in left.items()}
    return {
        "schema": SCHEMA,
        "software": {name: version(name) for name in ("coupole", "numpy", "numba", "h5py")},
        **settings,
        "simulated": any(m.run.simulated for m in measured_runs),
        "channels": "".join(measured_runs[0].channels),
        "views": list(views),
        "triangles": len(result.triangles),
        "not_fitted": int(np.count_nonzero(~np.isfinite(result.materials("ggx").alpha))),
        "samples": sum(view["samples"] for view in views),
        "residual": residual,
        "mae": {name: check.mae for name, check in checks.items()},
        "held_out_psnr_db": {name: check.psnr_db for name, check in checks.items()},
        "median_interval_percent": _interval_percent(result),
        "seconds": round(seconds, 3),
        "peak_memory_bytes": peak_bytes,
    }
