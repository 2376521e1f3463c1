"""A Unix socket by which processes of one user on one machine ask another process: a line of JSON each way.

One connection is one request and one answer. A thread of its own obeys each request, whatever the others do. Only
the user (and root) can enter the socket's folder, open the socket and get an answer.
"""

from __future__ import annotations

import contextlib
import json
import os
import select
import socket
import struct
import threading
import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from coupole.errors import InputError
from coupole.intake.plain_data import json_of
from coupole.storage.stopped_process import is_stopped

LONGEST_REQUEST_BYTES = 65536
PATIENCE_S = 10.0
_SAID_AFTER_S = 1.5
_MOST_WAITING = 256
"""Number of connections that may wait for a process; a stopped process leaves one waiting for each `coupole
status`."""
_CONNECTS_AGAIN_S = 0.05
_LOOK_EVERY_S = 1.0
"""Pause between looks at the socket's path."""
_LONGEST_ANSWER_BYTES = 16 * 1024**2


class Caller:
    """The other end of a connection, which asks."""

    def __init__(self, connection: socket.socket) -> None:
        self._connection = connection
        self.pid = peer_pid(connection)

    def is_gone(self) -> bool:
        """Tell whether the other end is closed. An end that is open but sends nothing more does not count."""
        poll = select.poll()
        poll.register(self._connection, 0)
        return any(events & (select.POLLHUP | select.POLLERR) for _, events in poll.poll(0))


class UserSocket:
    """Serves a socket at a path while a context lasts. Raises OSError if it cannot."""

    def __init__(self, path: Path, answer: Callable[[bytes, Caller], Mapping[str, Any]]) -> None:
        """`answer` makes the answer to a request's line. It begins nothing for a caller that is gone. If there
        is a file at the path, a killed process left it; the caller knows that this process is not alive.
        """
        self.path, self._answer = path, answer
        self._replacing = threading.Lock()
        self._is_over = False

    def __enter__(self) -> UserSocket:
        self._socket = self._listening()
        self._thread = threading.Thread(target=self._serve, name="user socket", daemon=True)
        self._thread.start()
        return self

    def _listening(self) -> socket.socket:
        """Return a new socket that listens at the path."""
        hidden_path = self.path.with_suffix(".new")
        hidden_path.unlink(missing_ok=True)
        listener = socket.socket(socket.AF_UNIX)
        try:
            listener.bind(str(hidden_path))
            hidden_path.chmod(0o600)
            listener.listen(_MOST_WAITING)
            hidden_path.replace(self.path)
        except BaseException:
            listener.close()
            raise
        return listener

    def __exit__(self, *_: object) -> None:
        with self._replacing:
            self._is_over = True
            with contextlib.suppress(OSError):
                self._socket.shutdown(socket.SHUT_RDWR)  # ends `accept`
        self._thread.join()
        self._socket.close()
        with contextlib.suppress(OSError):  # its folder may be gone, or replaced by a file
            self.path.unlink(missing_ok=True)

    def _serve(self) -> None:
        while True:
            try:
                if not _is_readable(self._socket, _LOOK_EVERY_S):
                    self._replace_if_lost()
                    continue
                connection, _ = self._socket.accept()
            except OSError:
                return
            threading.Thread(target=self._obey, args=(connection,), daemon=True).start()

    def _replace_if_lost(self) -> None:
        """Listen at the path again if somebody removed it, for example a program that cleans /tmp. Otherwise
        `coupole stop` would not find this process."""
        with self._replacing, contextlib.suppress(OSError):
            if self._is_over or os.path.lexists(self.path):
                return
            self.path.parent.mkdir(mode=0o700, exist_ok=True)
            if self.path.parent.stat(follow_symlinks=False).st_uid == os.getuid():
                old_socket, self._socket = self._socket, self._listening()
                old_socket.close()

    def _obey(self, connection: socket.socket) -> None:
        with connection, contextlib.suppress(OSError):
            connection.settimeout(PATIENCE_S)
            if peer_uid(connection) in (os.getuid(), 0):
                line = _line(connection, LONGEST_REQUEST_BYTES)
                answer = self._answer(line, Caller(connection))
                connection.sendall(json.dumps(answer).encode() + b"\n")


