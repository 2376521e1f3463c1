"""The live view of a cell: its camera under one light at a time, the arm held where it stands."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from coupole.acquisition.opened_cell import OpenedCell
from coupole.devices import NO_LIGHT, STEP_DTYPE, Deadline, Exposure
from coupole.errors import DeviceTimeout
from coupole.plan.bursts import burst_timing
from coupole.plan.led_table import LedTable
from coupole.plan.rig import Rig
from coupole.viewing.live import Choice, FrameRate, Shown, Studio
from coupole.viewing.raw_preview import Coding, figures

_FRAME_S = 2.0
"""How long after its exposure a frame may take to reach the host."""
_BUFFERS = 8


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
        pace, dose_lux_h, number = FrameRate(), 0.0, 0
        coding = Coding("MONO", 0, 1)
        while not studio.closing.is_set():
            choice = studio.choice
            timing = burst_timing(
                choice.exposure_us,
                rise_us=limits.rise_us,
                readout_us=1e6 / sensor.max_frames_per_s,
                exposure_gap_us=sensor.exposure_gap_us,
                hardware=True,
            )
            if armed_for != choice:
                cell.camera.disarm()
                made = cell.camera.configure(Exposure(choice.exposure_us))
                coding = Coding(made.bayer_pattern, made.black_dn, made.white_dn)
                cell.camera.arm(_BUFFERS)
                armed_for = choice
            table = np.zeros(1, STEP_DTYPE)
            table["led"] = NO_LIGHT if choice.led is None else choice.led
            table["on_us"], table["trigger_delay_us"] = timing.on_us, timing.trigger_delay_us
            rest_us = int(timing.on_us * (1.0 + limits.cooldown_ratio))
            table["period_us"] = max(timing.period_us, rest_us, int(self._every_s * 1e6))
            cell.ledbox.load(table)
            cell.ledbox.start(table)
            frame = cell.camera.next_frame(timing.on_us * 1e-6 + _FRAME_S)
            if frame is None:
                raise DeviceTimeout(
                    "camera",
                    expected=f"a frame within {timing.on_us * 1e-6 + _FRAME_S:.1f} s of its trigger",
                    happened="none came",
                    remedy="Check the trigger cable.",
                )
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
            self._wait_for_the_box(float(table["period_us"][0]) * 1e-6)

    def _wait_for_the_box(self, period_s: float) -> None:
        deadline = Deadline(self._cell.clock, 2.0 * period_s + _FRAME_S)
        while self._cell.ledbox.running():
            self._cell.ledbox.poll_log()
            if deadline.expired:
                raise DeviceTimeout(
                    "led box",
                    expected=f"a step of {period_s:.3f} s to end within {deadline.seconds:.1f} s",
                    happened="the box says that it is running still",
                    remedy="Check the box.",
                )
            self._cell.clock.sleep(0.01)
        self._cell.ledbox.poll_log()
