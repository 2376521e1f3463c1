"""The command line as a client of a cell's service, by its Unix socket."""

from __future__ import annotations

import contextlib
import http.client
import json
import socket
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from coupole.acquisition.runtime_folder import named_after
from coupole.errors import InputError
from coupole.intake.plain_data import json_of
from coupole.plan.cell import Cell

_PATIENCE_S = 30.0
PREFLIGHT_S = 1800.0
"""Patience with the preflight of a plan that is entered."""


class NotServed(InputError):
    """No console of the cell is served on this machine by this user."""


def service_socket(cell: Cell) -> Path:
    """The Unix socket at which the service of a cell hears the command line."""
    return named_after(cell.document.path, "console")


class _Local(http.client.HTTPConnection):
    def __init__(self, path: str, patience_s: float) -> None:
        super().__init__("localhost", timeout=patience_s)
        self._path = path

    def connect(self) -> None:
        self.sock = socket.socket(socket.AF_UNIX)
        self.sock.settimeout(self.timeout)
        self.sock.connect(self._path)


def call(
    cell: Cell, method: str, path: str, asked: dict[str, Any] | None = None, *, patience_s: float = _PATIENCE_S
) -> Any:
    """What the service answers. Raises NotServed; InputError: it refuses, with its words, or does not answer."""
    try:
        place = str(service_socket(cell))
    except (OSError, InputError) as error:
        raise NotServed(f"{cell.document.path}: no console can be served here: {error}") from error
    connection = _Local(place, patience_s)
    try:
        body = None if asked is None else json.dumps(asked)
        connection.request(method, path, body, {"Content-Type": "application/json"} if body else {})
        reply = connection.getresponse()
        found = json_of(reply.read(), "its answer", allow_nan=True)
    except (FileNotFoundError, ConnectionRefusedError) as error:
        raise NotServed(
            f"{cell.document.path}: no console of this cell is served on this machine by this user; "
            f"`coupole serve {cell.document.path}` does"
        ) from error
    except (OSError, ValueError, InputError) as error:
        raise InputError(f"{cell.document.path}: its console does not answer: {error}") from error
    finally:
        connection.close()
    if reply.status >= 400:
        raise InputError(str(found.get("detail", found)))
    return found


def is_served(cell: Cell) -> bool:
    """Whether a console of this user on this machine owns the cell. Raises InputError: it does not answer."""
    try:
        call(cell, "GET", "/api/v1/state")
    except NotServed:
        return False
    return True


@contextlib.contextmanager
def borrowed(cell: Cell, what: str) -> Iterator[None]:
    """The cell for `what` this process does, lent by its console; where none is served nobody is asked. Raises
    InputError: a run is at work, somebody else is in control, or has it."""
    try:
        call(cell, "POST", "/api/v1/cell/lease", {"what": what})
    except NotServed:
        yield
        return
    try:
        yield
    finally:
        with contextlib.suppress(InputError):  # it ends with this process anyhow
            call(cell, "DELETE", "/api/v1/cell/lease")
