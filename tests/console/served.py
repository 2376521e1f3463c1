"""A console that is served, and a client of it that is only the standard library's."""

from __future__ import annotations

import http.client
import json
import ssl
import subprocess
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any
from urllib.parse import urlsplit

import cells
from cells import CellFolder

BORROWER = """
import sys, time
from pathlib import Path
from coupole.console.command_line.client import borrowed_cell
from coupole.plan.cell import read_cell
with borrowed_cell(read_cell(Path(sys.argv[1])), "look at the focus"):
    print("mine", flush=True)
    time.sleep(600)
"""
"""A process that borrows the cell of a rig until it is ended."""


@dataclass
class Reply:
    """What a console answers."""

    status: int
    headers: http.client.HTTPMessage
    text: str

    @property
    def document(self) -> Any:
        return json.loads(self.text)


@dataclass
class Browser:
    """Somebody at a console: keeps the cookie, and takes a fresh token for each request that changes something."""

    url: str
    cookie: str = ""
    headers: dict[str, str] = field(default_factory=dict)
    trusted: ssl.SSLContext | None = None
    """For a console with TLS."""
    address: str | None = None
    """From which to connect."""

    def ask(self, method: str, path: str, body: Any = None, **headers: str) -> Reply:
        place = urlsplit(self.url)
        from_here = {"timeout": cells.PATIENCE_S, "source_address": self.address and (self.address, 0)}
        connection = (
            http.client.HTTPConnection(place.hostname or "", place.port, **from_here)
            if place.scheme == "http"
            else http.client.HTTPSConnection(place.hostname or "", place.port, **from_here, context=self.trusted)
        )
        sent = {**({"Cookie": self.cookie} if self.cookie else {}), **self.headers, **headers}
        data = None if body is None else json.dumps(body)
        connection.request(method, path, data, {"Content-Type": "application/json", **sent})
        reply = connection.getresponse()
        text = reply.read().decode()
        if cookie := reply.headers.get("Set-Cookie", ""):
            self.cookie = cookie.split(";")[0]
        connection.close()
        return Reply(reply.status, reply.headers, text)

    def get(self, path: str, **headers: str) -> Reply:
        return self.ask("GET", path, **headers)

    def token(self) -> str:
        found: str = self.get("/api/v1/token").document["token"]
        return found

    def post(self, path: str, body: Any = None, method: str = "POST") -> Reply:
        return self.ask(method, path, body, **{"X-Coupole-Token": self.token()})

    def sign_in(self, **who: Any) -> Reply:
        return self.ask("POST", "/api/v1/sign-in", who)

    def state(self) -> dict[str, Any]:
        found: dict[str, Any] = self.get("/api/v1/state").document
        return found


@dataclass
class Served:
    """A service as a process."""

    process: subprocess.Popen[str]
    url: str
    token: str

    def browser(self, **who: Any) -> Browser:
        """Somebody who has signed in, if it is said who."""
        found = Browser(self.url)
        if who:
            assert found.sign_in(**who).status == 200
        return found


@contextmanager
def served(cell: CellFolder, *options: str | Path) -> Iterator[Served]:
    """The console of a cell, until the context ends. Whatever it has begun goes on."""
    process = cells.start("serve", cell.rig, "--port", "0", "--json", "--plans", cell.folder, *options)
    assert process.stdout is not None
    line = process.stdout.readline()
    assert line, cells.finish(process).err
    told = json.loads(line)
    assert told["pid"] == process.pid
    try:
        yield Served(process, told["url"], told["token"])
    finally:
        process.terminate()
        cells.finish(process)
