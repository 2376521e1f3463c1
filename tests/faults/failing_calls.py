"""A small run in which the k-th call of any device fails, and what must be true after it.

The failure is put between the session and the real drivers, which speak to a real world. Used by a test that draws
a few cases, and by `tools/fail_every_call.py`, which goes through all.
"""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Set
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any
from unittest import mock

import cells
from cells import TOP, CellFolder, Ended
from expected_pictures import mislabelled
from never_returning import LIMITS_S, Hang, begin
from nursery import NURSERY
from real_cells import true_dose_lux_h

from coupole.acquisition import opened_cell
from coupole.errors import DeviceError, DeviceTimeout
from sim.world.client import World

LIGHTS = {"kind": "every", "every": 180}
"""6 LEDs."""
NEAR = {**TOP, "name": "near", "azimuth_deg": -85, "elevation_deg": 72}
EXPOSURE_US = 20_000
SPEED = 2.0
HANG_S = 2.5
"""Of the world's time; longer than any driver waits for an answer by default."""
SIGNALS = {"sigint": signal.SIGINT, "sigterm": signal.SIGTERM, "sighup": signal.SIGHUP}
KINDS = ("error", "unexpected", "hang", "never", *SIGNALS, "sigkill", "world")
LASTS_S = {"hang": HANG_S, "never": (LIMITS_S + 2.0) * SPEED}
"""Of the world's time, until a call that hangs is given up."""
CODES = {
    "error": {0, 4},
    "unexpected": {1, 4},
    "hang": {0, 4},
    "never": {0, 4},
    "sigint": {0, 130},
    "sigterm": {0, 143},
    "sighup": {0, 129},
    "sigkill": {-signal.SIGKILL},
    "world": {0, 4},
}
"""Exit codes; 0 where the call was one whose failure the run bears, or came when all was done."""
DARK_WITHIN_S, STOP_WITHIN_S, STILL_WITHIN_S = 0.1, 0.05, 2.5
"""From the event, on the world's clock, where box and arm still listen. To brake from full speed takes 1.74 s."""
WATCHDOG_S = 2.0
QUIET_S = 0.3
"""Longer than the dark between two LEDs of a table."""
CLOCK_SHARE = 1e-3
"""By which the box's clock may run fast."""


class UnexpectedError(Exception):
    """A defect, such as any line may have."""


@dataclass
class Failure:
    """Counts the calls of all devices; the k-th one fails in its own way, or the first one of a `name`, if given
    `after` the first one of another."""

    k: int
    kind: str
    name: str = ""
    after: str = ""
    world_pid: int = 0
    on_event: Callable[[], None] = lambda: None
    calls: list[str] = field(default_factory=list)
    event_ns: int | None = None
    """Of the failure, on the rig's clock."""
    stop_s: float | None = None
    """From then until the arm's `stop` was first called."""
    _named: bool = False
    _lock: threading.Lock = field(default_factory=threading.Lock)

    def __call__(self, device: str, method: str, clock: Any) -> None:
        with self._lock:
            called = f"{device}.{method}"
            named = called == self.name and not self._named and (not self.after or self.after in self.calls)
            self._named |= named
            mine = named or len(self.calls) + 1 == self.k
            self.calls.append(called)
            if called == "robot.stop" and self.event_ns is not None and self.stop_s is None:
                self.stop_s = (clock.now_ns() - self.event_ns) * 1e-9
        if not mine:
            return
        self.event_ns = clock.now_ns()
        self.on_event()
        fail(self.kind, device, method, clock)
        match self.kind:
            case "world":
                os.kill(self.world_pid, signal.SIGKILL)
            case "sigkill":
                os.kill(os.getpid(), signal.SIGKILL)
            case name:
                os.kill(os.getpid(), SIGNALS[name])


def fail(kind: str, device: str, method: str, clock: Any) -> None:
    """What a call of a device may raise; nothing for other kinds."""
    match kind:
        case "error":
            raise DeviceError(device, expected="an answer", happened="an error was put in", remedy="None.")
        case "unexpected":
            raise UnexpectedError(f"put into {device}.{method}")
        case "hang":
            clock.sleep(HANG_S)
            raise DeviceTimeout(device, expected="an answer", happened="it hung", remedy="None.")


class Watched:
    """A driver each of whose calls is counted, and may fail before it reaches the device."""

    def __init__(self, real: Any, device: str, failure: Failure, clock: Any) -> None:
        self._real, self._device, self._failure, self._clock = real, device, failure, clock

    def __getattr__(self, name: str) -> Any:
        value = getattr(self._real, name)
        if not callable(value):
            return value

        def call(*arguments: Any, **named: Any) -> Any:
            self._failure(self._device, name, self._clock)
            return value(*arguments, **named)

        return call

    def close(self) -> None:
        """The real one is closed, whatever is put in: processes and sockets of a case must not outlive it."""
        try:
            self._failure(self._device, "close", self._clock)
        finally:
            self._real.close()


