"""Plans while they are written: checked and drawn in a process of its own, so that nothing waits for it."""

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
    """A plan's text, to be read as if it were this file's."""

    path: Path
    text: str


@dataclass(frozen=True)
class Checked:
    """Result of the check of a draft."""

    problems: tuple[Problem, ...] = ()
    """Mistakes in the files; with any there is nothing else."""
    report: dict[str, Any] = field(default_factory=dict)
    """Report, as of `coupole check --json`."""
    views: tuple[dict[str, Any], ...] = ()
    """Name, duration in s and dose in lux h of each, in the order of the visits."""
    budget_lux_h: float | None = None


def check_draft(draft: Draft) -> Checked:
    """Everything but paths and collisions: those take longer."""
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
    """Picture and page of the cell with the plan's views and paths, as `coupole view`. Raises InputError."""
    from coupole.preflight.job import read_job
    from coupole.viewing.terminal import make_console
    from coupole.viewing.view import look_at_plan

    return look_at_plan(read_job(draft.path, text=draft.text), folder, make_console(quiet=True), paths=True)


def draw_object(draft: Draft, path: Path) -> Path:
    """Picture of the object as it lies on the support. Raises InputError: the plan names no mesh."""
    from coupole.preflight.job import read_job
    from coupole.viewing.object_picture import write_object_picture

    job = read_job(draft.path, text=draft.text)
    path.parent.mkdir(parents=True, exist_ok=True)
    write_object_picture(job, path)
    return path


def bounds_of_mesh(draft: Draft) -> tuple[tuple[float, ...], tuple[float, ...]]:
    """Corners of the box round the draft's object in the support frame, mm. Raises InputError: there is none."""
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
        """None if the draft is no longer needed when its turn comes. Raises InputError: it takes too long, or the
        process died of it.
        """
        async with self._turn:
            checked_draft: Checked | None = await self._do_now(check_draft, draft) if is_wanted() else None
        return checked_draft

    async def draw(self, draft: Draft, folder: Path) -> tuple[Path, Path]:
        """Raises InputError."""
        paths: tuple[Path, Path] = await self._do(draw_draft, draft, folder)
        return paths

    async def draw_object(self, draft: Draft, path: Path) -> Path:
        """Raises InputError."""
        picture_path: Path = await self._do(draw_object, draft, path)
        return picture_path

    async def bounds(self, draft: Draft) -> tuple[tuple[float, ...], tuple[float, ...]]:
        """Raises InputError."""
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
