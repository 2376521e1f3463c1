"""Job from pictures under known lights to a result folder with normals, materials and the data for relighting.

Each step leaves either one complete file or no file; a job that was killed continues with the first missing file.
"""

from __future__ import annotations

import hashlib
import json
import resource
import sys
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from importlib.metadata import version
from pathlib import Path
from typing import Any

import h5py
import numpy as np
from numpy.typing import NDArray

from coupole.errors import InputError
from coupole.reflectance import normal_cones, relit_intervals
from coupole.reflectance.light_gains import SUSPECT, gains
from coupole.reflectance.normal_fit import PointMaterials, colours, fit_materials
from coupole.reflectance.picture_result import (
    ABOUT,
    AXES,
    CONES,
    INTERPOLATION,
    INTERVALS,
    MATERIALS,
    NORMALS,
    SAMPLES,
    SCHEMA,
    PictureResult,
    open_result_file,
)
from coupole.reflectance.picture_set import FEWEST_LIGHTS, PictureSet
from coupole.reflectance.relighting import Interpolation, learn, read_interpolation, relit
from coupole.reflectance.result_folder import begin, complete
from coupole.storage.disk_errors import disk_error
from coupole.storage.durable import sha256
from coupole.storage.hdf5_file import hdf5_file

VIEW = np.array([0.0, 0.0, 1.0])
BLOCK = 20_000
"""Number of pixels that are fitted at a time."""
PEAK_QUANTILE, _PEAK_PIXELS = 0.999, 100_000
_GAIN_PIXELS = 20_000
_FIRST = "fits/first.h5"
"""File of the materials fitted with all pictures, before suspect pictures are known."""
Said = Callable[[str, int, int], None]
"""Function that takes a step, the number of its parts that are done, and their total number."""


@dataclass(frozen=True)
class Checked:
    """Errors of the predicted picture of a left-out light."""

    light: int
    psnr_db: float
    mae: float
    """Mean absolute error."""


def fit_pictures(
    pictures: PictureSet, out: Path, *, left_out: Sequence[int] = (), say: Said = lambda step, done, of: None
) -> dict[str, Any]:
    """Make the result, or its missing parts, and return the content of `result.json`.

    Raises InputError if too few lights are left, or if the folder holds the result of other pictures or settings,
    and StorageError if the disk cannot be written.
    """
    try:
        return _fit_pictures(pictures, out, left_out, say)
    except OSError as error:
        raise disk_error(out, error) from error


def _fit_pictures(pictures: PictureSet, out: Path, left_out: Sequence[int], say: Said) -> dict[str, Any]:
    begun_s = time.monotonic()
    lights = np.setdiff1d(np.arange(len(pictures)), np.asarray(left_out, dtype=int))
    if wrong := sorted(set(left_out) - set(range(len(pictures)))):
        raise InputError(f"--leave-out: there is no light {wrong[0]}; lights are 0 to {len(pictures) - 1}")
    if len(lights) < FEWEST_LIGHTS:
        raise InputError(f"--leave-out: {len(lights)} lights are left; at least {FEWEST_LIGHTS} are needed")
    result = PictureResult(out)
    settings: dict[str, Any] = {"left_out": sorted(set(left_out)), "inputs": _inputs(pictures)}
    if pictures.uncalibrated_run:
        settings["uncalibrated_run"] = pictures.uncalibrated_run
    begin(out, settings)
    if not (out / SAMPLES).exists():
        _store(pictures, out / SAMPLES, say)
    if not (out / MATERIALS).exists():
        _fit_twice(result, lights, say)
    materials = read_materials(out / MATERIALS)
    np.save(out / NORMALS, result.picture(materials.normals.astype(np.float32), np.nan))
    if not (out / INTERPOLATION).exists():
        interpolation = learn(
            result, lights, _gains(result, lights, materials), say=lambda done, of: say("relighting", done, of)
        )
        complete(out / INTERPOLATION, interpolation.write)
    interpolation = read_interpolation(out)
    if not (out / CONES).exists():
        _write_cones(result, materials, say)
    if not (out / INTERVALS).exists() and len(lights) >= relit_intervals.FEWEST_LIGHTS:
        intervals = relit_intervals.calibrate(
            result, interpolation, say=lambda count, of: say("intervals", count, of)
        )
        complete(out / INTERVALS, intervals.write)
    peak = peak_of(result)
    checks = [check(result, interpolation, light, peak) for light in settings["left_out"]]
    about_settings = {**settings, "simulated": pictures.simulated}
    about = _about(result, about_settings, interpolation, materials, checks, time.monotonic() - begun_s)
    complete(out / ABOUT, lambda path: path.write_text(json.dumps(about, indent=1) + "\n", encoding="utf-8"))
    return about


