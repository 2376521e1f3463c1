"""Stop of a session that has no run yet, for other processes of the same user on the same machine.

Reading the plan, preflight and the opening of devices take seconds, or minutes if a controller must be started
first. In this time a session serves a socket of its own, named after its process, until the socket of its run is
there (`coupole.acquisition.run_control`)::

    {"version": 1, "command": "stop"}       stop | state
    {"version": 1, "run": "", "plan": "/plans/bust.yaml", "pid": 4711, "state": "starting"}

`run` is the run that is resumed; empty for a new one.
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

_SUFFIX = ".start"
_LOOK_PATIENCE_S = 5.0
"""A session that loads its modules on a busy machine answers late."""


class StartingSession:
    """Serves the socket of a session that is starting, while a context lasts. If this is not possible on a
    machine, nothing is served; the run's own socket then has the same trouble, and says so."""

    def __init__(self, plan: Path, resumed_run: Path | None) -> None:
        self._about: State = {
            "version": VERSION,
            "run": str(resumed_run.resolve()) if resumed_run else "",
            "plan": str(plan.resolve()),
            "pid": os.getpid(),
        }
        self._state = "starting"
        self._served = contextlib.ExitStack()

    def __enter__(self) -> StartingSession:
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
            return {**self._about, "error": f"{command}: the run has not begun; `coupole stop` ends it"}
        return {**self._about, "state": self._state, "trouble": []}


def starting() -> Iterator[tuple[Path, State]]:
    """Yield sockets and states of all sessions of this user on this machine that are starting. One that does not
    answer is `silent`: its run and plan are not known."""
    for path in sorted(runtime_folder().glob(f"*{_SUFFIX}")):
        try:
            yield path, exchange_command(path, "state", _LOOK_PATIENCE_S)
        except (ConnectionRefusedError, FileNotFoundError):  # of a process that was killed, or has just ended
            continue
        except (OSError, ValueError):
            yield path, {"version": VERSION, "run": "", "plan": "", "pid": int(path.stem), "state": "silent"}


def name_of(state: State) -> str:
    """Return the run or the plan of a session that is starting, or its process if these are not known."""
    return str(state["run"] or state["plan"] or f"process {state['pid']}, which does not answer")


def ask_starting(path: Path, state: State, command: Command, say: Callable[[str], object]) -> State:
    """Send a command to the session behind a socket, whose state is known; return its state afterwards. Raises
    InputError if the session has ended meanwhile, does not answer, or cannot do this before its run begins."""
    name = name_of(state)
    try:
        return exchange_command(path, command, say=lambda why: say(f"{name}: no answer yet: {why}"))
    except ValueError as error:
        raise InputError(f"{name}: {error}") from error
    except (ConnectionResetError, BrokenPipeError) as error:
        if command == "stop":  # it was faster than its answer
            return {**state, "state": "stopping", "trouble": []}
        raise InputError(f"{name}: {reason(error)}") from error
    except OSError as error:
        raise NoAnswer(
            f"{name}: the process {state['pid']}, which starts it, gives no answer: {reason(error)}"
        ) from error
