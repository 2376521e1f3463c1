"""A result of the views so far, while the run goes on: fits, check and report of the samples that are there.

It uses the samples of the final result through links to their files. These files are only replaced whole, never
changed. So this result can be abandoned at any time, and it does not change the final result. Afterwards the
kernels of all fits are compiled. Steps that do not depend on later views are remembered for the final result.
"""

from __future__ import annotations

import os
import shutil
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any
from uuid import uuid4

from coupole.plan.held_out import held_out_leds
from coupole.reflectance.block_work import Said
from coupole.reflectance.light_paths import Ahead
from coupole.reflectance.result_folder import begin
from coupole.reflectance.result_pages import run_reflectance_page
from coupole.reflectance.run_check import check_result
from coupole.reflectance.run_fits import fit_result
from coupole.reflectance.run_job import (
    RunRequest,
    expected_leds,
    forget,
    read_runs,
    settings_of,
    subtract_from,
)
from coupole.reflectance.run_result import FRAMES, OBJECT
from coupole.storage import so_far
from coupole.storage.run import Run

_COPIES = 3
"""Space needed on the disk, in sizes of the samples: each view's file is replaced twice, while old and new file
exist side by side."""
_FREE_BYTES = 2**30
"""Free space that must remain: more than a rig keeps free by default (`reserve_bytes`)."""
_SHARE_OF_MEMORY = 8
"""Factor by which the blocks of work are smaller for a result so far, so that it can be abandoned without
delay."""


@dataclass(frozen=True)
class Growth:
    """Views, run and folder of a result of the views so far."""

    run: Path
    result: Path
    """Folder of the final result, which has the samples."""
    views: tuple[str, ...]
    """Views whose samples are there, in the plan's order."""
    of: int
    """Number of views of the plan."""
    folder: Path
    """New folder in which this result is made."""

    @classmethod
    def of_views(cls, run: Path, result: Path, views: tuple[str, ...], of: int) -> Growth:
        return cls(run, result, views, of, so_far.new_folder(result, run.name, len(views), of))

    def has_room(self) -> bool:
        """Tell whether the disk has room for this result, for `_FREE_BYTES`, and for the frames and samples of
        later views. Later views are taken to be as large as the largest view and as the mean view. False for a run
        that discards frames, because its disk is small. Raises OSError."""
        run = Run(self.run)
        if run.discards:
            return False
        sample_bytes = sum(path.stat().st_size for path in (self.result / "samples").glob("*.h5"))
        views_to_come = self.of - len(self.views)
        frame_bytes = max(run.view_path(view).stat().st_size for view in self.views) * views_to_come
        sample_bytes_to_come = sample_bytes * views_to_come // len(self.views)
        needed_bytes = _COPIES * sample_bytes + sample_bytes_to_come + frame_bytes + _FREE_BYTES
        return shutil.disk_usage(self.result).free > needed_bytes


def fit_so_far(growth: Growth, memory_bytes: int, say: Said, ahead: Ahead) -> None:
    """Make the result, and move it to its place when it is complete. An error that `say` raises ends it; then only
    the contents of `ahead` remain. Raises as `reflectance_of`."""
    so_far.remove_halves(growth.result)
    try:
        _begin(growth)
        subtract_from(growth.folder, say, ahead)
        fit_result(growth.folder, memory_bytes // _SHARE_OF_MEMORY, say=say)
        check_result(growth.folder, memory_bytes // _SHARE_OF_MEMORY, say=say)
        run_reflectance_page.write(growth.folder)
        so_far.put_in_place(growth.result, growth.folder)
    except BaseException:
        shutil.rmtree(growth.folder, ignore_errors=True)
        raise


def _begin(growth: Growth) -> None:
    begin(growth.folder, _settings(growth))
    sample_names = [f"{view}{ending}" for view in growth.views for ending in (".h5", ".json")]
    _link(growth.result / "samples", growth.folder / "samples", sample_names)
    _link(growth.result / FRAMES, growth.folder / FRAMES, [f"{view}.h5" for view in growth.views])
    _link(growth.result, growth.folder, [OBJECT])


def _settings(growth: Growth) -> dict[str, Any]:
    """Return the settings of a result of these views, with their number."""
    try:
        (measured_run,) = read_runs(RunRequest((growth.run,)), token := uuid4().hex)
        views = tuple(view for view in measured_run.views if view.name in growth.views)
        measured_leds = {led for view in views for led in view.by_led}
        left_out = tuple(led for led in held_out_leds(expected_leds(measured_run.run)) if led in measured_leds)
        request = RunRequest((growth.run,), left_out=left_out)
        settings = settings_of(request, token, [replace(measured_run, views=views)])
    finally:
        forget()
    return {**settings, so_far.KEY: {"views": len(growth.views), "of": growth.of}}


def _link(source: Path, to: Path, names: Sequence[str]) -> None:
    """Link files, or copy them where the file system has no links."""
    to.mkdir(exist_ok=True)
    for name in names:
        try:
            os.link(source / name, to / name)
        except FileNotFoundError:
            raise
        except OSError:
            shutil.copyfile(source / name, to / name)
