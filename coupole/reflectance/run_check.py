"""Errors of the fits of runs under LEDs that were not fitted, and the content of `result.json`.

The fits are compared with pictures, in blocks of 2 x 2 pixels (Lucat et al. 2025, 6.3), and with the samples,
which are means over triangles and have less noise. Inter-reflection that was subtracted from the samples is
subtracted from the pictures too.
"""

from __future__ import annotations

import json
import os
import resource
import sys
import time
from collections.abc import Callable, Mapping
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field
from importlib.metadata import version
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from coupole.reflectance.fits import FITS, GGX, MATERIALS
from coupole.reflectance.material_uncertainty import relative_uncertainty
from coupole.reflectance.result_folder import read_settings
from coupole.reflectance.run_fits import predict_samples
from coupole.reflectance.run_intervals import WideningSamples
from coupole.reflectance.run_pictures import held_out, read_check_frames
from coupole.reflectance.run_result import ABOUT, SCHEMA, RunResult, ViewSamples
from coupole.reflectance.run_uncertainty import QUANTILE, uncertainty_of
from coupole.reflectance.triangle_fit import TriangleSamples
from coupole.storage.disk_errors import disk_error
from coupole.storage.durable import write_synced

Said = Callable[[str, int, int], None]
PEAK_QUANTILE = 0.999
_LEVELS, _LEVELS_OF_RANGE = 1 << 17, 1 << 16
"""Number of levels of a histogram of shares of the camera's range, up to twice the range; and number of levels in
the range itself."""


@dataclass
class _Missed:
    """Errors of one fit, summed over blocks."""

    absolute: float = 0.0
    square: float = 0.0
    count: int = 0

    def add(self, off: NDArray[np.floating]) -> None:
        self.absolute += float(np.abs(off).sum())
        self.square += float(np.sum(off**2))
        self.count += off.size

    @property
    def mae(self) -> float | None:
        return self.absolute / self.count if self.count else None

    def psnr_db(self, peak: float) -> float | None:
        return float(10 * np.log10(peak**2 / max(self.square / self.count, 1e-30))) if self.count else None


@dataclass
class _Check:
    """Errors of all fits."""

    pictures: dict[str, _Missed] = field(default_factory=lambda: {name: _Missed() for name in FITS})
    triangles: dict[str, _Missed] = field(default_factory=lambda: {name: _Missed() for name in FITS})
    noise: list[float] = field(default_factory=list)
    """Mean absolute error of each picture from noise."""
    levels: NDArray[np.int64] = field(default_factory=lambda: np.zeros(_LEVELS, np.int64))
    """Number of the pictures' values at each level."""
    inside: dict[str, list[int]] = field(default_factory=lambda: {name: [0, 0] for name in MATERIALS})
    """Number of triangles' samples that lie in the interval of the material's value, and number of all samples."""
    ratios: dict[str, WideningSamples] = field(
        default_factory=lambda: {name: WideningSamples() for name in MATERIALS}
    )
    """Errors of pictures, divided by their stated uncertainty."""

    @property
    def peak(self) -> float:
        """Peak of the pictures, which PSNR uses."""
        upper = np.searchsorted(np.cumsum(self.levels), PEAK_QUANTILE * self.levels.sum())
        return float(upper + 0.5) / _LEVELS_OF_RANGE


def check_result(
    out: Path,
    memory_bytes: int,
    *,
    begun_s: float | None = None,
    say: Said = lambda step, done, of: None,
) -> dict[str, Any]:
    """Compare the fits with the samples under the LEDs that were left out; write and return `result.json`.

    Raises InputError if samples or fits are missing, StorageError if the disk cannot be written.
    """
    begun_s = time.monotonic() if begun_s is None else begun_s
    settings = read_settings(out)
    result = RunResult(out)
    result.refuse_unfinished(settings, fits=True)
    check = _Check()
    for view in result.views:
        _check_view(result, view, settings, memory_bytes, check, say)
    paper = settings["emission"] == "paper"
    uncertainty = uncertainty_of(result, settings["scan_noise_um"], paper=paper, say=say)
    about = _about(result, settings, check, uncertainty, time.monotonic() - begun_s)
    try:
        write_synced(out / ABOUT, json.dumps(about, indent=1) + "\n")
    except OSError as error:
        raise disk_error(out, error) from error
    return about


def _check_view(
    result: RunResult, view: ViewSamples, settings: dict[str, Any], memory_bytes: int, check: _Check, say: Said
) -> None:
    """Compare all fits with pictures and samples of a view, in shares of the camera's range. Only places where
    every fit has a value are used, so that all fits are compared on the same data."""
    check.noise += list(read_check_frames(result, view).noise)
    for part in held_out(result, view, settings, memory_bytes):
        some = part.samples
        values_of_fits = _modelled_values(result, view, part.rows, some, part.share)
        common = np.hypot(result.u_triangles(slice(None))[part.places], result.u_shared)[:, None]
        _compare(values_of_fits, some.values * part.share, check.triangles)
        noise = result.view_noise(view, part.rows, np.isin(view.leds, settings["left_out"]))
        for name, inside in check.inside.items():
            covariance = result.material_covariances(name, part.places)
            materials = result.materials(name, part.places)
            relative = relative_uncertainty(some, materials, covariance)
            check.ratios[name].add(part, values_of_fits[name], np.hypot(relative, common), materials.residual)
            in_interval = _inside(values_of_fits[name] / part.share, relative, some.values, noise)
            inside[0] += int(np.count_nonzero(in_interval))
            inside[1] += in_interval.size
        for channel, (_, measured_values) in enumerate(part.blocks):
            pixels = {name: part.pixels(values, channel) for name, values in values_of_fits.items()}
            compared_values = _compare(pixels, measured_values, check.pictures)
            level = np.clip(compared_values * _LEVELS_OF_RANGE, 0, _LEVELS - 1).astype(np.int64)
            check.levels += np.bincount(level, minlength=_LEVELS)
        say(f"check of {view.view}", part.rows.stop, len(view.triangles))


