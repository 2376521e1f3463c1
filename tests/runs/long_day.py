"""One run that lasts a day and longer by the rig's clock, watched from outside: what of it grows.

The run is the real command, on disk, in a world kept outside that runs fast while the command waits and at the
pace of life while it works. Edges are dropped now and then. Whoever watches asks the world what shone in each
exposure, compares it with the journal's label, and samples memory, handles, threads, sockets and file sizes.
"""

from __future__ import annotations

import json
import random
import subprocess
import time
from collections.abc import Iterator
from contextlib import suppress
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import cells
from cells import LOW, SIDE, TOP, CellFolder, Ended
from soaking import figures_of

from coupole.errors import DeviceError
from sim.world.client import World

PAGE = 2_000
WORLD = {"hurry_only_when_told": True, "exposures_remembered": 10_000, "camera": {"render_every": 0}}
EXPOSURE_US = 250_000
"""Long, as of a dark object: fewer frames in a day."""
FULLY, HARDLY = 0.99, 0.01
DROPS_A_VIEW = 0.5
_LOOK_S, _SAMPLE_S = 0.2, 5.0


@dataclass
class Day:
    """What was seen of the run, in the order in which it was seen."""

    hours: float = 0.0
    """Of the rig's clock, from the first sample to the last."""
    labels: int = 0
    """Of the journal, each compared with what shone."""
    dropped: int = 0
    ended: Ended = field(default_factory=lambda: Ended(-1, "", ""))
    mislabelled: list[str] = field(default_factory=list)
    ends: list[str] = field(default_factory=list)
    """Why sessions ended before the run was done."""
    samples: list[dict[str, Any]] = field(default_factory=list)


