"""Stops the work of this user's other processes at a cell: an acquisition, or a session without a run."""

from __future__ import annotations

import contextlib
import itertools
import json
import time
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING

from coupole.commands.common import JsonOption
from coupole.commands.run_controls import SESSION_PATIENCE_S, RunningRun, running_run, sessions
from coupole.errors import CoupoleError, DeviceError, InputError, unsafe_end

if TYPE_CHECKING:
    from coupole.acquisition.run_control import State
    from coupole.acquisition.starting_processes import StartingProcess
    from coupole.storage.run import Run

_LOOK_EVERY_S, _STARTING_EVERY_S = 0.2, 0.05
_SAID_AFTER_S = 0.5
_ENDS_WITHIN_S = 600.0
"""Longest wait for the end of a process, s: longer than a session in which every call hangs (`coupole.bounded`),
and than a slow report."""
_LEAVES_WITHIN_S = 2.0
"""Longest wait for the end of the process of a run that has ended, s. A Python program may go on after its run."""
_LOOKS = len(SESSION_PATIENCE_S)
"""How often sessions are looked for before the command says that there is nothing to stop. Later looks have the
patience of the last of these."""


def stop(run: RunningRun = None, as_json: JsonOption = False) -> None:
    """Stop a running acquisition now: lights off, arm still, camera disarmed. It can be resumed.

    While nothing is acquired, it stops a commissioning, metering, live view, bench or drive of the arm. With a
    plan or a rig, it stops all that use it, also what was started a moment ago. Ends when the process has ended;
    exit code 4 if the journal says that the cell may not be safe. This is no emergency stop: that is the button at
    the cell.
    """
    stopping = _Stopping(run)
    stopping.send()
    documents, errors = [], []
    for reply in stopping.replies.values():
        try:
            documents.append(_await_end(reply, as_json=as_json))
        except CoupoleError as error:
            errors.append(error)
    if as_json and documents:
        print(json.dumps(documents if len(documents) > 1 else documents[0]))
    for name in stopping.other_names:
        _alarm(f"not stopped: {name}; `coupole stop` with its plan or rig stops it")
    for further_error in errors[1:]:
        _alarm(str(further_error))
    if errors:
        raise errors[0]


def _alarm(message: str) -> None:
    """Print a warning. The outlet is loaded only now, because a stop must not wait for it."""
    from coupole.viewing import terminal

    terminal.alarm(message)


# -- what is stopped ----------------------------------------------------------------------------------------------


