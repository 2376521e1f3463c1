"""Acquisition of a plan from a script or a notebook, as an iterator of events.

The run is a separate process, `coupole acquire`. Therefore the caller's pauses, garbage collection, debugger and
signal handlers never delay the thread that watches the arm. This module reads the run's journal. When the loop
ends, for whatever reason, the process is interrupted as by Ctrl-C and makes the cell safe. If the thread that
began the process dies, the kernel interrupts it (docs/decisions/0058-python-face.md).
"""

from __future__ import annotations

import logging
import os
import signal
import subprocess
import sys
import tempfile
import time
from collections import deque
from collections.abc import Iterator, Mapping
from pathlib import Path
from types import TracebackType
from typing import Any

from coupole.acquisition.run_control import running
from coupole.console.processes import bound_process
from coupole.errors import InputError, Interrupted, error_as_told, unsafe_end
from coupole.intake.plain_data import read_json
from coupole.scripting.plans import Plan
from coupole.storage.journal import Follower
from coupole.storage.journal_events import Event
from coupole.storage.run import Run
from coupole.storage.stopped_process import is_stopped

AnyPath = str | os.PathLike[str]
_LOG = logging.getLogger("coupole")
_LOOK_EVERY_S = 0.1
_SIGNALLED = 128
"""An exit code above this means that a signal ended the process."""
_ENDS_WITHIN_S = 600.0
"""Longest wait for the end of the process, s: longer than a session in which every call hangs, and than a slow
report."""


