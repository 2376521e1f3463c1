"""Bursts: the shots of one table. The box executes them, or the host executes them light by light.

A burst has dark marks, dark frames, lights, and marks again (`plan.marks`). All its frames have one exposure.
"""

from __future__ import annotations

from collections.abc import Collection, Iterator, Sequence
from dataclasses import astuple, dataclass, replace
from functools import cached_property
from itertools import count
from typing import assert_never

import numpy as np
from numpy.typing import NDArray

from coupole.devices import NO_LED, STEP_DTYPE, Step
from coupole.plan.marks import MARKS_AT_ENDS, Marks, with_marks
from coupole.plan.shot_id import Dark, Led, Light, Panel, PanelMark, Sentinel, ShotId, ShotLabel

EXPOSURE_MARGIN_US = 200
"""On-time of an LED after the exposure's nominal end, because the camera's exposure may start late."""
PERIOD_MARGIN_US, PERIOD_MARGIN_PPM = 10, 200
"""Margin for early edges: for jitter, and for the drift between two quartzes. A camera at its limit would ignore
early edges."""
LED_GAP_US = 100
"""Least dark time between two lights."""
_COOLS_FOR = 3
"""Least number of steps between a sentinel and another shot of its LED. During these steps the LED rests for twice
the time of a flash."""
SOFTWARE_LATENCY_US = 60_000
"""Additional on-time of an LED with software trigger, for the host's round trip to the camera."""


@dataclass(frozen=True)
class Pace:
    """Limits that make step periods longer than camera and LED need, because of disk or heat."""

    disk_us: int = 0
    """Time in which the disk writes a frame."""
    led_duty: float = 1.0
    """Largest share of a step in which an LED is lit, because of heat."""


FASTEST = Pace()


@dataclass(frozen=True)
class BurstTiming:
    """Times of a burst's ordinary steps, in us."""

    exposure_us: int
    on_us: int
    trigger_delay_us: int
    period_us: int
    bound: str
    """The limit that determines the period: `camera`, `LED`, `disk` or `heat`."""


@dataclass(frozen=True)
class Burst:
    """The steps of one burst and the shots of its frames."""

    view: str
    exposure_index: int
    repeat: int
    panel: int
    hardware: bool
    """True if the box triggers the camera, False if the host does, light by light."""
    marks: Marks
    timing: BurstTiming
    table: NDArray[np.void]
    """STEP_DTYPE [steps]."""
    labels: tuple[ShotLabel | None, ...]
    """Label of the frame of each step; None for a mark whose frame is not needed, in a burst that is taken
    again."""

    @cached_property
    def duration_s(self) -> float:
        """Duration of the table, s."""
        return float(self.table["period_us"].sum()) / 1e6

    @property
    def inner(self) -> range:
        """Steps between the marks."""
        start, end = MARKS_AT_ENDS[self.marks]
        return range(start, len(self.labels) - end)

    @property
    def shots(self) -> list[ShotId | None]:
        """Shot of each step; None for frames that are not needed."""
        return [None if label is None else ShotId(self.view, label) for label in self.labels]

    def is_light(self) -> NDArray[np.bool_]:
        """[steps] True for shots, False for marks and dark frames."""
        return np.array([label is not None and label.is_shot for label in self.labels])

    def without(self, leds: Collection[int]) -> Burst:
        """Return the same burst without the shots under these LEDs."""
        drops = np.isin(self.table["led"], list(leds)) & (self.table["led"] != NO_LED)
        return self.only({label for label, drop in zip(self.labels, drops, strict=True) if label and not drop})

    def only(self, wanted_labels: Collection[ShotLabel]) -> Burst:
        """Return the same burst with only those shots, and with new marks."""
        inner = self.inner
        keep = [i for i in inner if self.labels[i] in wanted_labels]
        marks = [
            label if label in wanted_labels else None for i, label in enumerate(self.labels) if i not in inner
        ]
        dark = _dark_step(self.timing, sends_edge=self.hardware)
        own_labels = [self.labels[i] for i in keep]
        table, labels = with_marks(self.marks, self.table[keep], own_labels, marks, dark)
        return replace(self, table=table, labels=tuple(labels))


@dataclass(frozen=True)
class DeviceTimes:
    """Times that the LEDs and the camera of a cell need."""

    rise_us: int
    """Time from an LED's current to its full light."""
    readout_us: float
    """Least time from frame to frame."""
    exposure_gap_us: int
    """Least time from the end of an exposure to the next one."""


