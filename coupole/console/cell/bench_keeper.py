"""The bench that people at a console begin: a process that holds the cell's devices while there is no run.

The console only sends requests to it (docs/reference/bench.md). The bench is closed by a person, after some time
without use, before the queue begins an entry, and when the console ends.
"""

from __future__ import annotations

import threading
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any, Literal

from coupole.acquisition.cell_bench.bench_client import ask_bench, bench_socket, checked_answer
from coupole.acquisition.runtime_folder import named_after
from coupole.console.cell.acquisitions import Acquisitions
from coupole.console.people.sessions import Control
from coupole.console.plans.plan_files import PlanFiles
from coupole.console.processes.tasks import Task, Tasks
from coupole.errors import CoupoleError, InputError
from coupole.plan.cell import Cell
from coupole.plan.reading import read_plan
from coupole.plan.schedule import expand_view

IDLE_S = 600.0
"""Time without use, s, after which the bench is closed."""
_LOOK_EVERY_S, _FOREIGN_EVERY_S, _LOOKED_AT_S = 0.1, 1.0, 2.0
_CLOSES_WITHIN_S = 20.0
Phase = Literal["closed", "opening", "open", "closing"]


class Bench:
    """The bench of one cell, for its console."""

    def __init__(
        self,
        cell: Cell,
        acquisitions: Acquisitions,
        plans: PlanFiles,
        folder: Path,
        now_s: Callable[[], float] = time.monotonic,
        control: Control | None = None,
    ) -> None:
        """`folder`: for the output of its process. `control` tells who is in control of the cell."""
        self._control, self._driver, self._taken_count = control or Control(), "", 0
        self._cell, self._acquisitions, self._plans, self._now_s = cell, acquisitions, plans, now_s
        self._tasks = Tasks(folder)
        self._task: Task | None = None
        self._lock, self._ended = threading.Lock(), threading.Event()
        self._closing = ""
        self._acted_s = self._looked_s = self._asked_s = -_FOREIGN_EVERY_S
        self.plan = ""
        """The plan whose object lies on the support; empty if nothing lies there, or if this console has not begun
        the bench."""
        self.state: dict[str, Any] | None = None
        """Last state that the bench reported; None if there is no bench."""
        self.closed_because = ""
        """Reason why the last bench has ended; empty if a person closed it."""
        self._thread = threading.Thread(target=self._watch, name="bench", daemon=True)
        acquisitions.give_way = self.give_way

    def __enter__(self) -> Bench:
        self._thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        """Close this console's bench, because without the console nobody can see that devices are open."""
        self._ended.set()
        self._thread.join()
        if self._running is not None:
            self._close("the console has ended")

    @property
    def phase(self) -> Phase:
        if self._closing:
            return "closing"
        if self.state is not None:
            return "open"
        return "opening" if self._running is not None else "closed"

    @property
    def is_own(self) -> bool:
        """True if this console has begun the bench."""
        return self._running is not None

    @property
    def work(self) -> dict[str, Any]:
        """The last work of the bench; empty if there was none."""
        return (self.state or {}).get("work") or {}

    @property
    def identities(self) -> dict[str, Any]:
        """Identities of the devices that the bench holds, by kind."""
        devices = (self.state or {}).get("devices", {})
        return {kind: device["identity"] for kind, device in devices.items()}

    @property
    def pictures(self) -> Path:
        """Folder of the bench's last pictures."""
        return named_after(self._cell.state_folder, "frames")

    def looked_at(self) -> None:
        """Note that a person looks at the bench: its state is updated for a while."""
        self._looked_s = self._now_s()

    def open(self, person: str, plan: str) -> None:
        """Begin the bench; the object of `plan` lies on the support, or nothing if it is empty. Raises InputError
        if something has the cell, or if there is no such plan."""
        with self._lock:
            if self.phase != "closed":
                raise InputError(f"the devices are {self.phase}")
            lies = ["--object", str(self._plans.path(plan))] if plan else []
            rig = str(self._cell.document.path.resolve())
            task = self._tasks.begin("open the devices", ["bench", rig, "--yes", *lies], person)
            try:
                self._acquisitions.lend(task.process.pid, person, "the devices are open")
            except InputError:
                task.stop()
                raise
            self._acted_s = self._now_s()
            self._task, self.plan, self.closed_because = task, plan, ""

    def close(self, why: str = "") -> list[str]:
        """End the bench and make the cell safe; return the devices that may not be safe. Raises InputError if
        there is no bench.
        """
        if self.phase not in ("open", "opening"):
            raise InputError(f"the devices are {self.phase}")
        return self._close(why)

    def give_way(self, action: str) -> None:
        """Close the bench for another action, unless the arm is moving. The caller calls again until the bench is
        closed."""
        if self.is_own and self.phase in ("open", "opening") and self.work.get("state") != "running":
            self._closing = f"closed, because {action} begins"
            threading.Thread(target=self._close, args=(self._closing,), daemon=True).start()

    def stop(self) -> list[str]:
        """Stop the bench's work; return the devices that may not be safe. If the bench does not obey, because it
        is being opened or closed, it is interrupted as by Ctrl-C. Raises InputError if another console began the
        bench and it does not obey.
        """
        try:
            return list(self.ask("stop")["trouble"])
        except InputError:
            if (task := self._running) is None:
                raise
            task.stop()
            return [
                (
                    "perhaps not safe: the devices do not answer; their process was told to make the cell safe "
                    "and end"
                )
            ]

    def ask(self, command: str, **fields: Any) -> dict[str, Any]:
        """Send a command to the bench and return its answer. Raises InputError with the bench's words if it did
        not obey."""
        self._acted_s = self._now_s()
        return checked_answer(ask_bench(self._cell, command, **fields))

    def drive(self, path: str, person: str) -> dict[str, Any]:
        """Begin to drive the arm along a path for a person; return the work. It ends when another person comes
        into control. Raises InputError."""
        taken_count = self._control.taken_count
        work = self.ask("drive", path=path)
        self._driver, self._taken_count = person, taken_count
        return work

    def views(self) -> list[str]:
        """Return the names of the plan's views. Raises InputError."""
        if not self.plan:
            return []
        plan = read_plan(self._plans.path(self.plan), self._cell.document.path).plan
        return [pose.name for view in plan.view_entries for pose in expand_view(view)]

    def plan_path(self) -> str:
        """Return the plan's file. Raises InputError if the bench was begun without a plan."""
        if not self.plan:
            raise InputError(
                "no plan: close the devices, and open them with the plan whose object lies on the support"
            )
        return str(self._plans.path(self.plan))

    # -- watching -----------------------------------------------------------------------------------------------

    @property
    def _running(self) -> Task | None:
        return self._task if self._task is not None and self._task.running else None

    def _close(self, why: str) -> list[str]:
        task, trouble = self._running, []
        self._closing = why or "closed"
        try:
            trouble = list(checked_answer(ask_bench(self._cell, "close"))["trouble"])
        except InputError:
            if task is not None:
                task.stop()
        end_s = time.monotonic() + _CLOSES_WITHIN_S
        while (task.running if task else bench_socket(self._cell).exists()) and time.monotonic() < end_s:
            time.sleep(_LOOK_EVERY_S)
        self.state, self._task, self._closing, self.closed_because = None, None, "", why
        return trouble

    def _watch(self) -> None:
        while not self._ended.wait(_LOOK_EVERY_S):
            self._end_drive_of_another()
            if self._closing:
                continue
            if self._task is not None and not self._task.running:
                self.closed_because = self._task.why or "the bench has ended by itself"
                self._task = self.state = None
            else:
                self._look()

    def _end_drive_of_another(self) -> None:
        """Stop the arm if it is driven for a person, and another person has come into control since the motion
        began."""
        if not self._driver or not (name := self._control.taken_since(self._taken_count, self._driver)):
            return
        try:
            work = self.ask("state")["work"] or {}
            if work.get("kind") == "drive" and work["state"] == "running":
                self.ask("stop", why=f"{name} took control")
        except InputError:
            if bench_socket(self._cell).exists():
                return  # it does not answer: asked again in the next round
        self._driver = ""

    def _look(self) -> None:
        now_s = self._now_s()
        looked_at = now_s - self._looked_s < _LOOKED_AT_S
        pause_s = {"open": 0.0 if looked_at else _LOOKED_AT_S, "opening": 0.0}.get(self.phase, _FOREIGN_EVERY_S)
        if now_s - self._asked_s < pause_s or (self.phase == "closed" and not looked_at):
            return
        self._asked_s = now_s
        try:
            state = checked_answer(ask_bench(self._cell, "state")) if bench_socket(self._cell).exists() else None
        except CoupoleError:
            state = None
        if not self._closing and (state is not None or self._running is None):
            self.state = state
        if self.work.get("state") == "running":
            self._acted_s = now_s
        if self.is_own and state is not None and now_s - self._acted_s > IDLE_S:
            self._close(f"nobody has used the devices for {IDLE_S / 60:g} minutes")
