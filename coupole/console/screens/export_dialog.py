"""Dialog that asks which format a run is exported to."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

from nicegui import ui

from coupole.console.screens.parts import Choice, button, heading
from coupole.exchange.formats import FORMATS, Source, formats_of
from coupole.storage.run import Run


class ExportDialog:
    """The format, and the options that it needs."""

    def __init__(self, run: Run, folder: Callable[[str], Path]) -> None:
        """`folder` returns the folder of each format."""
        self._run, self._folder = run, folder
        with ui.dialog().props('aria-label="Export"') as self._dialog, ui.column().classes("panel ask"):
            heading(f"Export {run.folder.name}")
            formats = {name: FORMATS[name].gives for name in formats_of(Source.RUN)}
            self._form = Choice("format", formats, self._tell, name="format")
            views = {"": "all views"} | {view: view for view in run.views}
            self._view = Choice("views", views, name="views")
            self._licence = ui.input("licence, such as CC-BY-4.0").props("outlined dense").style("width:100%")
            self._again = ui.checkbox("overwrite earlier files")
            self._told = ui.label().classes("hint")
            with ui.row():
                button("Export", lambda: self._dialog.submit(True), name="yes", kind="main")
                button("Cancel", lambda: self._dialog.submit(False), name="cancel")
        self._tell()

    def _tell(self) -> None:
        form = self._form.value
        self._told.text = f"Into {self._folder(form)} on this machine."
        self._licence.set_visibility("licence" in FORMATS[form].options)
        self._view.set_visibility("views" in FORMATS[form].options)

    async def command(self) -> list[str]:
        """Return the arguments of `coupole` for the export; none if the dialog was cancelled."""
        is_confirmed = await self._dialog
        form, licence, view = self._form.value, self._licence.value, self._view.value
        self._dialog.delete()
        if not is_confirmed:
            return []
        command = ["export", str(self._run.folder), "--to", form, "--out", str(self._folder(form))]
        options = FORMATS[form].options
        command += ["--licence", licence] if "licence" in options and licence else []
        command += ["--views", view] if "views" in options and view else []
        return command + (["--overwrite"] if self._again.value else [])
