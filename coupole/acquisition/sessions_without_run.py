"""Stop of a session that has no run, for other processes of the same user on the same machine.

A commissioning, a metering, a live view, a bench and a drive of the arm have none. An acquisition has none
yet while it reads the plan, makes its preflight and opens devices, which takes seconds, or minutes if a
controller must be started first. In this time a session serves a socket of its own, named after its process; an
acquisition does so until the socket of its run is there (`coupole.acquisition.run_control`)::

    {"version": 1, "command": "stop"}       stop | state
    {"version": 1, "run": "", "plan": "/plans/bust.yaml", "rig": "", "doing": "acquire", "pid": 4711,
     "state": "starting"}

`run` is the run that is resumed; empty for others. `plan` and `rig` are files; empty if there is none, or if it is
not known yet. `doing` is the command, and `state` is `starting`, `working` (all commands but `acquire`) or
`stopping`.
"""

from __future__ import annotations

import contextlib
import os
import signal
from collections.abc import Callable, Iterator
from pathlib import Path

from coupole.acquisition.run_control import VERSION, Command, NoAnswer, State, exchange_command, request_of
from coupole.acquisition.runtime_folder import runtime_folder
from coupole.acquisition.user_socket import Caller, UserSocket
from coupole.errors import InputError, reason

ACQUIRE = "acquire"
_SUFFIX = ".start"


class SessionEnded(InputError):
    """A session has no socket any more: it has ended, or its run has begun."""


class SessionWithoutRun:
    """Serves the socket of a session that has no run, while a context lasts. If this is not possible on a machine,
    nothing is served; a run's own socket then has the same trouble, and says so."""

    def __init__(self, doing: str, plan: Path | None, rig: Path | None, resumed_run: Path | None = None) -> None:
        """`doing` is the command; it has a plan or a rig, or both."""
        self._about: State = {
            "version": VERSION,
            "run": str(resumed_run.resolve()) if resumed_run else "",
            "plan": str(plan.resolve()) if plan else "",
            "rig": str(rig.resolve()) if rig else "",
            "doing": doing,
            "pid": os.getpid(),
        }
        self._state = "starting" if doing == ACQUIRE else "working"
        self._served = contextlib.ExitStack()

    def __enter__(self) -> SessionWithoutRun:
        with contextlib.suppress(OSError, InputError):
            path = runtime_folder() / f"{os.getpid()}{_SUFFIX}"
            self._served.enter_context(UserSocket(path, self._answer))
        return self

    def __exit__(self, *_: object) -> None:
        self.end()

    def end(self) -> None:
        """Serve no more: the run has a socket, or there is none."""
        self._served.close()

    def _answer(self, line: bytes, _: Caller) -> State:
        try:
            command = request_of(line)
        except InputError as error:
            return {"version": VERSION, "error": str(error)}
        if command == "stop":
            self._state = "stopping"
            os.kill(os.getpid(), signal.SIGINT)  # as Ctrl-C, at whatever it is
        elif command != "state":
            has_no_run = "the run has not begun" if self._about["doing"] == ACQUIRE else "this session has no run"
            return {**self._about, "error": f"{command}: {has_no_run}; `coupole stop` ends it"}
        return {**self._about, "state": self._state, "trouble": []}


def sessions_without_run(patience_s: float) -> Iterator[tuple[Path, State]]:
    """Yield sockets and states of all sessions of this user on this machine that have no run. One that does not
    answer within `patience_s` is `silent`: its run and plan are not known."""
    for path in sorted(runtime_folder().glob(f"*{_SUFFIX}")):
        try:
            yield path, exchange_command(path, "state", patience_s)
        except (ConnectionRefusedError, FileNotFoundError):  # of a process that was killed, or has just ended
            continue
        except (OSError, ValueError):
            unknown = {"run": "", "plan": "", "rig": "", "doing": "", "state": "silent"}
            yield path, {"version": VERSION, **unknown, "pid": int(path.stem)}


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
