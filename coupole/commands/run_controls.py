"""Commands to a run that another process of this user acquires: pause and go-on; and its progress."""

from __future__ import annotations

import contextlib
import json
import time
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from coupole.commands.common import JsonOption
from coupole.commands.completion import runs
from coupole.errors import DeviceError, InputError

if TYPE_CHECKING:
    from rich.console import Console

    from coupole.acquisition.run_control import Command, State

RunningRun = Annotated[
    Path | None,
    typer.Argument(
        help="The run's folder, or its plan or rig; not needed while only one run is being acquired.",
        show_default=False,
        autocompletion=runs,
    ),
]
_LOOK_EVERY_S = 0.2
_PLAIN_LINE_EVERY_S = 5.0
SESSION_PATIENCE_S = (0.5, 5.0, 0.5)
"""Longest waits for the answer of a session without a run. A frozen session must not delay the stop of another
session; a session that loads its modules on a busy machine answers late. After each wait the run may have
begun."""


def pause(run: RunningRun = None, as_json: JsonOption = False) -> None:
    """Pause a running acquisition after its burst; ends when lights are off and the arm is at rest."""
    _say(_state_after(run, "pause", until="paused"), as_json=as_json)


def go_on(run: RunningRun = None, as_json: JsonOption = False) -> None:
    """Go on with a paused acquisition. (One that has ended goes on by `coupole acquire --resume RUN`.)"""
    state = _state_after(run, "go-on")
    if why := state.get("unheard"):
        raise DeviceError(
            "run",
            expected="it to go on",
            happened=why,
            remedy="Give `coupole go-on` again when the run is paused.",
        )
    _say(state, as_json=as_json)


def follow(run: Path | None, console: Console) -> Path:
    """Show a running acquisition until it ends, a line whenever there is something new; its folder."""
    said_s, last_state = 0.0, ""
    folder = run or Path(running_run(run)["run"])
    for state in _states(folder):
        is_new = state["state"] != last_state
        if is_new or console.is_terminal or time.monotonic() - said_s > _PLAIN_LINE_EVERY_S:
            said_s, last_state = time.monotonic(), state["state"]
            console.print(_line(state), end="\r" if console.is_terminal else "\n", markup=False)
    if console.is_terminal:
        console.print()
    return folder


def _states(folder: Path) -> Iterator[State]:
    """Yield the states of a run until its process has ended; there is no state while the process opens or
    concludes the run."""
    from coupole.acquisition.run_control import ask
    from coupole.storage.run import Run

    run = Run(folder)
    while run.in_use:
        with contextlib.suppress(InputError):
            yield ask(folder, "state")
        time.sleep(_LOOK_EVERY_S)


def running_run(run: Path | None) -> State:
    """Return the state of the given run, or of the only run that is being acquired. Raises InputError."""
    from coupole.acquisition.run_control import NoRun, ask, running

    if run is not None:
        return ask(run, "state")
    answers = running()
    states = [state for state in answers if state["run"]]
    if not states:
        silent = [why for state in answers for why in state.get("trouble", ())]
        raise NoRun("; ".join(["no run that answers is being acquired by this user on this machine", *silent]))
    if len(states) > 1:
        folders = "\n".join(f"  {state['run']}" for state in states)
        raise InputError(f"several runs are being acquired; name one of\n{folders}")
    return states[0]


def _state_after(run: Path | None, command: Command, *, until: str = "") -> State:
    """Send a command; return the state after it, or, with `until`, the first state of this name. Raises InputError
    if the run is not being acquired, or has ended."""
    from coupole.acquisition.run_control import ask

    state = _answer_to(run, command)
    while until and state["state"] != until:
        time.sleep(_LOOK_EVERY_S)
        state = ask(Path(state["run"]), "state")
        if state["state"] in ("running", "stopping"):
            break
    return state


