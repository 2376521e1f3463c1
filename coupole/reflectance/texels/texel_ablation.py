"""Dependence of texels' materials on the number of LEDs and on grazing light.

Some patches of texels, spread over the views, are fitted again with fewer values. So are the triangles that they
see, because the fits of texels begin at the materials of triangles. Both are compared, in the same texels, under
LEDs that were left out of all fits.
"""

from __future__ import annotations

import json
import os
from collections.abc import Iterable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any
from uuid import uuid4

import numpy as np
from numpy.typing import NDArray

from coupole.reflectance.block_work import Said, silent
from coupole.reflectance.discarded_frames import refuse_texels
from coupole.reflectance.extraction.lamp_sight import lit_on
from coupole.reflectance.fits import GGX_NORMAL, TEXELS
from coupole.reflectance.model_bias import unbiased_normals
from coupole.reflectance.new_light.pictured_surface import surface_of_view
from coupole.reflectance.result_folder import read_settings
from coupole.reflectance.run_ablation import FEWER_SAMPLES, Variant, incidence_deg, leds_of, mean_errors
from coupole.reflectance.run_job import RunRequest, forget, prepare_run, read_runs, view_file_name
from coupole.reflectance.run_result import RunResult, ViewSamples
from coupole.reflectance.texels.pixel_file import size_of_texels, views_with_texels
from coupole.reflectance.texels.pixel_values import FittedView
from coupole.reflectance.texels.texel_grid import pixel_mm
from coupole.reflectance.texels.texel_job import open_result_of
from coupole.reflectance.texels.texel_patches import Patch, read_patches
from coupole.reflectance.texels.texel_size import TexelSize
from coupole.reflectance.texels.view_centres import FitStart, centres_of, lights_of
from coupole.reflectance.triangle_fit import (
    TriangleMaterials,
    TriangleSamples,
    join_materials,
    model_values,
    recolour_materials,
)
from coupole.storage.disk_errors import disk_error
from coupole.storage.durable import write_synced
from coupole.storage.run import Run

TEXEL_ABLATION = "texel_ablation.json"
_PATCHES = 8
"""Number of patches in a result, at least one for each view."""
Floats = NDArray[np.float64]


@dataclass(frozen=True)
class _View:
    """A view's patches, and what their texels and triangles have in common."""

    samples: ViewSamples
    side_px: int
    mesh_normals: Floats
    """[triangles of the view, 3]"""
    patches: list[Patch]


@dataclass(frozen=True)
class _Triangles:
    """Fits of some triangles to the samples of a variant."""

    places: NDArray[np.int64]
    """[n] places in the result's `triangles`, in rising order."""
    materials: TriangleMaterials
    covariance: Floats
    """[n, 5, 5]"""


def ablate_texels(request: RunRequest, out: Path, *, say: Said = silent) -> dict[str, Any]:
    """Return, for each setting, the mean absolute errors of texels and of their triangles as shares of the
    camera's range, and write them to the result. The frames of the runs are read again.

    Raises InputError for a result without texels or of another request, FrameDiscarded without the frames, and
    StorageError if a frame is damaged or the disk cannot be written.
    """
    token = uuid4().hex
    for run in request.runs:
        refuse_texels(Run(run), out)
    try:
        result = open_result_of(request, token, out)
        settings = read_settings(out)
        views = _read_views(request, token, result, say)
        places = np.unique(np.concatenate([_places(result, view, patch) for view, patch in _all_patches(views)]))
        variants = {variant for steps in FEWER_SAMPLES.values() for _, variant in steps}
        errors: dict[Variant, dict[str, list[Floats]]] = {}
        known_counts: dict[Variant, int] = {}
        for number, variant in enumerate(sorted(variants, key=str), start=1):
            triangles = _fit_triangles(result, places, variant, settings, request.memory_bytes)
            parts = [
                _errors(result, view, patch, triangles, variant, settings) for view, patch in _all_patches(views)
            ]
            errors[variant] = {name: [of_fits[name] for of_fits, _ in parts] for name in (TEXELS, GGX_NORMAL.name)}
            known_counts[variant] = sum(count for _, count in parts)
            say("ablate texels", number, len(variants))
        report = _report(views, errors, known_counts)
        write_synced(out / TEXEL_ABLATION, json.dumps(report, indent=1) + "\n")
    except OSError as error:
        raise disk_error(out, error) from error
    finally:
        forget()
    return report


def _report(
    views: list[_View], errors: dict[Variant, dict[str, list[Floats]]], known_counts: dict[Variant, int]
) -> dict[str, Any]:
    counts = {
        view.samples.view: int(sum(np.count_nonzero(patch.is_inner) for patch in view.patches)) for view in views
    }
    total = max(1, sum(counts.values()))
    return {
        "texels": counts,
        "side_px": {view.samples.view: view.side_px for view in views},
        "mae": mean_errors(FEWER_SAMPLES, errors),
        "share_with_material": {
            setting: [[value, known_counts[variant] / total] for value, variant in steps]
            for setting, steps in FEWER_SAMPLES.items()
        },
    }


def _all_patches(views: list[_View]) -> Iterable[tuple[_View, Patch]]:
    return ((view, patch) for view in views for patch in view.patches)


def _places(result: RunResult, view: _View, patch: Patch) -> NDArray[np.int64]:
    """Return the places, in the result's `triangles`, of the triangles that a patch sees."""
    rows = np.unique(patch.triangle[patch.triangle >= 0])
    return np.searchsorted(result.triangles, view.samples.triangles[rows])


