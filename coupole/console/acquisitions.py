"""Runs the queue: each plan in a process of its own, `coupole acquire`, which no fault of the service touches.

The process is told nothing and asked nothing but by its run's socket (`acquisition.run_control`), as by any other
client; it goes on if the service dies, and a new service finds it by its id in the queue.
"""

from __future__ import annotations

import contextlib
import json
import subprocess
import sys
import threading
from pathlib import Path
from typing import Any

from coupole.acquisition.run_control import Command, State, ask, running
from coupole.console.plan_queue import Entry, PlanQueue
from coupole.errors import CoupoleError, InputError
from coupole.storage.line_file import utc_now

_LOOK_EVERY_S = 0.2
_STOPPED = (129, 130, 143)
"""Exit codes of a session that somebody stopped."""


class Acquisitions:
    """The thread that begins what waits in a queue, and watches what runs."""

    def __init__(self, queue: PlanQueue, rig: Path, folder: Path) -> None:
        """`folder`: for what processes print."""
        self._queue, self._rig, self._folder = queue, str(rig.resolve()), folder
        self._ended = threading.Event()
        self._process: subprocess.Popen[bytes] | None = None
        self.state: State | None = None
        """Of the run at work, as its process tells it; None if there is none."""
        self._thread = threading.Thread(target=self._watch, name="acquisitions", daemon=True)

    def __enter__(self) -> Acquisitions:
        self._folder.mkdir(parents=True, exist_ok=True)
        self._thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        """What runs goes on without us."""
        self._ended.set()
        self._thread.join()

    def tell(self, run: str, command: Command) -> State:
        """`pause`, `go-on` or `stop` to the run with this name. Raises InputError: it is not being acquired."""
        for state in running():
            if Path(state["run"]).name == run and state["rig"] == self._rig:
                return ask(Path(state["run"]), command)
        raise InputError(f"{run}: is not being acquired in this cell")

    def _watch(self) -> None:
        while not self._ended.wait(_LOOK_EVERY_S):
            try:
                self._look()
            except CoupoleError as error:  # of the disk: the queue must not go on without its file
                with contextlib.suppress(CoupoleError):
                    self._queue.halt(str(error))

    def _look(self) -> None:
        entry = self._queue.running
        self.state = next((state for state in running() if state["rig"] == self._rig), None)
        if entry is not None:
            self._look_after(entry)
        elif self.state is None and (following := self._queue.following) is not None:
            if following.hold:
                self._queue.change(following.id, state="done", begun=utc_now(), ended=utc_now())
                self._queue.halt(f"hold: {following.hold}")
            else:
                self._begin(following)

    def _begin(self, entry: Entry) -> None:
        said, figures = self._files(entry)
        with said.open("wb") as errors, figures.open("wb") as found:
            command = [sys.executable, "-m", "coupole.commands.cli", "acquire", entry.plan, "--yes", "--json"]
            self._process = subprocess.Popen(
                command, stdin=subprocess.DEVNULL, stdout=found, stderr=errors, start_new_session=True
            )
        self._queue.change(entry.id, state="running", begun=utc_now(), pid=self._process.pid)

    def _look_after(self, entry: Entry) -> None:
        if self.state is not None and self.state["pid"] == entry.pid and not entry.run:
            self._queue.change(entry.id, run=self.state["run"])
        if not self._is_alive(entry):
            self._conclude(self._queue.entry(entry.id))

    def _is_alive(self, entry: Entry) -> bool:
        if self._process is not None and self._process.pid == entry.pid:
            return self._process.poll() is None
        try:  # of a service before this one
            words = Path(f"/proc/{entry.pid}/cmdline").read_bytes().split(b"\0")
        except OSError:
            return False
        return b"acquire" in words and entry.plan.encode() in words

    def _conclude(self, entry: Entry) -> None:
        said, figures = self._files(entry)
        found = _last_document(figures)
        code = found.get("exit_code", 0 if "proven" in found else None)
        if self._process is not None and self._process.pid == entry.pid:
            code = self._process.returncode if self._process.returncode >= 0 else None
        self._process = None
        state = "done" if code == 0 else "stopped" if code in _STOPPED else "failed"
        why = found.get("error") or _last_line(said) or "its process was killed"
        self._queue.change(
            entry.id, state=state, ended=utc_now(), exit_code=code, run=str(found.get("run", entry.run)),
            said="" if code == 0 else why,
        )  # fmt: skip
        if code != 0:
            self._queue.halt(f"{Path(entry.plan).name}: {why}")

    def _files(self, entry: Entry) -> tuple[Path, Path]:
        return self._folder / f"{entry.id}.log", self._folder / f"{entry.id}.json"


def _last_document(path: Path) -> dict[str, Any]:
    """The last line of JSON; empty if there is none."""
    try:
        found = json.loads(path.read_text(encoding="utf-8").strip().splitlines()[-1])
    except (OSError, ValueError, IndexError):
        return {}
    return found if isinstance(found, dict) else {}


def _last_line(path: Path) -> str:
    try:
        return path.read_text(encoding="utf-8", errors="replace").strip().splitlines()[-1]
    except (OSError, IndexError):
        return ""
