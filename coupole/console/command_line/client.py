"""The command line as a client of a cell's service, by its Unix socket."""

from __future__ import annotations

import contextlib
import http.client
import json
import select
import socket
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

from coupole.acquisition.runtime_folder import named_after
from coupole.acquisition.sessions_without_run import SessionWithoutRun
from coupole.acquisition.user_socket import peer_pid
from coupole.console.command_line.owner import owner_of
from coupole.console.people.still_wanted import begins_nothing
from coupole.errors import InputError
from coupole.intake.plain_data import json_of
from coupole.plan.cell import Cell
from coupole.storage.stopped_process import is_stopped
from coupole.viewing.terminal import alarm

_PATIENCE_S = 30.0
_SAID_AFTER_S, _PROBED_EVERY_S, _LOOK_EVERY_S = 1.5, 5.0, 0.1
PREFLIGHT_S = 1800.0
"""Longest wait, s, for the preflight of a plan that is entered."""


class NotServed(InputError):
    """No console of the cell is served on this machine by this user."""


class NoAnswer(InputError):
    """The console does not answer, or has ended without an answer."""


class GivenUp(InputError):
    """The caller no longer waits for an answer."""


def service_socket(cell: Cell) -> Path:
    """Return the Unix socket at which the service of a cell accepts commands."""
    return named_after(cell.document.path, "console")


class _Local(http.client.HTTPConnection):
    def __init__(self, path: str, patience_s: float) -> None:
        super().__init__("localhost", timeout=patience_s)
        self._path = path

    def connect(self) -> None:
        self.sock = socket.socket(socket.AF_UNIX)
        self.sock.settimeout(self.timeout)
        self.sock.connect(self._path)


def _never() -> bool:
    return False


def call(
    cell: Cell,
    method: str,
    path: str,
    request: dict[str, Any] | None = None,
    *,
    patience_s: float = _PATIENCE_S,
    given_up: Callable[[], bool] = _never,
    meanwhile: str = "",
) -> Any:
    """Send a request and return the service's answer. If there is no answer within 2 s, a message on standard
    error says so, and what happens `meanwhile`.

    Raises NotServed; GivenUp; NoAnswer; InputError with the service's words if it refuses.
    """
    rig, end_s = cell.document.path, time.monotonic() + patience_s
    place = _place(cell)
    connection = _Local(place, patience_s)
    try:
        body = None if request is None else json.dumps(request)
        _connect(cell, connection, end_s, given_up)
        connection.request(method, path, body, {"Content-Type": "application/json"} if body else {})
        with _told_if_given_up(rig, begins_nothing(method, path)):
            _await(connection.sock, place, rig, end_s, given_up, meanwhile)
        reply = connection.getresponse()
        answer = json_of(reply.read(), "its answer", allow_nan=True)
    except (NotServed, GivenUp):
        raise
    except (OSError, ValueError, InputError) as error:
        raise NoAnswer(f"{rig}: its console does not answer: {error}") from error
    finally:
        connection.close()
    if reply.status >= 400:
        raise _refusal(answer)
    return answer


def _refusal(answer: dict[str, Any]) -> InputError:
    """Return an error with the service's words, and with the exit code that the refusal has without a console."""
    error = InputError(str(answer.get("detail", answer)))
    error.exit_code = answer.get("exit_code", InputError.exit_code)
    return error


def _place(cell: Cell) -> str:
    try:
        return str(service_socket(cell))
    except (OSError, InputError) as error:
        raise NotServed(f"{cell.document.path}: no console can be served here: {error}") from error


def _connect(cell: Cell, connection: _Local, end_s: float, given_up: Callable[[], bool]) -> None:
    """Connect; wait for a console that has the cell but does not listen yet. Raises NotServed if no console has
    it."""
    rig, begun_s, has_spoken = cell.document.path, time.monotonic(), False
    while True:
        try:
            connection.connect()
        except (FileNotFoundError, ConnectionRefusedError) as error:
            owner = owner_of(cell)
            if owner is None:
                raise NotServed(
                    f"{rig}: this user serves no console of this cell on this machine; `coupole serve {rig}` "
                    "starts one"
                ) from error
            if time.monotonic() > end_s:
                raise InputError(
                    f"process {owner} has this cell, but does not listen under the name of {rig}: if it serves "
                    "another rig, name that rig"
                ) from error
            if not has_spoken and time.monotonic() - begun_s > _SAID_AFTER_S:
                has_spoken = True
                alarm(
                    f"{rig}: a console has this cell, but does not listen under this rig's name: "
                    f"{_state_of(owner)}. It may be starting, or it may serve another rig with the same storage "
                    "folder; waiting for it"
                )
        else:
            return
        if given_up():
            raise GivenUp(f"{rig}: given up")
        time.sleep(_LOOK_EVERY_S)


