"""`coupole acquire` with a console that owns the cell: the plan is entered in the queue, and followed in the
terminal.

The acquiring process belongs to the console. Signals and keys of the terminal are passed on to it; its messages
and its progress are shown here. The command ends with the same error or exit code as that process.
"""

from __future__ import annotations

import contextlib
import re
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from rich.console import Console

from coupole.acquisition.observer import Control
from coupole.acquisition.operator import ask_to_begin, refuse
from coupole.acquisition.run_control import State, ask, running
from coupole.acquisition.signals import obeyed_by
from coupole.console.command_line.client import GivenUp, NoAnswer, NotServed, call
from coupole.errors import DeviceError, DeviceLost, InputError, Interrupted, error_as_told, reason
from coupole.plan.cell import Cell
from coupole.plan.rig_devices import in_world
from coupole.preflight.checking import preflight_of
from coupole.preflight.job import read_job, without_hidden
from coupole.storage.run import Occupied, Run
from coupole.viewing.keys import key_actions
from coupole.viewing.preflight_table import show_preflight
from coupole.viewing.progress import Progress
from coupole.viewing.terminal import RunObserver, alarm

_LOOK_EVERY_S, _TRIALS, _STOP_PATIENCE_S = 0.3, 50, 2.0
_PROGRESS_LINE = re.compile(r"view \S+ \(\d+/\d+\) .* frames proven, ")
_FIELDS = tuple(Progress.__dataclass_fields__)


def acquire_by_console(
    cell: Cell,
    console: Console,
    request: dict[str, Any],
    *,
    confirm: bool,
    summary: dict[str, Any],
) -> None:
    """Enter a plan or a run to be resumed (`request`: as in `POST /api/v1/queue`), which begins at once, and
    follow it to its end. `summary` receives the figures of `--json`.

    Raises InputError if the queue is busy or if another person is in control; otherwise the errors of the
    acquisition.
    """
    if confirm and not in_world(cell.rig, dry_run=False):
        _confirm(cell, console, request)
    control = Control()
    follower = _Followed(cell, console, control)
    with obeyed_by(control, follower.stop, is_watched=False):
        follower.enter(request)
        follower.to_its_end(summary)


def _confirm(cell: Cell, console: Console, request: dict[str, Any]) -> None:
    """Show what a real cell will do, and ask for confirmation. Raises PreflightRefused, Interrupted."""
    run = Run(Path(request["resume"])) if request.get("resume") else None
    plan = Path(request["plan"]) if request.get("plan") else run.plan_path if run else Path()
    job = without_hidden(read_job(plan, cell.document.path), run.hidden_leds if run else None)
    folder = run.folder if run else Path(request.get("output") or cell.storage_folder)
    job, preflight = preflight_of(
        job, folder, occupied_space=run.occupied_space() if run else Occupied(), proven=run.proven() if run else ()
    )
    show_preflight(console, preflight, name=job.plan.name, rig=cell.rig.name)
    refuse(preflight)
    ask_to_begin(cell, confirm=True)


