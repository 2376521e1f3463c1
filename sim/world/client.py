"""Starts a simulated world as a child process, or joins one that is already running."""

from __future__ import annotations

import json
import select
import socket
import subprocess
import sys
from pathlib import Path
from typing import IO, Any

from coupole.errors import DeviceLost, DeviceTimeout
from sim.world.clock import SharedClock
from sim.world.config import Config, Settings

__all__ = ["Config", "Settings", "World"]

_START_TIMEOUT_S = 900.0
"""Time-out for the start. At its first start on a machine a world compiles its code, which takes a minute or two,
or many minutes on a busy machine."""
_ANSWER_TIMEOUT_S = 180.0
_STOP_TIMEOUT_S = 5.0


class World:
    """A running world: its clock, its endpoints, and a control connection."""

    def __init__(self, endpoints: dict[str, Any], process: subprocess.Popen[str] | None = None) -> None:
        self.endpoints = endpoints
        self.clock = SharedClock(Path(endpoints["clock"]["path"]))
        self._process = process

    @staticmethod
    def start(config: dict[str, Any]) -> World:
        """Start a world for this process; it ends together with this process.

        `config` is the JSON form of `Config`. Raises DeviceError if the world does not start.
        """
        line = Config.model_validate(config).model_dump_json()
        process = _launch()
        assert process.stdin is not None
        assert process.stdout is not None
        process.stdin.write(line + "\n")
        process.stdin.flush()
        try:
            return World(_first_line(process.stdout), process)
        except BaseException:
            process.kill()
            process.wait()
            process.stdin.close()
            process.stdout.close()
            raise

    @staticmethod
    def join(path: Path) -> World:
        """Join the world whose `coupole sim` wrote its JSON line to `path`."""
        try:
            endpoints = json.loads(path.read_text().splitlines()[0])
            return World(endpoints)
        except (OSError, IndexError, json.JSONDecodeError) as error:
            raise DeviceLost(
                "world",
                expected=f"the JSON line of a running `coupole sim` in {path}",
                happened=str(error),
                remedy="Start it with `coupole sim RIG > FILE`.",
            ) from error

    def ask(self, do: str, **arguments: Any) -> dict[str, Any]:
        """Send a command on the control connection: `state`, `light`, `fault`, `exposures`, `edges`, `reset_robot`
        or `stop`."""
        with socket.socket(socket.AF_UNIX, socket.SOCK_SEQPACKET) as link:
            link.settimeout(_ANSWER_TIMEOUT_S)
            try:
                link.connect(self.endpoints["control"]["address"])
                link.send(json.dumps({"do": do, **arguments}).encode())
                reply: dict[str, Any] = json.loads(link.recv(65536) or b'{"error": "the world hung up"}')
            except OSError as error:
                raise DeviceLost(
                    "world", expected=f"an answer to `{do}`", happened=str(error), remedy="Restart it."
                ) from error
        return reply

    def close(self) -> None:
        """End the world if this process started it."""
        if self._process is None:
            return
        assert self._process.stdin is not None
        assert self._process.stdout is not None
        self._process.stdin.close()
        try:
            self._process.wait(_STOP_TIMEOUT_S)
        except subprocess.TimeoutExpired:
            self._process.kill()
            self._process.wait()
        self._process.stdout.close()

    def wait(self) -> None:
        """Wait until the world ends. Raises DeviceLost if it ended without a command."""
        assert self._process is not None
        if code := self._process.wait():
            how = f"was killed by signal {-code}" if code < 0 else f"ended with code {code}"
            raise DeviceLost(
                "world",
                expected="the stand-ins to serve until they are told to stop",
                happened=f"their process {how}",
                remedy="See its message above; start it again.",
            )


def _launch() -> subprocess.Popen[str]:
    """Launch a world that waits for its configuration."""
    return subprocess.Popen(
        [sys.executable, "-m", "sim.world.world"],
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        text=True,
        start_new_session=True,
    )


def _first_line(stream: IO[str]) -> dict[str, Any]:
    if not select.select([stream], [], [], _START_TIMEOUT_S)[0]:
        raise DeviceTimeout(
            "world",
            expected=f"endpoints within {_START_TIMEOUT_S:g} s",
            happened="none came",
            remedy="Run `coupole sim RIG` to see its messages.",
        )
    line = stream.readline()
    if not line:
        raise DeviceLost(
            "world",
            expected="endpoints",
            happened="the world ended at its start",
            remedy="See its message above.",
        )
    endpoints: dict[str, Any] = json.loads(line)
    return endpoints
