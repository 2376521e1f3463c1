"""A cell in memory for the burst's loop: box, camera, arm, clock and recorder that do what a take says.

Time stands still but for the clock's `sleep`. Frames reach the grabber's thread while the clock sleeps, or while
the box is asked for its log; the cell waits until they are taken and written, so that the machine's speed does not
matter.
"""

from __future__ import annotations

import math
import threading
from collections import deque
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from types import SimpleNamespace
from typing import Any

import numpy as np
from matching_takes import Take
from numpy.typing import NDArray

from coupole.acquisition.arm_supervisor import ArmMovedError
from coupole.acquisition.burst_runner import BurstRunner, CameraSettings
from coupole.acquisition.host_burst import Overseer
from coupole.acquisition.verdict import Verdict
from coupole.devices import ArmState, CameraStatistics, Exposure, Frame, FrameFormat
from coupole.plan.bursts import Burst
from coupole.plan.shot_id import ShotId

FORMAT = FrameFormat(8, 8, 12, "MONO", 64, 4095)
MOVED = ArmMovedError("the arm moved by 0.100 deg during a burst")


class Camera:
    """Frames are handed to the grabber's thread by `deliver`."""

    id_modulus = (0, 2**62)
    timestamp_jitter_us = 80.0
    delivery_s = 0.05

    def __init__(self, done: list[str]) -> None:
        self._done = done
        self._changed = threading.Condition()
        self._due: deque[Frame] = deque()
        self._all_taken = True

    def configure(self, exposure: Exposure) -> FrameFormat:
        return FORMAT

    def min_period_us(self, exposure: Exposure) -> int:
        return 0

    def arm(self, buffers: int) -> None:
        self._done.append("camera armed")

    def next_frame(self, timeout_s: float) -> Frame | None:
        with self._changed:
            self._all_taken = not self._due
            self._changed.notify_all()
            self._changed.wait_for(lambda: self._due, timeout_s)
            self._all_taken = False
            return self._due.popleft() if self._due else None

    def deliver(self, frames: list[Frame]) -> None:
        """Give frames to the grabber, and wait until it asks for the next one."""
        with self._changed:
            self._due.extend(frames)
            self._all_taken = False
            self._changed.notify_all()
            assert self._changed.wait_for(lambda: self._all_taken, 10.0)

    def statistics(self) -> CameraStatistics:
        return CameraStatistics(0, 0, 0, 0, 0)

    def disarm(self) -> None:
        self._done.append("camera disarmed")


class Box:
    """Runs the take's table: a step is in its log as soon as it is over."""

    runs_tables = True

    def __init__(self, cell: Cell) -> None:
        self._cell = cell
        self._told = 0
        self.uploads: list[int] = []
        """Steps of each table that was loaded."""

    def load(self, table: NDArray[np.void]) -> None:
        self.uploads.append(len(table))
        if self._cell.on_load is not None:
            self._cell.on_load(table)

    def start(self, table: NDArray[np.void]) -> None:
        self._cell.done.append("started")
        if self._cell.start_fails is not None:
            raise self._cell.start_fails
        self._cell.started_us, self._told = self._cell.now_us, 0

    def poll_log(self) -> NDArray[np.void]:
        cell = self._cell
        finished = int(np.searchsorted(cell.what.edges_us, cell.burst_us - cell.burst.timing.on_us))
        records, self._told = cell.what.log[self._told : finished], finished
        cell.frames_at_poll = cell.arrived
        cell.pass_time(cell.poll_takes_s)  # frames that come now are newer than what the log could tell
        return records

    def edges(self) -> int:
        return len(self._cell.what.log)

    def panel(self, panel: int, on: bool) -> None:
        self._cell.done.append(f"panel {panel} {'on' if on else 'off'}")

    def lights_off(self) -> None:
        self._cell.done.append("lights off")