def burst_timing(
    exposure_us: int,
    times: DeviceTimes,
    *,
    hardware: bool,
    pace: Pace = FASTEST,
) -> BurstTiming:
    """Return the shortest times of a step that camera, LEDs and the given pace allow.

    The LED is on for its rise, the exposure and a margin. The period is the longest of these times: the camera's
    readout, the exposure plus the sensor's gap, the LED's on-time plus a dark gap, and the limits of disk and
    heat.
    """
    on_us = times.rise_us + exposure_us + EXPOSURE_MARGIN_US
    if not hardware:
        on_us += SOFTWARE_LATENCY_US
    camera_us = max(times.readout_us, exposure_us + times.exposure_gap_us)
    camera_us += PERIOD_MARGIN_US + PERIOD_MARGIN_PPM * 1e-6 * camera_us
    periods_us = {
        "camera": int(np.ceil(camera_us)),
        "LED": on_us + LED_GAP_US,
        "disk": pace.disk_us,
        "heat": int(np.ceil(on_us / pace.led_duty)),
    }
    bound = max(periods_us, key=lambda name: periods_us[name])
    return BurstTiming(exposure_us, on_us, times.rise_us, periods_us[bound], bound)


def bursts_of_exposure(
    lights: Sequence[Sequence[Led | Sentinel] | Panel],
    timing: BurstTiming,
    exposure_index: int,
    repeat: int,
    *,
    darks: int,
    marks: Marks,
) -> Iterator[Burst]:
    """Yield the bursts of one exposure, without a view: one for each list of LEDs, one for each panel. Dark frames
    are in the first burst."""
    for number, lit in enumerate(lights):
        own_darks = darks if number == 0 else 0
        yield _burst(lit, own_darks, timing, exposure_index, repeat, marks=marks)


def with_sentinels(lit: Sequence[Led], sentinels: Sequence[int], every: int) -> list[Led | Sentinel]:
    """Return the LEDs with `sentinels` among them. All sentinels are lit at the begin and at the end. Between,
    one sentinel follows after every `every` LEDs, each sentinel in turn. They keep a distance from the shots of
    the same LEDs, so that the LEDs cool.
    """
    if not sentinels:
        return list(lit)
    between = range(every, len(lit) - every // 2, every)
    groups = [(place, [sentinels[k % len(sentinels)]]) for k, place in enumerate(between)]
    groups = [(0, list(sentinels)), *groups, (len(lit), list(sentinels))]
    leds_before: dict[int, list[int]] = {}
    for wanted_place, leds in groups:
        own_places = [place for place, led in enumerate(lit) if led.id in leds]
        leds_before.setdefault(_cool_place(wanted_place, own_places, len(lit)), []).extend(leds)
    numbers = count()
    in_order: list[Led | Sentinel] = []
    for place in range(len(lit) + 1):
        in_order += [Sentinel(led, next(numbers)) for led in leds_before.get(place, ())]
        in_order += lit[place : place + 1]
    return in_order


def _cool_place(wanted_place: int, own_places: Sequence[int], led_count: int) -> int:
    """Return the place nearest to the wanted one, among this number of LEDs, that keeps the distance from these
    places."""
    cool = (p for p in range(led_count + 1) if not any(-_COOLS_FOR <= at - p < _COOLS_FOR for at in own_places))
    return min(cool, key=lambda p: (abs(p - wanted_place), p), default=wanted_place)


def _burst(
    lit: Sequence[Led | Sentinel] | Panel,
    darks: int,
    timing: BurstTiming,
    exposure_index: int,
    repeat: int,
    *,
    marks: Marks,
) -> Burst:
    # A panel is lit during the whole burst that the box runs, so a dark frame would be another picture of the
    # panel.
    panel = lit.number if isinstance(lit, Panel) else 0
    hardware, mark_count = marks == "coded", sum(MARKS_AT_ENDS[marks])
    lights: list[Light] = [lit] if isinstance(lit, Panel) else [*_darks(mark_count, darks), *lit]
    mark_lights: list[Light] = [PanelMark(panel, k) if panel else Dark(k) for k in range(mark_count)]
    dark = _dark_step(timing, sends_edge=hardware)
    steps = np.repeat(dark, len(lights))
    steps["led"] = [_led_of(light) for light in lights]
    own_labels = [ShotLabel(light, exposure_index, repeat) for light in lights]
    mark_labels = [ShotLabel(light, exposure_index, repeat) for light in mark_lights]
    table, labels = with_marks(marks, steps, own_labels, mark_labels, dark)
    return Burst("", exposure_index, repeat, panel, hardware, marks, timing, table, tuple(labels))


def _led_of(light: Light) -> int:
    """Return the id of the LED that is lit, or NO_LED."""
    match light:
        case Led(id=led) | Sentinel(led=led):
            return led
        case Panel() | PanelMark() | Dark():
            return NO_LED
        case _:
            assert_never(light)


def _darks(first: int, count: int) -> list[Dark]:
    return [Dark(first + k) for k in range(count)]


def _dark_step(timing: BurstTiming, *, sends_edge: bool) -> NDArray[np.void]:
    """Return one step (STEP_DTYPE [1]) without light."""
    step = Step(NO_LED, timing.on_us, timing.trigger_delay_us, timing.period_us, sends_edge)
    return np.array([astuple(step)], STEP_DTYPE)
