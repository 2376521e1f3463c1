"""Actions on a run: resume it, or run a command on it."""

from __future__ import annotations

import asyncio
from collections.abc import Callable, Sequence
from pathlib import Path

from nicegui import ui

from coupole.console.processes.tasks import Task
from coupole.console.routes.messages import NewEntry
from coupole.console.runs.run_results import export_folder, look_page, reflectance_folder, stands_alone
from coupole.console.screens.export_dialog import ExportDialog
from coupole.console.screens.parts import button, link, sure
from coupole.console.screens.visit import Visit, enter, in_background, in_thread
from coupole.exchange.formats import Source, source_of
from coupole.storage.line_file import utc_now
from coupole.storage.run import Run

_LOOK_EVERY_S = 0.3


async def resume(visit: Visit, name: str) -> None:
    """Enter a run in the queue, to take its remaining frames."""
    await enter(visit, NewEntry(resume=name), name)


class RunActions:
    """Buttons for one run, and links to its results."""

    def __init__(self, visit: Visit, name: str, *, can_resume: bool, frames: int) -> None:
        """`can_resume`: True if frames of it remain to be taken."""
        self._visit, self._name = visit, name
        self._run: Run = visit.service.runs.run(name)
        self._cell = visit.service.cell
        self._frames = frames
        with ui.row().classes("actions"):
            if can_resume:
                button("Resume", lambda: resume(visit, name), name="resume", icon="play_arrow", kind="main")
            for words, icon, do in (
                ("Verify", "fact_check", self._verify),
                ("Report", "description", self._report),
                ("Archive …", "compress", self._archive),
                ("Export …", "file_download", self._export),
                ("Reflectance …", "lens_blur", self._reflectance),
                ("Show", "3d_rotation", self._show),
            ):
                action_button = button(words, do, name=words.split()[0].lower(), icon=icon)
                action_button.set_enabled(visit.may_act)
        if not visit.may_act:
            ui.label("Only operators at this machine may do this.").classes("hint")
        self._links = ui.row().classes("links")
        self._there: list[bool] = []
        self._look()
        ui.timer(2.0, self._look)

    def _look(self) -> None:
        """Show links to the files that exist now."""
        run, page = self._run.folder, look_page(self._cell, self._run)
        there = [self._run.report_path.is_file(), (run / "README.txt").is_file(), stands_alone(page)]
        if there == self._there:
            return
        self._there = there
        self._links.clear()
        with self._links:
            for is_there, words, page_name in zip(
                there, ("Open the report", "README", "Open the page to look at"), ("report", "readme", "look"),
                strict=True,
            ):  # fmt: skip
                if is_there:
                    link(words, f"/api/v1/runs/{self._name}/{page_name}", name=f"open-{page_name}")

    async def _begin(
        self, action: str, command: Sequence[str | Path], then: Callable[[Task], object] = lambda _: None
    ) -> None:
        """Begin `coupole COMMAND` on this run; `then` is called if it ends without an error."""
        account, words = self._visit.account, f"{action} {self._name}"
        by = account.name if account else ""
        task = await self._visit.act(
            words,
            lambda: self._visit.service.tasks.begin(words, list(map(str, command)), by),
            acts=False,
            done_text=f"{words}: begun",
        )
        if task is not None:
            in_background(lambda: _when_done(task, then))

    async def _verify(self) -> None:
        runs, name = self._visit.service.runs, self._name
        before = await in_thread(runs.fingerprint, name)
        await self._begin(
            "verify", ["verify", self._run.folder], lambda _: runs.note_verified(name, utc_now(), before)
        )

    async def _report(self) -> None:
        await self._begin("report", ["report", self._run.folder])

    async def _archive(self) -> None:
        if await sure(
            f"Archive {self._name}?",
            "Its frames are compressed without loss. Each view is read back and compared before it replaces the "
            "old file. Only complete runs are archived.",
            "Archive",
        ):
            await self._begin("archive", ["archive", self._run.folder])

    async def _reflectance(self) -> None:
        out = reflectance_folder(self._cell, self._run)
        if await sure(
            f"Reflectance of {self._name}?",
            f"Normals and materials are fitted to its {self._frames} frames, with the calibrations in force for "
            f"it: minutes to hours of this machine's processors. The result lands in {out}. If you stop it and "
            "begin it again, it continues.",
            "Begin",
        ):
            out.parent.mkdir(parents=True, exist_ok=True)
            await self._begin("reflectance", ["reflectance", self._run.folder, "--out", out])

    async def _show(self) -> None:
        result = reflectance_folder(self._cell, self._run)
        source = result if source_of(result) is Source.RESULT else self._run.folder
        await self._begin("show", ["show", source, "--out", look_page(self._cell, self._run)])

    async def _export(self) -> None:
        dialog = ExportDialog(self._run, lambda form: export_folder(self._cell, self._run, form))
        if command := await dialog.command():
            await self._begin("export", command)


async def _when_done(task: Task, then: Callable[[Task], object]) -> None:
    while task.running:
        await asyncio.sleep(_LOOK_EVERY_S)
    if task.exit_code == 0:
        then(task)
