"""Runs a session to which one or two things happen, ends its freezes, gives a person's word, and judges it."""

from __future__ import annotations

import json
import os
import random
import select
import signal
import subprocess
import threading
import time
from contextlib import suppress
from dataclasses import dataclass, field
from datetime import UTC, datetime
from itertools import pairwise
from multiprocessing.connection import Connection, Listener
from pathlib import Path
from typing import Any, cast

import cells
from cells import COARSE_RELIEF, CellFolder, Ended
from failing_calls import (
    CODES,
    DARK_WITHIN_S,
    EXPOSURE_US,
    KINDS,
    SPEED,
    STILL_WITHIN_S,
    WATCHDOG_S,
    Case,
    Watch,
    cell_in,
    wrong_after_resuming,
    wrong_in_the_dose,
    wrong_in_the_journal,
)
from freezing import go_on
from happenings import ALLOWED, CHANGES, FILES, JUMPS_S, LASTING_S, MEANWHILE, READER, STOPS, Event
from nursery import NURSERY

from sim.world.client import World

ENDS_WITHIN_S = 240.0
BEAT_S = 0.5
"""The rig's `attention_s`: an arm that nobody watches brakes after it."""
BUSY_S = 0.25
"""Of the machine, by which a look may be late."""
UTC_SLACK_S = 1.0


@dataclass
class MeanwhileCase(Case):
    """What came of one case, of one or two events."""

    k2: int = 0
    kind2: str = ""
    call2: str = ""
    """Empty if the session ended before."""
    asked: bool = False
    """The run paused, and a person's word was given."""
    took_s: float = 0.0

    @property
    def reached(self) -> list[str]:
        return [kind for kind, call in ((self.kind, self.call), (self.kind2, self.call2)) if call]


@dataclass
class _Session:
    """The process, what it says, and whoever attends to it."""

    cell: CellFolder
    process: subprocess.Popen[str]
    line: Connection
    watch: Watch
    case: MeanwhileCase
    texts: dict[str, bytes] = field(default_factory=lambda: {"out": b"", "err": b""})
    frozen: int = 0
    _reading: bool = True
    _over: threading.Event = field(default_factory=threading.Event)
    _threads: list[threading.Thread] = field(default_factory=list)

    def poll(self) -> int | None:
        """As `Popen` has it; only the thread that joins a process may ask it for its exit code."""
        return 0 if self._over.is_set() else None

    def attend(self, readers: dict[str, int]) -> Ended:
        """Until it has ended by itself."""
        self._begin(self._listen)
        self._begin(self._read, readers)
        if any(kind in STOPS for kind in (self.case.kind, self.case.kind2)):
            self._begin(self._give_word)
        try:
            self.process.wait(ENDS_WITHIN_S)
        except subprocess.TimeoutExpired:
            self.case.wrong.append("it never ended")
            self.process.kill()
            self.process.wait()
        self._over.set()
        for thread in self._threads:
            thread.join()
        return Ended(self.process.returncode, *(self.texts[name].decode() for name in ("out", "err")))

    def _begin(self, what: Any, *arguments: Any) -> None:
        self._threads.append(threading.Thread(target=what, args=arguments, daemon=True))
        self._threads[-1].start()

    def _listen(self) -> None:
        """What happens, as the process tells it."""
        ended = False
        while not ended:
            ended = self._over.is_set()  # what it told last is heard still
            with suppress(EOFError, ConnectionResetError):
                while self.line.poll(0.05):
                    self._heard(*self.line.recv())
                continue
            return

    def _heard(self, kind: str, call: str, pid: int) -> None:
        first = not self.case.call and kind == self.case.kind
        if first:
            self.case.call = call
        else:
            self.case.call2 = call
        if kind not in MEANWHILE or (first and kind in STOPS):
            self.watch.begin()
        if kind in STOPS:
            self._begin(self._end_freeze, kind, pid, first)
        elif kind == READER:
            self._reading = False
            time.sleep(0.05)
            self.line.send(True)

    def _end_freeze(self, kind: str, pid: int, watched: bool) -> None:
        whose, seconds = STOPS[kind]
        self.frozen += 1
        try:
            cells.wait_until(lambda: cells.state_of(pid) in "TZ", "a frozen process")
            time.sleep(seconds)
            if watched and not self.case.call2 and cells.state_of(pid) == "T":
                self.case.wrong += self._wrong_while_frozen(whose, kind)
        finally:
            self.frozen -= 1
            with suppress(ProcessLookupError):
                os.kill(pid, signal.SIGCONT)

    def _wrong_while_frozen(self, whose: str, kind: str) -> list[str]:
        since_s, bright_s, moving_s = self.watch.so_far()
        wrong = []
        if whose == "session" and bright_s > (WATCHDOG_S + BUSY_S) * SPEED:
            wrong.append(f"{kind}: a lamp shone {bright_s:.3f} s after it")
        if whose == "session" and moving_s > STILL_WITHIN_S + (BEAT_S + BUSY_S) * SPEED:
            wrong.append(f"{kind}: the arm moved {moving_s:.3f} s after it ({since_s:.1f} s)")
        return wrong

    def _read(self, readers: dict[str, int]) -> None:
        """What it prints, as long as anybody reads."""
        while self._reading:
            over = self._over.is_set()
            ready = select.select(list(readers.values()), [], [], 0.02)[0]
            took = b""
            for name, fd in readers.items():
                if fd in ready and self._reading:
                    with suppress(BlockingIOError):
                        text = os.read(fd, 65536)
                        self.texts[name] += text
                        took += text
            if over and not took:
                return
            if ready and not took:  # closed by the session, or not opened yet
                time.sleep(0.02)

    def _give_word(self) -> None:
        """Whenever the run asks, once nothing is frozen."""
        storage = self.cell.folder / "storage"
        while self.poll() is None:
            time.sleep(0.05)
            found = sorted(storage.glob("2*/run.json"))
            if found and self.case.call and not self.frozen:
                self.case.asked |= go_on(found[0].parent, cast("Any", self))


