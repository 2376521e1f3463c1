"""Makes the fits of a result of runs, one file for each, and predicts samples from them."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from contextlib import ExitStack
from dataclasses import dataclass, replace
from functools import lru_cache, partial
from itertools import groupby
from pathlib import Path
from uuid import uuid4

import numpy as np
from numpy.typing import NDArray

from coupole.reflectance.block_work import Said, Workshop, silent, workshop
from coupole.reflectance.contradictions import Found, find, leave_out
from coupole.reflectance.fits import (
    CLUSTERED,
    FITS,
    GGX_NORMAL,
    MATERIALS,
    MaterialFit,
    ViewFit,
    fitted_together,
)
from coupole.reflectance.material_uncertainty import MaterialUncertainty
from coupole.reflectance.model_bias import unbiased_normals
from coupole.reflectance.result_folder import SETTINGS, clear_remains, complete, in_the_making, read_settings
from coupole.reflectance.run_result import RunResult, ViewSamples
from coupole.reflectance.run_result_files import begin_slices, write_materials
from coupole.reflectance.slice_fit import fit_slices
from coupole.reflectance.triangle_fit import (
    TriangleMaterials,
    TriangleSamples,
    join_materials,
    model_values,
    recolour_materials,
)
from coupole.storage.disk_errors import disk_error
from coupole.storage.durable import make_folder
from coupole.storage.hdf5_file import hdf5_file

Floats = NDArray[np.float64]


@dataclass(frozen=True)
class _Job:
    """Data that all blocks of a job share."""

    folder: Path
    token: str
    """Token that identifies this job."""
    left_out: list[int]
    memory_bytes: int
    noise_um: float
    """Noise of the mesh's vertices."""


def fit_result(out: Path, memory_bytes: int, *, scheduler: str | None = None, say: Said = silent) -> None:
    """Make the missing fits of a result, in the workers of a `scheduler` if one is named. Between materials and
    slices, samples that contradict others are removed. Raises InputError if samples are missing, or for the
    scheduler as `workshop` does; StorageError."""
    settings = read_settings(out)
    result = RunResult(out.resolve())
    result.refuse_unfinished(settings)
    job = _Job(result.folder, uuid4().hex, settings["left_out"], memory_bytes, settings["scan_noise_um"])
    try:
        with workshop(scheduler) as shop:
            shop.refuse_blind(result.folder, SETTINGS)
            clear_remains(out)
            for fit in MATERIALS.values():
                if not result.materials_path(fit.name).exists():
                    _fit_materials(result, job, fit, shop, say)
            _leave_out(result, job, shop, say)
            _fit_slices(RunResult(result.folder), job, shop, say)
            shop.everywhere(_open_result.cache_clear)
    except OSError as error:
        raise disk_error(out, error) from error


def predict_samples(
    result: RunResult, name: str, view: ViewSamples, rows: slice, samples: TriangleSamples
) -> NDArray[np.float32]:
    """[b, samples, channels] f cos_i, 1/sr, of a fit for `samples` of rows of a view's file, under any lights. It
    is NaN where the fit has no value. If the residual of the material was not fitted, the result is the value of
    the material."""
    places = np.searchsorted(result.triangles, view.triangles[rows])
    if name == CLUSTERED:
        own_materials = result.materials(GGX_NORMAL.name, places)
        return model_values(samples, result.clusters.at(own_materials, samples.normals, places))
    fit = FITS[name]
    if isinstance(fit, MaterialFit):
        return fit.values(samples, result.materials(name, places))
    return fit.values(samples, result.slices(name, view, rows), _under(result, fit, view, rows, samples))


def _fit_materials(result: RunResult, job: _Job, material_fit: MaterialFit, shop: Workshop, say: Said) -> None:
    parts: list[TriangleMaterials] = []
    uncertain: list[MaterialUncertainty] = []
    blocks = list(result.blocks(job.memory_bytes, shop.most_rows(len(result.triangles))))
    fit = partial(_materials_block, job, material_fit, shop.threads)
    for block, materials_part in zip(blocks, shop.map(fit, blocks), strict=True):
        parts.append(materials_part)
        say(f"fit {material_fit.name}", block.stop, len(result.triangles))
    if material_fit.fits_normals:
        whole = join_materials(parts)
        normals = unbiased_normals(whole, *_mesh(result), job.noise_um)
        parts = [replace(part, normals=normals[block]) for part, block in zip(parts, blocks, strict=True)]
    tasks = list(zip(blocks, parts, strict=True))
    finish = partial(_uncertain_block, job, material_fit, shop.threads)
    for number, (block, (materials, uncertainty)) in enumerate(zip(blocks, shop.map(finish, tasks), strict=True)):
        parts[number] = materials
        uncertain.append(uncertainty)
        say(f"uncertainty of {material_fit.name}", block.stop, len(result.triangles))
    u_triangle = np.concatenate([result.u_triangles(block) for block in blocks])

    def write(path: Path) -> None:
        write_materials(path, parts, uncertain, u_triangle, result.u_shared, result.triangles)

    complete(result.materials_path(material_fit.name), write)


def _mesh(result: RunResult) -> tuple[Floats, Floats, Floats]:
    """Return normals [n, 3], centres [n, 3] and areas [n] of the triangles of the fits."""
    corners = result.corners_mm[result.triangles].astype(np.float64)
    across = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    twice = np.linalg.norm(across, axis=1)
    return across / np.maximum(twice, 1e-300)[:, None], corners.mean(axis=1), 0.5 * twice


