"""Live view: the newest frame of a cell or of a run that goes on, for people who focus, aim and watch.

A *source* makes frames, `Studio` holds the newest one for viewers. Viewers ask when they like and get what is
there: nothing waits for them. A run is watched through its folder alone, so that no viewer can slow it.
"""

from __future__ import annotations

import threading
import time
from collections.abc import Callable
from dataclasses import astuple, dataclass, replace
from pathlib import Path
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from coupole.acquisition.cell import OpenedCell
from coupole.devices import NO_LED, STEP_DTYPE, Deadline, Exposure, Frame, Step, table_box
from coupole.errors import DeviceTimeout, InputError
from coupole.plan.led_table import LedTable
from coupole.plan.rig import Rig
from coupole.plan.shots import BurstTiming, burst_timing
from coupole.storage import frame_file, journal
from coupole.storage.run import Run
from coupole.viewing.raw_preview import Coding, Figures, figures

_POLL_S = 0.2
_FRAME_S = 2.0
"""How long after its exposure a frame may take to reach the host."""
_BUFFERS = 8


@dataclass(frozen=True)
class Choice:
    """What the viewer wants to see."""

    led: int | None
    """Id of the LED that lights the picture, None for none."""
    exposure_us: int


@dataclass(frozen=True)
class Shown:
    """One frame and what is known of it."""

    number: int
    title: str
    raw: NDArray[np.uint16]
    coding: Coding
    exposure_us: int
    led: int | None
    figures: Figures
    frames_per_s: float
    dose_lux_h: float


class Source(Protocol):
    """Gives frames until it is told to stop."""

    leds: tuple[int, ...]
    """LEDs to choose from; none where nothing can be chosen."""

    def frames(self, studio: Studio) -> None:
        """Hand frames to `studio.show` until `studio.closing` is set. Raises what ends it."""
        ...


class Studio:
    """The newest frame, and the viewers' choice."""

    def __init__(self, choice: Choice) -> None:
        self.closing = threading.Event()
        self._lock = threading.Lock()
        self._shown: Shown | None = None
        self._choice = choice

    @property
    def choice(self) -> Choice:
        with self._lock:
            return self._choice

    def choose(self, choice: Choice) -> None:
        with self._lock:
            self._choice = choice

    @property
    def shown(self) -> Shown | None:
        with self._lock:
            return self._shown

    def show(self, shown: Shown) -> None:
        with self._lock:
            self._shown = shown


class _Pace:
    """Frames a second, over the last ones."""

    def __init__(self) -> None:
        self._times_s: list[float] = []

    def beat(self) -> float:
        self._times_s = [*self._times_s[-9:], time.monotonic()]
        took_s = self._times_s[-1] - self._times_s[0]
        return (len(self._times_s) - 1) / took_s if took_s > 0 else 0.0