def drawn_kind() -> str:
    """Of today."""
    return random.Random(datetime.now(UTC).date().toordinal()).choice((*KINDS, *MEANWHILE))


def draw_pair(
    draw: random.Random, calls: int, first: str | None = None, k: int | None = None
) -> tuple[Event, Event]:
    """Two failures in one session of so many calls; half of the second ones soon after the first, while the cell
    is made safe or the end is noted."""
    kinds = (*KINDS, *MEANWHILE)
    k = k or draw.randint(1, calls)
    later = draw.randint(1, 12) if draw.random() < 0.5 else draw.randint(1, calls)
    return Event(k, first or draw.choice(kinds)), Event(k + later, draw.choice(kinds))


def run_events(folder: Path, events: tuple[Event, ...]) -> MeanwhileCase:
    """The session in which these happen; the cell, what is stored, the ledger, the resumed run."""
    begun_s = time.monotonic()
    case = MeanwhileCase(events[0].k, events[0].kind)
    if len(events) > 1:
        case.k2, case.kind2 = events[1].k, events[1].kind
    cell = _cell_with_own_files(folder)
    originals = {name: (folder / path).read_bytes() for name, path in FILES.items()}
    with cell.world({"kind": "drop_trigger", "edge": 9}) as world:
        watch = Watch(world)
        from_utc = datetime.now(UTC)
        ended = _attended(cell, world, watch, events, case)
        lasted_s = (datetime.now(UTC) - from_utc).total_seconds()
        case.code = ended.code
        if ended.code not in _allowed(case):
            case.wrong.append(f"exit code {ended.code}: {ended.err[-500:]}")
        runs = sorted((folder / "storage").glob("2*/run.json"))
        run = runs[0].parent if runs else None
        if run is not None:
            case.wrong += wrong_in_what_was_read(run, case, originals)
        for name, path in FILES.items():
            (folder / path).write_bytes(originals[name])
        if "world" not in case.reached:
            case.dark_s, case.still_s = watch.end()
            case.wrong += _wrong_in_the_cell(case, world)
            case.wrong += wrong_in_the_dose(cell, world)
    if run is not None:
        if ended.code != -signal.SIGKILL:
            both = _allowed(case) - {0} if len(case.reached) > 1 else set()
            case.wrong += wrong_in_the_journal(run, ended, both)
        case.wrong += _wrong_in_the_times(run, case, from_utc.timestamp(), lasted_s)
    case.wrong += wrong_after_resuming(cell, run, ended)
    case.took_s = round(time.monotonic() - begun_s, 2)
    return case


def _cell_with_own_files(folder: Path) -> CellFolder:
    cell = cell_in(folder)
    dome = Path(cell.rig_data["dome"]["leds"])
    for name, source in (("LED table", dome), ("mesh", COARSE_RELIEF)):
        (folder / FILES[name]).write_bytes(source.read_bytes())
    cell.rig_data["dome"]["leds"] = str(folder / FILES["LED table"])
    cell.write(object={"id": "relief", "mesh": str(folder / FILES["mesh"])})
    return cell