def _is_readable(listener: socket.socket, within_s: float) -> bool:
    """Wait for a connection, or for the end of the socket."""
    poll = select.poll()  # takes any file's number
    poll.register(listener, select.POLLIN)
    return bool(poll.poll(1e3 * within_s))


def peer_uid(connection: socket.socket) -> int:
    """The user at the other end."""
    return _peer(connection)[1]


def peer_pid(connection: socket.socket) -> int:
    """Return the process at the other end; for a server, the process that listens."""
    return _peer(connection)[0]


def _peer(connection: socket.socket) -> tuple[int, int, int]:
    """Return process, user and group at the other end; for a server, of the process that listens."""
    credentials = connection.getsockopt(socket.SOL_SOCKET, socket.SO_PEERCRED, struct.calcsize("3i"))
    pid, uid, gid = struct.unpack("3i", credentials)
    return pid, uid, gid


def exchange(
    path: Path,
    request: Mapping[str, Any],
    patience_s: float = PATIENCE_S,
    say: Callable[[str], object] = lambda _: None,
) -> dict[str, Any]:
    """Return the answer to a request. If there is none yet, `say` gets the reason within 2 s. Raises OSError (of
    which ConnectionResetError if the other end closes without an answer), and ValueError for data that are not an
    answer.
    """
    begun_s = time.monotonic()
    with socket.socket(socket.AF_UNIX) as connection:
        connection.settimeout(patience_s)
        _connect(connection, path, patience_s)
        try:
            connection.sendall(json.dumps(request).encode() + b"\n")
            if not select.select([connection], [], [], min(patience_s, _SAID_AFTER_S))[0]:
                say(_silence(_peer(connection)[0], time.monotonic() - begun_s))
                connection.settimeout(max(0.001, begun_s + patience_s - time.monotonic()))
            answer = _line(connection, _LONGEST_ANSWER_BYTES)
        except TimeoutError as error:
            raise TimeoutError(_silence(_peer(connection)[0], patience_s)) from error
    if not answer:
        raise ConnectionResetError("the process has ended without an answer")
    try:
        fields: dict[str, Any] = json_of(answer, str(path), allow_nan=True)
    except InputError as error:
        raise ValueError(str(error)) from error
    return fields


def _connect(connection: socket.socket, path: Path, patience_s: float) -> None:
    """Connect; wait for a place while too many others wait already. Raises OSError, TimeoutError."""
    begun_s = time.monotonic()
    while True:
        try:
            connection.connect(str(path))
        except BlockingIOError as error:  # the queue of the listening process is full
            if time.monotonic() - begun_s > patience_s:
                raise TimeoutError(
                    f"the process behind {path.name} accepts no connection, and {_MOST_WAITING} wait already. It "
                    "is stopped (Ctrl-Z, SIGSTOP) or hangs: `ps -eo pid,stat,args` shows stopped processes by T, "
                    "and `kill -CONT PID` lets a process run again"
                ) from error
            time.sleep(_CONNECTS_AGAIN_S)
        else:
            return


@contextmanager
def told_if_given_up(words: str, say: Callable[[str], object]) -> Iterator[None]:
    """Pass `words` to `say` when a request ends without an answer from a process that exists; without `words`, do
    nothing."""
    try:
        yield
    except (FileNotFoundError, ConnectionRefusedError):
        raise
    except BaseException:
        if words:
            say(words)
        raise


def _silence(pid: int, patience_s: float) -> str:
    """Return why a process does not answer."""
    if is_stopped(pid):
        return (
            f"process {pid} is stopped (Ctrl-Z, SIGSTOP). An arm that moved has braked, and the box's watchdog "
            f"switches lamps off; `kill -CONT {pid}` lets the process run again; a run then asks a person "
            "before it continues"
        )
    return f"nothing within {patience_s:.2g} s from process {pid}"


def _line(connection: socket.socket, longest_bytes: int) -> bytes:
    line = bytearray()
    while b"\n" not in line and len(line) < longest_bytes and (more := connection.recv(65536)):
        line += more
    return bytes(line)
