"""The live view of a cell: its camera under one light at a time; the arm does not move."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import astuple

import numpy as np

from coupole.acquisition.opened_cell import OpenedCell
from coupole.devices import NO_LED, STEP_DTYPE, Deadline, Exposure, Frame, Step, table_box
from coupole.errors import DeviceTimeout
from coupole.plan.bursts import BurstTiming, burst_timing
from coupole.plan.led_table import LedTable
from coupole.plan.rig import Rig
from coupole.viewing.live import Choice, FrameRate, Shown, Studio
from coupole.viewing.raw_preview import Coding, figures

_FRAME_S = 2.0
"""Longest time from the end of an exposure until the frame reaches the host."""
_BUFFERS = 8


class CellSource:
    """A cell's camera under one light at a time; the arm does not move."""

    def __init__(
        self, cell: OpenedCell, rig: Rig, leds: LedTable, lux: Callable[[int], float], *, frames_per_s: float
    ) -> None:
        self.leds = tuple(int(led) for led in leds.ids)
        self._cell, self._rig, self._lux = cell, rig, lux
        self._every_s = 1.0 / frames_per_s

    def frames(self, studio: Studio) -> None:
        cell, limits, sensor = self._cell, self._rig.led_limits, self._rig.sensor
        armed_for: Choice | None = None
        pace, dose_lux_h, number = FrameRate(), 0.0, 0
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
        """The box switches the LED on command, and the host triggers the camera."""
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
                    happened="the box reports that it is still running",
                    remedy="Check the box.",
                )
            self._cell.clock.sleep(0.01)
        box.poll_log()
