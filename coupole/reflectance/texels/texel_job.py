"""Job that adds materials of texels (single pixels, or squares of them) to a result of runs, view by view, and
compares them with pictures of LEDs that were kept for the check.

Each view's texels are a separate file, complete or missing. A job that was killed continues with the first missing
file.
"""

from __future__ import annotations

import json
import os
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any, TypeVar
from uuid import uuid4

import numpy as np

from coupole.errors import InputError
from coupole.reflectance.block_work import Said, Workshop, silent, workshop
from coupole.reflectance.new_light.pictured_surface import surface_of_view
from coupole.reflectance.result_folder import SETTINGS, clear_remains, complete, read_settings
from coupole.reflectance.run_job import (
    RunRequest,
    Sources,
    forget,
    prepare_run,
    read_runs,
    settings_of,
    view_file_name,
)
from coupole.reflectance.run_result import RunResult
from coupole.reflectance.texels.grid_fit import texels_of_grid
from coupole.reflectance.texels.pixel_file import (
    TexelFileHead,
    refuse_other_size,
    texels_path,
    write_view_texels,
)
from coupole.reflectance.texels.pixel_values import FittedView, PixelBlock, PixelReader
from coupole.reflectance.texels.texel_check import check_texels
from coupole.reflectance.texels.texel_grid import pixel_mm, texel_grid
from coupole.reflectance.texels.texel_size import TexelSize
from coupole.reflectance.texels.texel_values import TexelBlock, TexelReader
from coupole.reflectance.texels.view_centres import start_of
from coupole.reflectance.texels.view_texels import texels_of_view
from coupole.storage.disk_errors import disk_error
from coupole.storage.durable import make_folder
from coupole.storage.run_json import RUN_JSON

_Block = TypeVar("_Block", PixelBlock, TexelBlock)


@dataclass(frozen=True)
class _View:
    """A block of the job: the texels of one view, which become one file."""

    run: Path
    view: str
    name: str
    """Name of its files."""
    out: Path
    left_out: tuple[int, ...]
    memory_bytes: int
    size: TexelSize


def add_texels(
    request: RunRequest,
    out: Path,
    size: TexelSize | None = None,
    *,
    scheduler: str | None = None,
    say: Said = silent,
) -> dict[str, Any]:
    """Make the missing texels of a complete result, in the workers of a `scheduler` if one is named. They have a
    `size`, or are single pixels without one. Return the content of `texels/texels.json`.

    Raises InputError for a result that is incomplete, belongs to another request, or has texels of another size,
    and for a scheduler that does not answer. Raises StorageError if a frame is damaged or the disk cannot be
    written.
    """
    token, size = uuid4().hex, size or TexelSize()
    refuse_other_size(out, size)
    try:
        result = open_result_of(request, token, out)
        measured_runs, settings = read_runs(request, token), read_settings(out)
        tasks = [
            _View(
                run.resolve(), view.name, view_file_name(measured_runs, measured_run, view), out.resolve(),
                tuple(settings["left_out"]), request.memory_bytes, size,
            )
            for run, measured_run in zip(request.runs, measured_runs, strict=True)
            for view in measured_run.views
        ]  # fmt: skip
        paths = {run_view.path.stem: texels_path(result, run_view) for run_view in result.views}
        make_folder(next(iter(paths.values())).parent)
        with workshop(scheduler) as shop:
            shop.refuse_blind(result.folder, SETTINGS)
            clear_remains(out)
            _fit(request.sources, token, [task for task in tasks if not paths[task.name].exists()], shop, say)
        return check_texels(result, say)
    except OSError as error:
        raise disk_error(out, error) from error
    finally:
        forget()


def open_result_of(request: RunRequest, token: str, out: Path) -> RunResult:
    """Open a complete result. Raises InputError if it is incomplete, or belongs to another request."""
    settings = read_settings(out)
    if settings != json.loads(json.dumps(settings_of(request, token, read_runs(request, token)))):
        raise InputError(f"{out}: is a result of other runs, records or settings")
    result = RunResult(out.resolve())
    result.refuse_unfinished(settings, fits=True)
    return result


def _fit(sources: Sources, token: str, tasks: list[_View], shop: Workshop, say: Said) -> None:
    for task in tasks:
        shop.refuse_blind(task.run, RUN_JSON)
    fit = partial(_texels_of_one, token, sources, shop.threads, shop.reporter(say))
    for number, _ in enumerate(shop.map(fit, tasks), start=1):
        say("texels", number, len(tasks))
    shop.everywhere(forget)


def _texels_of_one(token: str, sources: Sources, threads: int | None, say: Said, task: _View) -> None:
    measured_run, geometry, radiometry = prepare_run(token, task.run, sources)
    view = next(view for view in measured_run.views if view.name == task.view)
    result = RunResult(task.out)
    samples = next(samples for samples in result.views if samples.path.stem == task.name)
    surface = surface_of_view(result, samples)
    width_mm = pixel_mm(surface)
    side_px = task.size.side_px(width_mm)
    threads = threads or len(os.sched_getaffinity(0))
    say_view = partial(say, f"texels of {task.view}")
    fitted_view = FittedView(measured_run, geometry, radiometry, view, surface, samples)
    u_pixel = radiometry.u_pixel
    if side_px == 1:
        pixels = PixelReader(fitted_view)
        start = start_of(result, samples, surface.triangle_of_pixel, surface.normals, task.left_out)
        read_block = partial(pixels.read_block, threads=threads)
        blocks = _blocks(pixels.blocks(task.memory_bytes), read_block, pixels.count, say_view)
        texels = texels_of_view(start, blocks, threads)
    else:
        reader = TexelReader(fitted_view, texel_grid(surface, side_px))
        start = start_of(result, samples, reader.grid.triangle, surface.normals, task.left_out)
        read_band = partial(reader.read_band, threads=threads)
        bands = _blocks(reader.bands(task.memory_bytes), read_band, reader.count, say_view)
        texels = texels_of_grid(start, reader.squares(), bands, threads)
        u_pixel = u_pixel / np.sqrt(reader.pixels_of_channels)
    head = TexelFileHead(
        samples.view, measured_run.frames.size_px, task.size, width_mm, u_pixel, result.u_shared,
        measured_run.run.is_simulated,
    )  # fmt: skip
    complete(texels_path(result, samples), lambda path: write_view_texels(path, texels, head))


def _blocks(
    parts: Iterable[slice], read_part: Callable[[slice], _Block], total: int, say: Callable[[int, int], None]
) -> Iterator[_Block]:
    """Yield the texels of a view part by part; all frames are read for each part. After a part, the number of
    texels that are done is given to `say`."""
    count = 0
    for part in parts:
        block = read_part(part)
        yield block
        count += len(block.values)
        say(count, total)
