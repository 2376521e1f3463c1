"""What may happen to a session at calls of its devices, in a process of its own: failures, freezes, a reader who
stalls, files that change, a wall clock that jumps; one of them, or two in one session.

The process tells of each before it happens, on a line to whoever started it, who ends freezes and judges.
"""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass, field
from datetime import datetime, timedelta, tzinfo
from multiprocessing.connection import Client, Connection
from pathlib import Path
from types import SimpleNamespace
from typing import Any, cast

from failing_calls import LASTS_S, SIGNALS, SPEED, Watched, fail
from freezing import FROZEN, frozen_pid
from never_returning import LIMITS_S

from coupole import bounded
from coupole.acquisition import conclusion, opened_cell, safeguard
from coupole.commands import cli

STOPPED_S = (0.2, 2.0, 20.0)
"""Of the machine's time."""
STOPS = {f"{whose} stops {s:g} s": (whose, s) for whose in ("session", "arm") for s in STOPPED_S}
"""Whose process is frozen, and for how long."""
FILES = {"plan": "plan.yaml", "rig": "rig.yaml", "LED table": "leds.csv", "mesh": "relief.ply"}
CHANGES = {f"{name} {how}": (name, how) for name in FILES for how in ("edited", "truncated", "removed")}
JUMPS_S = {"clock forward": 3600.0, "clock back": -3600.0}
READER = "reader stalls"
MEANWHILE = (*STOPS, READER, *CHANGES, *JUMPS_S)
"""Nothing fails, but something stops, stalls or changes meanwhile."""
ALLOWED = {kind: {0, 4} if kind in STOPS else {0} for kind in MEANWHILE}
"""Exit codes: after a freeze a device may not have borne it; the rest a session bears."""
LASTING_S = {**LASTS_S, **{kind: (s + 1.0) * SPEED for kind, (_, s) in STOPS.items()}}
"""Of the world's time, until the session can act on it."""


@dataclass(frozen=True)
class Event:
    """What happens at the k-th call."""

    k: int
    kind: str


@dataclass
class Happenings:
    """Counts the calls of all devices; at some of them something happens."""

    events: tuple[Event, ...]
    folder: Path
    world_pid: int
    line: Connection
    count: int = 0
    _lock: threading.Lock = field(default_factory=threading.Lock)
    _telling: threading.Lock = field(default_factory=threading.Lock)

    def __call__(self, device: str, method: str, clock: Any) -> None:
        with self._lock:
            self.count += 1
            mine = [event.kind for event in self.events if event.k == self.count]
        for kind in mine:
            self._happen(kind, device, method, clock)

    def _tell(self, kind: str, call: str, pid: int = 0) -> None:
        with self._telling:
            self.line.send((kind, call, pid))
            if kind == READER:
                self.line.recv()  # nobody reads from now on

    def _happen(self, kind: str, device: str, method: str, clock: Any) -> None:
        call = f"{device}.{method}"
        if kind in STOPS:
            self._stop(kind, call)
            return
        self._tell(kind, call)
        fail(kind, device, method, clock)
        match kind:
            case "never":
                while True:
                    os.open(self.folder / "fifo", os.O_RDONLY)  # nobody ever writes
            case "world":
                with suppress(ProcessLookupError):  # the second time
                    os.kill(self.world_pid, signal.SIGKILL)
            case "sigkill" | "sigint" | "sigterm" | "sighup":
                os.kill(os.getpid(), SIGNALS.get(kind, signal.SIGKILL))
            case _:
                self._change(kind)

    def _change(self, kind: str) -> None:
        match kind:
            case _ if kind == READER:
                for name in ("out", "err"):
                    _fill(self.folder / name)
            case _ if kind in CHANGES:
                change(self.folder, *CHANGES[kind])
            case _:
                jump(JUMPS_S[kind])

    def _stop(self, kind: str, call: str) -> None:
        """Freeze this process, or the one that answers the arm; if that has none yet, nothing happens."""
        me = cast("subprocess.Popen[str]", SimpleNamespace(pid=os.getpid()))
        whose, _ = STOPS[kind]
        pid = frozen_pid(me, FROZEN[1]) if whose == "arm" else me.pid
        if whose == "arm" and pid == me.pid:
            return
        self._tell(kind, call, pid)
        with suppress(ProcessLookupError):
            os.kill(pid, signal.SIGSTOP)


