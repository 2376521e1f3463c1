"""Puts the screens before a console's interface."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

from fastapi import FastAPI, Request
from nicegui import app as nicegui_app
from nicegui import ui

from coupole.console.screens import object_screen, plan_screen, queue_screen, run_screen
from coupole.console.screens.frame import Place, framed
from coupole.console.screens.visit import Visit
from coupole.console.service_parts import Service

Build = Callable[[Visit], None]
"""Quick: what takes time is begun by a timer."""
SCREENS: dict[Place, Build] = {
    Place("/run", "Run", "play_circle"): run_screen.build,
    Place("/queue", "Queue", "format_list_numbered"): queue_screen.build,
    Place("/plan", "Plan", "edit_note"): plan_screen.build,
    Place("/object", "Object and dose", "category"): object_screen.build,
}


def add_screens(app: FastAPI, service: Service) -> None:
    """Serve all screens of a cell's console. Everything they need comes from this machine."""
    nicegui_app.colors(primary="var(--accent)", negative="#b00020", positive="#1b6e3c")
    ui.add_css(Path(__file__).parent / "screens.css", shared=True)
    for place, build in SCREENS.items():
        _add(service, place, build)
    ui.run_with(
        app,
        title="Coupole",
        dark=None,
        language="en-GB",
        tailwind=False,
        reconnect_timeout=30.0,
        show_welcome_message=False,
    )


def _add(service: Service, place: Place, build: Build) -> None:
    @ui.page(place.path, title=f"{place.title} · Coupole")
    def page(request: Request) -> None:
        visit = Visit(service, request)
        with framed(visit, place, tuple(SCREENS)):
            build(visit)
