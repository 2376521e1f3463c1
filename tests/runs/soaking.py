"""Rehearsals with random faults, whose every label is checked against the world's truth.

A rehearsal runs a plan on stand-ins, faster than life, and writes nothing, as a dry run does. One world and one
controller outlive many of them, and what ends a session is put right as an operator would: the arm is reset, a hot
board cools, a box whose cable was cut is powered on again. Sessions then go on with what is not proven yet.

The truth comes from the world's record of what shone while the sensor was exposed, asked for on its control
connection; the controller never sees it. Used by a test with a few thousand shots, and by `tools/soak.py`.
"""

from __future__ import annotations

import contextlib
import gc
import os
import resource
from collections import Counter
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from cells import LOW, SIDE, TOP, CellFolder

from coupole.acquisition.memory_recorder import MemoryRecorder
from coupole.acquisition.opened_cell import open_cell
from coupole.acquisition.operator import UNLIMITED_BYTES
from coupole.acquisition.recorder import ViewStart
from coupole.acquisition.sequencer import Sequencer
from coupole.devices import Frame
from coupole.errors import DeviceError, UnprovenError
from coupole.plan.shot_id import Led, ShotId
from coupole.preflight.checking import check_job
from coupole.preflight.job import read_job
from coupole.preflight.preflight import StorageFacts
from sim.world.client import World

REMEMBERED, PAGE = 8_192, 400
"""Exposures that the world remembers, and how many it tells at a time."""
FULLY, HARDLY = 0.99, 0.01
"""An exposure's own LED shines during more than the first share of it, all others during less than the second."""
FLICKERING_FULLY = 0.3
"""The same for an LED whose flux varies."""
MOST_SESSIONS = 25
"""Of one rehearsal. An LED whose contact is loose costs several."""
COOLING_S = 40.0
"""In which a board cools from 5 K above the limit of 75 C, with a time constant of 240 s: 21.6 s are needed."""

BORNE = {
    "drop_trigger": 20,
    "double_trigger": 20,
    "lost_transfer": 20,
    "dead_led": 10,
    "short_nudge": 8,
    "few_late_rsi": 6,
    "flickering_led": 1,
}
"""Faults that a session is to bear, by how often they are drawn."""
ENDING = {
    "long_nudge": 2,
    "many_late_rsi": 2,
    "rsi_link_loss": 2,
    "short_mute": 2,
    "long_mute": 2,
    "emergency_stop": 1,
    "over_temperature": 1,
    "cut_wire": 0.25,
    "unplug_camera": 0.25,
}
"""Faults that may end a session; it is resumed."""
KIND = {
    "short_nudge": "nudge_arm",
    "long_nudge": "nudge_arm",
    "few_late_rsi": "late_rsi",
    "many_late_rsi": "late_rsi",
    "short_mute": "mute_box",
    "long_mute": "mute_box",
}
"""What the world calls a fault, where that is not its name here."""
LEDS_PER_BOARD = 6
NEW_WORLD = ("cut_wire", "unplug_camera")
"""After these the stand-ins are powered on again."""


@dataclass(frozen=True)
class Ordered:
    """A fault that will happen when the box has sent so many edges, or the camera has made so many exposures."""

    name: str
    edge: int


@dataclass
class Rehearsed:
    """What came of one rehearsal."""

    number: int
    shots: int = 0
    frames: int = 0
    proven: int = 0
    """Frames proven, darks and marks included."""
    sessions: int = 0
    reshot: int = 0
    faults: Counter[str] = field(default_factory=Counter)
    ended_by: Counter[str] = field(default_factory=Counter)
    """Sessions that ended early, by the device of the error."""
    told_missing: list[str] = field(default_factory=list)
    mislabelled: list[str] = field(default_factory=list)
    twice: list[str] = field(default_factory=list)
    lost: list[str] = field(default_factory=list)
    """Neither proven nor told as missing."""
    unexplained: list[str] = field(default_factory=list)
    """Sessions that ended though no fault that ends one had happened."""
    controller: dict[str, int] = field(default_factory=dict)
    world: dict[str, int] = field(default_factory=dict)

    def line(self) -> dict[str, Any]:
        return dict(vars(self))


