"""Pictures and pages of plans, over HTTP."""

from __future__ import annotations

import re

from fastapi import FastAPI, Response
from fastapi.responses import FileResponse

from coupole.console.routes.messages import Text
from coupole.console.service_parts import Service
from coupole.errors import InputError

_PAGE_POLICY = (
    "default-src 'none'; script-src 'unsafe-inline' 'unsafe-eval'; style-src 'unsafe-inline'; "
    "img-src data: blob:; worker-src blob:; sandbox allow-scripts; frame-ancestors 'self'"
)
"""Policy of a page that Coupole made and that is shown inside a screen: it may load nothing."""


def add_plan_routes(app: FastAPI, service: Service) -> None:
    """Add the route of the drawings that the plan screen has made."""

    @app.get("/drawings/{folder}/{name}", include_in_schema=False)
    def drawing(folder: Text, name: Text) -> Response:
        path = service.plan_files.drawings / folder / name
        if not re.fullmatch(r"[0-9a-f]{16}", folder) or not re.fullmatch(r"[\w.-]+\.(png|html)", name):
            raise InputError("no such drawing")
        if not path.is_file():
            raise InputError("this drawing is gone: draw again")
        return FileResponse(
            path, headers={"Content-Security-Policy": _PAGE_POLICY, "X-Frame-Options": "SAMEORIGIN"}
        )
