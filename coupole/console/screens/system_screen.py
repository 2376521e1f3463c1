"""The machine and the service: disk space, versions, the rig and its values to be measured, people, log,
commands."""

from __future__ import annotations

from typing import Any

from nicegui import ui

from coupole.console.people.accounts import Role
from coupole.console.screens.parts import button, facts, moment, panel, table_html, with_name
from coupole.console.screens.people_panel import PeoplePanel
from coupole.console.screens.task_list import TaskList
from coupole.console.screens.visit import Visit, in_thread
from coupole.console.upkeep.support_bundle import versions
from coupole.console.upkeep.system_facts import NOTIFICATIONS, Disk, disk_of, log_lines, notifications, to_measure
from coupole.viewing.terminal import bytes_text

_LOG_SHOWN, _LOOK_EVERY_S = 100, 3.0
_MAIN_VERSIONS = ("coupole", "python", "system", "h5py", "numpy", "nicegui", "fastapi")


def build(visit: Visit) -> None:
    """Build the screen."""
    with ui.element("div").classes("columns"):
        _disk(visit)
        _versions()
    _rig(visit)
    if visit.is_engineer:
        PeoplePanel(visit)
    _Log(visit)
    with panel("Commands"):
        TaskList(visit, lambda _: True, most=50)
    with ui.element("div").classes("columns"):
        _notifications(visit)
        _Bundle(visit)


def _disk(visit: Visit) -> None:
    service = visit.service
    with panel("Disk"):
        waiting = ui.label("Reading the runs …").classes("hint")
        box = with_name(ui.column().style("width:100%"), "disk")

    async def fill() -> None:
        disk = await in_thread(lambda: disk_of(service.cell, service.runs.rows()))
        waiting.delete()
        with box:
            _show_disk(disk, str(service.cell.storage_folder))

    ui.timer(0.01, fill, once=True)


def _show_disk(disk: Disk, folder: str) -> None:
    used_share = 1 - disk.free / disk.total
    ui.linear_progress(used_share, show_value=False).props(f'aria-label="disk, {used_share:.0%} full"').style(
        "height:.6rem"
    )
    few = "; below the reserve" if disk.free < disk.reserve else ""
    facts(
        {
            "free": f"{bytes_text(disk.free)} of {bytes_text(disk.total)}{few}",
            "runs take": bytes_text(disk.runs),
            "reserve": f"{bytes_text(disk.reserve)} are left free by every run",
            "room for": f"{disk.frames_left:,} frames of {bytes_text(disk.frame)}",
            "folder": folder,
        }
    )


def _versions() -> None:
    version_of = versions()
    with panel("Versions"):
        facts({name: version_of[name] for name in _MAIN_VERSIONS if name in version_of})
        with ui.expansion("All packages").classes("printed"):
            facts({name: version for name, version in version_of.items() if name not in _MAIN_VERSIONS})


def _rig(visit: Visit) -> None:
    cell = visit.service.cell
    rig = cell.rig
    with panel("Rig"):
        facts(
            {
                "name": rig.name,
                "file": str(cell.document.path),
                "LED box": rig.ledbox.driver,
                "camera": rig.camera.driver,
                "arm": rig.robot.driver,
                "frames": f"{rig.sensor.width_px} x {rig.sensor.height_px}, {rig.sensor.bit_depth} bits, "
                f"{rig.sensor.bayer_pattern}",
                "lens": f"{rig.lens.focal_length_mm:g} mm, f/{rig.lens.f_number:g}, focus "
                f"{rig.lens.focus_distance_mm:g} mm",
                "LEDs": str(len(cell.leds.ids)),
            }
        ).classes("two-columns")
        if lines := to_measure(cell.document.path):
            ui.label(f"{len(lines)} lines of the rig are still to be measured:").classes("warm")
            rows = [(str(line.line), line.key, line.why) for line in lines]
            with_name(ui.html(table_html(("line", "key", "what"), rows), sanitize=False), "measure").style(
                "width:100%"
            )
        else:
            ui.label("No line of the rig is marked as still to be measured.").classes("hint")


class _Log:
    """Panel of the log: senders and their requests, the newest first."""

    def __init__(self, visit: Visit) -> None:
        self._path = visit.service.folder / "audit.jsonl"
        self._lines: list[dict[str, Any]] = []
        self._shown = ""
        with panel("Log"):
            with ui.row().classes("bar"):
                self._search = ui.input("Search", on_change=self._show).props(
                    "outlined dense clearable type=search data-name=search-log"
                )
                self._count = ui.label("").classes("hint").props("role=status")
            self._table = with_name(ui.html("", sanitize=False), "log").style("width:100%")
        ui.timer(_LOOK_EVERY_S, self._look, immediate=True)

    async def _look(self) -> None:
        self._lines = await in_thread(log_lines, self._path)
        self._show()

    def _show(self) -> None:
        words = (self._search.value or "").lower().split()
        every = [_cells(line) for line in self._lines]
        rows = [row for row in every if all(word in " ".join(row).lower() for word in words)]
        self._count.text = f"{len(rows)} of {len(self._lines)} lines"
        text = table_html(("UTC", "who", "asked", "answer", "from"), rows[:_LOG_SHOWN])
        if text != self._shown:
            self._shown = text
            self._table.set_content(text)


def _cells(line: dict[str, Any]) -> list[str]:
    status = int(line.get("status", 0))
    action = f"{line.get('asked', '')} {line.get('about', '')}".strip()
    t = str(line.get("t", ""))
    answer = f"good|{status}" if status < 400 else f"bad|{status}"
    return [moment(t) + t[16:19], str(line.get("name", "")) or "nobody", action, answer, str(line.get("from", ""))]


def _notifications(visit: Visit) -> None:
    with panel("Notifications"):
        if receivers := notifications(visit.service.folder):
            facts(receivers)
        else:
            ui.label(f"Nobody is notified: there is no {visit.service.folder / NOTIFICATIONS}.").classes("hint")


class _Bundle:
    """Panel of the support bundle, a file for those who help with a fault."""

    def __init__(self, visit: Visit) -> None:
        self._visit = visit
        with panel("Support bundle"):
            ui.label(
                "One file for a person who helps you: rig, plans, journals, logs and versions; no frames, no "
                "passwords. Names of people and objects are in it. Nothing is sent automatically."
            )
            self._make = button("Make one", self._begin, name="make-bundle", icon="folder_zip")
            self._make.set_enabled(visit.is_engineer)
            self._links = ui.column()
            if not visit.is_engineer:
                ui.label("Only engineers at this machine may make one.").classes("hint")

    async def _begin(self) -> None:
        self._make.set_enabled(False)
        name = await self._visit.act(
            "support bundle", self._visit.service.bundles.make, role=Role.ENGINEER, acts=False
        )
        self._make.set_enabled(True)
        if name is not None:
            with self._links:
                ui.link(name, f"/api/v1/support-bundles/{name}").props(f'download="{name}" data-name=bundle')
