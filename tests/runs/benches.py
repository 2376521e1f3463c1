"""A bench as a process of its own, and clients that know nothing but its words."""

from __future__ import annotations

import json
import signal
import socket
import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import cells

HERE = "127.0.0.1"
"""The console at the cell."""


class Bench:
    """A bench's socket and process."""

    def __init__(self, process: subprocess.Popen[str], path: Path) -> None:
        self.process, self.path = process, path

    def ask(self, command: str, **fields: Any) -> dict[str, Any]:
        return self.say(json.dumps({"version": 1, "command": command, **fields}).encode())

    def say(self, line: bytes) -> dict[str, Any]:
        with socket.socket(socket.AF_UNIX) as connection:
            connection.settimeout(cells.PATIENCE_S)
            connection.connect(str(self.path))
            connection.sendall(line + b"\n")
            found: dict[str, Any] = json.loads(connection.makefile().readline())
        return found

    def done(self, command: str, **fields: Any) -> dict[str, Any]:
        """The answer of what must be obeyed."""
        found = self.ask(command, **fields)
        assert "error" not in found, found["error"]
        return found

    def ended_work(self) -> dict[str, Any]:
        """The last work, once it has ended."""
        found: dict[str, Any] = cells.wait_until(
            lambda: (work := self.done("state")["work"])["state"] != "running" and work, "the end of the work"
        )
        return found

    def drive(self, to: Any) -> dict[str, Any]:
        if self.done("state")["work"] is not None:
            self.ended_work()
        path = self.done("plan_path", to=to)
        self.done("drive", path=path["path"])
        assert self.ended_work()["state"] == "done"
        return path


def begun(rig: Path, *options: str | Path) -> Bench:
    process = cells.start("bench", rig, "--yes", "--json", *options, stderr=subprocess.DEVNULL)
    assert process.stdout is not None
    line = process.stdout.readline()
    assert line, f"no bench; exit code {process.wait()}"
    return Bench(process, Path(json.loads(line)["socket"]))


@contextmanager
def bench(rig: Path, *options: str | Path) -> Iterator[Bench]:
    found = begun(rig, *options)
    try:
        yield found
    finally:
        found.process.send_signal(signal.SIGINT)
        cells.finish(found.process)


ASKS = """
import json, socket, sys
with socket.socket(socket.AF_UNIX) as connection:
    connection.connect(sys.argv[1])
    request = {"version": 1, "command": "frame", **json.loads(sys.argv[2])}
    connection.sendall(json.dumps(request).encode() + b"\\n")
    connection.makefile().readline()
"""
"""A client that asks for a picture: the socket's path, the fields."""
_HOLDING = """
import json, socket, sys, time
path, fields = sys.argv[1], json.loads(sys.argv[2])
hold = None
while True:
    with socket.socket(socket.AF_UNIX) as connection:
        connection.connect(path)
        request = {"version": 1, "command": "jog", **fields, **({"hold": hold} if hold else {})}
        connection.sendall(json.dumps(request).encode() + b"\\n")
        work = json.loads(connection.makefile().readline())
    hold = work.get("hold")
    print(json.dumps(work), flush=True)
    if "error" in work:
        break
    if work.get("state") != "running":
        if not work.get("ended", "").startswith("it was not renewed"):
            break
        hold = None  # a busy machine was late: pressed anew
    time.sleep(0.1)
"""


@contextmanager
def holding(bench: Bench, axis: str, direction: int, **fields: Any) -> Iterator[subprocess.Popen[str]]:
    """A console, as a process, whose user holds a button, and presses it anew where a busy machine was too late to
    renew it; it ends when its hold has for another reason."""
    told = json.dumps({"axis": axis, "direction": direction, "from": HERE, **fields})
    command = [sys.executable, "-c", _HOLDING, str(bench.path), told]
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as console:
        try:
            yield console
        finally:
            console.kill()
