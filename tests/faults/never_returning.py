"""Sessions in which one call of a device, or of a disk, never returns: a thread waits in the kernel for ever.

The session runs in a process of its own, which must end by itself; the program's limits are made short there.
"""

from __future__ import annotations

import os
import signal
import sys
import threading
import time
from collections.abc import Callable
from dataclasses import dataclass, field
from multiprocessing.process import BaseProcess
from pathlib import Path
from typing import Any

import cells
from cells import CellFolder, Ended
from forks import fork_context

from coupole import bounded
from coupole.acquisition import conclusion, opened_cell, safeguard
from coupole.acquisition.burst_runner import BurstRunner
from coupole.commands import cli

ENDS_WITHIN_S = 150.0
"""Limits of a second or two each, on a machine that may be busy; what hangs for ever is far from it."""
LIMITS_S = 1.5
_ONE = threading.Lock()
DISK_CALLS = ("pwrite", "fdatasync", "fsync", "posix_fallocate", "write")


@dataclass
class Hang:
    """The first call of `name` after the first of `after` never returns: `camera.arm`; `disk.fdatasync`, of a file
    whose path contains `file`; `motion.file`, by the thread that watches the arm while it moves."""

    name: str = ""
    after: str = ""
    file: str = ""
    again: bool = False
    """Later calls hang as well."""
    returns: bool = False
    """It returns as soon as it was given up."""
    k: int = 0
    """The k-th call of all devices hangs, in place of one with a name."""
    count: int = 0
    seen: set[str] = field(default_factory=set)

    def called(self, name: str, folder: Path, path: str = "", *, counts: bool = False) -> None:
        with _ONE:
            self.count += counts
            named = name == self.name and self.file in path and (not self.after or self.after in self.seen)
            due = named or (counts and self.count == self.k)
            mine = due and (self.again or f"{name}, hung" not in self.seen)
            self.seen |= {name, f"{name}, hung"} if mine else {name}
        if mine:
            (folder / "hangs").write_text(name)
            (folder / "hangs").rename(folder / "hanging")
            while self.returns and not bounded.left_behind():
                time.sleep(0.01)
            if self.returns:
                return
            while True:
                os.open(folder / "fifo", os.O_RDONLY)  # nobody ever writes


class HangingDevice:
    """A driver of which one call may never return."""

    def __init__(self, real: Any, device: str, hang: Hang, folder: Path) -> None:
        self._real, self._device, self._hang, self._folder = real, device, hang, folder

    def __getattr__(self, name: str) -> Any:
        value = getattr(self._real, name)
        if not callable(value):
            return value

        def call(*arguments: Any, **named: Any) -> Any:
            self._hang.called(f"{self._device}.{name}", self._folder, counts=True)
            return value(*arguments, **named)

        return call


def _session(folder: str, arguments: list[str], hang: Hang) -> None:
    """In the process that is to end by itself."""
    here = Path(folder)
    for number, name in ((1, "out"), (2, "err")):
        os.dup2(os.open(here / name, os.O_WRONLY | os.O_CREAT | os.O_TRUNC), number)
    sys.stdout, sys.stderr = os.fdopen(1, "w", closefd=False), os.fdopen(2, "w", buffering=1, closefd=False)
    for number in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP):
        signal.signal(number, signal.SIG_DFL)
    bounded.DEVICE_S = bounded.DISK_S = bounded.STOPPED_S = safeguard._SAFE_WITHIN_S = LIMITS_S
    if hang.name.startswith("disk."):  # a report that is only slow has the time that it has in life
        conclusion._REPORT_S = 0.0
    open_device = opened_cell._open_device

    def open_hanging(rig: Any, kind: str, *rest: Any, **named: Any) -> Any:
        name = {"ledbox": "led box"}.get(kind, kind)
        with bounded.under_way(name, "open"):
            hang.called(f"{name}.open", here)
        return HangingDevice(open_device(rig, kind, *rest, **named), name, hang, here)

    opened_cell._open_device = open_hanging
    look = BurstRunner.look_at_upload

    def look_and_hang(self: BurstRunner) -> None:
        with bounded.under_way(bounded.DISK, "a file"):
            hang.called("motion.file", here)
        look(self)

    BurstRunner.look_at_upload = look_and_hang
    for name in DISK_CALLS:
        setattr(os, name, _hanging_file_call(name, getattr(os, name), hang, here))
    sys.argv = ["coupole", *arguments]
    cli.main()


def _hanging_file_call(name: str, real: Callable[..., Any], hang: Hang, folder: Path) -> Callable[..., Any]:
    def call(fd: int, *arguments: Any) -> Any:
        try:
            path = str(Path(f"/proc/self/fd/{fd}").readlink())
        except OSError:
            path = ""
        if str(folder) in path:
            hang.called(f"disk.{name}", folder, path)
        return real(fd, *arguments)

    return call


@dataclass
class Session:
    """A session that hangs, or will."""

    folder: Path
    process: BaseProcess

    def hangs(self) -> str:
        """Wait until it hangs, or has ended; the name of the call."""
        told = self.folder / "hanging"
        cells.wait_until(lambda: told.exists() or not self.process.is_alive(), "the hang")
        return told.read_text() if told.exists() else ""

    def wait_until_it_hangs(self) -> None:
        assert self.hangs(), self.words

    @property
    def words(self) -> str:
        path = self.folder / "err"
        return path.read_text() if path.exists() else ""

    def ended(self) -> Ended:
        """How it ended, by itself."""
        self.process.join(ENDS_WITHIN_S)
        still_there = self.process.is_alive()
        if still_there:
            self.process.kill()
            self.process.join()
        assert not still_there, f"it never ended: {self.words}"
        return Ended(self.process.exitcode or 0, (self.folder / "out").read_text(), self.words)


def begin(cell: CellFolder, hang: Hang, *arguments: str | Path) -> Session:
    """A session, as a process: that of a run of the cell's plan, unless other arguments are given."""
    os.mkfifo(cell.folder / "fifo")
    words = [str(word) for word in arguments or ("acquire", cell.plan, "--json", "--yes")]
    process = fork_context().Process(target=_session, args=(str(cell.folder), words, hang))
    process.start()
    return Session(cell.folder, process)
