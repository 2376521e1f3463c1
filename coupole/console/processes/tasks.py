"""Tasks that people begin at the console, independent of the queue: commands such as `verify` and `archive`, each
in a separate process. Their output is kept while the service lives."""

from __future__ import annotations

import os
import secrets
import signal
import subprocess
import sys
import threading
import time
from collections import OrderedDict
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, BinaryIO

from coupole.console.processes.growing_file import GrowingFile
from coupole.console.processes.keeping_newest import keep_newest
from coupole.errors import InputError
from coupole.intake.plain_data import json_of
from coupole.storage.durable import make_folder
from coupole.storage.line_file import utc_now

MOST_AT_ONCE, _MOST_KEPT, _MOST_SAID = 4, 100, 20_000
_PATIENCE_S = 20.0
"""Longest wait for the end of a process, s; it includes making a cell safe."""
_COUPOLE = (sys.executable, "-m", "coupole")
_BOUND = Path(__file__).with_name("bound_process.py")
_FORMER_KEPT = 50


@dataclass
class Task:
    """One command, running or ended."""

    id: str
    words: str
    """Description of what the task does, for people."""
    command: tuple[str, ...]
    """Arguments of the command `coupole`."""
    by: str
    begun_at: str
    process: subprocess.Popen[bytes] = field(repr=False)
    folder: Path = field(repr=False)
    begun_s: float = field(default_factory=time.monotonic)
    ended_s: float | None = None
    _figures: dict[str, Any] | None = None

    def __post_init__(self) -> None:
        self._log = GrowingFile(self.folder / f"{self.id}.log", _MOST_SAID)

    @property
    def running(self) -> bool:
        if self.ended_s is None and self.process.poll() is not None:
            self.ended_s = time.monotonic()
        return self.ended_s is None

    @property
    def exit_code(self) -> int | None:
        """Exit code; None while the task runs; below 0 if a signal ended it."""
        return self.process.poll()

    @property
    def duration_s(self) -> float:
        return (self.ended_s if not self.running and self.ended_s else time.monotonic()) - self.begun_s

    @property
    def output_text(self) -> str:
        """The end of the output for people."""
        return self._log.text

    @property
    def figures(self) -> dict[str, Any]:
        """Content of `--json`; empty until the task has ended, and if there is none."""
        if self.running:
            return {}
        if self._figures is None:
            try:
                path = self.folder / f"{self.id}.json"
                figures = json_of(path.read_bytes().splitlines()[-1], str(path), allow_nan=True)
            except (OSError, InputError, IndexError):
                figures = {}
            self._figures = figures if isinstance(figures, dict) else {}
        return self._figures

    @property
    def why(self) -> str:
        """Reason why the task failed, in one line; empty if it did not fail."""
        if self.running or self.exit_code == 0:
            return ""
        lines = [line.strip() for line in self.output_text.splitlines() if line.strip()]
        return str(self.figures.get("error") or (lines[-1] if lines else "it was stopped"))

    def wait(self, timeout_s: float | None = None) -> None:
        """Wait until the task has ended. Raises subprocess.TimeoutExpired."""
        self.process.wait(timeout_s)

    def stop(self) -> None:
        """Interrupt the task, as Ctrl-C does."""
        if self.running:
            os.kill(self.process.pid, signal.SIGINT)


class Tasks:
    """All tasks during a service's life, the newest last. They end with the service, also if it is killed."""

    def __init__(self, folder: Path) -> None:
        """`folder`: for the output of processes. The newest outputs of earlier services are kept, to help in
        finding faults."""
        self._folder, self._lock = folder, threading.Lock()
        self._tasks: OrderedDict[str, Task] = OrderedDict()
        self._beginner = ThreadPoolExecutor(1, "tasks")
        """The kernel interrupts a bound process when the thread that began it ends; this thread lives as long as
        the service."""
        keep_newest(folder, _FORMER_KEPT)

    def begin(self, words: str, command: Sequence[str], by: str) -> Task:
        """Begin `coupole COMMAND... --json`. Raises InputError if too many tasks are running."""
        make_folder(self._folder)
        with self._lock:
            if sum(task.running for task in self._tasks.values()) >= MOST_AT_ONCE:
                raise InputError(f"{words}: {MOST_AT_ONCE} commands are under way; wait for one to end")
            number = secrets.token_hex(6)
            output_path, figures_path = self._folder / f"{number}.log", self._folder / f"{number}.json"
            with output_path.open("wb") as errors, figures_path.open("wb") as figures:
                process = self._beginner.submit(
                    _begin_process, [*_COUPOLE, *command, "--json"], figures, errors
                ).result()
            task = Task(number, words, tuple(command), by, utc_now(), process, self._folder)
            self._tasks[number] = task
            self._forget_old()
        return task

    @property
    def newest_first(self) -> list[Task]:
        """Return all tasks, the newest first."""
        return list(reversed(self._tasks.values()))

    def close(self) -> None:
        """Stop the running commands; a command that has not ended after 20 s is killed."""
        running = [task for task in self._tasks.values() if task.running]
        for task in running:
            task.stop()
        end_s = time.monotonic() + _PATIENCE_S
        for task in running:
            try:
                task.wait(max(0.0, end_s - time.monotonic()))
            except subprocess.TimeoutExpired:
                task.process.kill()
        self._beginner.shutdown()

    def _forget_old(self) -> None:
        for number, task in list(self._tasks.items()):
            if len(self._tasks) <= _MOST_KEPT:
                return
            if not task.running:
                del self._tasks[number]
                for kind in ("log", "json"):
                    (self._folder / f"{number}.{kind}").unlink(missing_ok=True)


def _begin_process(command: Sequence[str], figures: BinaryIO, errors: BinaryIO) -> subprocess.Popen[bytes]:
    """Begin a process that ends with the calling thread."""
    return subprocess.Popen(
        [sys.executable, "-I", "-S", _BOUND, str(os.getpid()), *command],
        stdin=subprocess.DEVNULL,
        stdout=figures,
        stderr=errors,
        start_new_session=True,
    )
