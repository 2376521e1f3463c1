"""Pause, stop and state of a running acquisition, for other processes of the same user on the same machine.

The process that acquires serves a Unix socket (`RunControl`). The socket is named after the run's folder, and lies
in a folder that only this user can enter (`user_socket`). Commands and consoles ask it (`ask`, `running`)::

    {"version": 1, "command": "pause"}      pause | go-on | stop | state
    {"version": 1, "run": "/runs/...", "pid": 4711, "state": "pausing", "view": "top", "proven": 52, ...}

`stop` is answered when the lights are off and the arm was told to stop. After 4 s it is answered in any case, with
the devices that are perhaps not safe (`trouble`). After the answer the process still stores and concludes.
"""

from __future__ import annotations

import contextlib
import os
import signal
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from types import MappingProxyType
from typing import TYPE_CHECKING, Any, Literal, NamedTuple

from coupole.acquisition.observer import Control
from coupole.acquisition.runtime_folder import named_after, runtime_folder
from coupole.acquisition.safeguard import Safeguard, unsure
from coupole.acquisition.user_socket import PATIENCE_S, Caller, UserSocket, exchange, told_if_given_up
from coupole.errors import InputError, reason
from coupole.intake.plain_data import json_of

if TYPE_CHECKING:
    from coupole.viewing.progress import Progress

VERSION = 1
Command = Literal["pause", "go-on", "stop", "state"]
State = dict[str, Any]
"""`run`, `plan`, `rig`, `pid`, `light_after_lux_h`, `state` (running, pausing, paused, stopping). From the first
burst on it also has the fields of `Progress`."""
_SAFE_WITHIN_S = 4.0
_UNHEARD = "the process did not run for a while, and is making the cell safe; when the cell is safe, ask again"
_LOOK_PATIENCE_S = 0.5


# -- the side of the acquisition ------------------------------------------------------------------------------


class RunPaths(NamedTuple):
    """Paths by which a run is named."""

    run: Path
    """Its folder."""
    plan: Path
    rig: Path


class RunControl:
    """Serves the socket of a run while a context lasts. If this is not possible on a machine, the run goes on
    without a socket, and `trouble` says why."""

    def __init__(
        self,
        paths: RunPaths,
        control: Control,
        halt: Callable[[], Sequence[Safeguard]],
        progress: Callable[[], Progress | None],
        light_after_lux_h: Mapping[str, float] = MappingProxyType({}),
        when_served: Callable[[Path], bool] = lambda _: False,
    ) -> None:
        """`halt` switches the lights off and stops the arm, at once, from any thread. `progress` is the newest
        progress. `light_after_lux_h` is the total light of each object (by its id) when the run is complete, as
        preflight expects it. `when_served` is called with the run when the socket is there, or cannot be. It
        returns whether the session was told to stop before."""
        self._when_served = when_served
        files = {"plan": str(paths.plan.resolve()), "rig": str(paths.rig.resolve())}
        self._about: State = {"version": VERSION, "run": str(paths.run), **files, "pid": os.getpid()}
        self._about["light_after_lux_h"] = dict(light_after_lux_h)
        self._run, self._control, self._halt, self._progress = paths.run, control, halt, progress
        self.trouble = ""

    def __enter__(self) -> RunControl:
        stack = contextlib.ExitStack()
        try:
            stack.enter_context(UserSocket(named_after(self._run, "sock"), self._answer))
        except (OSError, InputError) as error:
            self.trouble = f"`coupole pause` and `coupole stop` will not reach this run: {reason(error)}"
        self._served = stack
        if self._when_served(self._run):
            self._control.stop_by(signal.SIGINT, "`coupole stop`, or the console")
        return self

    def __exit__(self, *_: object) -> None:
        self._served.close()

    def state(self) -> State:
        """Return the state, which is the answer to every request."""
        control = self._control
        state = "running"
        if control.pause.is_set():
            state = "paused" if control.standing.is_set() and not control.coming_to_stand else "pausing"
        state = "stopping" if control.stop.is_set() else state
        progress = self._progress()
        return {**self._about, "state": state, **(vars(progress) if progress else {})}

    def _answer(self, line: bytes, caller: Caller) -> State:
        try:
            command = request_of(line)
        except InputError as error:
            return {"version": VERSION, "error": str(error)}
        match command:
            case "state":
                pass
            case "pause":
                self._control.pause.set()
            case "go-on":
                if self._control.stands:  # which waits for the word of what was frozen
                    return {**self.state(), "unheard": _UNHEARD}
                if not caller.is_gone():
                    self._control.let_go_on()
            case "stop":
                self._control.stop_by(signal.SIGINT, "`coupole stop`, or the console")
                return {**self.state(), "trouble": unsure(self._halt(), _SAFE_WITHIN_S)}
            case _:
                return {"version": VERSION, "error": "expected the command pause, go-on, stop or state"}
        return self.state()