@dataclass
class _Stopping:
    """Stops the given run, or all that use the given plan or rig; without a name the only one that there is."""

    file: Path | None
    replies: dict[int, State] = field(default_factory=dict)
    """Answers of what was stopped, by process."""
    other_names: list[str] = field(default_factory=list)
    """Names of sessions that were found and not stopped: without a name, a session is stopped only if it is the
    only one."""
    _unclear: dict[int, str] = field(default_factory=dict)
    """Names of sessions whose rig is not known yet, by process."""
    _ended_session: State = field(default_factory=dict)
    """State of a session that ended while it was asked, as if another `coupole stop` had reached it first."""
    _told_pids: set[int] = field(default_factory=set)
    """Processes for which the command has said that it waits for them."""
    _no_run: InputError | None = None
    """Reason why no run was stopped."""

    def send(self) -> None:
        """Send the stop, also to what is just starting. Raises InputError if there is nothing to stop, or if it is
        not clear what is meant."""
        from coupole.acquisition.starting_processes import YOUNG_S, starting_processes

        begun_s = time.monotonic()
        for look in itertools.count(1):
            processes = list(starting_processes())  # before the sockets, which one of them may have a moment later
            silent_sessions = self._stop_those_that_listen(SESSION_PATIENCE_S[min(look, _LOOKS) - 1])
            waited_s = time.monotonic() - begun_s
            starting = self._starting(processes) if waited_s < YOUNG_S else {}
            if self.file is None and self.replies:
                self.other_names += starting.values()
                return
            if not starting and (self.replies or look >= _LOOKS):
                break
            self._tell(starting, waited_s)
        if not self.replies and silent_sessions:
            self._ask_session(*next(iter(self._only(silent_sessions).items())))
        if not self.replies and self._ended_session:
            self.replies[self._ended_session["pid"]] = self._ended_session | {"state": "ended", "trouble": []}
        if not self.replies:
            assert self._no_run is not None
            raise self._no_run

    def _stop_those_that_listen(self, patience_s: float) -> dict[Path, State]:
        """Stop all that is meant and has a socket. Return the sessions that do not answer."""
        from coupole.acquisition.run_control import NoRun, ask
        from coupole.acquisition.sessions_without_run import name_of

        try:
            for run in self._runs():
                reply = ask(run, "stop", _alarm)
                self.replies[reply["pid"]] = reply
        except NoRun as none:
            self._no_run = none
        answering_sessions, silent_sessions = sessions(patience_s)
        meant_sessions = {path: state for path, state in answering_sessions.items() if self._means(state)}
        if self.file is None and self.replies:
            self.other_names = [
                name_of(state) for state in meant_sessions.values() if state["state"] in ("starting", "working")
            ]
            return {}
        for path, state in (self._only(meant_sessions) if self.file is None else meant_sessions).items():
            self._ask_session(path, state)
        self._unclear = {
            state["pid"]: name_of(state)
            for state in answering_sessions.values()
            if state["state"] == "starting" and not state["rig"] and state["pid"] not in self.replies
        }
        return silent_sessions

    def _runs(self) -> list[Path]:
        """Return the folders of the runs that are meant and that were not stopped yet. Raises NoRun; InputError if
        there are several and none is named."""
        from coupole.acquisition.run_control import NoRun, running

        if self.file is None:
            return [Path(running_run(None)["run"])]
        if self.file.is_dir():
            return [] if self.replies else [self.file]
        states = [state for state in running() if state["run"] and self._means(state)]
        if not states:
            raise NoRun(f"{self.file}: no process of this user acquires into this run on this machine")
        return [Path(state["run"]) for state in states]

    def _means(self, state: State) -> bool:
        """Tell whether a run or session is meant and was not stopped yet."""
        files = None if self.file is None else str(self.file.resolve())
        return state["pid"] not in self.replies and (
            files is None or files in (state["run"], state["plan"], state.get("rig"))
        )

    def _only(self, meant: Mapping[Path, State]) -> Mapping[Path, State]:
        """Return the only session; if no session works, return the sessions that are stopping. Raises InputError
        if there are several."""
        from coupole.acquisition.sessions_without_run import name_of

        working_sessions = {path: state for path, state in meant.items() if state["state"] != "stopping"}
        if len(working_sessions) > 1:
            names = "\n".join(f"  {name_of(state)}" for state in working_sessions.values())
            raise InputError(f"several sessions have no run; name the run, plan or rig of one of\n{names}")
        return working_sessions or meant

    def _ask_session(self, path: Path, state: State) -> None:
        """Stop a session, or its run if that has begun meanwhile. If the run has its last frame, the process is
        interrupted as by Ctrl-C, so that nothing follows. A session that is being stopped already is only noted.
        Raises InputError if it does not answer."""
        import os
        import signal

        from coupole.acquisition.run_control import NoRun, ask
        from coupole.acquisition.sessions_without_run import SessionEnded, ask_session, name_of

        try:
            reply = ask_session(path, state, "stop", _alarm)
        except SessionEnded:  # or its run has begun, and is found by the next look
            self._ended_session = state
            return
        if reply["state"] == "running":
            try:
                reply = ask(Path(reply["run"]), "stop", _alarm)
            except NoRun:
                with contextlib.suppress(ProcessLookupError):
                    os.kill(reply["pid"], signal.SIGINT)
        if state["state"] == "stopping":
            _alarm(f"{name_of(state)} is being stopped already: waiting for its end")
        self.replies[reply["pid"]] = reply

    def _starting(self, starting_processes: Iterable[StartingProcess]) -> dict[int, str]:
        """Return names of the processes that are starting and that may be meant, by process."""
        file = self.file
        plans_stopped = [state["plan"] for state in self.replies.values()]
        may_be_rig = file is None or str(file.resolve()) not in plans_stopped
        processes = {
            process.pid: process.name
            for process in starting_processes
            if process.pid not in self.replies and (file is None or may_be_rig or process.names(file))
        }
        return processes | (self._unclear if may_be_rig else {})

    def _tell(self, starting: Mapping[int, str], waited_s: float) -> None:
        """If the wait takes a while, say what is awaited; wait a moment."""
        for pid, name in starting.items():
            if waited_s > _SAID_AFTER_S and pid not in self._told_pids:
                self._told_pids.add(pid)
                _alarm(
                    f"{name} is just starting: waiting until it can be stopped, or until it turns out to be "
                    "a session that you did not mean"
                )
        if starting:
            time.sleep(_STARTING_EVERY_S)