def cell_in(folder: Path) -> CellFolder:
    """Two near views of 6 LEDs whose world is kept outside; the box drops one edge: a shot is taken again. A run
    of all kinds of calls can hardly be smaller; tens of thousands of them are judged."""
    cell = CellFolder(folder, speed=SPEED)
    cell.rig_data["ledbox"]["settings"]["watchdog_s"] = WATCHDOG_S * SPEED
    cell.join()
    exposure = {"kind": "fixed", "exposure_us": EXPOSURE_US}
    cell.write(views=[TOP, NEAR], lights=LIGHTS, darks_per_view=1, exposure=exposure)
    return cell


def acquire(cell: CellFolder, failure: Failure, *options: str | Path) -> Ended:
    """The session in this process, its devices watched."""
    open_device = opened_cell._open_device

    def open_watched(rig: Any, kind: str, clock: Any, *arguments: Any, **named: Any) -> Any:
        name = {"ledbox": "led box"}.get(kind, kind)
        return Watched(open_device(rig, kind, clock, *arguments, **named), name, failure, clock)

    with mock.patch.object(opened_cell, "_open_device", open_watched):
        return cell.acquire(*options)


@dataclass
class Case:
    """What came of one case."""

    k: int
    kind: str
    call: str = ""
    code: int = 0
    dark_s: float | None = None
    """From the event until no lamp shone, on the world's clock; None if none shone, or the world died."""
    stop_s: float | None = None
    """From the event until the arm was told to stop; None if it was not, or the process died."""
    still_s: float | None = None
    """From the event until the arm stood; None if it did, or the world died."""
    wrong: list[str] = field(default_factory=list)

    def line(self) -> dict[str, Any]:
        return asdict(self)


def count_calls(folder: Path) -> list[str]:
    """Names of all calls of a session without failure, in their order."""
    cell, failure = cell_in(folder), Failure(0, "")
    with cell.world({"kind": "drop_trigger", "edge": 9}):
        ended = acquire(cell, failure)
    assert ended.code == 0, ended
    assert ended.document["reshot"] == 1
    return failure.calls


def run_case(folder: Path, k: int, kind: str) -> Case:
    """Run the plan with the k-th call failing, look at the cell, resume the run, look at what is stored."""
    cell, case = cell_in(folder), Case(k, kind)
    signal.signal(signal.SIGHUP, signal.SIG_DFL)  # whoever runs this may have ignored it
    with cell.world({"kind": "drop_trigger", "edge": 9}) as world:
        watch = Watch(world)
        failure = Failure(k, kind, world_pid=world.endpoints["pid"], on_event=watch.begin)
        if kind == "sigkill":
            ended = _killed(cell, k, watch)
        elif kind == "never":
            session = begin(cell, Hang(k=k))
            if call := session.hangs():
                case.call = call
                watch.begin()
            ended = session.ended()
        else:
            ended = acquire(cell, failure)
            case.call = failure.calls[k - 1] if len(failure.calls) >= k else ""
            case.stop_s = failure.stop_s
        case.code = ended.code
        reached = ended.code != 0 if kind == "sigkill" else bool(case.call)  # a session may have fewer calls
        if ended.code not in (CODES[kind] if reached else {0}):
            case.wrong.append(f"exit code {ended.code}: {ended.err[-500:]}")
        if kind != "world":
            case.dark_s, case.still_s = watch.end()
            case.wrong += _wrong_in_the_cell(case, world)
            case.wrong += wrong_in_the_dose(cell, world)
    runs = sorted((folder / "storage").glob("2*/run.json"))
    if runs and kind != "sigkill":
        case.wrong += wrong_in_the_journal(runs[0].parent, ended)
    case.wrong += wrong_after_resuming(cell, runs[0].parent if runs else None, ended)
    return case


class Watch:
    """Looks at the world every few milliseconds, from the event until the session has ended, and for `QUIET_S`
    nothing has shone and the arm has stood: a box without its host goes on with its table, LED by LED."""

    def __init__(self, world: World) -> None:
        self._world, self._thread = world, threading.Thread(target=self._look, daemon=True)
        self._session_over = threading.Event()
        self._dark_s: float | None = None
        self._still_s: float | None = None

    def begin(self) -> None:
        """The event is now; a later one counts in place of the earlier."""
        self._event_s = self._world.clock.now_ns() / 1e9
        self._dark_s = self._still_s = None
        if self._thread.ident is None:
            self._thread.start()

    def so_far(self) -> tuple[float, float, float]:
        """Seconds since the event, since then until it was last seen bright, and moving."""
        return self._world.clock.now_ns() / 1e9 - self._event_s, self._dark_s or 0.0, self._still_s or 0.0

    def end(self) -> tuple[float | None, float | None]:
        """Seconds from the event until it was dark, and until the arm stood."""
        self._session_over.set()
        if self._thread.ident is not None:
            self._thread.join(cells.PATIENCE_S)
        return self._dark_s, self._still_s

    def _look(self) -> None:
        end_s = time.monotonic() + cells.PATIENCE_S
        busy_s = 0.0
        while time.monotonic() < end_s:
            try:
                state = self._world.ask("state")
            except (DeviceError, ValueError):  # the world was killed
                return
            late_s = state["t_s"] - self._event_s
            if state["shining"] or state["panels"]:
                self._dark_s = busy_s = late_s
            if state["arm_moving"]:
                self._still_s = busy_s = late_s
            if not self._session_over.is_set():
                busy_s = late_s
            elif late_s > busy_s + QUIET_S:
                return
            time.sleep(0.002)


