"""The console's HTTP interface to files: runs, their pictures and pages, and support bundles."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

from fastapi import FastAPI, Query, Request, Response
from fastapi.responses import FileResponse

from coupole.console.people.accounts import Role
from coupole.console.people.guard import account_here, is_of_this_machine
from coupole.console.people.permission import NotAllowed
from coupole.console.people.sessions import Session
from coupole.console.routes.messages import Text
from coupole.console.runs.run_files import RunRow
from coupole.console.runs.run_results import look_page
from coupole.console.service_parts import Service
from coupole.errors import InputError
from coupole.storage.growing_pictures import Growing, file_so_far, read_growing
from coupole.storage.so_far import LINK, REPORT

_STILL = (
    "sandbox allow-popups; default-src 'none'; img-src data:; style-src 'unsafe-inline'; base-uri 'none'; "
    "form-action 'none'; frame-ancestors 'self'"
)
"""Policy of a page without scripts: it may load nothing from another place, and has no rights of this console."""
_LIVELY = (
    "sandbox allow-scripts; default-src 'none'; script-src 'unsafe-inline' 'wasm-unsafe-eval'; "
    "style-src 'unsafe-inline'; img-src data: blob:; connect-src data: blob:; worker-src blob:; base-uri 'none'; "
    "form-action 'none'; frame-ancestors 'self'"
)
"""Policy of a page with its own scripts, which reach nothing outside the page."""


def add_run_routes(app: FastAPI, service: Service) -> None:
    """Add the routes to a console's app."""

    @app.get("/api/v1/runs")
    def runs() -> list[RunRow]:
        """Return the cell's runs, the newest first."""
        return service.runs.rows()

    @app.get("/api/v1/runs/{run}/picture", response_class=Response)
    def picture(
        run: Text, shot: Text, width: Annotated[int, Query(ge=1, le=2048)] = 640, saturation: bool = False
    ) -> Response:
        """Return a proven shot as JPEG, developed for the eye; with `saturation`, saturated pixels are red."""
        jpeg = service.runs.picture(run, shot, width, saturation=saturation)
        return Response(jpeg, media_type="image/jpeg", headers={"Cache-Control": "private, max-age=3600"})

    @app.get("/api/v1/runs/{run}/report", response_class=FileResponse)
    def report_page(run: Text) -> FileResponse:
        """Return the run's report, which may not run scripts."""
        return _file(service.runs.run(run).report_path, "text/html", _STILL)

    @app.get("/api/v1/runs/{run}/readme", response_class=FileResponse)
    def readme(run: Text) -> FileResponse:
        """Return the README.txt of the run's folder, which describes the folder."""
        return _file(service.runs.run(run).folder / "README.txt", "text/plain; charset=utf-8", _STILL)

    @app.get("/api/v1/support-bundles/{name}", response_class=FileResponse)
    def support_bundle(name: Text, request: Request) -> FileResponse:
        """Return a support bundle that was made at the console; for engineers."""
        session: Session = request.state.session
        if account_here(session.account, of_this_machine=is_of_this_machine(request)).role < Role.ENGINEER:
            raise NotAllowed(403, "support bundles are only for engineers")
        return FileResponse(service.bundles.path(name), media_type="application/zip", filename=name)

    @app.get("/api/v1/runs/{run}/look", response_class=FileResponse)
    def look(run: Text) -> FileResponse:
        """Return the page that `coupole show` made of the run, if all its data are in it."""
        return _file(look_page(service.cell, service.runs.run(run)), "text/html", _LIVELY)


def add_routes_so_far(app: FastAPI, service: Service) -> None:
    """Add the routes to pictures and pages of a run that is processed during its acquisition."""

    @app.get("/api/v1/runs/{run}/pictures-so-far")
    def pictures_so_far(run: Text) -> Growing:
        """Return the pictures of normals, materials and uncertainty that there are during the run, with their
        scales and the data on which they rest."""
        return read_growing(service.watch.result_of(run))

    @app.get("/api/v1/runs/{run}/pictures-so-far/{name}", response_class=FileResponse)
    def picture_so_far(run: Text, name: Text) -> FileResponse:
        """Return one of these pictures, as PNG."""
        return _file(_so_far(service.watch.result_of(run), name), "image/png", _STILL)

    @app.get("/api/v1/runs/{run}/relight-so-far", response_class=FileResponse)
    def relight_so_far(run: Text) -> FileResponse:
        """Return the page to relight of a result of the views so far, during the run."""
        result = service.watch.result_of(run)
        page = read_growing(result).page
        if page is None:
            raise InputError(f"{run}: there is no page to relight yet")
        return _file(_so_far(result, page.file), "text/html", _LIVELY)

    @app.get("/api/v1/runs/{run}/so-far", response_class=FileResponse)
    def result_so_far(run: Text) -> FileResponse:
        """Return the report of the result of the views so far, during the run: normals, materials, uncertainty."""
        return _file(service.watch.result_of(run) / LINK / REPORT, "text/html", _STILL)


def _so_far(result: Path, name: str) -> Path:
    """Return the path of a file that is shown during a run. Raises InputError for any other file."""
    path = file_so_far(result, name)
    if path is None:
        raise InputError(f"{name}: there is no such picture or page, or it is not complete")
    return path


def _file(path: Path, kind: str, policy: str) -> FileResponse:
    """Return one of Coupole's files with a given policy. Raises InputError."""
    if not path.is_file():
        raise InputError(f"{path}: there is no such file yet")
    return FileResponse(path, media_type=kind, headers={"Content-Security-Policy": policy})