def _await(
    sock: socket.socket, place: str, rig: Path, end_s: float, given_up: Callable[[], bool], meanwhile: str
) -> None:
    """Wait for an answer. Raises TimeoutError, GivenUp."""
    pid, begun_s, probed_s, has_spoken = peer_pid(sock), time.monotonic(), 0.0, False
    while not select.select([sock], [], [], _LOOK_EVERY_S)[0]:
        now_s = time.monotonic()
        if given_up():
            raise GivenUp(f"{rig}: given up")
        if now_s > end_s:
            raise TimeoutError(_state_of(pid))
        if has_spoken or now_s - begun_s < _SAID_AFTER_S:
            continue
        silent = is_stopped(pid)
        if not silent and now_s - probed_s > _PROBED_EVERY_S:
            probed_s, silent = now_s, not _answers(place)
        if silent:
            has_spoken = True
            alarm(f"{rig}: its console does not answer: {_state_of(pid)}; waiting for it{meanwhile}")


def _answers(place: str) -> bool:
    """Tell whether a console answers at all: while it makes a preflight, it still answers other requests."""
    probe = _Local(place, _LOOK_EVERY_S * 4)
    try:
        probe.request("GET", "/api/v1/token")
        return probe.getresponse().status > 0
    except (OSError, http.client.HTTPException):
        return False
    finally:
        probe.close()


def _state_of(pid: int) -> str:
    if is_stopped(pid):
        return f"process {pid} is stopped (Ctrl-Z, SIGSTOP); `kill -CONT {pid}` lets it run again"
    return f"process {pid} runs, but gives no answer"


@contextlib.contextmanager
def _told_if_given_up(rig: Path, counts_anyway: bool) -> Iterator[None]:
    """Print what happens to a request if the caller stops waiting for its answer."""
    try:
        yield
    except BaseException:
        if not counts_anyway:
            alarm(
                f"{rig}: stopped waiting for an answer: the console will not carry out the request, unless the "
                f"console had begun it before it stopped answering; `coupole queue {rig}` "
                f"shows what is in its queue"
            )
        raise


def is_served(cell: Cell) -> bool:
    """Tell whether a console of this user on this machine owns the cell. Raises InputError if it does not
    answer."""
    try:
        call(cell, "GET", "/api/v1/state")
    except NotServed:
        return False
    return True


def ask_permission(cell: Cell, action: str) -> int:
    """Ask the cell's console whether this process may act with devices that are open already; without a console,
    no permission is needed. Return the number of times that somebody came into control until now. Raises
    InputError if another person is in control, or if the console does not answer."""
    with contextlib.suppress(NotServed):
        return int(call(cell, "POST", "/api/v1/bench/permission", {"action": action})["taken_count"])
    return 0


@contextlib.contextmanager
def borrowed_cell(cell: Cell, purpose: str, plan: Path | None = None) -> Iterator[None]:
    """Borrow the cell from its console for the `purpose` of this process; without a console, the cell needs no
    loan. Meanwhile `coupole stop`, perhaps with the `plan` or the rig, ends this process as Ctrl-C does. Raises
    InputError if a run is being acquired, or if another person is in control or has the cell."""
    with SessionWithoutRun(purpose, plan, cell.document.path), _loan(cell, purpose):
        yield


@contextlib.contextmanager
def _loan(cell: Cell, purpose: str) -> Iterator[None]:
    try:
        call(cell, "POST", "/api/v1/cell/lease", {"what": purpose})
    except NotServed:
        yield
        return
    try:
        yield
    finally:
        with contextlib.suppress(InputError):  # the loan ends with this process in any case
            call(cell, "DELETE", "/api/v1/cell/lease")
