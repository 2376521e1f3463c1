"""Bursts: what one table in the box fires without the host.

Coded dark marks, dark frames, lights, marks again; all frames of a burst have one exposure.
"""

from __future__ import annotations

from collections.abc import Collection, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import TypeVar

import numpy as np
from numpy.typing import NDArray

from coupole.devices import FLAG_NO_TRIGGER, NO_LIGHT, STEP_DTYPE
from coupole.plan.shot_id import Dark, Led, Light, Panel, PanelMark, ShotId, ShotLabel

L = TypeVar("L", bound=ShotLabel | None)

MARK_UNITS = 16
START_MARK_EXTRA = (5, 1, 4, 2, 3)
"""Sixteenths of the burst's period that each start mark takes longer. Counted back from the first light the
marks stand at phases 13, 11, 7, 6, 1 of 16: nowhere on the lights' grid, and all different."""
END_MARK_EXTRA = (2, 5, 1, 3, 1)
"""The same for the last light and the end marks but one: phases 2, 7, 8, 11, 12 behind the grid."""
MARKS = len(START_MARK_EXTRA) + len(END_MARK_EXTRA)
EXPOSURE_MARGIN_US = 200
"""An LED stays on this long after the exposure's nominal end: the camera's exposure may start late."""
PERIOD_MARGIN_US, PERIOD_MARGIN_PPM = 10, 200
"""Edges may come this much early, by jitter and by the drift of two quartzes; a camera at its limit would miss
them."""
LED_GAP_US = 100
"""Least dark time between two lights."""
SOFTWARE_LATENCY_US = 60_000
"""With software trigger an LED stays on this much longer: the host's way to the camera and back."""


@dataclass(frozen=True)
class Pace:
    """What holds the steps of a burst farther apart than camera and LED ask for."""

    disk_us: int = 0
    """The disk takes a frame in this time."""
    led_duty: float = 1.0
    """Largest share of its step that an LED shines, for the heat."""


FASTEST = Pace()


@dataclass(frozen=True)
class BurstTiming:
    """Times of a burst's ordinary steps, in us."""

    exposure_us: int
    on_us: int
    trigger_delay_us: int
    period_us: int
    bound: str
    """What decides the period: `camera`, `LED`, `disk` or `heat`."""


@dataclass(frozen=True)
class Burst:
    """One table for the box, and which shots its frames are."""

    view: str
    exposure_index: int
    repeat: int
    panel: int
    hardware: bool
    timing: BurstTiming
    table: NDArray[np.void]
    labels: tuple[ShotLabel | None, ...]
    """Of the frame that each step triggers; None for a mark whose frame is not wanted (in a burst taken again)."""

    @cached_property
    def duration_s(self) -> float:
        """The table's own time."""
        return float(self.table["period_us"].sum(dtype=np.int64)) / 1e6

    @property
    def shots(self) -> list[ShotId | None]:
        """Step by step; None for unwanted frames."""
        return [None if label is None else ShotId(self.view, label) for label in self.labels]

    def is_light(self) -> NDArray[np.bool_]:
        """[steps] True for shots, False for marks and dark frames."""
        return np.array([label is not None and label.is_shot for label in self.labels])

    def without(self, leds: Collection[int]) -> Burst:
        """The same burst without the shots under these LEDs."""
        dropped = np.isin(self.table["led"], list(leds)) & (self.table["led"] != NO_LIGHT)
        return self.only({label for label, drop in zip(self.labels, dropped, strict=True) if label and not drop})

    def only(self, wanted: Collection[ShotLabel]) -> Burst:
        """The same burst with those shots only, and marks anew."""
        marked = self.hardware
        inner = (
            range(len(START_MARK_EXTRA), len(self.labels) - len(END_MARK_EXTRA))
            if marked
            else range(len(self.labels))
        )
        keep = [i for i in inner if self.labels[i] in wanted]
        marks = [label if label in wanted else None for i, label in enumerate(self.labels) if i not in inner]
        table, labels = self.table[keep], [self.labels[i] for i in keep]
        if marked:
            table, labels = _with_marks(table, labels, marks, self.timing)
        return replace(self, table=table, labels=tuple(labels))


