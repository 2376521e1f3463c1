"""The live view of a cell: its camera under one light at a time; the arm does not move."""

from __future__ import annotations

from coupole.acquisition.dose import FlashMeter
from coupole.acquisition.opened_cell import OpenedCell
from coupole.acquisition.single_shots import SingleShots
from coupole.devices import NO_LED
from coupole.viewing.live import Choice, FrameRate, Shown, Studio
from coupole.viewing.raw_preview import figures

_POLL_S = 0.2


class CellSource:
    """A cell's camera under one light at a time; the arm does not move. Without a viewer no light is given."""

    def __init__(
        self, opened_cell: OpenedCell, shots: SingleShots, leds: tuple[int, ...], meter: FlashMeter | None
    ) -> None:
        """The user may choose from `leds`. `meter` is for an object whose light is counted."""
        self.leds = leds
        self._opened, self._shots, self._meter = opened_cell, shots, meter

    def frames(self, studio: Studio) -> None:
        try:
            self._frames(studio)
        finally:
            self._opened.make_safe()
            if self._meter is not None:
                self._meter.settle()

    def _frames(self, studio: Studio) -> None:
        pace, number = FrameRate(), 0
        while not studio.closing.is_set():
            choice = studio.choice
            if self._waits_for_a_viewer(studio, choice):
                continue
            shot = self._shots.take(NO_LED if choice.led is None else choice.led, choice.exposure_us)
            number += 1
            light = "no light" if choice.led is None else f"LED {choice.led}"
            frame_figures, dose_lux_h = figures(shot.raw, shot.coding), float(self._shots.given_lux_h.max())
            studio.show(
                Shown(
                    number,
                    light,
                    shot.raw,
                    shot.coding,
                    choice.exposure_us,
                    choice.led,
                    frame_figures,
                    pace.beat(),
                    dose_lux_h,
                )
            )
            self._shots.rest()

    def _waits_for_a_viewer(self, studio: Studio, choice: Choice) -> bool:
        """True, after a moment, if an LED is chosen but nobody has a page open. The LED is then not lit."""
        if choice.led is None or studio.is_watched:
            studio.remark = self._meter.warning if self._meter else ""
            return False
        studio.remark = "no page is open: the light is off until a page is opened"
        studio.closing.wait(_POLL_S)
        return True
