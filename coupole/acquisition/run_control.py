"""Pause, stop and state of a running acquisition, for other processes of the same user on the same machine.

Whoever acquires serves a Unix socket (`RunControl`), named after its run's folder, in a folder that only this user
can enter; commands and consoles ask it (`ask`, `running`). One connection is one request and one answer, a line of
JSON each::

    {"version": 1, "command": "pause"}      pause | go-on | stop | state
    {"version": 1, "run": "/runs/...", "pid": 4711, "state": "pausing", "view": "top", "proven": 52, ...}

Each request is answered at once, by a thread of its own: `stop` has switched the lights off and commanded the arm
to stop when its answer comes, and what the process still has to do (store, conclude) goes on after it.
"""

from __future__ import annotations

import contextlib
import hashlib
import json
import os
import signal
import socket
import stat
import struct
import tempfile
import threading
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any, Literal

from coupole.acquisition.observer import Control
from coupole.errors import InputError
from coupole.viewing.progress import Progress

VERSION = 1
Command = Literal["pause", "go-on", "stop", "state"]
State = dict[str, Any]
"""`run`, `pid`, `state` (running, pausing, paused, stopping), and from the first burst on those of `Progress`."""
_LONGEST_LINE_BYTES = 4096
_PATIENCE_S = 5.0


def socket_folder() -> Path:
    """Folder of the sockets, made if it is missing: `$XDG_RUNTIME_DIR/coupole`, else one in the folder for
    temporary files. Raises InputError: it is another user's, or others may enter it."""
    base = os.environ.get("XDG_RUNTIME_DIR")
    folder = Path(base) / "coupole" if base else Path(tempfile.gettempdir()) / f"coupole-{os.getuid()}"
    folder.mkdir(mode=0o700, parents=True, exist_ok=True)
    found = folder.stat(follow_symlinks=False)
    if not stat.S_ISDIR(found.st_mode) or found.st_uid != os.getuid() or found.st_mode & 0o077:
        raise InputError(f"{folder}: expected a folder of this user that nobody else may enter (mode 0700)")
    return folder


def _socket_path(run: Path) -> Path:
    return socket_folder() / f"{hashlib.sha256(os.fsencode(run.resolve())).hexdigest()[:24]}.sock"


# -- the side of the acquisition ------------------------------------------------------------------------------


class RunControl:
    """Serves the socket of a run while a context lasts; a machine on which that is not possible does without, and
    `trouble` says why."""

    def __init__(
        self, run: Path, control: Control, halt: Callable[[], object], progress: Callable[[], Progress | None]
    ) -> None:
        """`halt` switches lights off and stops the arm, at once, from any thread; `progress` is the newest."""
        self._run, self._control, self._halt, self._progress = run, control, halt, progress
        self._socket: socket.socket | None = None
        self.trouble = ""

    def __enter__(self) -> RunControl:
        try:
            path = _socket_path(self._run)
            path.unlink(missing_ok=True)  # of a process that was killed: the run's lock is ours
            self._socket = socket.socket(socket.AF_UNIX)
            self._socket.bind(str(path))
            path.chmod(0o600)
            self._socket.listen(8)
        except (OSError, InputError) as error:
            self.trouble = f"`coupole pause` and `coupole stop` will not reach this run: {error}"
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
        state = "pausing" if control.pause.is_set() else "running"
        state = "paused" if control.paused.is_set() else state
        state = "stopping" if control.stop.is_set() else state
        found: State = {"version": VERSION, "run": str(self._run), "pid": os.getpid(), "state": state}
        progress = self._progress()
        return {**found, **(vars(progress) if progress else {})}

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
                self._halt()
            case _:
                return {"version": VERSION, "error": "expected the command pause, go-on, stop or state"}
        return self.state()


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
        return _exchange(_socket_path(run), command)
    except (FileNotFoundError, ConnectionRefusedError) as error:
        raise InputError(f"{run}: no process of this user acquires into this run on this machine") from error
    except (OSError, ValueError) as error:
        raise InputError(f"{run}: the process that acquires into it does not answer: {error}") from error


def running() -> list[State]:
    """States of all acquisitions of this user on this machine, the newest last."""
    return sorted(_running(), key=lambda state: str(Path(state["run"]).name))


def _running() -> Iterator[State]:
    for path in socket_folder().glob("*.sock"):
        try:
            yield _exchange(path, "state")
        except ConnectionRefusedError:  # of a process that was killed
            path.unlink(missing_ok=True)
        except (OSError, ValueError):
            continue


def _exchange(path: Path, command: Command) -> State:
    with socket.socket(socket.AF_UNIX) as connection:
        connection.settimeout(_PATIENCE_S)
        connection.connect(str(path))
        connection.sendall(json.dumps({"version": VERSION, "command": command}).encode() + b"\n")
        found: State = json.loads(_line(connection))
    if "error" in found:
        raise ValueError(found["error"])
    return found
