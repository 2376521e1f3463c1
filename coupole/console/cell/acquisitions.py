"""Runs the queue: each plan in a separate process, `coupole acquire`, which no fault of the service affects.

The service asks and commands the process by its run's socket (`acquisition.run_control`), like any other client.
Before that socket exists, the process can be interrupted as by Ctrl-C. The process continues if the service dies;
a new service finds it by its process id in the queue.
"""

from __future__ import annotations

import contextlib
import os
import signal
import subprocess
import sys
import threading
from collections.abc import Callable
from pathlib import Path
from typing import Any

from coupole.acquisition.cell_marks import is_in_use
from coupole.acquisition.run_control import Command, State, ask, running
from coupole.acquisition.runtime_folder import named_after
from coupole.console.cell.lending import Lending
from coupole.console.plans.plan_queue import Entry, PlanQueue
from coupole.console.processes.growing_file import end_of_file
from coupole.errors import CoupoleError, InputError
from coupole.intake.plain_data import json_of
from coupole.plan.cell import Cell
from coupole.storage.line_file import utc_now

_LOOK_EVERY_S = 0.2
_STOPPED = (129, 130, 143)
"""Exit codes of a session that was stopped by a person or a signal."""
_MOST_SAID_BYTES = 65536


class Acquisitions:
    """The thread that begins waiting entries of a queue and watches the running one."""

    def __init__(self, queue: PlanQueue, cell: Cell, folder: Path) -> None:
        """`folder`: for the output of the processes."""
        self._queue, self._cell, self._folder = queue, cell, folder
        self._rig = str(cell.document.path.resolve())
        self._ended = threading.Event()
        self._process: subprocess.Popen[bytes] | None = None
        self._stopped_ids = set[str]()
        """Entries that a person has stopped. The queue halts after them even if they were complete by then."""
        self.state: State | None = None
        """State of the present run, as its process reports it; None if there is no run."""
        self.lending = Lending()
        self.give_way: Callable[[str], object] = lambda _: None
        """Function that is called repeatedly while an entry should begin but something else has the cell; its
        argument is the entry's name."""
        self._beginning = threading.Lock()
        self._thread = threading.Thread(target=self._watch, name="acquisitions", daemon=True)

    def __enter__(self) -> Acquisitions:
        self._folder.mkdir(parents=True, exist_ok=True)
        self._forget_old()
        self._thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        """End the thread; a present run continues."""
        self._ended.set()
        self._thread.join()

    def tell(self, run: str, command: Command) -> State:
        """Send `pause`, `go-on` or `stop` to the run with this name. If a run that the queue has begun does not
        answer a `stop`, or has its last frame, it is stopped as by Ctrl-C. Raises InputError if the run is not
        being acquired, or does not answer.
        """
        for state in [self.state] if self.state and Path(self.state["run"]).name == run else running():
            if Path(state["run"]).name == run and self._is_ours(state):
                return self._send_command(state, command)
        entry = self._queue.running
        if command == "stop" and entry is not None and entry.run and Path(entry.run).name == run:
            self.stop(entry)  # its result is made
            return {"run": entry.run, "plan": entry.plan, "pid": entry.pid, "state": "stopping", "trouble": []}
        raise InputError(f"{run}: this run is not being acquired in this cell")

    def _send_command(self, state: State, command: Command) -> State:
        entry = self._queue.running
        if command == "stop" and entry is not None and entry.pid == state["pid"]:
            self._stopped_ids.add(entry.id)
        try:
            return ask(Path(state["run"]), command)
        except InputError:
            entry = self._queue.running
            if command != "stop" or entry is None or entry.pid != state["pid"]:
                raise
            self.stop(entry)
            return {
                **state,
                "trouble": ["perhaps not stopped yet: the run does not answer; its process was told to end"],
            }

    def stop(self, entry: Entry) -> None:
        """Interrupt the process of an entry as by Ctrl-C, also before its run has a name. Raises InputError."""
        if entry.state != "running" or not entry.pid or not self._is_alive(entry):
            raise InputError(f"queue: {entry.id} is not running")
        self._stopped_ids.add(entry.id)
        os.kill(entry.pid, signal.SIGINT)

    def begin_at_once(self, by: str, **fields: Any) -> Entry:
        """Return a new entry that begins now. Raises InputError if something has the cell or waits for it;
        StorageError."""
        with self._beginning:
            if why := self._had_by():
                raise InputError(why)
            return self._queue.add(by, at_once=True, **fields)

    def lend(self, pid: int, borrower: str, purpose: str) -> None:
        """Lend the cell to a process until it gives the cell back or ends; nothing begins meanwhile. A process
        that already has the cell keeps it. Raises InputError if something else has the cell."""
        with self._beginning:
            if self.lending.has(pid):
                return
            if why := self._had_by() or ("the queue is about to begin a plan" if self._queue.following else ""):
                raise InputError(why)
            self.lending.lend(pid, borrower, purpose)

    def output(self, entry: Entry) -> tuple[str, dict[str, Any]]:
        """Return the output of an entry's process (the last 64 KiB) and, once they exist, its figures as in
        `acquire --json`."""
        output_path, figures = self._files(entry)
        return end_of_file(output_path, _MOST_SAID_BYTES), _last_document(figures)

    def _had_by(self) -> str:
        """Return what uses the cell; empty if nothing uses it."""
        if self._queue.running is not None:
            return f"{self._queue.running.words} is being acquired"
        if self.state is not None:
            return f"{Path(self.state['run']).name} is being acquired"
        if self.lending.lent_to:
            return f"the cell is lent to {self.lending.lent_to}"
        return "another process of this user has its devices open" if is_in_use(self._cell) else ""

    def _is_ours(self, state: State) -> bool:
        """Tell whether a run belongs to this cell: the run names the cell's rig, or the queue has begun the run.
        (A resumed run names its own copy of the rig.)"""
        entry = self._queue.running
        return state["rig"] == self._rig or (entry is not None and bool(entry.pid) and state["pid"] == entry.pid)

    def _watch(self) -> None:
        while not self._ended.wait(_LOOK_EVERY_S):
            try:
                self._look()
            except Exception as error:  # noqa: BLE001  it must go on to watch, and tell what it cannot
                self.state = None
                with contextlib.suppress(CoupoleError):
                    self._queue.halt(f"{type(error).__name__}: {error}")

    def _look(self) -> None:
        entry = self._queue.running
        self.state = self._at_work()
        if entry is not None:
            self._look_after(entry)
            return
        with self._beginning:
            following = self._queue.following
            if following is None:
                return
            if self._had_by():
                self.give_way(following.words)
                return
            if following.hold:
                now = utc_now()
                self._queue.conclude(following.id, halt=following.words, state="done", begun=now, ended=now)
            else:
                self._begin(following)

    def _at_work(self) -> State | None:
        """Return the state of this cell's run. While its process does not answer, this is the last known state
        with `silent` as its name."""
        states, entry = running(), self._queue.running
        last = self.state
        if last is None and entry is not None and entry.run:  # begun by an earlier service
            last = {"run": entry.run, "rig": self._rig, "pid": entry.pid, "light_after_lux_h": {}}
        if last is not None:
            socket = named_after(Path(last["run"]), "sock").name
            if any(state["state"] == "silent" and state["socket"] == socket for state in states):
                return {**last, "state": "silent"}
        return next((state for state in states if self._is_ours(state)), None)

    def _begin(self, entry: Entry) -> None:
        # recorded first, because an entry must never begin twice
        self._queue.change(entry.id, state="running", begun=utc_now())
        output_path, figures = self._files(entry)
        command = [sys.executable, "-m", "coupole", "acquire", *self._arguments(entry)]
        try:
            with output_path.open("wb") as errors, figures.open("wb") as figures_file:
                self._process = subprocess.Popen(
                    [*command, "--yes", "--json", "--begun-by-console"],
                    stdin=subprocess.DEVNULL,
                    stdout=figures_file,
                    stderr=errors,
                    start_new_session=True,
                )
        except OSError as error:
            self._queue.conclude(
                entry.id, halt=f"{entry.words}: {error}", state="failed", ended=utc_now(), said=str(error)
            )
            return
        self._queue.change(entry.id, pid=self._process.pid)

    def _arguments(self, entry: Entry) -> list[str]:
        plan = [entry.plan, "--rig", self._rig] if entry.plan else []
        resume = ["--resume", entry.resume] if entry.resume else []
        output = ["--output", entry.output] if entry.output else []
        result = ["--result", entry.result] if entry.result else []
        flags = {"--with-mesh": entry.with_mesh, "--reflectance": entry.reflectance}
        return [*plan, *resume, *output, *result, *(flag for flag, is_set in flags.items() if is_set)]

    def _look_after(self, entry: Entry) -> None:
        if self.state is not None and self.state["pid"] == entry.pid and not entry.run:
            self._queue.change(entry.id, run=self.state["run"])
        if not self._is_alive(entry):
            self._conclude(self._queue.entry(entry.id))

    def _is_alive(self, entry: Entry) -> bool:
        if self._process is not None and self._process.pid == entry.pid:
            return self._process.poll() is None
        try:  # of an earlier service
            words = Path(f"/proc/{entry.pid}/cmdline").read_bytes().split(b"\0")
        except OSError:
            return False
        return b"acquire" in words and (entry.plan or entry.resume).encode() in words

    def _conclude(self, entry: Entry) -> None:
        output_path, figures = self._files(entry)
        last_figures = _last_document(figures)
        code = last_figures.get("exit_code", 0 if "proven" in last_figures else None)
        if self._process is not None and self._process.pid == entry.pid:
            code = self._process.returncode
            # ended by a signal: a signal that ends a session may arrive before the process can handle it
            if code < 0:
                code = 128 - code if 128 - code in _STOPPED else None
        self._process = None
        state = "done" if code == 0 else "stopped" if code in _STOPPED else "failed"
        last = _last_line(output_path) if code is not None else ""
        why = "" if code == 0 else last_figures.get("error") or last or "its process was killed"
        if code == 0 and entry.id in self._stopped_ids:
            why = "stopped when it was complete"
        halt = f"{entry.words}: {why}" if why else ""
        run = str(last_figures.get("run", entry.run))
        self._queue.conclude(entry.id, halt=halt, state=state, ended=utc_now(), exit_code=code, run=run, said=why)
        self._forget_old()

    def _forget_old(self) -> None:
        """Remove the output of processes whose entries are no longer in the queue."""
        entry_ids = {entry.id for entry in self._queue.entries}
        for path in self._folder.iterdir():
            if path.suffix in (".log", ".json") and path.stem not in entry_ids:
                with contextlib.suppress(OSError):
                    path.unlink()

    def _files(self, entry: Entry) -> tuple[Path, Path]:
        return self._folder / f"{entry.id}.log", self._folder / f"{entry.id}.json"


def _last_document(path: Path) -> dict[str, Any]:
    """Return the last line as JSON; empty if there is none."""
    try:
        document = json_of(path.read_bytes().strip().splitlines()[-1], str(path), allow_nan=True)
    except (OSError, InputError, IndexError):
        return {}
    return document if isinstance(document, dict) else {}


def _last_line(path: Path) -> str:
    lines = end_of_file(path, _MOST_SAID_BYTES).strip().splitlines()
    return lines[-1] if lines else ""