def _materials_block(job: _Job, material_fit: MaterialFit, threads: int | None, block: slice) -> TriangleMaterials:
    result = _open_result(job.folder, job.token)
    sample_mask = ~np.isin(result.along_samples(block, "leds"), job.left_out)
    return material_fit.fit(result.samples(block), sample_mask, job.noise_um, threads)


def _uncertain_block(
    job: _Job, material_fit: MaterialFit, threads: int | None, task: tuple[slice, TriangleMaterials]
) -> tuple[TriangleMaterials, MaterialUncertainty]:
    """Return the materials of a block with their final normals: the fitted normals without their common tilt."""
    block, materials = task
    result = _open_result(job.folder, job.token)
    sample_mask = ~np.isin(result.along_samples(block, "leds"), job.left_out)
    samples = result.samples(block)
    if material_fit.fits_normals:
        materials = recolour_materials(samples, sample_mask, materials, materials.normals, threads=threads)
    return materials, material_fit.uncertainty(
        samples, sample_mask, materials, job.noise_um, result.middle_mm, threads
    )


def _leave_out(result: RunResult, job: _Job, shop: Workshop, say: Said) -> None:
    view_numbers = [number for number, view in enumerate(result.views) if view.contradicted_count is None]
    tasks = _blocks_of_views(result, view_numbers, job.memory_bytes // 4, shop)
    task_outcomes = zip(tasks, shop.map(partial(_contradictions_block, job, shop.threads), tasks), strict=True)
    for count, (number, blocks) in enumerate(groupby(task_outcomes, key=lambda one: one[0][0]), start=1):
        leave_out(result.views[number], (contradictions for _, contradictions in blocks))
        say("contradictions", count, len(view_numbers))


def _contradictions_block(job: _Job, threads: int | None, task: tuple[int, slice]) -> Found:
    number, rows = task
    result = _open_result(job.folder, job.token)
    return find(result, result.views[number], rows, threads)


def _blocks_of_views(
    result: RunResult, numbers: Sequence[int], memory_bytes: int, shop: Workshop
) -> list[tuple[int, slice]]:
    """Return the number of the view, and rows of its file."""
    most = shop.most_rows(sum(len(result.views[number].triangles) for number in numbers))
    return [
        (number, rows)
        for number in numbers
        for rows in result.view_blocks(result.views[number], memory_bytes, most)
    ]


def _fit_slices(result: RunResult, job: _Job, shop: Workshop, say: Said) -> None:
    """Fit the slices of all views in one pass, so that no worker waits for the last block of a view."""
    tasks = []
    for together in fitted_together():
        view_numbers = [
            number
            for number, view in enumerate(result.views)
            if not all(result.slices_path(fit.name, view).exists() for fit in together)
        ]
        tasks += [(together, *block) for block in _blocks_of_views(result, view_numbers, job.memory_bytes, shop)]
    task_outcomes = zip(tasks, shop.map(partial(_slices_block, job, shop.threads), tasks), strict=True)
    for (together, number), blocks in groupby(task_outcomes, key=lambda one: one[0][:2]):
        rows_and_coefficients = ((rows, coefficients) for (_, _, rows), coefficients in blocks)
        _write_slices(result, together, result.views[number], rows_and_coefficients, say)


def _write_slices(
    result: RunResult,
    fits: Sequence[ViewFit],
    view: ViewSamples,
    of_fits: Iterable[tuple[slice, list[NDArray[np.float32]]]],
    say: Said,
) -> None:
    with ExitStack() as files:
        slice_files, coefficients = [], []
        for fit in fits:
            path = result.slices_path(fit.name, view)
            make_folder(path.parent)
            part = files.enter_context(in_the_making(path))
            slice_files.append(files.enter_context(hdf5_file(part, "w")))
            coefficients.append(begin_slices(slice_files[-1], fit, view, result.channels))
        for rows, of_rows in of_fits:
            for data, block_coefficients in zip(coefficients, of_rows, strict=True):
                data[rows] = block_coefficients
            for file in slice_files:
                file.raise_error()
            say(f"fit {', '.join(fit.name for fit in fits)} of {view.view}", rows.stop, len(view.triangles))


def _slices_block(
    job: _Job, threads: int | None, task: tuple[Sequence[ViewFit], int, slice]
) -> list[NDArray[np.float32]]:
    together, number, rows = task
    result = _open_result(job.folder, job.token)
    view = result.views[number]
    samples = result.view_samples(view, rows)
    fits = [(fit.basis, _under(result, fit, view, rows, samples)) for fit in together]
    return fit_slices(samples, ~np.isin(view.leds, job.left_out), *fits, threads=threads)


def _under(
    result: RunResult, fit: ViewFit, view: ViewSamples, rows: slice, samples: TriangleSamples
) -> NDArray[np.float32] | None:
    """Return the values of the material to which a fit is added; None for a fit without one."""
    return None if fit.over is None else predict_samples(result, fit.over.name, view, rows, samples)


@lru_cache(maxsize=1)
def _open_result(folder: Path, _token: str) -> RunResult:
    """Open a result as it is during one job, once in each process."""
    return RunResult(folder)