class CellSource:
    """A cell's camera, one light at a time; the arm is held where it stands."""

    def __init__(
        self, cell: OpenedCell, rig: Rig, leds: LedTable, lux: Callable[[int], float], *, frames_per_s: float
    ) -> None:
        self.leds = tuple(int(led) for led in leds.ids)
        self._cell, self._rig, self._lux = cell, rig, lux
        self._every_s = 1.0 / frames_per_s

    def frames(self, studio: Studio) -> None:
        cell, limits, sensor = self._cell, self._rig.led_limits, self._rig.sensor
        armed_for: Choice | None = None
        pace, dose_lux_h, number = _Pace(), 0.0, 0
        coding = Coding("MONO", 0, 1)
        while not studio.closing.is_set():
            choice = studio.choice
            timing = burst_timing(
                choice.exposure_us,
                rise_us=limits.rise_us,
                readout_us=1e6 / sensor.max_frames_per_s,
                exposure_gap_us=sensor.exposure_gap_us,
                hardware=cell.ledbox.runs_tables,
            )
            if armed_for != choice:
                cell.camera.disarm()
                made = cell.camera.configure(
                    Exposure(choice.exposure_us, hardware_trigger=cell.ledbox.runs_tables)
                )
                coding = Coding(made.bayer_pattern, made.black_dn, made.white_dn)
                cell.camera.arm(_BUFFERS)
                armed_for = choice
            rest_us = int(timing.on_us * (1.0 + limits.cooldown_ratio))
            period_us = max(timing.period_us, rest_us, int(self._every_s * 1e6))
            led = NO_LED if choice.led is None else choice.led
            next_ns = cell.clock.now_ns() + period_us * 1000
            frame = (self._by_cable if cell.ledbox.runs_tables else self._by_host)(led, timing, period_us)
            raw = frame.pixels.copy()
            frame.release()
            if choice.led is not None:
                dose_lux_h += self._lux(choice.led) * timing.on_us / 3.6e9
            number += 1
            light = "no light" if choice.led is None else f"LED {choice.led}"
            seen = figures(raw, coding)
            studio.show(
                Shown(number, light, raw, coding, choice.exposure_us, choice.led, seen, pace.beat(), dose_lux_h)
            )
            if cell.ledbox.runs_tables:
                self._wait_for_the_box(period_us * 1e-6)
            else:
                cell.clock.sleep(max(0.0, (next_ns - cell.clock.now_ns()) / 1e9))

    def _by_cable(self, led: int, timing: BurstTiming, period_us: int) -> Frame:
        """The box lights the LED and triggers the camera."""
        box = table_box(self._cell.ledbox)
        step = Step(led, timing.on_us, timing.trigger_delay_us, period_us)
        table = np.array([astuple(step)], STEP_DTYPE)
        box.load(table)
        box.start(table)
        return self._frame(timing, "Check the trigger cable.")

    def _by_host(self, led: int, timing: BurstTiming, period_us: int) -> Frame:
        """The box lights the LED when it is told to, and the host triggers the camera."""
        self._cell.ledbox.flash(led, timing.on_us)
        self._cell.clock.sleep(timing.trigger_delay_us * 1e-6)
        self._cell.camera.trigger()
        frame = self._frame(timing, "Check the camera.")
        self._cell.ledbox.end_flash()
        return frame

    def _frame(self, timing: BurstTiming, remedy: str) -> Frame:
        seconds = timing.on_us * 1e-6 + _FRAME_S
        frame = self._cell.camera.next_frame(seconds)
        if frame is None:
            raise DeviceTimeout(
                "camera",
                expected=f"a frame within {seconds:.1f} s of its trigger",
                happened="none came",
                remedy=remedy,
            )
        return frame

    def _wait_for_the_box(self, period_s: float) -> None:
        box = table_box(self._cell.ledbox)
        deadline = Deadline(self._cell.clock, 2.0 * period_s + _FRAME_S)
        while box.running():
            box.poll_log()
            if deadline.expired:
                raise DeviceTimeout(
                    "led box",
                    expected=f"a step of {period_s:.3f} s to end within {deadline.seconds:.1f} s",
                    happened="the box says that it is running still",
                    remedy="Check the box.",
                )
            self._cell.clock.sleep(0.01)
        box.poll_log()


class RunSource:
    """A run's folder: the newest proven frame, read from the disk."""

    leds: tuple[int, ...] = ()

    def __init__(self, folder: Path) -> None:
        self._run = Run(folder)

    def frames(self, studio: Studio) -> None:
        pace, number = _Pace(), 0
        newest: dict[str, Any] | None = None
        while not studio.closing.is_set():
            last = self._newest()
            if last is not None and last != newest:
                newest = last
                number += 1
                studio.show(replace(self._read(last, number), frames_per_s=pace.beat()))
            studio.closing.wait(_POLL_S)

    def _newest(self) -> dict[str, Any] | None:
        path = self._run.journal_path
        found = None
        for event in journal.tail(path, 64 * 1024) if path.exists() else ():
            if event["event"] == "frame" and "/led" in event["shot"]:
                found = event
        return found

    def _read(self, event: dict[str, Any], number: int) -> Shown:
        path = self._run.folder / event["file"]
        layout, facts = frame_file.read_layout(path), frame_file.read_facts(path)
        raw = frame_file.read_frame(path, layout, event["index"])
        record = frame_file.read_frames(path)[event["index"]]
        coding = Coding(facts["pattern"], facts["black_dn"], facts["white_dn"])
        seen = figures(raw, coding)
        exposure_us, led = int(record["exposure_us"]), int(record["led"])
        return Shown(number, event["shot"], raw, coding, exposure_us, led, seen, 0.0, 0.0)


def choice_from(wanted: dict[str, Any], before: Choice, leds: tuple[int, ...], longest_us: int) -> Choice:
    """A viewer's choice, checked. Raises InputError for what the cell does not have or must not do."""
    led, exposure_us = wanted.get("led", before.led), wanted.get("exposure_us", before.exposure_us)
    if led is not None and led not in leds:
        raise InputError(f"led: expected one of the dome's, found {led!r}")
    if not isinstance(exposure_us, int) or not 10 <= exposure_us <= longest_us:
        raise InputError(f"exposure_us: expected a whole number from 10 to {longest_us}, found {exposure_us!r}")
    return Choice(led, exposure_us)


def run_source(source: Source, studio: Studio, failed: Callable[[Exception], None]) -> threading.Thread:
    """Have a thread of its own fill the studio; `failed` hears what ended it."""

    def work() -> None:
        try:
            source.frames(studio)
        except Exception as error:  # noqa: BLE001  handed to the thread that shows it
            failed(error)
            studio.closing.set()

    thread = threading.Thread(target=work, name="live")
    thread.start()
    return thread
