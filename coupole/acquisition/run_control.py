"""Pause, stop and state of a running acquisition, for other processes of the same user on the same machine.

Whoever acquires serves a Unix socket (`RunControl`), named after its run's folder, in a folder that only this user
can enter; commands and consoles ask it (`ask`, `running`). One connection is one request and one answer, a line of
JSON each::

    {"version": 1, "command": "pause"}      pause | go-on | stop | state
    {"version": 1, "run": "/runs/...", "pid": 4711, "state": "pausing", "view": "top", "proven": 52, ...}

Each request is answered by a thread of its own, whatever the others do. `stop` is answered when the lights are off
and the arm was told to stop, or after 4 s with what is not sure (`trouble`); what the process still has to do
(store, conclude) goes on after that.
"""

from __future__ import annotations

import contextlib
import json
import os
import signal
import socket
import struct
import threading
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from types import MappingProxyType
from typing import Any, Literal

from coupole.acquisition.observer import Control
from coupole.acquisition.opened_cell import Safeguard
from coupole.acquisition.runtime_folder import named_after, runtime_folder
from coupole.errors import InputError, reason
from coupole.viewing.progress import Progress

VERSION = 1
Command = Literal["pause", "go-on", "stop", "state"]
State = dict[str, Any]
"""`run`, `rig`, `pid`, `light_after_lux_h`, `state` (running, pausing, paused, stopping); from the first burst on
`Progress` too."""
_LONGEST_LINE_BYTES = 65536
_SAFE_WITHIN_S, _PATIENCE_S = 4.0, 10.0


# -- the side of the acquisition ------------------------------------------------------------------------------


class RunControl:
    """Serves the socket of a run while a context lasts; a machine on which that is not possible does without, and
    `trouble` says why."""

    def __init__(
        self,
        run: Path,
        rig: Path,
        control: Control,
        halt: Callable[[], Sequence[Safeguard]],
        progress: Callable[[], Progress | None],
        light_after_lux_h: Mapping[str, float] = MappingProxyType({}),
    ) -> None:
        """`halt` switches lights off and stops the arm, at once, from any thread; `progress` is the newest;
        `light_after_lux_h` is all light of the object (by its id) when the run is complete, by its preflight."""
        self._about: State = {"version": VERSION, "run": str(run), "rig": str(rig.resolve()), "pid": os.getpid()}
        self._about["light_after_lux_h"] = dict(light_after_lux_h)
        self._run, self._control, self._halt, self._progress = run, control, halt, progress
        self._socket: socket.socket | None = None
        self.trouble = ""

    def __enter__(self) -> RunControl:
        try:
            path = named_after(self._run, "sock")
            hidden = path.with_suffix(".new")
            hidden.unlink(missing_ok=True)  # of a process that was killed: the run's lock is ours
            self._socket = socket.socket(socket.AF_UNIX)
            self._socket.bind(str(hidden))
            hidden.chmod(0o600)
            self._socket.listen(8)
            hidden.replace(path)
        except (OSError, InputError) as error:
            self.trouble = f"`coupole pause` and `coupole stop` will not reach this run: {reason(error)}"
            self._close()
            return self
        self._path = path
        self._thread = threading.Thread(target=self._serve, name="run control", daemon=True)
        self._thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        if self._socket is None:
            return
        with contextlib.suppress(OSError):
            self._socket.shutdown(socket.SHUT_RDWR)  # ends `accept`
        self._thread.join()
        self._close()
        self._path.unlink(missing_ok=True)

    def _close(self) -> None:
        if self._socket is not None:
            self._socket.close()
            self._socket = None

    def state(self) -> State:
        """What is answered to every request."""
        control = self._control
        state = "running"
        if control.pause.is_set():
            state = "paused" if control.paused.is_set() else "pausing"
        state = "stopping" if control.stop.is_set() else state
        progress = self._progress()
        return {**self._about, "state": state, **(vars(progress) if progress else {})}

    def _serve(self) -> None:
        while True:
            assert self._socket is not None
            try:
                connection, _ = self._socket.accept()
            except OSError:
                return
            threading.Thread(target=self._obey, args=(connection,), daemon=True).start()

    def _obey(self, connection: socket.socket) -> None:
        with connection, contextlib.suppress(OSError):
            connection.settimeout(_PATIENCE_S)
            if _peer_uid(connection) in (os.getuid(), 0):
                answer = self._answer(_line(connection))
                connection.sendall(json.dumps(answer).encode() + b"\n")

    def _answer(self, line: bytes) -> State:
        try:
            request = json.loads(line)
            version, command = request["version"], request["command"]
        except (ValueError, TypeError, KeyError):
            return {"version": VERSION, "error": "expected one line of JSON with `version` and `command`"}
        if version != VERSION:
            return {"version": VERSION, "error": f"expected version {VERSION}, found {version!r}"}
        match command:
            case "state":
                pass
            case "pause":
                self._control.pause.set()
            case "go-on":
                self._control.pause.clear()
            case "stop":
                self._control.stop_by(signal.SIGINT)
                return {**self.state(), "trouble": _trouble(self._halt())}
            case _:
                return {"version": VERSION, "error": "expected the command pause, go-on, stop or state"}
        return self.state()


def _trouble(done: Sequence[Safeguard]) -> list[str]:
    """What is not sure to be done of it after a while."""
    end_s = time.monotonic() + _SAFE_WITHIN_S
    for safeguard in done:
        safeguard.wait(max(0.0, end_s - time.monotonic()))
    return [f"not sure: {safeguard.what}: {safeguard.trouble}" for safeguard in done if safeguard.trouble]


def _peer_uid(connection: socket.socket) -> int:
    credentials = connection.getsockopt(socket.SOL_SOCKET, socket.SO_PEERCRED, struct.calcsize("3i"))
    return int(struct.unpack("3i", credentials)[1])


def _line(connection: socket.socket) -> bytes:
    found = b""
    while b"\n" not in found and len(found) < _LONGEST_LINE_BYTES and (more := connection.recv(4096)):
        found += more
    return found


# -- the side of whoever asks ---------------------------------------------------------------------------------


def ask(run: Path, command: Command) -> State:
    """Send a command to the process that acquires into `run`; its state after it.

    Raises InputError: none does, on this machine and by this user, or it does not answer.
    """
    try:
        return _exchange(named_after(run, "sock"), command)
    except (FileNotFoundError, ConnectionRefusedError) as error:
        raise InputError(f"{run}: no process of this user acquires into this run on this machine") from error
    except (OSError, ValueError) as error:
        raise InputError(f"{run}: the process that acquires into it does not answer: {reason(error)}") from error


def running() -> list[State]:
    """States of all acquisitions of this user on this machine, the newest last; one that does not answer is
    `silent`."""
    return sorted(_running(), key=lambda state: str(Path(state["run"]).name))


def _running() -> Iterator[State]:
    for path in runtime_folder().glob("*.sock"):
        try:
            yield _exchange(path, "state")
        except (ConnectionRefusedError, FileNotFoundError):  # of a process that was killed, or has just ended
            continue
        except (OSError, ValueError) as error:
            yield {"version": VERSION, "run": "", "rig": "", "pid": 0, "state": "silent", "trouble": [str(error)]}


def _exchange(path: Path, command: Command) -> State:
    with socket.socket(socket.AF_UNIX) as connection:
        connection.settimeout(_PATIENCE_S)
        connection.connect(str(path))
        connection.sendall(json.dumps({"version": VERSION, "command": command}).encode() + b"\n")
        found: State = json.loads(_line(connection))
    if "error" in found:
        raise ValueError(found["error"])
    return found