def cell_in(folder: Path, hours: float, leds: int, speed: float) -> CellFolder:
    """As many views as last so many hours, each of so many LEDs, between three poses."""
    cell = CellFolder(folder, speed=speed)
    cell.rig_data["ledbox"]["settings"]["watchdog_s"] = min(60.0, 4 * speed)
    cell.join()
    view_s = (leds + 12) * (EXPOSURE_US * 1e-6 + 0.001) + 6.0  # as measured
    poses = (TOP, SIDE, LOW)
    views = [{**poses[k % 3], "name": f"v{k:04d}"} for k in range(max(2, round(hours * 3600.0 / view_s)))]
    cell.write(
        views=views,
        order="as_written",
        lights={"kind": "every", "every": 1080 // leds},
        exposure={"kind": "fixed", "exposure_us": EXPOSURE_US},
    )
    return cell


class Watcher:
    """Follows a run from outside, session by session, until it is done."""

    def __init__(self, cell: CellFolder, world: World, seed: int) -> None:
        self._cell, self._world = cell, world
        self._random = random.Random(seed)
        self._shone: dict[int, dict[int, float]] = {}
        self._seen_exposures = self._seen_bytes = 0
        self._process: subprocess.Popen[str]
        self.day = Day()

    def follow(self, most_sessions: int = 1) -> Iterator[Day]:
        """After each sample, and at the end, the day so far. A session that ends by an error of a device is told,
        and resumed: a machine that stands still for a moment does so for long on a clock that runs fast."""
        for number in range(most_sessions):
            resumed = ("--resume", self._cell.run_folder) if number else ()
            with self._cell.start_acquire(*resumed, anew=True) as self._process:
                try:
                    yield from self._follow()
                finally:
                    self._process.kill()
            if self.day.ended.code != DeviceError.exit_code:
                return
            self.day.ends.append(self.day.ended.err.strip().splitlines()[-1])
            self._shone.clear()

    def _follow(self) -> Iterator[Day]:
        run = self._cell.run_folder
        cells.wait_until((run / "journal.jsonl").exists, "a journal")
        next_s = began_s = 0.0
        while (over := self._process.poll()) is None or self._label(run):
            with suppress(DeviceError):  # the world ends after the command
                self._ask_the_world()
                self._label(run)
                if over is None and time.monotonic() >= next_s:
                    next_s = time.monotonic() + _SAMPLE_S
                    self._sample(run)
                    began_s = began_s or self.day.samples[0]["t_s"]
                    self.day.hours = (self.day.samples[-1]["t_s"] - began_s) / 3600.0
                    yield self.day
            time.sleep(_LOOK_S)
        out, err = self._process.communicate()
        self.day.ended = Ended(self._process.returncode, out, err)
        yield self.day

    def _ask_the_world(self) -> None:
        while True:
            told = self._world.ask("exposures", first=self._seen_exposures, count=PAGE)["exposures"]
            for number, frame_id, _, exposure_s, lit, panels in told:
                self._shone[frame_id] = {led: s / exposure_s for led, s in lit} | dict.fromkeys(panels, -1.0)
                self._seen_exposures = number + 1
            if len(told) < PAGE:
                return

    def _label(self, run: Path) -> int:
        """The journal's new whole lines: each frame against what shone. How many there were."""
        with (run / "journal.jsonl").open("rb") as file:
            file.seek(self._seen_bytes)
            text = file.read()
        text = text[: text.rfind(b"\n") + 1]
        self._seen_bytes += len(text)
        lines = [json.loads(line) for line in text.splitlines()]
        for event in lines:
            if event["event"] == "frame":
                self._judge(event["shot"], event["frame_id"])
            elif event["event"] == "begin" and self._random.random() < DROPS_A_VIEW:
                edge = self._world.ask("edges")["next"] + self._random.randint(20, 40)
                self._world.ask("fault", fault={"kind": "drop_trigger", "edge": edge})
                self.day.dropped += 1
        return len(lines)

    def _judge(self, shot: str, frame_id: int) -> None:
        self.day.labels += 1
        light = shot.split("/")[1]
        own = int(light[3:]) if light.startswith("led") else None
        shone = self._shone.pop(frame_id, None)
        if shone is None:
            self.day.mislabelled.append(f"{shot}: frame {frame_id} was never exposed")
            return
        full = own is None or shone.get(own, 0.0) > FULLY
        others = [led for led, share in shone.items() if led != own and abs(share) > HARDLY]
        if not full or others:
            self.day.mislabelled.append(f"{shot}: lit were {shone}")

    def _sample(self, run: Path) -> None:
        children = cells.children(self._process.pid)
        pids = {"controller": self._process.pid, "world": self._world.endpoints["pid"]}
        pids |= {"arm's process": children[0]} if children else {}
        sample: dict[str, Any] = {"t_s": self._world.ask("state")["t_s"], "labels": self.day.labels}
        for name, pid in pids.items():
            with suppress(FileNotFoundError, ProcessLookupError):
                sample[name] = {**figures_of(pid), "sockets": _sockets(pid)}
        sample["on disk"] = {
            "journal": (run / "journal.jsonl").stat().st_size,
            "ledger": sum(path.stat().st_size for path in (self._cell.folder / "ledger").rglob("*.*")),
            "run.json": (run / "run.json").stat().st_size,
            "other": _others(run),
        }
        self.day.samples.append(sample)


def _sockets(pid: int) -> int:
    found = 0
    for path in Path(f"/proc/{pid}/fd").iterdir():
        with suppress(FileNotFoundError):
            found += str(path.readlink()).startswith("socket:")
    return found


def _others(run: Path) -> int:
    """Bytes of what is neither frames nor journal nor run.json."""
    own = {"journal.jsonl", "run.json"}
    found = 0
    for path in run.rglob("*"):
        with suppress(FileNotFoundError):
            if path.is_file() and path.suffix != ".h5" and path.name not in own:
                found += path.stat().st_size
    return found


def wrong_at_the_end(cell: CellFolder, day: Day) -> list[str]:
    """Nothing was lost in silence: the command says that all is there, and all is."""
    wrong = [*day.mislabelled]
    if day.ended.code != 0:
        wrong.append(f"exit code {day.ended.code}: {day.ended.err[-1000:]}")
    expected = cells.about(cell.run_folder)["expected"]["frames"]
    if day.labels != expected:
        wrong.append(f"{day.labels} labels, {expected} frames expected")
    verified = cells.here("verify", cell.run_folder, "--json")
    if verified.code != 0 or verified.document["bad"]:
        wrong.append(f"verify: {verified.code} {verified.out[-300:]}")
    return wrong