def _attended(
    cell: CellFolder, world: World, watch: Watch, events: tuple[Event, ...], case: MeanwhileCase
) -> Ended:
    readers = {}
    for name in ("fifo", "out", "err"):
        os.mkfifo(cell.folder / name)
        if name != "fifo":
            readers[name] = os.open(cell.folder / name, os.O_RDONLY | os.O_NONBLOCK)
    happens = json.dumps([(event.k, event.kind) for event in events])
    with Listener(str(cell.folder / "line"), "AF_UNIX") as listener:
        process = NURSERY.function(
            "happenings:session", [str(cell.folder), happens, str(world.endpoints["pid"]), str(listener.address)]
        )
        with listener.accept() as line:
            try:
                return _Session(cell, process, line, watch, case).attend(readers)
            finally:
                for fd in readers.values():
                    os.close(fd)


def _allowed(case: MeanwhileCase) -> set[int]:
    every = {**CODES, **ALLOWED}
    return set[int]().union({0} if not case.reached else set(), *(every[kind] for kind in case.reached))


def _wrong_in_the_cell(case: MeanwhileCase, world: World) -> list[str]:
    state = world.ask("state")
    if state["shining"] or state["panels"] or state["arm_moving"]:
        return [f"the cell is not safe: {state}"]
    ending = [kind for kind in case.reached if kind not in MEANWHILE]
    if case.code == 0 or not ending:  # it went on
        return []
    calls = (case.call, case.call2)
    listens = not any(call.startswith("led box") for call in calls) and not any(
        kind == "sigkill" or kind in STOPS for kind in case.reached
    )
    lasts_s = sum(LASTING_S.get(kind, 0.0) for kind in case.reached)
    dark_limit_s = (DARK_WITHIN_S if listens else WATCHDOG_S * SPEED) + lasts_s
    wrong = []
    if case.dark_s is not None and case.dark_s > dark_limit_s + BUSY_S * SPEED:
        wrong.append(f"dark {case.dark_s:.3f} s after the event, {dark_limit_s:g} s promised")
    still_limit_s = STILL_WITHIN_S + lasts_s + BEAT_S * SPEED
    if case.still_s is not None and case.still_s > still_limit_s:
        wrong.append(f"the arm stood {case.still_s:.3f} s after the event, {still_limit_s:g} s promised")
    return wrong


def wrong_in_what_was_read(run: Path, case: MeanwhileCase, originals: dict[str, bytes]) -> list[str]:
    """Files may have changed since; run.json, inputs/ and verify have what was read."""
    about = cells.about(run)
    texts = [about[name]["text"].encode() for name in ("plan", "rig")]
    wrong = [
        f"run.json has another {name}"
        for name, text in zip(("plan", "rig"), texts, strict=True)
        if text != originals[name]
    ]
    kept = [path.read_bytes() for path in (run / "inputs").rglob("*") if path.is_file()]
    wrong += [
        f"inputs/ lack the {name} that was read" for name in ("LED table", "mesh") if originals[name] not in kept
    ]
    if f'"exposure_us": {EXPOSURE_US}'.encode() not in (run / "inputs/plan.yaml").read_bytes():
        wrong.append("inputs/plan.yaml is another plan")
    verified = cells.here("verify", run, "--json")
    if case.code == 0 and verified.code != 0:
        wrong.append(f"verify, of a complete run: {verified.code} {verified.out[-300:]}")
    if verified.out and json.loads(verified.out)["bad"]:
        wrong.append(f"verify finds bad frames: {verified.out[-300:]}")
    calls = [call for kind, call in ((case.kind, case.call), (case.kind2, case.call2)) if call and kind in CHANGES]
    told = cells.events(run, "changed")
    early = [call for call in calls if not call.endswith((".close", ".statistics"))]
    changed = any(
        not path.exists() or path.read_bytes() != originals[name]
        for name, path in ((name, run.parent.parent / path) for name, path in FILES.items())
    )  # one that was edited twice may be as it was
    if case.code == 0 and early and changed and not told:
        wrong.append("the journal does not tell that a file was changed")
    return wrong


def _wrong_in_the_times(run: Path, case: MeanwhileCase, from_s: float, lasted_s: float) -> list[str]:
    """Of the journal, line by line: the wall clock's, with what it had jumped by and no more. A line is written a
    moment after its time was noted, so one beside a jump may be out of order."""
    by_s = [0.0]
    for kind in case.reached:
        by_s += [by_s[-1] + JUMPS_S[kind]] if kind in JUMPS_S else []
    clocks = []
    for event in cells.events(run):
        since_s = datetime.fromisoformat(event["t"]).timestamp() - from_s
        fits = [at for at, jump_s in enumerate(by_s) if -UTC_SLACK_S < since_s - jump_s < lasted_s + UTC_SLACK_S]
        if not fits:
            return [f"the journal's line {event['event']} has the time {event['t']}"]
        clocks.append(by_s[fits[0]])
    switches = sum(a != b for a, b in pairwise(clocks))
    return [f"times of the journal go forth and back: {clocks}"] if switches > 3 * (len(by_s) - 1) else []
