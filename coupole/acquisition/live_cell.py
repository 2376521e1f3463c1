"""The live view of a cell: its camera under one light at a time; the arm does not move."""

from __future__ import annotations

from dataclasses import astuple

import numpy as np
from numpy.typing import NDArray

from coupole.acquisition.dose import FlashMeter
from coupole.acquisition.opened_cell import OpenedCell
from coupole.devices import NO_LED, STEP_DTYPE, Deadline, Exposure, Frame, Step, table_box
from coupole.errors import DeviceTimeout
from coupole.plan.bursts import BurstTiming, burst_timing
from coupole.plan.led_table import LedTable
from coupole.plan.rig import Rig
from coupole.plan.rig_devices import longest_light_s
from coupole.viewing.live import Choice, FrameRate, Shown, Studio
from coupole.viewing.raw_preview import Coding, figures

_FRAME_S = 2.0
"""Longest time from the end of an exposure until the frame reaches the host."""
_BUFFERS = 8
_POLL_S = 0.2


class CellSource:
    """A cell's camera under one light at a time; the arm does not move. Without a viewer no light is given."""

    def __init__(
        self,
        cell: OpenedCell,
        rig: Rig,
        leds: LedTable,
        lux: NDArray[np.float64],
        meter: FlashMeter | None,
        *,
        frames_per_s: float,
    ) -> None:
        """`lux` [points, LEDs of the table]; `meter` for an object whose light is counted."""
        self.leds = tuple(int(led) for led in leds.ids)
        self._cell, self._rig, self._lux, self._meter = cell, rig, lux, meter
        self._row_of_led = {led: row for row, led in enumerate(self.leds)}
        self._every_s = 1.0 / frames_per_s
        self._given_lux_h = np.zeros(len(lux))

    def frames(self, studio: Studio) -> None:
        try:
            self._frames(studio)
        finally:
            self._cell.make_safe()
            if self._meter is not None:
                self._meter.settle()

    def _frames(self, studio: Studio) -> None:
        cell = self._cell
        armed_for: Choice | None = None
        pace, number = FrameRate(), 0
        coding = Coding("MONO", 0, 1)
        while not studio.closing.is_set():
            choice = studio.choice
            if self._waits_for_a_viewer(studio, choice):
                continue
            timing = self._timing(choice)
            if armed_for != choice:
                cell.camera.disarm()
                made = cell.camera.configure(
                    Exposure(choice.exposure_us, hardware_trigger=cell.ledbox.runs_tables)
                )
                coding = Coding(made.bayer_pattern, made.black_dn, made.white_dn)
                cell.camera.arm(_BUFFERS)
                armed_for = choice
            rest_us = int(timing.on_us * (1.0 + self._rig.led_limits.cooldown_ratio))
            period_us = max(timing.period_us, rest_us, int(self._every_s * 1e6))
            led = NO_LED if choice.led is None else choice.led
            next_ns = cell.clock.now_ns() + period_us * 1000
            self._enter(led, timing)
            frame = (self._by_cable if cell.ledbox.runs_tables else self._by_host)(led, timing, period_us)
            raw = frame.pixels.copy()
            frame.release()
            number += 1
            light = "no light" if choice.led is None else f"LED {choice.led}"
            seen, dose_lux_h = figures(raw, coding), float(self._given_lux_h.max())
            studio.show(
                Shown(number, light, raw, coding, choice.exposure_us, choice.led, seen, pace.beat(), dose_lux_h)
            )
            if cell.ledbox.runs_tables:
                self._wait_for_the_box(period_us * 1e-6)
            else:
                cell.clock.sleep(max(0.0, (next_ns - cell.clock.now_ns()) / 1e9))

    def _timing(self, choice: Choice) -> BurstTiming:
        sensor = self._rig.sensor
        return burst_timing(
            choice.exposure_us,
            rise_us=self._rig.led_limits.rise_us,
            readout_us=1e6 / sensor.max_frames_per_s,
            exposure_gap_us=sensor.exposure_gap_us,
            hardware=self._cell.ledbox.runs_tables,
        )

    def _waits_for_a_viewer(self, studio: Studio, choice: Choice) -> bool:
        """True, after a moment, if an LED is chosen and nobody has a page open: then it is not lit."""
        if choice.led is None or studio.watched:
            studio.remark = self._meter.warning if self._meter else ""
            return False
        studio.remark = "no page is open: the light is off until one is"
        studio.closing.wait(_POLL_S)
        return True

    def _enter(self, led: int, timing: BurstTiming) -> None:
        """Count a flash that is about to be given."""
        if led == NO_LED:
            return
        lux = self._lux[:, self._row_of_led[led]]
        lux_h = lux * timing.on_us / 3.6e9
        if self._meter is not None:
            longest_s = longest_light_s(self._rig, timing.on_us)
            self._meter.begin(lux_h, lux * max(longest_s, timing.on_us * 1e-6) / 3600.0)
        self._given_lux_h = self._given_lux_h + lux_h

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
        over_us = self._cell.ledbox.end_flash().on_us - timing.on_us
        if self._meter is not None and led != NO_LED and over_us > 0:
            self._meter.add(self._lux[:, self._row_of_led[led]] * over_us / 3.6e9)
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