def _answer_to(run: Path | None, command: Command) -> State:
    """Send a command to the given run, or to the only one that is being acquired; without a run, to the session
    that has none (`_session_of`). Return the state after it. Raises InputError."""
    from coupole.acquisition.run_control import NoRun, ask

    def alarm(message: str) -> None:
        """Print a warning: a run does not answer."""
        from coupole.viewing import terminal

        terminal.alarm(message)

    silent_sessions: dict[Path, State] = {}
    for patience_s in SESSION_PATIENCE_S:
        try:
            return ask(_run_of(run), command, alarm)
        except NoRun as none:
            no_run = none
        answering_sessions, silent_sessions = sessions(patience_s)
        if (answer := _answer_of_session(run, answering_sessions, command, alarm)) is not None:
            return answer
    if (answer := _answer_of_session(None, silent_sessions, command, alarm)) is not None:
        return answer
    raise no_run


def _run_of(named: Path | None) -> Path:
    """Return the folder of the given run, of the run with this plan or rig, or of the only run that is being
    acquired. Raises InputError."""
    if named is None:
        return Path(running_run(None)["run"])
    if named.is_dir():
        return named
    from coupole.acquisition.run_control import running

    file = str(named.resolve())
    keys = ("plan", "rig")  # a run of an earlier version tells no plan
    folders = [state["run"] for state in running() if file in [state.get(key) for key in keys] and state["run"]]
    if len(folders) > 1:
        names = "\n".join(f"  {folder}" for folder in folders)
        raise InputError(f"several runs with {named} are being acquired; name one of\n{names}")
    return Path(folders[0]) if folders else named


def sessions(patience_s: float) -> tuple[dict[Path, State], dict[Path, State]]:
    """Return sockets and states of the sessions without a run: the sessions that answer, and the sessions that do
    not."""
    from coupole.acquisition.sessions_without_run import sessions_without_run

    answering_sessions: dict[Path, State] = {}
    silent_sessions: dict[Path, State] = {}
    for path, state in sessions_without_run(patience_s):
        (silent_sessions if state["state"] == "silent" else answering_sessions)[path] = state
    return answering_sessions, silent_sessions


def _answer_of_session(
    run: Path | None, sessions: Mapping[Path, State], command: Command, alarm: Callable[[str], None]
) -> State | None:
    """Send a command to the one of these sessions that is meant; return its state afterwards. None if there is no
    such session, or if it has just ended: its run may have begun. Raises InputError."""
    from coupole.acquisition.sessions_without_run import SessionEnded, ask_session

    session = _session_of(run, sessions)
    try:
        return None if session is None else ask_session(*session, command, alarm)
    except SessionEnded:
        return None


def _session_of(run: Path | None, sessions: Mapping[Path, State]) -> tuple[Path, State] | None:
    """Return the socket and state of the only session, or of the one that resumes this run, or has this plan or
    rig; None if there is none. Raises InputError if there are several."""
    from coupole.acquisition.sessions_without_run import name_of

    path_text = run and str(run.resolve())
    matches = [
        (path, state)
        for path, state in sessions.items()
        if path_text in (None, state["run"], state["plan"], state.get("rig"))
    ]
    if len(matches) > 1:
        names = "\n".join(f"  {name_of(state)}" for _, state in matches)
        raise InputError(f"several sessions have no run; name the run, plan or rig of one of\n{names}")
    return matches[0] if matches else None


def _say(state: State, *, as_json: bool) -> None:
    from coupole.viewing.terminal import make_console

    make_console(quiet=as_json).print(_line(state), markup=False)
    if as_json:
        print(json.dumps(state))


def _line(state: dict[str, Any]) -> str:
    from coupole.viewing.terminal import duration_text

    name = Path(state["run"]).name
    if "view" not in state:
        return f"{state['state']}: {name}, nothing proven yet in this session"
    return (
        f"{state['state']}: {name}, view {state['view']} ({state['view_number'] + 1}/{state['views']}) "
        f"{state['light']}, {state['proven']}/{state['frames']} frames proven, {state['dose_lux_h']:.3f} lux.h, "
        f"{duration_text(state['left_s'])} left"
    )