def _inputs(pictures: PictureSet) -> dict[str, Any]:
    return {
        "pictures": {path.name: sha256(path) for path in pictures.files},
        "directions": pictures.directions.round(9).tolist(),
        "intensities": pictures.intensities.tolist(),
        "mask": hashlib.sha256(np.packbits(pictures.mask).tobytes()).hexdigest(),
        **({"encoding": "sRGB"} if pictures.srgb else {}),
    }


def _store(pictures: PictureSet, path: Path, say: Said) -> None:
    def write(part: Path) -> None:
        with hdf5_file(part, "w") as file:
            file.attrs.update(full_scale=pictures.full_scale, axes=AXES)
            file["mask"], file["directions"] = pictures.mask, pictures.directions
            file["intensities"] = pictures.intensities
            file["names"] = [path.name for path in pictures.files]
            values = file.create_dataset("values", (len(pictures), pictures.pixels, 3), pictures.dtype)
            values.attrs["shape"] = "lights, pixels of the mask in the order of rows, rgb; linear"
            for number in range(len(pictures)):
                say("reading", number, len(pictures))
                values[number] = pictures.raw_values(number)

    complete(path, write)


_FIELDS = {"normal": 3, "kd": 3, "ks": 3, "alpha": 1, "residual": 1, "grey_kd": 1, "grey_ks": 1}


def _fit_twice(result: PictureResult, lights: NDArray[np.int64], say: Said) -> None:
    """Fit with all lights. If there are suspect pictures, fit again without them."""
    first, last = result.folder / _FIRST, result.folder / MATERIALS
    if not first.exists():
        _fit(result, lights, first, "normals and materials", say)
    sound = lights[np.abs(_gains(result, lights, read_materials(first)) - 1.0) <= SUSPECT]
    if FEWEST_LIGHTS <= len(sound) < len(lights):
        _fit(result, sound, last, "again without suspect pictures", say)
        first.unlink()
    else:
        first.replace(last)


def _fit(result: PictureResult, lights: NDArray[np.int64], path: Path, step: str, say: Said) -> None:
    """Fit block by block; blocks that an earlier job fitted are kept."""
    begun = path.with_suffix(".begun")  # no `.part`, which the next job would remove
    if begun.exists() and not _can_go_on(begun):
        begun.unlink()
    pixels = int(np.count_nonzero(result.mask))
    directions = result.directions[lights]
    with hdf5_file(begun, "r+" if begun.exists() else "w") as file:
        for name, width in _FIELDS.items():
            file.require_dataset(name, (pixels, width)[: 1 + (width > 1)], np.float32, fillvalue=np.nan)
        file["normal"].attrs["axes"], file.attrs["lights"] = AXES, lights
        for begin in range(int(file.attrs.get("fitted", 0)), pixels, BLOCK):
            block = slice(begin, min(begin + BLOCK, pixels))
            say(step, begin, pixels)
            values = result.values(lights, block).transpose(1, 0, 2).astype(np.float64)
            materials = fit_materials(values.mean(axis=2), directions, VIEW)
            kd, ks = colours(values, materials, directions, VIEW)
            contents = (materials.normals, kd, ks, materials.alpha, materials.residual, materials.kd, materials.ks)
            for name, content in zip(_FIELDS, contents, strict=True):
                file[name][block] = content
            file.sync()  # the block is on the disk before it counts as fitted
            file.attrs["fitted"] = block.stop
            file.flush()
    begun.replace(path)


def _can_go_on(begun: Path) -> bool:
    """Tell whether the file of a killed fit can be read. It cannot if not even its first block is on the disk."""
    try:
        with h5py.File(begun, "r") as file:
            return "fitted" in file.attrs
    except OSError:
        return False


def read_materials(path: Path) -> PointMaterials:
    """Read the materials of the grey values, [pixels] of the mask."""
    with open_result_file(path) as file:
        names = ("normal", "grey_kd", "grey_ks", "alpha", "residual")
        return PointMaterials(*(np.asarray(file[name], dtype=np.float64) for name in names))