class _Followed:
    """An entry of the queue that this terminal has begun."""

    def __init__(self, cell: Cell, console: Console, control: Control) -> None:
        self._cell, self._console, self._control = cell, console, control
        self._entry: dict[str, Any] = {}
        self._printed = ""
        self._observer = RunObserver(console, cell.rig.frame_bytes, 0)
        self._bars = contextlib.ExitStack()
        self._has_bars = False

    def enter(self, request: dict[str, Any]) -> None:
        try:
            begin = {**request, "now": True}
            self._entry = call(self._cell, "POST", "/api/v1/queue", begin, given_up=self._control.stop.is_set)
        except GivenUp:
            raise self._control.interruption() from None
        except InputError as error:
            rig, plan = self._cell.document.path, request.get("plan") or f"--resume {request['resume']}"
            raise InputError(
                f"not begun: {error}\nA console owns this cell: `coupole queue {rig} {plan}` enters it in its "
                "queue, and shows that."
            ) from error
        if self._control.stop.is_set():
            self.stop()

    def stop(self) -> list[str]:
        """Stop the entry, whether or not it has begun; may be called from any thread. Return the devices that may
        not be safe.

        A run is stopped directly, because it obeys even if its console does not. It answers when the lights are
        off and the arm was stopped.
        """
        if not self._entry:
            return ["as far as this terminal knows, nothing has begun"]
        for _ in range(_TRIALS):
            if (trouble := self._stop_run(self._run)) is not None:
                return trouble
            try:
                if self._take_out():
                    return []
            except (NotServed, NoAnswer):  # only in these cases: otherwise the run may be another person's
                if (trouble := self._stop_run(self._run_at_work())) is not None:
                    return trouble
            if self._has_ended:
                return []
            time.sleep(_LOOK_EVERY_S)
        return ["perhaps not stopped: the run gives no answer"]

    def _take_out(self) -> bool:
        """Let the console stop the entry's process. Return True if the entry had not begun and never will. Raises
        NotServed, NoAnswer."""
        place = f"/api/v1/queue/{self._entry['id']}"
        for method, path in (("POST", f"{place}/stop"), ("DELETE", place)):
            try:
                call(self._cell, method, path, patience_s=_STOP_PATIENCE_S)
            except (NotServed, NoAnswer):
                raise
            except InputError:
                continue
            if method == "DELETE":
                return True
        return False

    def _stop_run(self, run: Path | None) -> list[str] | None:
        """Stop a run; return the devices that may not be safe. None if there is no run, or if it does not
        answer."""
        with contextlib.suppress(InputError):
            return None if run is None else list(ask(run, "stop").get("trouble", ()))
        return None

    def _run_at_work(self) -> Path | None:
        """Return this cell's present run, for the time before the console has reported it."""
        rig = str(self._cell.document.path.resolve())
        return next((Path(state["run"]) for state in running() if state["run"] and state.get("rig") == rig), None)

    @property
    def _run(self) -> Path | None:
        """Folder of the entry's run, once there is one."""
        return Path(self._entry["run"]) if self._entry.get("run") else None

    @property
    def _has_ended(self) -> bool:
        return bool(self._entry.get("ended"))

    def to_its_end(self, summary: dict[str, Any]) -> None:
        """Show the output and progress of the process until it ends; raise its error."""
        keys = {"p": self._pause_or_go_on, "q": self.stop}
        with key_actions(keys) as has_keys, self._bars:
            if has_keys:
                self._console.print("keys: p pauses after the burst, and continues; q stops")
            for output in self._outputs():
                self._entry = output["entry"]
                self._say(output["said"])
                self._show_progress()
                figures = output["figures"]
                if self._run is not None:
                    summary["run"] = str(self._run)  # also if the console does not come to tell the end
        self._conclude(figures, summary)

    def _outputs(self) -> Iterator[dict[str, Any]]:
        """Yield the output until the entry has ended. Raises Interrupted if the entry was taken out before it
        began; DeviceLost if the console has ended, after the process that it had begun."""
        is_announced = False
        while not self._has_ended:
            try:
                path = f"/api/v1/queue/{self._entry['id']}/output"
                yield call(self._cell, "GET", path, given_up=self._was_stopped, meanwhile=self._meanwhile())
            except GivenUp:
                raise self._control.interruption() from None
            except (NotServed, NoAnswer) as error:
                run = self._run or "RUN"
                if self._state() is None and self._control.stop.is_set():
                    raise self._control.interruption() from None
                if self._state() is None:
                    raise DeviceLost(
                        "console",
                        expected="the console to report how the run ended",
                        happened=reason(error),
                        remedy=f"`coupole status {run}` shows the run's state; `coupole stop {run}` stops it.",
                    ) from error
                if not is_announced:
                    is_announced = True
                    alarm(
                        "the console is gone; the run GOES ON, with its arm and lamps. Ctrl-C, q and `coupole "
                        f"stop {run}` still stop it"
                    )
                self._show_progress()
            except InputError:
                if self._control.stop.is_set():
                    raise self._control.interruption() from None
                raise
            time.sleep(_LOOK_EVERY_S)

    def _was_stopped(self) -> bool:
        """Tell whether this terminal has stopped the run, and the run has ended."""
        return self._control.stop.is_set() and self._state() is None

    def _meanwhile(self) -> str:
        run = self._run or "RUN"
        return f"; the run GOES ON, with its arm and lamps. Ctrl-C and q stop it, as does `coupole stop {run}`"

    def _state(self) -> State | None:
        try:
            return ask(self._run, "state") if self._run is not None else None
        except InputError:
            return None

    def _pause_or_go_on(self) -> None:
        state = self._state()
        if state is not None and self._run is not None:
            with contextlib.suppress(InputError):
                is_paused = state["state"] in ("paused", "pausing")
                ask(self._run, "go-on" if is_paused else "pause")

    def _say(self, output_text: str) -> None:
        """Print the new whole lines of the process's output."""
        whole = output_text[: output_text.rfind("\n") + 1]
        new = whole[len(self._printed) :] if whole.startswith(self._printed) else whole
        self._printed = whole
        for line in new.splitlines():
            if not (self._has_bars and _PROGRESS_LINE.match(line)):
                self._console.print(line, markup=False)

    def _show_progress(self) -> None:
        """Show progress bars on a terminal. Elsewhere the lines of the process report the progress."""
        state = self._state() if self._console.is_terminal else None
        if state is None or "view" not in state or self._has_ended:
            return
        progress = Progress(**{name: state[name] for name in _FIELDS})
        if not self._has_bars:
            self._has_bars = True
            self._observer = RunObserver(self._console, self._cell.rig.frame_bytes, progress.proven)
            self._bars.enter_context(self._observer.showing(progress.frames, progress.views))
        self._observer.progress(progress)

    def _conclude(self, figures: dict[str, Any], summary: dict[str, Any]) -> None:
        summary.update(
            {name: value for name, value in figures.items() if name not in ("error", "kind", "exit_code")}
        )
        if self._entry["exit_code"] == 0:
            return
        if self._entry["state"] == "stopped":
            number = self._control.signal_number
            raise Interrupted(figures.get("error") or "stopped before it began", number)
        if "error" in figures:
            raise error_as_told(figures)
        run = self._entry["run"]
        raise DeviceError(
            "cell",
            expected="the process that acquires to end by itself",
            happened=self._entry["said"] or "it was killed",
            remedy="Look at the cell: without this process, lights and arm stop by their own watchdogs"
            + (f"; go on with `coupole acquire --resume {run}`." if run else "."),
        )