# -- its end ------------------------------------------------------------------------------------------------------


def _await_end(reply: State, *, as_json: bool) -> State:
    """Wait until the process behind an answer has ended; return what `--json` prints of it. Raises DeviceError."""
    from coupole.viewing.terminal import make_console

    if "doing" in reply and reply["state"] != "running":
        _await_end_without_run(reply, as_json=as_json)
        return reply

    from coupole.storage.run import Run
    from coupole.storage.run_status import status
    from coupole.viewing.terminal import show_status

    for trouble in reply["trouble"]:
        _alarm(trouble)
    folder = Run(Path(reply["run"]))
    end_s = time.monotonic() + _ENDS_WITHIN_S
    while folder.in_use:
        if time.monotonic() > end_s:
            raise DeviceError(
                "cell",
                expected=f"the process {reply['pid']} to end within {_ENDS_WITHIN_S:g} s of its stop",
                happened="the process still acquires frames into the run",
                remedy="Look at the cell, then end the process (`kill -9`); the run can be resumed.",
            )
        time.sleep(_LOOK_EVERY_S)
    _has_ended(reply["pid"], _LEAVES_WITHIN_S)
    progress = status(folder)
    show_status(make_console(quiet=as_json), progress)
    if unsafe := _unsafe(folder):
        raise unsafe_end("; ".join(unsafe))
    make_console(quiet=as_json).print("lights are off, the arm is at rest, the camera is disarmed")
    return progress.figures()


def _await_end_without_run(reply: State, *, as_json: bool) -> None:
    """Wait until a session without a run has ended, which was stopped. Raises DeviceError."""
    from coupole.acquisition.sessions_without_run import ACQUIRE
    from coupole.viewing.terminal import make_console

    if not _has_ended(reply["pid"], _ENDS_WITHIN_S):
        raise DeviceError(
            "cell",
            expected=f"the process {reply['pid']} to end within {_ENDS_WITHIN_S:g} s of its stop",
            happened="it is still there",
            remedy="Look at the cell, then end the process (`kill -9`).",
        )
    when = f"stopped: {reply['doing']} "
    if reply["state"] == "ended":
        when = "ended while it was asked to stop: "
    elif reply["doing"] == ACQUIRE:
        when = "stopped while it was starting: "
    words = f"{when}{reply['plan'] or reply.get('rig')}; its process {reply['pid']} has ended"
    make_console(quiet=as_json).print(words, markup=False)


def _has_ended(pid: int, within_s: float) -> bool:
    """Wait until a process has ended; return whether it has."""
    import os
    import select

    try:
        process = os.pidfd_open(pid)
    except ProcessLookupError:
        return True
    try:
        return bool(select.select([process], [], [], within_s)[0])
    finally:
        os.close(process)


def _unsafe(run: Run) -> list[str]:
    """Return reasons to doubt that the cell is safe after the last session, from the run's journal."""
    from coupole.storage import journal
    from coupole.storage.journal_events import FaultNoted, SessionResumed, SessionStarted, SessionStopped

    reasons = ["the session has no end in its journal: its process was killed, or could not write the end"]
    has_end = False
    for event in journal.read_events(run.journal_path):
        if isinstance(event, SessionStarted | SessionResumed):
            reasons, has_end = reasons[:1], False
        elif isinstance(event, FaultNoted) and event.kind == "unsafe":
            reasons.append(event.message)
        elif isinstance(event, SessionStopped):
            has_end = True
    return reasons[1:] if has_end else reasons
