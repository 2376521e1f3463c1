"""The command line as a client of a cell's service, by its Unix socket."""

from __future__ import annotations

import http.client
import json
import socket
from pathlib import Path
from typing import Any

from coupole.acquisition.runtime_folder import named_after
from coupole.errors import InputError
from coupole.plan.cell import Cell

_PATIENCE_S = 30.0


def service_socket(cell: Cell) -> Path:
    """The Unix socket at which the service of a cell hears the command line."""
    return named_after(cell.document.path, "console")


class _Local(http.client.HTTPConnection):
    def __init__(self, path: str) -> None:
        super().__init__("localhost", timeout=_PATIENCE_S)
        self._path = path

    def connect(self) -> None:
        self.sock = socket.socket(socket.AF_UNIX)
        self.sock.settimeout(self.timeout)
        self.sock.connect(self._path)


def call(cell: Cell, method: str, path: str, asked: dict[str, Any] | None = None) -> Any:
    """What the service answers. Raises InputError: none is there, or it refuses, with its words."""
    connection = _Local(str(service_socket(cell)))
    try:
        body = None if asked is None else json.dumps(asked)
        connection.request(method, path, body, {"Content-Type": "application/json"} if body else {})
        reply = connection.getresponse()
        found = json.loads(reply.read())
    except (FileNotFoundError, ConnectionRefusedError) as error:
        raise InputError(
            f"{cell.document.path}: no console of this cell is served on this machine by this user; "
            f"`coupole serve {cell.document.path}` does"
        ) from error
    except (OSError, ValueError) as error:
        raise InputError(f"{cell.document.path}: its console does not answer: {error}") from error
    finally:
        connection.close()
    if reply.status >= 400:
        raise InputError(str(found.get("detail", found)))
    return found