def _modelled_values(
    result: RunResult, view: ViewSamples, rows: slice, samples: TriangleSamples, share: NDArray[np.float64]
) -> dict[str, NDArray[np.float64]]:
    """Return the predictions of all fits for some samples, in shares of the camera's range."""

    def of(name: str) -> NDArray[np.float64]:
        return predict_samples(result, name, view, rows, samples) * share

    with ThreadPoolExecutor(len(os.sched_getaffinity(0))) as pool:
        return dict(zip(FITS, pool.map(of, FITS), strict=True))


def _inside(
    modelled_values: NDArray[np.float64],
    relative: NDArray[np.float32],
    measured_values: NDArray[np.float32],
    noise: NDArray[np.float64],
) -> NDArray[np.bool_]:
    """Tell whether the channels' means of samples [n, leds, channels] lie in the interval of the model's values.
    The interval has the uncertainty of the model [n, leds] and of the samples. Only samples with all channels are
    used."""
    middle = modelled_values.mean(axis=2)
    variance = (relative * middle) ** 2 + np.sum((noise * measured_values) ** 2, axis=2) / measured_values.shape[
        2
    ] ** 2
    off = np.abs(measured_values.mean(axis=2) - middle)
    is_finite = np.isfinite(off) & np.isfinite(variance)
    in_interval: NDArray[np.bool_] = off[is_finite] < QUANTILE * np.sqrt(variance[is_finite])
    return in_interval


def _compare(
    values_of_fits: Mapping[str, NDArray[np.floating]],
    measured_values: NDArray[np.floating],
    misses: dict[str, _Missed],
) -> NDArray[np.floating]:
    """Add the errors of the fits where all have a value; return the measured values there."""
    is_finite = np.isfinite(measured_values)
    for values in values_of_fits.values():
        is_finite &= np.isfinite(values)
    for name, values in values_of_fits.items():
        misses[name].add(values[is_finite] - measured_values[is_finite])
    compared_values: NDArray[np.floating] = measured_values[is_finite]
    return compared_values


def _interval_percent(uncertainty: dict[str, Any] | None) -> dict[str, float] | None:
    """Return the interval of the median sample; None if it is not known, or if all intervals are open."""
    if uncertainty is None or uncertainty["interval"]["median"] is None:
        return None
    low, high = uncertainty["interval"]["median"]
    return {"coverage": uncertainty["interval"]["coverage"], "low": low, "high": high}


def _typical(result: RunResult, name: str) -> dict[str, float | None]:
    """Return the medians of standard uncertainties of a material. The uncertainties of kd and ks include two
    errors: the errors that all samples of a triangle share, and the errors that all triangles share. None for an
    unknown uncertainty.
    """
    variances = np.einsum("nii->ni", result.material_covariances(name)).copy()
    variances[:, 2:4] += (result.u_triangles(slice(None)) ** 2 + result.u_shared**2)[:, None]
    deviations = np.sqrt(variances)
    tilt = np.degrees(np.hypot(deviations[:, 0], deviations[:, 1]))
    columns = {"normal_deg": tilt} | {
        f"{key}_percent": 100 * deviations[:, 2 + n] for n, key in enumerate(("kd", "ks", "alpha"))
    }
    return {key: _median(values[np.isfinite(values)]) for key, values in columns.items()}


def _median(values: NDArray[np.float64]) -> float | None:
    return float(np.median(values)) if len(values) else None


def _about(
    result: RunResult,
    settings: dict[str, Any],
    check: _Check,
    uncertainty: dict[str, Any] | None,
    seconds: float,
) -> dict[str, Any]:
    peak_bytes = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * (1 if sys.platform == "darwin" else 1024)
    residuals = {name: result.materials(name).residual for name in MATERIALS}
    views = result.summaries
    return {
        "schema": SCHEMA,
        "software": {name: version(name) for name in ("coupole", "numpy", "numba", "h5py")},
        **settings,
        "views": views,
        "triangles": len(result.triangles),
        "not_fitted": int(np.count_nonzero(~np.isfinite(result.materials(GGX.name).alpha))),
        "samples": sum(view["samples"] for view in views),
        "residual": {name: _median(values[np.isfinite(values)]) for name, values in residuals.items()},
        "mae": {name: fit_errors.mae for name, fit_errors in check.pictures.items()},
        "held_out_psnr_db": {name: fit_errors.psnr_db(check.peak) for name, fit_errors in check.pictures.items()},
        "mae_of_triangles": {name: fit_errors.mae for name, fit_errors in check.triangles.items()},
        "held_out_inside": {name: n / of if of else None for name, (n, of) in check.inside.items()},
        "widening": {name: samples.widening() for name, samples in check.ratios.items()},
        "material_uncertainty": {name: _typical(result, name) for name in MATERIALS},
        "mae_of_noise": float(np.nanmean(check.noise)) if np.isfinite(check.noise).any() else None,
        "median_interval_percent": _interval_percent(uncertainty),
        "uncertainty_percent": uncertainty,
        "seconds": round(seconds, 3),
        "peak_memory_bytes": peak_bytes,
    }