class Acquisition(Iterator[Event]):
    """A run that is being acquired: an iterator of its journal's events. Use it in a `with` statement: when this
    ends, the run is over and the cell is safe."""

    run: Path | None
    """The run's folder, absolute; None until it exists."""
    figures: Mapping[str, Any]
    """Figures of the run, as in `coupole acquire --json`; empty until the run is over."""

    def __init__(self, arguments: list[str], plan: Plan | None, run: Path | None) -> None:
        self.run, self.figures = None, {}
        self._events: deque[Event] = deque()
        self._follower: Follower | None = None
        self._words, self._stands_still = "", False
        self._folder = tempfile.TemporaryDirectory(prefix="coupole-")
        if plan is not None:
            arguments = [str(plan.write(Path(self._folder.name) / "plan.yaml")), *arguments]
        if run is not None:
            self._follow(run, skip_old=True)
        self._process = self._begin(arguments)

    def _begin(self, arguments: list[str]) -> subprocess.Popen[bytes]:
        command = [sys.executable, "-m", "coupole", "acquire", *arguments, "--json"]
        with self._output_path("errors").open("wb") as errors, self._output_path("figures").open("wb") as figures:
            return subprocess.Popen(
                [sys.executable, bound_process.__file__, str(os.getpid()), *command],
                stdin=subprocess.DEVNULL,
                stdout=figures,
                stderr=errors,
                start_new_session=True,  # a Ctrl-C of the terminal reaches it once, through `close`
            )

    def __enter__(self) -> Acquisition:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()

    def __del__(self) -> None:
        if hasattr(self, "_process"):
            self.close()

    def __next__(self) -> Event:
        """Wait for the next event and return it. After the last event, raises the command's error if it failed
        (InputError, PreflightRefused, DeviceError, UnprovenError, StorageError, Interrupted)."""
        while not self._events:
            is_over = self._process.poll() is not None
            self._look()
            if not self._events:
                if is_over:
                    self._conclude()
                    raise StopIteration
                self._tell_if_it_stands_still()
                time.sleep(_LOOK_EVERY_S)
        return self._events.popleft()

    def close(self) -> None:
        """Stop the run if it is not over: lights off, arm still, camera disarmed. Returns when its process has
        ended; the run can be resumed. Raises DeviceError if it is not certain that the cell is safe."""
        was_over = self._process.poll() is not None
        if not was_over:
            self._process.send_signal(signal.SIGINT)
            self._process.send_signal(signal.SIGCONT)  # a stopped process must run to end
        self._take_in_the_end()
        if not was_over and (trouble := self.figures.get("unsafe")):
            raise unsafe_end("; ".join(trouble))

    def _tell_if_it_stands_still(self) -> None:
        """Log once that the run's process is stopped (SIGSTOP): no events come until it runs again."""
        stands_still = is_stopped(self._process.pid)
        if stands_still and not self._stands_still:
            _LOG.warning(
                "process %d, which acquires, is stopped (SIGSTOP): `kill -CONT %d` lets it run again; it then "
                "asks a person (`coupole go-on %s`)",
                self._process.pid,
                self._process.pid,
                self.run or "RUN",
            )
        self._stands_still = stands_still

    def _look(self) -> None:
        """Add the journal's new events."""
        if self._follower is None:
            self._find_run()
        if self._follower is not None:
            self._events += self._follower.news()

    def _find_run(self) -> None:
        if self._process.poll() is None:
            runs = [state["run"] for state in running() if state["pid"] == self._process.pid]
        else:
            self._take_in_the_end()
            runs = [self.figures["run"]] if "run" in self.figures else []
        if runs:
            self._follow(Path(runs[0]), skip_old=False)

    def _follow(self, run: Path, *, skip_old: bool) -> None:
        self.run = run.resolve()
        self._follower = Follower(Run(run).journal_path)
        if skip_old:
            self._follower.news()

    def _conclude(self) -> None:
        """Raise the error of the process, if it failed."""
        self._take_in_the_end()
        code = self._process.returncode
        if code == 0:
            return
        if "error" in self.figures:
            raise error_as_told(self.figures)
        if code > _SIGNALLED:
            raise Interrupted(self._words or "stopped before it began", code - _SIGNALLED)
        if code > 0:
            raise RuntimeError(f"`coupole acquire` ended with exit code {code}: {self._words}")
        raise unsafe_end(f"its process was killed (signal {-code}); lights and arm stop by their own watchdogs")

    def _take_in_the_end(self) -> None:
        """Wait for the end of the process, and read its output."""
        try:
            self._process.wait(_ENDS_WITHIN_S)
        except subprocess.TimeoutExpired as error:
            what = f"its process {self._process.pid} has not ended within {_ENDS_WITHIN_S:g} s"
            raise unsafe_end(what) from error
        if not self._output_path("figures").exists():
            return
        self._words = self._output_path("errors").read_text(errors="replace").strip()
        figures = self._output_path("figures")
        self.figures = read_json(figures) if figures.stat().st_size else {}
        self._folder.cleanup()

    def _output_path(self, name: str) -> Path:
        return Path(self._folder.name) / name


def acquire(
    plan: Plan | AnyPath | None = None,
    *,
    rig: AnyPath | None = None,
    output: AnyPath | None = None,
    resume: AnyPath | None = None,
    yes: bool = False,
) -> Acquisition:
    """Acquire a plan (a `Plan`, a file, or the name of a shipped one), or resume a run; return an iterator of
    events.

    `rig` replaces the plan's rig; `output` is the parent folder of the run. A real cell moves only if `yes` is
    True. Events are those of the journal (`coupole.events`), such as `FrameProven` with `shot`, `file` and
    `index`. Raises InputError for arguments that do not go together. The iterator raises the errors of
    `Acquisition.__next__`.

    ::

        with coupole.acquire("demo-short") as events:
            for event in events:
                print(event.event)
    """
    if (plan is None) == (resume is None):
        raise InputError("expected a plan, or `resume` with a run's folder, and not both")
    if resume is not None and output is not None:
        raise InputError("a resumed run keeps its folder: `resume` excludes `output`")
    options = {"--rig": rig, "--output": output, "--resume": resume}
    arguments = [word for name, path in options.items() if path is not None for word in (name, os.fspath(path))]
    arguments += ["--yes"] if yes else []
    if isinstance(plan, Plan):
        return Acquisition(arguments, plan, None)
    plan_words = [] if plan is None else [os.fspath(plan)]
    return Acquisition([*plan_words, *arguments], None, None if resume is None else Path(resume))