def request_of(line: bytes) -> str:
    """Return the command of a request. Raises InputError."""
    try:
        request = json_of(line, "request")
        version, command = request["version"], request["command"]
    except (InputError, TypeError, KeyError):
        raise InputError("expected one line of JSON with `version` and `command`") from None
    if version != VERSION:
        raise InputError(f"expected version {VERSION}, found {version!r}")
    return str(command)


class NoRun(InputError):
    """No process of this user on this machine acquires into a run."""


class NoAnswer(InputError):
    """The process that acquires does not answer."""

    exit_code = 4


# -- the side of whoever asks ---------------------------------------------------------------------------------

_OBEYED_LATER = "stopped waiting for an answer: the process obeys `coupole {}` as soon as it runs again"
_WHEN_GIVEN_UP = {
    "pause": _OBEYED_LATER.format("pause"),
    "stop": _OBEYED_LATER.format("stop"),
    "go-on": "stopped waiting for an answer: the process does not obey this `coupole go-on` later",
}


def ask(run: Path, command: Command, say: Callable[[str], object] = lambda _: None) -> State:
    """Send a command to the process that acquires into `run`; return its state afterwards. `say` gets a message
    within 2 s if the process does not answer, and another if this function stops waiting: it says what happens to
    the command.

    Raises NoRun if no process of this user on this machine acquires into `run`, and NoAnswer.
    """
    path = named_after(run, "sock")
    try:
        with told_if_given_up(_WHEN_GIVEN_UP.get(command, ""), say):
            return exchange_command(path, command, say=lambda why: say(f"{run}: no answer yet: {why}"))
    except (FileNotFoundError, ConnectionRefusedError) as error:
        raise NoRun(f"{run}: no process of this user acquires into this run on this machine") from error
    except (OSError, ValueError) as error:
        raise NoAnswer(f"{run}: the process that acquires into it does not answer: {reason(error)}") from error


def running() -> list[State]:
    """Return the states of all acquisitions of this user on this machine, the newest last. An acquisition that
    does not answer is `silent`, and has only its `socket`, a file's name."""
    return sorted(_running(), key=lambda state: str(Path(state["run"]).name))


def _running() -> Iterator[State]:
    for path in runtime_folder().glob("*.sock"):
        try:
            yield exchange_command(path, "state", _LOOK_PATIENCE_S)
        except (ConnectionRefusedError, FileNotFoundError):  # of a process that was killed, or has just ended
            continue
        except (OSError, ValueError) as error:
            about = {"version": VERSION, "run": "", "plan": "", "rig": "", "pid": 0, "socket": path.name}
            yield {**about, "state": "silent", "trouble": [str(error)]}


def exchange_command(
    path: Path, command: Command, patience_s: float = PATIENCE_S, say: Callable[[str], object] = lambda _: None
) -> State:
    """Return the answer to a command. Raises OSError, and ValueError for an answer that is an error."""
    state = exchange(path, {"version": VERSION, "command": command}, patience_s, say)
    if "error" in state:
        raise ValueError(state["error"])
    return state
