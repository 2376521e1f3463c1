"""Adds the screens to a console's interface."""

from __future__ import annotations

from collections.abc import Callable
from contextlib import suppress
from pathlib import Path

from fastapi import FastAPI, Request
from nicegui import app as nicegui_app
from nicegui import ui

from coupole.console.screens import (
    calibration_screen,
    devices_screen,
    focus_screen,
    object_screen,
    plan_screen,
    queue_screen,
    run_page,
    run_screen,
    runs_screen,
    system_screen,
)
from coupole.console.screens.frame import Place, screen_frame
from coupole.console.screens.visit import Visit
from coupole.console.service_parts import Service

Build = Callable[..., None]
"""Function that builds a screen. It is called with the visit, and with the parts of the path by their names. It
must be quick: long work is begun by a timer."""
RUNS = Place("/runs", "Runs", "photo_library")
SCREENS: dict[Place, Build] = {
    Place("/run", "Run", "play_circle"): run_screen.build,
    Place("/queue", "Queue", "format_list_numbered"): queue_screen.build,
    Place("/plan", "Plan", "edit_note"): plan_screen.build,
    Place("/object", "Object and dose", "category"): object_screen.build,
    Place("/focus", "Focus and expose", "center_focus_strong"): focus_screen.build,
    Place("/devices", "Devices", "precision_manufacturing"): devices_screen.build,
    RUNS: runs_screen.build,
    Place("/calibration", "Calibration", "straighten"): calibration_screen.build,
    Place("/system", "System", "settings"): system_screen.build,
}
PAGES_BELOW: dict[str, tuple[Place, Build]] = {
    "/runs/{name}": (RUNS, run_page.build),
}
"""Pages that are not in the navigation, and the entry to which they belong."""


def add_screens(app: FastAPI, service: Service) -> None:
    """Serve all screens of a cell's console. All their files come from this machine."""
    nicegui_app.colors(primary="var(--accent)", negative="#b00020", positive="#1b6e3c")
    ui.add_css(Path(__file__).parent / "screens.css", shared=True)
    nicegui_app.on_exception(_say)
    for place, build in SCREENS.items():
        _add(service, place.path, place, build)
    for path, (place, build) in PAGES_BELOW.items():
        _add(service, path, place, build)
    ui.run_with(
        app,
        title="Coupole",
        dark=None,
        language="en-GB",
        tailwind=False,
        reconnect_timeout=30.0,
        show_welcome_message=False,
    )


def _say(error: Exception) -> None:
    """Show an unexpected error to the person who caused it."""
    with suppress(RuntimeError, AttributeError):  # there may be no page that can show it
        ui.notify(
            f"{type(error).__name__}: {error}", type="negative", multi_line=True, close_button="close", timeout=0
        )


def _add(service: Service, path: str, place: Place, build: Build) -> None:
    @ui.page(path, title=f"{place.title} · Coupole")
    def page(request: Request) -> None:
        visit = Visit(service, request)
        with screen_frame(visit, place, tuple(SCREENS)):
            build(visit, **request.path_params)
