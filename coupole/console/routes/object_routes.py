"""Photographs of objects, over HTTP."""

from __future__ import annotations

from typing import Annotated

from fastapi import Body, FastAPI
from fastapi.responses import FileResponse, Response

from coupole.console.people.accounts import Role
from coupole.console.people.asking import REFUSALS, Who
from coupole.console.people.permission import allow
from coupole.console.routes.messages import Text
from coupole.console.service_parts import Service
from coupole.errors import InputError


def add_object_routes(app: FastAPI, service: Service) -> None:
    """Add the routes of the object screen."""

    @app.get("/api/v1/objects")
    def objects() -> list[str]:
        """Return the ids of all objects that a plan, a run or a ledger names."""
        return service.objects.ids()

    @app.get("/api/v1/objects/{object_id}/photograph", response_class=Response)
    def photograph(object_id: Text) -> Response:
        """Return the photograph of an object as JPEG."""
        if (path := service.objects.photograph(object_id)) is None:
            raise InputError(f"{object_id}: there is no photograph")
        return FileResponse(path, media_type="image/jpeg")

    @app.put("/api/v1/objects/{object_id}/photograph", responses=REFUSALS)
    def keep(
        object_id: Text, picture: Annotated[bytes, Body(media_type="application/octet-stream")], person: Who
    ) -> dict[str, str]:
        """Store a picture (JPEG, PNG or TIFF, at most 20 MB) and replace the former one."""
        allow(service, person, Role.OPERATOR, "photograph")
        service.objects.keep_photograph(object_id, picture)
        return {"object": object_id}