def _killed(cell: CellFolder, k: int, watch: Watch) -> Ended:
    """The session in a process of its own, which kills itself at its k-th call."""
    streams = {"stdout": subprocess.PIPE, "stderr": subprocess.PIPE, "text": True}
    with NURSERY.function("failing_calls:acquire_and_die", [str(cell.folder), str(k)], **streams) as process:
        out, err = process.communicate(timeout=cells.PATIENCE_S)
        watch.begin()
    return Ended(process.returncode, out, err)


def acquire_and_die(folder: str, k: str) -> None:
    """In a process of its own: kills it at the k-th call of its devices."""
    cell = CellFolder(Path(folder), speed=SPEED, write_now=False)
    sys.exit(acquire(cell, Failure(int(k), "sigkill")).code)


def _wrong_in_the_cell(case: Case, world: World) -> list[str]:
    wrong = []
    state = world.ask("state")
    if state["shining"] or state["panels"] or state["arm_moving"]:
        wrong.append(f"the cell is not safe: {state}")
    if case.code == 0:  # the failure was borne: there was nothing to end
        return wrong
    listens = case.kind != "sigkill" and not case.call.startswith("led box")
    lasts_s = LASTS_S.get(case.kind, 0.0)
    limit_s = (DARK_WITHIN_S if listens else WATCHDOG_S * SPEED) + lasts_s
    if case.dark_s is not None and case.dark_s > limit_s + 0.1 * SPEED:
        wrong.append(f"dark {case.dark_s:.3f} s after the event, {limit_s:g} s promised")
    stop_limit_s = STOP_WITHIN_S + lasts_s
    if case.stop_s is not None and case.stop_s > stop_limit_s + 0.25 * SPEED:  # of a busy machine
        wrong.append(f"told the arm to stop {case.stop_s:.3f} s after the event, {stop_limit_s:g} s promised")
    if case.still_s is not None and case.still_s > STILL_WITHIN_S + lasts_s:
        wrong.append(f"the arm stood {case.still_s:.3f} s after the event")
    return wrong


def wrong_in_the_dose(cell: CellFolder, world: World) -> list[str]:
    """What the run says that it gave, against the world's own account."""
    true_lux_h = float(true_dose_lux_h(cell, world).max())
    runs = sorted((cell.folder / "storage").glob("2*/run.json"))
    told_lux_h = 0.0
    if runs:
        told_lux_h = cells.here("status", runs[0].parent, "--json").document["dose_lux_h"]
    if true_lux_h > told_lux_h * (1.0 + CLOCK_SHARE) + 1e-9:
        return [f"the object received {true_lux_h:.6f} lux.h, the run counts {told_lux_h:.6f}"]
    return []


def wrong_in_the_journal(run: Path, ended: Ended, codes: Set[int] = frozenset()) -> list[str]:
    """`codes`: other exit codes that the session may have had, where one event came while another ended it."""
    stops = cells.events(run, "stop")
    if not stops:
        return [] if not cells.events(run) else ["the journal has no line of the session's end"]
    done = stops[-1]["outcome"] == "done"
    outcomes = {0: "done", 130: "interrupted", 143: "interrupted", 129: "interrupted"}
    expected = {outcomes.get(code, "failed") for code in {ended.code, *codes}}
    while_it_closed = done and ended.code in {1, 4, 129, 130, 143}
    if stops[-1]["outcome"] not in expected and not while_it_closed:
        return [f"the journal says {stops[-1]['outcome']}, the exit code was {ended.code}"]
    proven = len({event["shot"] for event in cells.events(run, "frame")})
    return (
        ["the journal says done, but frames are missing"]
        if done and proven < cells.about(run)["expected"]["frames"]
        else []
    )


def wrong_after_resuming(cell: CellFolder, run: Path | None, ended: Ended) -> list[str]:
    """In a new world; a fault of the arm is confirmed first, and must be asked for."""
    again = ("--resume", run) if run is not None else ()
    with cell.world():
        resumed = cell.acquire(*again)
        if resumed.code == 4 and "confirmation by a person" in resumed.err:
            cell.confirm()
            resumed = cell.acquire(*again)
    if resumed.code != 0:
        return [f"the run was not resumed: {resumed.code} {resumed.err[-500:]}"]
    try:
        cells.assert_each_shot_proven_once(cell.run_folder)
    except AssertionError as error:
        return [f"after resuming: {str(error)[:500]}"]
    return [f"mislabelled: {line}" for line in mislabelled(cell, cell.run_folder)]
