"""The fits of a result of runs, each a file of its own, and what they give in a direction."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from contextlib import ExitStack
from pathlib import Path
from typing import Any

import h5py
import numpy as np
from numpy.typing import NDArray

from coupole.reflectance.material_uncertainty import covariances
from coupole.reflectance.result_folder import complete, in_the_making, read_settings
from coupole.reflectance.run_result import MATERIALS, SLICES, RunResult, ViewSamples
from coupole.reflectance.run_result_files import begin_slices, write_materials
from coupole.reflectance.slice_fit import fit_slices, slice_values
from coupole.reflectance.triangle_fit import TriangleSamples, fit_triangles, model_values
from coupole.storage.disk_errors import disk_error

TOGETHER = (("sh",), ("rbf", "ggx_rbf"))
"""Names in `SLICES` that share their functions, fitted in one pass."""
Said = Callable[[str, int, int], None]


def fit_result(out: Path, memory_bytes: int, *, say: Said = lambda step, done, of: None) -> None:
    """Make the fits that a result lacks. Raises InputError if its samples are not all there, StorageError."""
    settings = read_settings(out)
    result = RunResult(out)
    result.refuse_unfinished(settings)
    try:
        for name in MATERIALS:
            if not result.materials_path(name).exists():
                _fit_materials(result, name, settings, memory_bytes, say)
        for names in TOGETHER:
            for view in result.views:
                if not all(result.slices_path(name, view).exists() for name in names):
                    _fit_slices(result, names, view, settings["left_out"], memory_bytes, say)
    except OSError as error:
        raise disk_error(out, error) from error


def predicted(
    result: RunResult, name: str, view: ViewSamples, rows: slice, samples: TriangleSamples
) -> NDArray[np.float32]:
    """[b, samples, channels] f cos_i, 1/sr, that a fit gives for `samples` of rows of a view's file, whatever
    their lights are; NaN where the fit has nothing, the material alone where what it leaves was not fitted."""
    places = np.searchsorted(result.triangles, view.triangles[rows])
    if name == "clusters":
        own = result.materials("ggx_normal", places)
        return model_values(samples, result.clusters.at(own, samples.normals, places))
    kind = SLICES.get(name)
    material = name if kind is None else kind.over
    model = None
    if material is not None:
        model = model_values(samples, result.materials(material, places))
    if kind is None:
        assert model is not None
        return model
    coefficients = result.slices(name, view, rows)
    if model is not None:
        coefficients = np.nan_to_num(coefficients)
    return slice_values(samples, coefficients, kind.basis, model)


def _fit_materials(result: RunResult, name: str, settings: dict[str, Any], memory_bytes: int, say: Said) -> None:
    parts, uncertain = [], []
    noise_um, fitted_normals = settings["scan_noise_um"], name == "ggx_normal"
    for block in result.blocks(memory_bytes):
        used = ~np.isin(result.along_samples(block, "leds"), settings["left_out"])
        samples = result.samples(block)
        parts.append(fit_triangles(samples, used, noise_um if fitted_normals else None))
        uncertain.append(covariances(samples, used, parts[-1], noise_um, fitted_normals=fitted_normals))
        say(f"fit {name}", block.stop, len(result.triangles))
    u_triangle = np.concatenate([result.u_triangles(block) for block in result.blocks(memory_bytes)])

    def write(path: Path) -> None:
        write_materials(path, parts, uncertain, u_triangle, result.u_shared, result.triangles)

    complete(result.materials_path(name), write)


def _fit_slices(
    result: RunResult, names: Sequence[str], view: ViewSamples, left_out: list[int], memory_bytes: int, say: Said
) -> None:
    used = ~np.isin(view.leds, left_out)
    with ExitStack() as files:
        coefficients = []
        for name in names:
            path = result.slices_path(name, view)
            part = files.enter_context(in_the_making(path))
            file = files.enter_context(h5py.File(part, "w"))
            coefficients.append(begin_slices(file, SLICES[name], view, result.channels))
        for rows in result.view_blocks(view, memory_bytes):
            samples = result.view_samples(view, rows)
            fits = [(SLICES[name].basis, _under(result, name, view, rows, samples)) for name in names]
            for data, found in zip(coefficients, fit_slices(samples, used, *fits), strict=True):
                data[rows] = found
            say(f"fit {', '.join(names)} of {view.view}", rows.stop, len(view.triangles))


def _under(
    result: RunResult, name: str, view: ViewSamples, rows: slice, samples: TriangleSamples
) -> NDArray[np.float32] | None:
    """What the material gives that a fit is added to."""
    over = SLICES[name].over
    return None if over is None else predicted(result, over, view, rows, samples)