def burst_timing(
    exposure_us: int,
    *,
    rise_us: int,
    readout_us: float,
    exposure_gap_us: int,
    hardware: bool,
    pace: Pace = FASTEST,
) -> BurstTiming:
    """Shortest times of a step that camera, LEDs and the given pace allow.

    The LED is on for its rise, the exposure and a margin; the period is the longest of the camera's readout,
    the exposure plus the sensor's gap, the LED's on-time plus a dark gap, and what disk and heat ask for.
    """
    on_us = rise_us + exposure_us + EXPOSURE_MARGIN_US
    if not hardware:
        on_us += SOFTWARE_LATENCY_US
    camera_us = max(readout_us, exposure_us + exposure_gap_us)
    camera_us += PERIOD_MARGIN_US + PERIOD_MARGIN_PPM * 1e-6 * camera_us
    periods_us = {
        "camera": int(np.ceil(camera_us)),
        "LED": on_us + LED_GAP_US,
        "disk": pace.disk_us,
        "heat": int(np.ceil(on_us / pace.led_duty)),
    }
    bound = max(periods_us, key=lambda name: periods_us[name])
    return BurstTiming(exposure_us, on_us, rise_us, periods_us[bound], bound)


def bursts_of_exposure(
    lights: Sequence[Sequence[Led] | Panel],
    timing: BurstTiming,
    exposure_index: int,
    repeat: int,
    *,
    darks: int,
    hardware: bool,
) -> Iterator[Burst]:
    """The bursts of one exposure, without a view: one for each list of LEDs, one for each panel. Dark frames are
    the first one's."""
    for number, lit in enumerate(lights):
        own_darks = darks if number == 0 else 0
        yield _burst(lit, own_darks, timing, exposure_index, repeat, hardware=hardware)


def _burst(
    lit: Sequence[Led] | Panel,
    darks: int,
    timing: BurstTiming,
    exposure_index: int,
    repeat: int,
    *,
    hardware: bool,
) -> Burst:
    # A panel shines all through its burst: what would be dark there is one more picture of the panel.
    panel = lit.number if isinstance(lit, Panel) else 0
    first_dark = MARKS if hardware else 0
    lights: list[Light] = [lit] if isinstance(lit, Panel) else [*_dark(first_dark, darks), *lit]
    marks: list[Light] = [PanelMark(panel, k) for k in range(MARKS)] if panel else [*_dark(0, MARKS)]
    records = np.zeros(len(lights), STEP_DTYPE)
    records["led"] = [light.id if isinstance(light, Led) else NO_LIGHT for light in lights]
    records["on_us"], records["trigger_delay_us"] = timing.on_us, timing.trigger_delay_us
    records["period_us"] = timing.period_us
    labels = [ShotLabel(light, exposure_index, repeat) for light in lights]
    if hardware:
        mark_labels = [ShotLabel(mark, exposure_index, repeat) for mark in marks]
        records, labels = _with_marks(records, labels, mark_labels, timing)
    else:
        records["flags"] = FLAG_NO_TRIGGER
    return Burst("", exposure_index, repeat, panel, hardware, timing, records, tuple(labels))


def _dark(first: int, count: int) -> list[Dark]:
    return [Dark(first + k) for k in range(count)]


def _with_marks(
    records: NDArray[np.void], labels: Sequence[L], marks: Sequence[L], timing: BurstTiming
) -> tuple[NDArray[np.void], list[L]]:
    """Put the coded dark steps round a burst's own steps."""
    unit_us = -(-timing.period_us // MARK_UNITS)
    inner = records.copy()
    inner["period_us"] = timing.period_us
    dark = np.zeros(1, STEP_DTYPE)
    dark["led"], dark["on_us"] = NO_LIGHT, timing.on_us
    dark["trigger_delay_us"], dark["period_us"] = timing.trigger_delay_us, timing.period_us
    start, end = np.repeat(dark, len(START_MARK_EXTRA)), np.repeat(dark, len(END_MARK_EXTRA))
    start["period_us"] += np.array(START_MARK_EXTRA, np.uint32) * np.uint32(unit_us)
    table = np.concatenate([start, inner, end])
    first_end = len(table) - len(end)
    coded = slice(first_end - 1, len(table) - 1)
    table["period_us"][coded] += np.array(END_MARK_EXTRA, np.uint32) * np.uint32(unit_us)
    return table, [*marks[: len(start)], *labels, *marks[len(start) :]]