@dataclass
class Cell:
    """The cell, and what was done in it."""

    burst: Burst
    what: Take
    heard_until_s: float = np.inf
    """The arm is heard of at every round until this time after the start."""
    moves_at_s: float = np.inf
    """From then on the arm reports that it has moved."""
    poll_takes_s: float = 0.0
    """Time that passes while the log is read."""
    delivery_s: float = 0.02
    """From a frame's edge until it is at the host."""
    on_load: Callable[[NDArray[np.void]], None] | None = None
    start_fails: Exception | None = None
    """What the box raises when the burst is to begin."""
    done: list[str] = field(default_factory=list)
    proven: dict[ShotId, Mapping[str, int]] = field(default_factory=dict)
    slots: list[int] = field(default_factory=list)
    """Frame of each slot."""
    freed: list[int] = field(default_factory=list)
    marks_seen: list[int] = field(default_factory=list)
    """Steps of marks without a label, in slots that were not freed yet."""
    proven_frames: list[int] = field(default_factory=list)
    now_us: float = 0.0
    started_us: float = np.inf
    arrived: int = 0
    frames_at_poll: int = 0
    heard_ns: int = 1
    confirmed: int = 0
    """Frames that had come one round before the arm was last heard of."""
    arrived_last_round: int = 0
    awaited_news: int = 0
    switched_off_ns: list[tuple[int, int]] = field(default_factory=list)
    """When the box was told to switch all off, and had answered."""
    counted: list[dict[str, float]] = field(default_factory=list)
    """For the light of each burst: how long table and panel are said to have run."""
    _written: threading.Condition = field(default_factory=threading.Condition)

    def __post_init__(self) -> None:
        self.camera, self.box = Camera(self.done), Box(self)
        cell: Any = SimpleNamespace(
            ledbox=self.box,
            camera=self.camera,
            clock=self,
            robot=SimpleNamespace(measured=self._arm),
            make_safe=lambda: self.done.append("made safe"),
            switch_off=self.box.lights_off,
            switched_off_ns=self.switched_off_ns,
        )
        arm: Any = SimpleNamespace(
            attend=lambda: None,
            hurry=lambda seconds: None,
            heard_at_rest=self.heard_at_rest,
            was_held=lambda error: False,
            await_news=self.await_news,
        )
        dose: Any = SimpleNamespace(
            begin=lambda burst: None,
            count=lambda burst, log, **figures: self.counted.append(figures) or (0.0,),
            end=lambda given_lux_h: None,
        )
        outcome: Any = SimpleNamespace(over_triggers=0, lost_transfers=0)
        self.runner = BurstRunner(
            cell,
            self,  # type: ignore[arg-type]
            arm,
            dose,
            outcome,
            CameraSettings(gain_db=0.0, max_frames_per_s=100.0),
            Overseer(tell=lambda burst, step: None, wait_while_paused=lambda: None),
        )

    def fire(self, following: Burst | None = None) -> Verdict:
        return self.runner.fire(self.burst, lambda: following)

    # clock
    def now_ns(self) -> int:
        return round(self.now_us * 1e3)

    def sleep(self, seconds: float, at_most_s: float = math.inf) -> None:
        assert self.burst_us < 60e6, "the loop does not end"
        self.pass_time(seconds)

    @property
    def burst_us(self) -> float:
        """Time since the burst began."""
        return self.now_us - self.started_us

    def arrives_us(self, frame: int) -> float:
        return float(self.what.frames_us[frame]) + 1e6 * self.delivery_s

    def pass_time(self, seconds: float) -> None:
        self.now_us += 1e6 * seconds
        due = []
        while self.arrived < len(self.what.truth) and self.arrives_us(self.arrived) <= self.burst_us:
            number = self.arrived
            pixels = np.full((8, 8), number, np.uint16)
            due.append(Frame(int(self.what.frame_ids[number]), int(self.what.timestamps_ns[number]), pixels))
            self.arrived += 1
        if due:
            written = len(self.slots) + len(due)
            self.camera.deliver(due)
            with self._written:
                assert self._written.wait_for(lambda: len(self.slots) == written, 10.0)

    # arm
    def _arm(self) -> ArmState:
        return ArmState((0.0,) * 6, np.eye(4), self.heard_ns, moving=False)

    def heard_at_rest(self) -> int:
        if self.burst_us >= 1e6 * self.moves_at_s:
            raise MOVED
        if self.burst_us <= 1e6 * self.heard_until_s:
            self.heard_ns, self.confirmed = max(self.heard_ns, self.now_ns()), self.arrived_last_round
        self.arrived_last_round = self.arrived
        return self.heard_ns

    def await_news(self) -> ArmState:
        self.awaited_news += 1
        if np.isfinite(self.moves_at_s):
            raise MOVED
        return self._arm()

    # recorder
    def store(self, frame: Frame, exposure_us: int) -> int:
        with self._written:
            self.slots.append(int(frame.pixels[0, 0]))
            self._written.notify_all()
            return len(self.slots) - 1

    def prove(self, slot: int, shot: ShotId, fields: Mapping[str, int]) -> None:
        assert shot not in self.proven
        self.proven[shot] = fields
        self.proven_frames.append(self.slots[slot])

    def see_mark(self, slot: int, burst: Burst, step: int) -> None:
        assert slot not in self.freed
        self.marks_seen.append(step)

    def free(self, slot: int) -> None:
        self.freed.append(slot)

    def note(self, event: Any) -> None:
        self.done.append(type(event).__name__)

    def commit(self, *, now: bool) -> None:
        pass