def _write_cones(result: PictureResult, materials: PointMaterials, say: Said) -> None:
    """Write the half angles of the normals' 95 % cones; NaN under too few lights."""
    with open_result_file(result.folder / MATERIALS) as file:
        lights = np.asarray(file.attrs["lights"])
    cones_deg = np.full(len(materials.kd), np.nan)
    if len(lights) >= normal_cones.FEWEST_LIGHTS:
        spreads = []
        for begin in range(0, len(cones_deg), BLOCK):
            block = slice(begin, min(begin + BLOCK, len(cones_deg)))
            say("cones of normals", begin, len(cones_deg))
            grey = result.values(lights, block).mean(axis=2).T.astype(np.float64)
            spreads.append(normal_cones.spreads_deg(grey, materials.at(block), result.directions[lights], VIEW))
        fit_deg, jackknife_deg = (np.concatenate(parts) for parts in zip(*spreads, strict=True))
        cones_deg = normal_cones.cones_deg(fit_deg, jackknife_deg)
    picture = result.picture(cones_deg.astype(np.float32), np.nan)

    def write(path: Path) -> None:
        with path.open("wb") as file:
            np.save(file, picture)

    complete(result.folder / CONES, write)


def _gains(result: PictureResult, lights: NDArray[np.int64], materials: PointMaterials) -> NDArray[np.float64]:
    some = slice(None, None, 1 + len(materials.kd) // _GAIN_PIXELS)
    grey = result.values(lights, some).mean(axis=2).T.astype(np.float64)
    return gains(grey, materials.at(some), result.directions[lights], VIEW)


def peak_of(result: PictureResult) -> float:
    """Return the 99.9 % quantile of all pictures."""
    some = slice(None, None, 1 + int(np.count_nonzero(result.mask)) // _PEAK_PIXELS)
    return float(np.quantile(result.values(np.arange(len(result.directions)), some), PEAK_QUANTILE))


def check(result: PictureResult, interpolation: Interpolation, light: int, peak: float) -> Checked:
    """Predict one left-out light and compare it with its picture, inside the mask."""
    relit_picture = relit(result, interpolation, result.directions[light])
    measured_values = result.values(np.array([light]))[0]
    off = (relit_picture[result.mask] - measured_values).astype(np.float64)
    psnr_db = 10.0 * np.log10(peak**2 / max(float(np.mean(off**2)), 1e-30))
    return Checked(light, psnr_db, float(np.mean(np.abs(off))))


def pooled_psnr_db(light_checks: Sequence[Checked]) -> float | None:
    """Return the PSNR of all left-out lights together; None without any."""
    if not light_checks:
        return None
    return float(
        -10.0 * np.log10(np.mean([10.0 ** (-light_check.psnr_db / 10.0) for light_check in light_checks]))
    )


def _about(
    result: PictureResult,
    settings: dict[str, Any],
    interpolation: Interpolation,
    materials: PointMaterials,
    light_checks: Sequence[Checked],
    seconds: float,
) -> dict[str, Any]:
    with open_result_file(result.folder / SAMPLES) as file:
        names = [name.decode() for name in file["names"][:]]
    gains_of_lights = zip(interpolation.lights.tolist(), interpolation.gains.tolist(), strict=True)
    suspects = {names[light]: round(gain, 3) for light, gain in gains_of_lights if abs(gain - 1.0) > SUSPECT}
    peak_bytes = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * (1 if sys.platform == "darwin" else 1024)
    return {
        "schema": SCHEMA,
        "software": {name: version(name) for name in ("coupole", "numpy", "numba", "h5py")},
        **settings,
        "axes": AXES,
        "lights": len(names),
        "pixels": int(np.count_nonzero(result.mask)),
        "not_fitted": int(np.count_nonzero(~np.isfinite(materials.kd))),
        "residual": float(np.nanmedian(materials.residual)),
        "kernel": interpolation.kernel,
        "left_out_rms": interpolation.left_out_rms,
        "suspect_pictures": suspects,
        "held_out": [
            {"light": light_check.light, "psnr_db": round(light_check.psnr_db, 3), "mae": light_check.mae}
            for light_check in light_checks
        ],
        "held_out_psnr_db": pooled_psnr_db(light_checks),
        "seconds": round(seconds, 3),
        "peak_memory_bytes": peak_bytes,
    }