class CheckedRecorder(MemoryRecorder):
    """Keeps which frame was proven as which shot, until the world is asked."""

    def __init__(self, before_view: Callable[[str], None], after_view: Callable[[], None]) -> None:
        super().__init__()
        self._before_view, self._after_view = before_view, after_view
        self._frames: list[tuple[int, int]] = []
        self.labelled: list[tuple[ShotId, tuple[int, int]]] = []
        """Shots with id and timestamp of their frames, since the world was last asked."""

    def begin_view(self, start: ViewStart) -> None:
        super().begin_view(start)
        self._before_view(start.view)

    def store(self, frame: Frame, exposure_us: int) -> int:
        slot = len(self._frames)
        self._frames.append((frame.frame_id, frame.timestamp_ns))
        return slot

    def prove(self, slot: int, shot: ShotId, fields: Mapping[str, int]) -> None:
        super().prove(slot, shot, fields)
        self.labelled.append((shot, self._frames[slot]))

    def end_view(self) -> None:
        self._frames.clear()
        self._after_view()


class Soak:
    """A cell in a folder, its world, and rehearsals one after the other."""

    def __init__(self, folder: Path, *, seed: int, faults_per_shot: float, speed: float, leds: int = 1080) -> None:
        self._cell = CellFolder(folder, speed=speed)
        self._cell.rig_data["ledbox"]["settings"]["watchdog_s"] = min(60.0, 4 * speed)
        self._cell.join()
        self._cell.write(views=[TOP, SIDE, LOW], lights={"kind": "every", "every": 1080 // leds})
        self._job, _ = check_job(read_job(self._cell.plan), StorageFacts(UNLIMITED_BYTES))
        self._seed, self._rate = seed, faults_per_shot
        self._holder = contextlib.ExitStack()
        self._flickering: set[int] = set()
        self.world = self._new_world()

    def _new_world(self) -> World:
        """One that runs fast only while the controller says that it waits, as in a dry run."""
        self._holder.close()
        self._ordered: list[Ordered] = []
        self._seen_exposures = 0
        self._flickering.clear()
        settings = {
            "hurry_only_when_told": True,
            "exposures_remembered": REMEMBERED,
            "camera": {"render_every": 0},
        }
        world: World = self._holder.enter_context(self._cell.world(**settings))
        return world

    def close(self) -> None:
        self._holder.close()

    # -- one rehearsal ----------------------------------------------------------------------------------------

    def rehearse(self, number: int, recorder_of: type[CheckedRecorder] = CheckedRecorder) -> Rehearsed:
        """The plan, with faults drawn by the soak's seed and this number."""
        self._random = np.random.default_rng([self._seed, number])
        self._found = Rehearsed(number, shots=self._job.schedule.shots, frames=self._job.schedule.frames)
        self._gap: int | None = None
        self._judged: Counter[ShotId] = Counter()
        self._recorder = recorder_of(self._order_faults, self._check_labels)
        expected = {
            shot for bursts in self._job.schedule.bursts for burst in bursts for shot in burst.shots if shot
        }
        for _ in range(MOST_SESSIONS):
            if self._session(expected):
                break
        found = self._found
        done = set(self._judged)
        found.proven, found.twice = len(done), [str(shot) for shot, count in self._judged.items() if count > 1]
        found.lost += sorted(str(shot) for shot in expected - done if str(shot) not in set(found.told_missing))
        found.lost += [f"{shot}, which nobody asked for" for shot in done - expected]
        gc.collect()  # what a session leaves behind is freed at the collector's next turn; held is what is left
        found.controller, found.world = figures_of(os.getpid()), figures_of(self.world.endpoints["pid"])
        return found

    def _session(self, expected: set[ShotId]) -> bool:
        """One session with what is left; True if it says that the plan is complete. If it gets to its end, it must
        tell all that is missing."""
        found = self._found
        found.sessions += 1
        happened_before = +found.faults
        device, why = "", ""
        outcome = None
        try:
            with open_cell(self._job.cell, job=self._job) as cell:
                sequencer = Sequencer(self._job, cell, self._recorder)
                outcome = sequencer.outcome
                sequencer.acquire()
        except UnprovenError as error:
            device, why = "unproven", str(error)
        except DeviceError as error:
            device, why = error.device, str(error)
        if outcome is not None:
            found.reshot += outcome.reshot
            told = {*outcome.missing, *outcome.missing_darks}
            found.told_missing = sorted(map(str, told))
            if device in ("", "unproven"):
                silent = expected - set(self._judged) - told
                found.lost += [f"{shot}, in session {found.sessions}" for shot in silent]
        self._count_what_happened()
        if device:
            self._put_right(device, why, found.faults - happened_before)
        return not device

    def _put_right(self, device: str, why: str, happened: Counter[str]) -> None:
        """What an operator does before the session is resumed."""
        self._found.ended_by[device] += 1
        if device != "unproven" and not any(name in ENDING for name in happened):
            self._found.unexplained.append(f"{dict(happened)}: {why}")
        if any(name in happened for name in NEW_WORLD):
            self.world = self._new_world()
            return
        self.world.ask("reset_robot")
        wait_s = COOLING_S if "over_temperature" in happened else 2.0
        self.world.clock.hurry(self.world.clock.now_ns() + int(wait_s * 1e9))
        self.world.clock.sleep(wait_s)

    # -- faults -----------------------------------------------------------------------------------------------

    def _order_faults(self, view: str) -> None:
        """Before the bursts of a view: those of its next edges at which a fault is due are told to the world."""
        self._count_what_happened()
        edge, frame = self.world.ask("edges")["next"], self.world.ask("exposures", first=0, count=0)["next"]
        burst = next(own[0] for own in self._job.schedule.bursts if own[0].view == view)
        leds = [label.light.id for label in burst.labels if label and isinstance(label.light, Led)]
        if self._gap is None:
            self._gap = self._draw_gap()
        left = sum(shot is not None and shot not in self._recorder.proven() for shot in burst.shots)
        at = self._gap
        while at < left:
            name, fault = self._draw(edge + at, frame + at, leds[min(at, len(leds) - 1) :][:40])
            refused = self.world.ask("fault", fault=fault).get("error")
            assert not refused, refused
            self._ordered.append(Ordered(name, edge + at))
            at += 1 + self._draw_gap()
        self._gap = at - left

    def _draw_gap(self) -> int:
        return int(self._random.geometric(self._rate)) if self._rate else 2**40

    def _draw(self, edge: int, frame: int, leds: list[int]) -> tuple[str, dict[str, Any]]:
        """A fault's name here, and the fault for the world; `leds` are those to be lit next."""
        random, weights = self._random, {**BORNE, **ENDING}
        share = np.array(list(weights.values())) / sum(weights.values())
        name = str(random.choice(list(weights), p=share))
        led = int(random.choice(leds))
        if name == "flickering_led":
            self._flickering.add(led)
        settings: dict[str, dict[str, Any]] = {
            "drop_trigger": {"edge": edge},
            "double_trigger": {"edge": edge, "delay_us": int(random.integers(50, 20_000))},
            "lost_transfer": {"frame": frame},
            "dead_led": {"led": led, "seconds": float(random.choice([0.4, 4.0, 25.0])), "at_edge": edge},
            "flickering_led": {"led": led},
            "over_temperature": {"board": led // LEDS_PER_BOARD, "at_edge": edge},
            "short_nudge": {"seconds": float(random.uniform(0.1, 1.2)), "at_edge": edge},
            "long_nudge": {"deg": float(random.uniform(0.05, 0.5)), "at_edge": edge},
            "few_late_rsi": {"cycles": int(random.integers(1, 10)), "at_edge": edge},
            "many_late_rsi": {"cycles": 200, "at_edge": edge},
            "short_mute": {"seconds": float(random.uniform(0.05, 1.0)), "at_edge": edge},
            "long_mute": {"seconds": float(random.uniform(3.0, 8.0)), "at_edge": edge},
            "rsi_link_loss": {"seconds": float(random.uniform(0.2, 5.0)), "at_edge": edge},
        }
        return name, {"kind": KIND.get(name, name), **settings.get(name, {"at_edge": edge})}

    def _count_what_happened(self) -> None:
        """Of the ordered faults, those whose edge has come."""
        edge = self.world.ask("edges")["next"]
        self._found.faults.update(one.name for one in self._ordered if one.edge < edge)
        self._ordered = [one for one in self._ordered if one.edge >= edge]

    # -- truth ------------------------------------------------------------------------------------------------

    def _check_labels(self) -> None:
        """After a view: every label since the last one against what shone."""
        light_of: dict[tuple[int, int], list[Any]] = {}
        while True:
            told = self.world.ask("exposures", first=self._seen_exposures, count=PAGE)["exposures"]
            for number, frame_id, timestamp_ns, exposure_s, seconds_of_led, panels in told:
                light_of[frame_id, timestamp_ns] = [exposure_s, dict(seconds_of_led), panels]
                self._seen_exposures = number + 1
            if len(told) < PAGE:
                break
        for shot, frame in self._recorder.labelled:
            self._judged[shot] += 1
            if why := self._wrong(shot, light_of.get(frame)):
                self._found.mislabelled.append(f"{shot}: {why}")
        self._recorder.labelled.clear()

    def _wrong(self, shot: ShotId, truth: list[Any] | None) -> str:
        """Why the label is false; empty if it is true."""
        if truth is None:
            return "no such exposure"
        exposure_s, seconds_of_led, panels = truth
        own = {shot.light.id} if isinstance(shot.light, Led) else set()
        fully = FLICKERING_FULLY if own & self._flickering else FULLY
        dim = [led for led in own if seconds_of_led.get(led, 0.0) < fully * exposure_s]
        others = {led: s for led, s in seconds_of_led.items() if led not in own and s > HARDLY * exposure_s}
        if dim or others or panels:
            return f"lit were {seconds_of_led} and panels {panels} in {exposure_s} s"
        return ""


@contextlib.contextmanager
def soak(folder: Path, **settings: Any) -> Iterator[Soak]:
    """A `Soak`, whose world is ended at the end."""
    soaking = Soak(folder, **settings)
    try:
        yield soaking
    finally:
        soaking.close()


def figures_of(pid: int) -> dict[str, int]:
    """Resident memory, open files and threads of a process."""
    process = Path(f"/proc/{pid}")
    return {
        "pid": pid,
        "bytes": int((process / "statm").read_text().split()[1]) * resource.getpagesize(),
        "files": len(list((process / "fd").iterdir())),
        "threads": len(list((process / "task").iterdir())),
    }


WARM_UP_SHOTS = 10_000
"""Shots of a process before its memory counts: until then the world has not yet all that it remembers."""


@dataclass(frozen=True)
class Growth:
    """How much a process has grown from its warm-up to its largest later figure."""

    pid: int
    rehearsals: int
    first: Mapping[str, int]
    last: Mapping[str, int]
    bytes: int
    files: int
    threads: int

    def __str__(self) -> str:
        first, last = self.first, self.last
        return (
            f"{first['bytes'] / 1e6:.1f} to {last['bytes'] / 1e6:.1f} MB (at most {self.bytes / 1e6:+.1f}), "
            f"{first['files']} to {last['files']} files (at most {self.files:+}), "
            f"{first['threads']} to {last['threads']} threads, in {self.rehearsals} rehearsals after its warm-up"
        )


def growths(figures: Sequence[Mapping[str, int]], shots: int) -> list[Growth]:
    """Of each process that outlived its warm-up, by its `figures_of` after each rehearsal of so many `shots`."""
    found = []
    for pid in dict.fromkeys(one["pid"] for one in figures):
        mine = [one for one in figures if one["pid"] == pid][WARM_UP_SHOTS // shots :]
        if mine:
            most = {name: max(one[name] for one in mine) - mine[0][name] for name in ("bytes", "files", "threads")}
            found.append(Growth(pid, len(mine), mine[0], mine[-1], **most))
    return found