def _read_views(request: RunRequest, token: str, result: RunResult, say: Said) -> list[_View]:
    """Read the patches of all views, from the frames of the runs."""
    with_texels = {samples.path.stem: samples for samples in views_with_texels(result)}
    size, views = size_of_texels(result.folder) or TexelSize(), []
    measured_runs = read_runs(request, token)
    for run in request.runs:
        measured_run, geometry, radiometry = prepare_run(token, run.resolve(), request.sources)
        for view in measured_run.views:
            samples = with_texels.get(view_file_name(measured_runs, measured_run, view))
            if samples is None:
                continue
            surface = surface_of_view(result, samples)
            side_px = size.side_px(pixel_mm(surface))
            fitted_view = FittedView(measured_run, geometry, radiometry, view, surface, samples)
            count = -(-_PATCHES // len(with_texels))
            patches = read_patches(fitted_view, side_px, count, len(os.sched_getaffinity(0)))
            views.append(_View(samples, side_px, surface.normals, patches))
            say("read frames", len(views), len(with_texels))
    return views


def _fit_triangles(
    result: RunResult, places: NDArray[np.int64], variant: Variant, settings: dict[str, Any], memory_bytes: int
) -> _Triangles:
    """Fit some triangles again, as the result's fits were made, to the samples of a variant."""
    noise_um, parts, covariances = settings["scan_noise_um"], [], []
    for block in result.blocks(memory_bytes):
        some = places[(places >= block.start) & (places < block.stop)] - block.start
        if not len(some):
            continue
        samples = _reduced_samples(result.samples(block).of_triangles(some), variant)
        leds = result.along_samples(block, "leds")
        sample_mask = np.isin(leds, leds_of(variant, leds, settings["left_out"]))
        materials = GGX_NORMAL.fit(samples, sample_mask, noise_um, None)
        mesh = samples.normals, samples.centres_mm, samples.areas_mm2
        normals = unbiased_normals(materials, *mesh, noise_um)
        materials = recolour_materials(samples, sample_mask, materials, normals)
        uncertainty = GGX_NORMAL.uncertainty(samples, sample_mask, materials, noise_um, result.middle_mm, None)
        parts.append(materials)
        covariances.append(uncertainty.covariance)
    return _Triangles(places, join_materials(parts), np.concatenate(covariances))


def _reduced_samples(samples: TriangleSamples, variant: Variant) -> TriangleSamples:
    """Return the samples without those of light that is too grazing for a variant."""
    angles_deg = incidence_deg(samples.centres_mm, samples.normals, samples.led_mm)
    values = np.where(angles_deg[..., None] <= variant.most_incidence_deg, samples.values, np.float32(np.nan))
    return replace(samples, values=values)


def _errors(
    result: RunResult,
    view: _View,
    patch: Patch,
    triangles: _Triangles,
    variant: Variant,
    settings: dict[str, Any],
) -> tuple[dict[str, Floats], int]:
    """Return the errors of a patch's inner texels, and of their triangles, under the LEDs that were left out, in
    the texels where both have a value; and the number of inner texels with a material."""
    samples, left_out = view.samples, settings["left_out"]
    rows, number = np.unique(patch.triangle[patch.triangle >= 0], return_inverse=True)
    triangle = np.full_like(patch.triangle, -1)
    triangle[patch.triangle >= 0] = number
    at = np.searchsorted(triangles.places, np.searchsorted(result.triangles, samples.triangles[rows]))
    of_triangles, mesh_normals = triangles.materials.at(at), view.mesh_normals[rows]
    unused_leds = np.setdiff1d(samples.leds, leds_of(variant, samples.leds, left_out)).tolist()
    start = FitStart(
        triangle,
        centres_of(of_triangles, triangles.covariance[at], triangle, mesh_normals),
        lights_of(result, samples, unused_leds),
        np.zeros((len(rows), 15), np.float32),  # the materials do not depend on it
    )
    texel_triangle = triangle.reshape(-1)[patch.places].astype(np.int64)
    angles_deg = incidence_deg(patch.places_mm, mesh_normals[texel_triangle], samples.led_mm)
    is_used = angles_deg <= variant.most_incidence_deg
    inner = np.flatnonzero(patch.is_inner)
    materials = patch.fit(start, is_used, len(os.sched_getaffinity(0))).at(inner)
    fits = {TEXELS: materials, GGX_NORMAL.name: of_triangles.at(texel_triangle[inner])}
    is_paper = settings["emission"] == "paper"
    of_fits = _off(samples, patch, inner, fits, np.isin(samples.leds, left_out), is_paper=is_paper)
    return of_fits, int(np.count_nonzero(np.isfinite(materials.alpha)))


def _off(
    samples: ViewSamples,
    patch: Patch,
    inner: NDArray[np.int64],
    fits: dict[str, TriangleMaterials],
    held_out: NDArray[np.bool_],
    *,
    is_paper: bool,
) -> dict[str, Floats]:
    """Return the errors of fits at some texels under the LEDs `held_out` [leds], as shares of the camera's
    range."""
    led_mm, places_mm = samples.led_mm[held_out], patch.places_mm[inner].astype(np.float64)
    measured_values = patch.values[inner][:, :, held_out].swapaxes(1, 2).astype(np.float32, order="C")
    at_texels = TriangleSamples(
        measured_values,
        led_mm,
        np.zeros(len(led_mm), np.int64),
        samples.camera_mm[None],
        places_mm,
        np.zeros_like(places_mm),
        np.zeros(len(inner)),
    )
    lit = lit_on(places_mm, led_mm, samples.led_normals[held_out], is_paper)
    share = lit[..., None] * samples.full_scales[held_out]
    off = {name: (model_values(at_texels, of_fit) - measured_values) * share for name, of_fit in fits.items()}
    is_known = np.logical_and.reduce([np.isfinite(of_fit) for of_fit in off.values()])
    return {name: of_fit[is_known] for name, of_fit in off.items()}
