"""What the fits of runs miss under LEDs that they have not seen, and what `result.json` says."""

from __future__ import annotations

import json
import resource
import sys
import time
from collections.abc import Callable
from dataclasses import dataclass, field
from importlib.metadata import version
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from coupole.reflectance.extraction.lamp_sight import lit_on
from coupole.reflectance.result_folder import read_settings
from coupole.reflectance.run_fits import predicted
from coupole.reflectance.run_result import ABOUT, FITS, MATERIALS, SCHEMA, RunResult, ViewSamples
from coupole.reflectance.run_uncertainty import uncertainty_of
from coupole.storage.disk_errors import disk_error
from coupole.storage.durable import write_synced

Said = Callable[[str, int, int], None]
PEAK_QUANTILE = 0.999


@dataclass
class _Check:
    """Grows block by block: held-out samples of one fit."""

    absolute: float = 0.0
    square: float = 0.0
    count: int = 0
    measured: list[NDArray[np.float32]] = field(default_factory=list)

    def add(self, made: NDArray[np.float64], measured: NDArray[np.float64]) -> None:
        off = made - measured
        self.absolute += float(np.abs(off).sum())
        self.square += float(np.sum(off**2))
        self.count += off.size
        self.measured.append(measured[::16].astype(np.float32))

    @property
    def mae(self) -> float | None:
        return self.absolute / self.count if self.count else None

    @property
    def psnr_db(self) -> float | None:
        if not self.count:
            return None
        peak = float(np.quantile(np.concatenate(self.measured), PEAK_QUANTILE))
        return float(10 * np.log10(peak**2 / max(self.square / self.count, 1e-30)))


def check_result(
    out: Path,
    memory_bytes: int,
    *,
    begun_s: float | None = None,
    say: Said = lambda step, done, of: None,
) -> dict[str, Any]:
    """Compare the fits with the samples under the LEDs that were left out; write and return `result.json`.

    Raises InputError if samples or fits are not all there, StorageError if the disk takes nothing.
    """
    begun_s = time.monotonic() if begun_s is None else begun_s
    settings = read_settings(out)
    result = RunResult(out)
    result.refuse_unfinished(settings["view_names"], fits=True)
    checks: dict[str, _Check] = {name: _Check() for name in FITS}
    for view in result.views:
        _check_view(result, view, settings, memory_bytes, checks, say)
    paper = settings["emission"] == "paper"
    uncertainty = uncertainty_of(result, settings["scan_noise_um"], paper=paper, say=say)
    about = _about(result, settings, checks, uncertainty, time.monotonic() - begun_s)
    try:
        write_synced(out / ABOUT, json.dumps(about, indent=1) + "\n")
    except OSError as error:
        raise disk_error(out, error) from error
    return about


def _check_view(
    result: RunResult,
    view: ViewSamples,
    settings: dict[str, Any],
    memory_bytes: int,
    checks: dict[str, _Check],
    say: Said,
) -> None:
    """Samples of a view, in shares of the camera's range, where every fit has something: all fits are compared
    by the same ones."""
    held = np.isin(view.leds, settings["left_out"])
    for rows in result.view_blocks(view, memory_bytes):
        some = result.view_samples(view, rows, held)
        lit = lit_on(some.centres_mm, some.led_mm, view.led_normals[held], settings["emission"] == "paper")
        share = lit[..., None] * view.full_scales[held]
        made = {name: predicted(result, name, view, rows, some) for name in checks}
        known = np.isfinite(some.values)
        for values in made.values():
            known &= np.isfinite(values)
        for name, check in checks.items():
            check.add((made[name] * share)[known], (some.values * share)[known])
        say(f"check of {view.view}", rows.stop, len(view.triangles))


def _interval_percent(uncertainty: dict[str, Any] | None) -> dict[str, float] | None:
    """Of the median sample; None if it is not known, or all are open."""
    if uncertainty is None or uncertainty["interval"]["median"] is None:
        return None
    low, high = uncertainty["interval"]["median"]
    return {"coverage": uncertainty["interval"]["coverage"], "low": low, "high": high}


def _median(values: NDArray[np.float64]) -> float | None:
    return float(np.median(values)) if len(values) else None


def _about(
    result: RunResult,
    settings: dict[str, Any],
    checks: dict[str, _Check],
    uncertainty: dict[str, Any] | None,
    seconds: float,
) -> dict[str, Any]:
    peak_bytes = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * (1 if sys.platform == "darwin" else 1024)
    left = {name: result.materials(name).residual for name in MATERIALS}
    views = result.summaries
    return {
        "schema": SCHEMA,
        "software": {name: version(name) for name in ("coupole", "numpy", "numba", "h5py")},
        **settings,
        "views": views,
        "triangles": len(result.triangles),
        "not_fitted": int(np.count_nonzero(~np.isfinite(result.materials("ggx").alpha))),
        "samples": sum(view["samples"] for view in views),
        "residual": {name: _median(values[np.isfinite(values)]) for name, values in left.items()},
        "mae": {name: check.mae for name, check in checks.items()},
        "held_out_psnr_db": {name: check.psnr_db for name, check in checks.items()},
        "median_interval_percent": _interval_percent(uncertainty),
        "uncertainty_percent": uncertainty,
        "seconds": round(seconds, 3),
        "peak_memory_bytes": peak_bytes,
    }
