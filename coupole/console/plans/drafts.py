"""Plans that are being written: checked and drawn in a separate process, so that the console does not wait."""

from __future__ import annotations

import asyncio
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from coupole.console.processes.warm_process import WarmProcess
from coupole.errors import CoupoleError, InputError, Problem

_PATIENCE_S = 300.0


@dataclass(frozen=True)
class Draft:
    """A plan's text, which is read as if it were the content of this file."""

    path: Path
    text: str


@dataclass(frozen=True)
class Checked:
    """Result of the check of a draft."""

    problems: tuple[Problem, ...] = ()
    """Mistakes in the files; if there are any, the other fields are empty."""
    report: dict[str, Any] = field(default_factory=dict)
    """Report, as in `coupole check --json`."""
    views: tuple[dict[str, Any], ...] = ()
    """Name, duration in s and dose in lux h of each view, in the order of the visits."""
    budget_lux_h: float | None = None


def check_draft(draft: Draft) -> Checked:
    """Check everything except paths and collisions, which take longer."""
    from coupole.preflight.checking import preflight_of
    from coupole.preflight.job import read_job
    from coupole.viewing.preflight_table import document_of

    try:
        job = read_job(draft.path, text=draft.text)
        job, report = preflight_of(job, job.cell.storage_folder, paths=False)
    except InputError as error:
        return Checked(problems=tuple(error.problems) or (Problem(str(draft.path), 0, 0, "", str(error)),))
    except CoupoleError as error:
        return Checked(problems=(Problem(str(draft.path), 0, 0, "", str(error)),))
    views = tuple(
        {"name": view.name, "duration_s": view.move_s + view.burst_s, "dose_lux_h": view.dose_lux_h}
        for view in report.views
    )
    return Checked(report=document_of(report), views=views, budget_lux_h=report.dose_budget_lux_h)


def draw_draft(draft: Draft, folder: Path) -> tuple[Path, Path]:
    """Draw picture and page of the cell with the plan's views and paths, like `coupole view`. Raises
    InputError."""
    from coupole.preflight.job import read_job
    from coupole.viewing.terminal import make_console
    from coupole.viewing.view import look_at_plan

    return look_at_plan(read_job(draft.path, text=draft.text), folder, make_console(quiet=True), paths=True)


def draw_object(draft: Draft, path: Path) -> Path:
    """Draw the object as it lies on the support. Raises InputError if the plan names no mesh."""
    from coupole.preflight.job import read_job
    from coupole.viewing.object_picture import write_object_picture

    job = read_job(draft.path, text=draft.text)
    path.parent.mkdir(parents=True, exist_ok=True)
    write_object_picture(job, path)
    return path


def bounds_of_mesh(draft: Draft) -> tuple[tuple[float, ...], tuple[float, ...]]:
    """Return the corners of the bounding box of the draft's object, support frame, mm. Raises InputError if there
    is none."""
    from coupole.preflight.job import read_job

    corners = read_job(draft.path, text=draft.text).shape.corners_mm
    if not len(corners):
        raise InputError("the plan names no mesh: give one first")
    return tuple(corners.min(axis=(0, 1))), tuple(corners.max(axis=(0, 1)))


class Desk:
    """The process that reads drafts."""

    def __init__(self) -> None:
        self._process = WarmProcess("reads plans")
        self._turn = asyncio.Lock()

    async def check(self, draft: Draft, is_wanted: Callable[[], bool] = lambda: True) -> Checked | None:
        """Check a draft; return None if it is no longer wanted when its turn comes. Raises InputError if the check
        takes too long, or if the process dies.
        """
        async with self._turn:
            checked_draft: Checked | None = await self._do_now(check_draft, draft) if is_wanted() else None
        return checked_draft

    async def draw(self, draft: Draft, folder: Path) -> tuple[Path, Path]:
        """Call `draw_draft` in the process. Raises InputError."""
        paths: tuple[Path, Path] = await self._do(draw_draft, draft, folder)
        return paths

    async def draw_object(self, draft: Draft, path: Path) -> Path:
        """Call `draw_object` in the process. Raises InputError."""
        picture_path: Path = await self._do(draw_object, draft, path)
        return picture_path

    async def bounds(self, draft: Draft) -> tuple[tuple[float, ...], tuple[float, ...]]:
        """Call `bounds_of_mesh` in the process. Raises InputError."""
        bounds_mm: tuple[tuple[float, ...], tuple[float, ...]] = await self._do(bounds_of_mesh, draft)
        return bounds_mm

    async def _do(self, work: Any, *arguments: Any) -> Any:
        async with self._turn:
            return await self._do_now(work, *arguments)

    async def _do_now(self, work: Any, *arguments: Any) -> Any:
        try:
            return await asyncio.to_thread(self._process.run, work, _PATIENCE_S, 0, *arguments)
        except asyncio.CancelledError:
            self._process.end()
            raise

    def close(self) -> None:
        """End the process."""
        self._process.end()
