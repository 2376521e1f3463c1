"""Stop of a session that has no run, for other processes of the same user on the same machine.

A commissioning, a metering, a live view, a bench and a drive of the arm have none. An acquisition has none
yet while it reads the plan, makes its preflight and opens devices, which takes seconds, or minutes if a
controller must be started first; and none any more while its process ends. In this time a session serves a socket
of its own, named after its process; a run has another one (`coupole.acquisition.run_control`)::

    {"version": 1, "command": "stop"}       stop | state
    {"version": 1, "run": "", "plan": "/plans/bust.yaml", "rig": "", "doing": "acquire", "pid": 4711,
     "begun": false, "state": "starting"}

`run` is the run that is acquired or resumed; empty for others. `plan` and `rig` are files; empty if there is none,
or if it is not known yet. `doing` is the command. `begun` is true once the run has its own socket. `state` is
`starting`, `running` (`begun`; only the run's socket stops it), `working` (all commands but `acquire`),
`stopping`, or `done` (nothing here can be stopped).
"""

from __future__ import annotations

import contextlib
import os
import signal
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import ClassVar

from coupole.acquisition.run_control import VERSION, Command, NoAnswer, State, exchange_command, request_of
from coupole.acquisition.runtime_folder import runtime_folder
from coupole.acquisition.user_socket import Caller, UserSocket
from coupole.errors import InputError, Interrupted, reason

ACQUIRE = "acquire"
_SUFFIX = ".start"


_WHY_NOTHING_ELSE = {
    "starting": "the run has not begun; `coupole stop` ends it",
    "working": "this session has no run; `coupole stop` ends it",
    "running": "the run has ended, or ends now",
    "stopping": "it is being stopped",
    "done": "the run has ended",
}
"""Reasons why a session can only be stopped, by its state."""


class SessionEnded(InputError):
    """A session has no socket any more: it has ended, or its run has begun."""


class SessionWithoutRun:
    """Serves the socket of a session that has no run, while a context lasts; after a stop, until the process has
    ended, so that a second stop finds it too. If this is not possible on a machine, nothing is served; a run's own
    socket then has the same trouble, and says so."""

    _stopped_session: ClassVar[SessionWithoutRun | None] = None
    """The session of this process that was stopped, and is still served."""

    def __init__(
        self, doing: str, plan: Path | None, rig: Path | None = None, resumed_run: Path | None = None
    ) -> None:
        """`doing` is the command; it has a plan or a rig, or both."""
        self._about: State = {
            "version": VERSION,
            "run": str(resumed_run.resolve()) if resumed_run else "",
            "plan": str(plan.resolve()) if plan else "",
            "rig": str(rig.resolve()) if rig else "",
            "doing": doing,
            "pid": os.getpid(),
            "begun": False,
        }
        self._state = "starting" if doing == ACQUIRE else "working"
        self._served = contextlib.ExitStack()

    def __enter__(self) -> SessionWithoutRun:
        with contextlib.suppress(OSError, InputError):
            if SessionWithoutRun._stopped_session is not None:
                SessionWithoutRun._stopped_session._served.close()
                SessionWithoutRun._stopped_session = None
            self._served.enter_context(UserSocket(socket_of(os.getpid()), self._answer))
        return self

    def __exit__(self, kind: type[BaseException] | None, *_: object) -> None:
        is_stopped = kind is not None and issubclass(kind, Interrupted) and self._state != "done"
        if self._state == "stopping" or is_stopped:
            self._state, SessionWithoutRun._stopped_session = "stopping", self
        else:
            self._served.close()

    def know(self, plan: Path, rig: Path) -> None:
        """Tell the plan and its rig, now that they are known."""
        self._about |= {"plan": str(plan.resolve()), "rig": str(rig.resolve())}

    def begin_run(self, run: Path) -> bool:
        """Tell that the run has a socket now. Return whether the session was told to stop before, although its
        signal has ended nothing."""
        self._about |= {"run": str(run.resolve()), "begun": True}
        self._pass_on("running")
        return self._state == "stopping"

    def end(self) -> None:
        """Tell that nothing can be stopped here from now on."""
        self._pass_on("done")

    def _pass_on(self, state: str) -> None:
        if self._state != "stopping":
            self._state = state

    def _answer(self, line: bytes, _: Caller) -> State:
        try:
            command = request_of(line)
        except InputError as error:
            return {"version": VERSION, "error": str(error)}
        if command == "stop":
            if self._state in ("starting", "working"):
                self._state = "stopping"
                os.kill(os.getpid(), signal.SIGINT)  # as Ctrl-C, at whatever it is
        elif command != "state":
            return {**self._about, "error": f"{command}: {_WHY_NOTHING_ELSE[self._state]}"}
        return {**self._about, "state": self._state, "trouble": []}


def sessions_without_run(patience_s: float) -> Iterator[tuple[Path, State]]:
    """Yield sockets and states of all other sessions of this user on this machine that can be stopped, or that are
    stopping. A session that does not answer within `patience_s` is `silent`: its run and plan are not known."""
    for path in sorted(runtime_folder().glob(f"*{_SUFFIX}")):
        if path == socket_of(os.getpid()):
            continue
        try:
            state = exchange_command(path, "state", patience_s)
            if state["state"] != "done":
                yield path, state
        except (ConnectionRefusedError, FileNotFoundError):  # of a process that was killed, or has just ended
            if not Path(f"/proc/{path.stem}").exists():
                path.unlink(missing_ok=True)
        except (OSError, ValueError):
            unknown = {"run": "", "plan": "", "rig": "", "doing": "", "state": "silent"}
            yield path, {"version": VERSION, **unknown, "pid": int(path.stem)}


def socket_of(pid: int) -> Path:
    """Return the socket that the session of a process has. Raises InputError, OSError (`runtime_folder`)."""
    return runtime_folder() / f"{pid}{_SUFFIX}"


def name_of(state: State) -> str:
    """Return the command of a session and its run, plan or rig, or its process if these are not known."""
    file = state["run"] or state["plan"] or state.get("rig")
    return f"{state['doing']} {file}" if file else f"process {state['pid']}, which does not answer"


def ask_session(path: Path, state: State, command: Command, say: Callable[[str], object]) -> State:
    """Send a command to the session behind a socket, whose state is known; return its state afterwards. Raises
    SessionEnded, and InputError if the session does not answer, or cannot do this."""
    name = name_of(state)
    try:
        return exchange_command(path, command, say=lambda why: say(f"{name}: no answer yet: {why}"))
    except ValueError as error:
        raise InputError(f"{name}: {error}") from error
    except (FileNotFoundError, ConnectionRefusedError) as error:
        raise SessionEnded(f"{name}: it has just ended") from error
    except (ConnectionResetError, BrokenPipeError) as error:
        if command == "stop":  # it was faster than its answer
            return {**state, "state": "stopping", "trouble": []}
        raise InputError(f"{name}: {reason(error)}") from error
    except OSError as error:
        raise NoAnswer(f"{name}: the process {state['pid']} gives no answer: {reason(error)}") from error
