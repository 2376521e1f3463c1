"""One picture at a time under one light, for focus and exposure. The live view and the bench use it.

A light is on for one exposure only, and off before the next; nothing has to be switched off later.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import astuple, dataclass

import numpy as np
from numpy.typing import NDArray

from coupole.acquisition.dose import FlashMeter
from coupole.acquisition.opened_cell import OpenedCell
from coupole.clock import Deadline
from coupole.devices import NO_LED, STEP_DTYPE, Exposure, Frame, Step, table_box
from coupole.errors import DeviceTimeout
from coupole.plan.bursts import BurstTiming, burst_timing
from coupole.plan.cell import Cell
from coupole.plan.rig_devices import device_times, longest_light_s, watchdog_s
from coupole.viewing.raw_preview import Coding

_FRAME_S = 2.0
"""Longest time from the end of an exposure until the frame reaches the host."""
_BUFFERS = 8
_PANEL_OVERHEAD_S = 1.0
"""Expected time for which a panel is lit in addition to the exposure."""


@dataclass(frozen=True)
class Shot:
    """A RAW picture [height_px, width_px]."""

    raw: NDArray[np.uint16]
    coding: Coding


class SingleShots:
    """Pictures of a cell's camera, each under one LED, one panel or no light; the light is counted before it is
    given. Only one thread may use it at a time.
    """

    def __init__(
        self,
        cell: Cell,
        opened_cell: OpenedCell,
        lux: NDArray[np.float64],
        meter: FlashMeter | None,
        every_s: float = 0.0,
    ) -> None:
        """`lux` [points, LEDs of the table]. `meter` is for an object whose light is counted. LEDs are lit at most
        once every `every_s`."""
        self._cell, self._rig, self._opened = cell, cell.rig, opened_cell
        self._lux, self._meter, self._every_s = lux, meter, every_s
        self._row_of_led = {int(led): row for row, led in enumerate(cell.leds.ids)}
        self._armed_for: Exposure | None = None
        self._coding = Coding("MONO", 0, 1)
        self._rest_until_ns, self._period_s = 0, 0.0
        self.given_lux_h = np.zeros(len(lux))
        """[points] light of all pictures so far."""

    def take(self, led: int, exposure_us: int, gain_db: float = 0.0, panel: int = 0) -> Shot:
        """Take a picture under an LED (NO_LED: none) or a panel (0: none), not both. Raises DeviceError. Raises
        DoseBudgetReached or StorageError before the light is given."""
        opened_cell, timing = self._opened, self._timing(exposure_us)
        self._arm(Exposure(exposure_us, gain_db, opened_cell.ledbox.runs_tables))
        cooling_us = int(timing.on_us * (1.0 + self._rig.led_limits.cooldown_ratio)) if not panel else 0
        period_us = max(timing.period_us, cooling_us, int(self._every_s * 1e6) if not panel else 0)
        self._period_s = period_us * 1e-6
        self._rest_until_ns = opened_cell.clock.now_ns() + period_us * 1000
        fire = self._by_cable if opened_cell.ledbox.runs_tables else self._by_host
        if panel:
            frame = self._under_panel(panel, lambda: fire(NO_LED, timing, period_us), timing)
        else:
            self._enter(led, timing)
            frame = fire(led, timing, period_us)
        raw = frame.pixels.copy()
        frame.release()
        return Shot(raw, self._coding)

    def rest(self) -> None:
        """Wait until the box has ended its step, and the LED may be lit again."""
        if self._opened.ledbox.runs_tables:
            self._wait_for_the_box()
        else:
            clock = self._opened.clock
            clock.sleep(max(0.0, (self._rest_until_ns - clock.now_ns()) / 1e9))

    def disarm(self) -> None:
        """Disarm the camera, so that others can use it."""
        self._opened.camera.disarm()
        self._armed_for = None

    def _arm(self, exposure: Exposure) -> None:
        if exposure == self._armed_for:
            return
        camera = self._opened.camera
        self.disarm()
        frame_format = camera.configure(exposure)
        self._coding = Coding(frame_format.bayer_pattern, frame_format.black_dn, frame_format.white_dn)
        camera.arm(_BUFFERS)
        self._armed_for = exposure

    def _timing(self, exposure_us: int) -> BurstTiming:
        return burst_timing(exposure_us, device_times(self._rig), hardware=self._opened.ledbox.runs_tables)

    def _enter(self, led: int, timing: BurstTiming) -> None:
        """Count a flash that is about to be given."""
        if led == NO_LED:
            return
        lux = self._lux[:, self._row_of_led[led]]
        lux_h = lux * timing.on_us / 3.6e9
        if self._meter is not None:
            longest_s = longest_light_s(self._rig, timing.on_us)
            at_most = lux * max(longest_s, timing.on_us * 1e-6) / 3600.0
            self._meter.begin(lux_h, at_most, self._cell.led_damage_w_per_lm)
        self.given_lux_h = self.given_lux_h + lux_h

    def _under_panel(self, panel: int, fire: Callable[[], Frame], timing: BurstTiming) -> Frame:
        """Take the picture while a panel is on. The panel's light is counted from the command to the
        confirmation."""
        box, clock = self._opened.ledbox, self._opened.clock
        points, lux = len(self._lux), self._rig.dome.panel_lux
        expected_lux_h = np.full(points, lux * (timing.on_us * 1e-6 + _PANEL_OVERHEAD_S) / 3600.0)
        if self._meter is not None:
            at_most = expected_lux_h + lux * watchdog_s(self._rig) / 3600.0
            self._meter.begin(expected_lux_h, at_most, self._cell.panel_damage_w_per_lm)
        since_ns = clock.now_ns()
        try:
            box.panel(panel, True)
            frame = fire()
            if box.runs_tables:
                self._wait_for_the_box()
            return frame
        finally:
            box.panel(panel, False)
            given_lux_h = np.full(points, lux * (clock.now_ns() - since_ns) / 3.6e12)
            if self._meter is not None:
                self._meter.add(given_lux_h - expected_lux_h)
            self.given_lux_h = self.given_lux_h + given_lux_h

    def _by_cable(self, led: int, timing: BurstTiming, period_us: int) -> Frame:
        """The box lights the LED and triggers the camera."""
        box = table_box(self._opened.ledbox)
        step = Step(led, timing.on_us, timing.trigger_delay_us, period_us)
        table = np.array([astuple(step)], STEP_DTYPE)
        box.load(table)
        box.start(table)
        return self._frame(timing, "Check the trigger cable.")

    def _by_host(self, led: int, timing: BurstTiming, period_us: int) -> Frame:
        """The box switches the LED on command, and the host triggers the camera."""
        opened_cell = self._opened
        opened_cell.ledbox.flash(led, timing.on_us)
        opened_cell.clock.sleep(timing.trigger_delay_us * 1e-6)
        opened_cell.camera.trigger()
        frame = self._frame(timing, "Check the camera.")
        over_us = opened_cell.ledbox.end_flash().on_us - timing.on_us
        if self._meter is not None and led != NO_LED and over_us > 0:
            self._meter.add(self._lux[:, self._row_of_led[led]] * over_us / 3.6e9)
        return frame

    def _frame(self, timing: BurstTiming, remedy: str) -> Frame:
        seconds = timing.on_us * 1e-6 + _FRAME_S
        frame = self._opened.camera.next_frame(seconds)
        if frame is None:
            raise DeviceTimeout(
                "camera",
                expected=f"a frame within {seconds:.1f} s of its trigger",
                happened="none came",
                remedy=remedy,
            )
        return frame

    def _wait_for_the_box(self) -> None:
        box = table_box(self._opened.ledbox)
        deadline = Deadline(self._opened.clock, 2.0 * self._period_s + _FRAME_S)
        while box.running():
            box.poll_log()
            if deadline.has_expired:
                raise DeviceTimeout(
                    "led box",
                    expected=f"a step of {self._period_s:.3f} s to end within {deadline.seconds:.1f} s",
                    happened="the box reports that it is still running",
                    remedy="Check the box.",
                )
            self._opened.clock.sleep(0.01)
        box.poll_log()
