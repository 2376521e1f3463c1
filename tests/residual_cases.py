"""Results of runs whose material no GGX has, with the project's own fits of it."""

from __future__ import annotations

import json
from pathlib import Path

import h5py
import numpy as np
from relight_cases import BASE_FROM_SUPPORT, moved, unit, write_result, write_sources

from coupole.reflectance.fits import SLICES
from coupole.reflectance.material_uncertainty import MaterialUncertainty
from coupole.reflectance.new_light.pictured_surface import surface_of_view
from coupole.reflectance.run_result import RunResult
from coupole.reflectance.run_result_files import begin_slices, write_materials
from coupole.reflectance.slice_fit import fit_slices
from coupole.reflectance.triangle_fit import fit_triangles, model_values

KD = np.array([0.1, 0.07, 0.04])
SIDE = np.array([0.6, -0.8, 0.0])
LEDS, LEFT_OUT = 130, 13
FULL_SCALE = np.array([0.8, 0.5, 0.3])


def backscatter(normals: np.ndarray, lights: np.ndarray, views: np.ndarray) -> np.ndarray:
    """[..., 3] f cos_i of a surface that sends light back to where it comes from, as dust and plaster do, and
    more of it on one side than on the other, so that no plane of symmetry hides a mirrored frame."""
    cosine = np.maximum(np.sum(normals * lights, axis=-1), 0.0)
    back = np.maximum(np.sum(lights * views, axis=-1), 0.0) ** 6
    made: np.ndarray = (cosine * (0.5 + 1.2 * back) * (1.0 + 0.4 * lights @ SIDE))[..., None] * KD
    return made


def write_backscatter(folder: Path, corners_mm: np.ndarray) -> RunResult:
    """A result with one view, `top`, samples under `LEDS` LEDs, and the fits `ggx_normal` and `ggx_rbf`, which
    have not seen every `LEFT_OUT`th of these."""
    result = write_result(folder, corners_mm)
    number = np.arange(LEDS) + 0.5
    z, azimuth = 1.0 - 0.85 * number / LEDS, number * np.pi * (3.0 - 5.0**0.5)
    ways = np.stack([np.sqrt(1 - z * z) * np.cos(azimuth), np.sqrt(1 - z * z) * np.sin(azimuth), z], axis=1)
    led_mm = moved(BASE_FROM_SUPPORT, 450.0 * ways)
    with h5py.File(result.views[0].path, "a") as file:
        for name in ("leds", "led_positions_mm", "led_normals", "full_scales", "f"):
            del file[name]
        file["leds"], file["led_positions_mm"] = np.arange(LEDS), led_mm
        file["led_normals"] = unit(moved(BASE_FROM_SUPPORT, np.zeros(3)) - led_mm)
        file["full_scales"] = np.tile(FULL_SCALE, (LEDS, 1))
        lights = unit(led_mm - file["centres_mm"][()][:, None])
        views = unit(file["camera_mm"][()] - file["centres_mm"][()])[:, None]
        normals = file["normals"][()][:, None]
        cosine = np.sum(normals * lights, axis=-1, keepdims=True)
        f = backscatter(normals, lights, views) / np.maximum(cosine, 1e-6)
        noisy = f * np.random.default_rng(1).normal(1.0, 0.01, f.shape)
        file["f"] = np.where(cosine > 0.05, noisy, np.nan).astype(np.float32)
        write_sources(file, {"u_own": 0.01})
    result = RunResult(folder)
    (view,) = result.views
    samples, used = result.view_samples(view, slice(None)), np.arange(LEDS) % LEFT_OUT != 0
    material = fit_triangles(samples, used, 30.0)
    count = len(view.triangles)
    certain = MaterialUncertainty(np.zeros((count, 5, 5)), *np.zeros((2, *material.kd.shape)))
    write_materials(folder / "fits/ggx_normal.h5", [material], [certain], np.zeros(count), 0.0, view.triangles)
    (found,) = fit_slices(samples, used, (SLICES["ggx_rbf"].basis, model_values(samples, material)))
    (folder / "fits/ggx_rbf").mkdir()
    with h5py.File(result.slices_path("ggx_rbf", view), "w") as file:
        begin_slices(file, SLICES["ggx_rbf"], view, result.channels)[...] = found
    about = json.loads((folder / "result.json").read_text())
    about["mae"] = {"ggx": 0.2, "ggx_normal": 0.3, "ggx_rbf": 0.1}
    (folder / "result.json").write_text(json.dumps(about))
    return RunResult(folder)


def true_frame(result: RunResult, led: int) -> np.ndarray:
    """[h, w, 3] what the camera would see, in shares of its range, without shadows; NaN beside the object."""
    (view,) = result.views
    surface = surface_of_view(result, view)
    triangle = np.maximum(surface.triangle_of_pixel, 0)
    apart = view.led_mm[led] - surface.places_mm.astype(np.float64)
    distance = np.linalg.norm(apart, axis=-1, keepdims=True)
    ways = apart / distance
    value = backscatter(surface.normals[triangle], ways, unit(surface.camera_mm - surface.places_mm))
    reach = -np.sum(ways * view.led_normals[led], axis=-1, keepdims=True) / (np.pi * (distance * 1e-3) ** 2)
    frame = value * reach * view.full_scales[led]
    return np.where((surface.triangle_of_pixel >= 0)[..., None], frame, np.nan)