def _fill(fifo: Path) -> None:
    """Until nothing fits into it; opened anew, since blocking belongs to the opening."""
    fd = os.open(fifo, os.O_WRONLY | os.O_NONBLOCK)
    for size in (4096, 1):
        with suppress(BlockingIOError):
            while True:
                os.write(fd, size * b"\n")
    os.close(fd)


def change(folder: Path, name: str, how: str) -> None:
    """One of the files that the run was made of; an edited one is as well-formed as before."""
    path = folder / FILES[name]
    if not path.exists():  # removed by another
        return
    text = path.read_bytes()
    match how:
        case "edited":
            path.write_bytes(_EDITS[name](text))
        case "truncated":
            os.truncate(path, len(text) // 2)
        case _:
            path.unlink()


_EDITS: dict[str, Callable[[bytes], bytes]] = {
    "plan": lambda text: text.replace(b'"exposure_us": 20000', b'"exposure_us": 10000'),
    "rig": lambda text: text.replace(b'"pixel_pitch_um": 176.0', b'"pixel_pitch_um": 88.0'),
    "LED table": lambda text: (
        text.replace(b"\n0,", b"\n9999,").replace(b"\n1,", b"\n0,").replace(b"\n9999,", b"\n1,")
    ),
    "mesh": lambda text: text[:-1] + bytes([text[-1] ^ 1]),
}


def jump(seconds: float) -> None:
    """The wall clock, for all that asks Python for it in this process; monotonic clocks go on."""
    Jumped.by += timedelta(seconds=seconds)
    for name, module in list(sys.modules.items()):
        if name.startswith(("coupole", "drivers")) and vars(module).get("datetime") is datetime:
            module.datetime = Jumped  # type: ignore[attr-defined]
    true_ns = _WALL_NS
    time.time = lambda: true_ns() / 1e9 + Jumped.by.total_seconds()
    time.time_ns = lambda: true_ns() + int(Jumped.by.total_seconds() * 1e9)


_WALL_NS = time.time_ns


class AnyTime(type):
    """Whoever asks whether a time is one of a set clock is told that any is."""

    def __instancecheck__(cls, value: object) -> bool:
        return isinstance(value, datetime)


class Jumped(datetime, metaclass=AnyTime):
    """Python's `datetime` of a clock that was set."""

    by = timedelta()

    @classmethod
    def now(cls, tz: tzinfo | None = None) -> datetime:  # type: ignore[override]
        return datetime.now(tz) + cls.by


def session(folder: str, happens: str, world_pid: str, line: str) -> None:
    """`acquire` in this process, to which what `happens` (JSON: call and kind of each event) does happen."""
    here, events = Path(folder), tuple(Event(*one) for one in json.loads(happens))
    for number, name in ((1, "out"), (2, "err")):
        os.dup2(os.open(here / name, os.O_WRONLY), number)
    sys.stdout, sys.stderr = os.fdopen(1, "w", closefd=False), os.fdopen(2, "w", buffering=1, closefd=False)
    for ending in SIGNALS.values():
        signal.signal(ending, signal.SIG_DFL)
    if any(event.kind == "never" for event in events):
        bounded.DEVICE_S = bounded.DISK_S = bounded.STOPPED_S = safeguard._SAFE_WITHIN_S = LIMITS_S
    conclusion._REPORT_S = 0.0
    happenings = Happenings(events, here, int(world_pid), Client(line))
    open_device = opened_cell._open_device

    def open_watched(rig: Any, kind: str, clock: Any, *rest: Any, **named: Any) -> Any:
        name = {"ledbox": "led box"}.get(kind, kind)
        return Watched(open_device(rig, kind, clock, *rest, **named), name, cast("Any", happenings), clock)

    opened_cell._open_device = open_watched
    sys.argv = ["coupole", "acquire", str(here / "plan.yaml"), "--json", "--yes"]
    cli.main()
