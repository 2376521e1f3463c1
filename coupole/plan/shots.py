"""From plan to ordered views, shots and bursts. Pure: no device, no file.

A *burst* is what one table in the box fires without the host: coded dark marks, dark frames, lights, marks
again. All frames of a burst have one exposure. A shot's id is `<view>/<light>/e<exposure>`, for repeats after
the first with `/r<repeat>` behind: `top/led0417/e0`, `top/dark0/e0`, `top/panel2/e1/r3`.
"""

from __future__ import annotations

from collections.abc import Collection, Iterator, Mapping
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from coupole.devices import FLAG_NO_TRIGGER, NO_LIGHT, STEP_DTYPE
from coupole.geometry import Transform, direction, inverse, look_at
from coupole.plan.led_table import LedTable
from coupole.plan.plan import (
    AllLights,
    EveryLight,
    Grid,
    Joints,
    LightBoards,
    LightCone,
    LightIds,
    Lights,
    LookAt,
    Panels,
    Plan,
    View,
)

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
class ViewPose:
    """One place of the camera: where it looks from, or the joint angles that say so."""

    name: str
    support_from_camera: Transform | None
    joints_deg: tuple[float, ...] | None
    target_mm: tuple[float, float, float] | None


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
    """One table for the box and the shots that its frames are.

    `labels[i]` is the id, without its view, of the frame that step i fires; empty for a mark whose frame is
    not wanted any more (in a re-shot burst).
    """

    view: str
    exposure_index: int
    repeat: int
    panel: int
    hardware: bool
    timing: BurstTiming
    table: NDArray[np.void]
    labels: tuple[str, ...]

    @cached_property
    def duration_s(self) -> float:
        """The table's own time."""
        return float(self.table["period_us"].sum(dtype=np.int64)) / 1e6

    @property
    def shot_ids(self) -> list[str]:
        """Ids with the view in front, step by step; empty for unwanted frames."""
        return [f"{self.view}/{label}" if label else "" for label in self.labels]

    def is_light(self) -> NDArray[np.bool_]:
        """[steps] True for shots, False for marks and dark frames."""
        return np.array(["dark" not in label and "mark" not in label and label != "" for label in self.labels])

    def without(self, leds: Collection[int]) -> Burst:
        """The same burst without the shots under these LEDs."""
        dropped = np.isin(self.table["led"], list(leds)) & (self.table["led"] != NO_LIGHT)
        return self.only({label for label, drop in zip(self.labels, dropped, strict=True) if not drop})

    def only(self, wanted: set[str]) -> Burst:
        """The same burst with those shots only (ids without view), and marks anew."""
        marked = self.hardware
        inner = (
            range(len(START_MARK_EXTRA), len(self.labels) - len(END_MARK_EXTRA))
            if marked
            else range(len(self.labels))
        )
        keep = [i for i in inner if self.labels[i] in wanted]
        marks = [label if label in wanted else "" for i, label in enumerate(self.labels) if i not in inner]
        table, labels = self.table[keep], [self.labels[i] for i in keep]
        if marked:
            table, labels = _with_marks(table, labels, marks, self.timing)
        return replace(self, table=table, labels=tuple(labels))


@dataclass(frozen=True)
class Schedule:
    """Everything that a plan asks for, in order."""

    views: tuple[ViewPose, ...]
    bursts: tuple[tuple[Burst, ...], ...]
    """Bursts of each view."""
    labels: tuple[tuple[str, ...], ...]
    """Of all frames that each view can have, before any was left out, in the order of its bursts."""

    @property
    def shots(self) -> int:
        """Frames under a light, darks and marks apart."""
        return sum(int(b.is_light().sum()) for bursts in self.bursts for b in bursts)

    @property
    def frames(self) -> int:
        return sum(len(b.labels) for bursts in self.bursts for b in bursts)

    def without(self, hidden: Mapping[str, Collection[int]]) -> Schedule:
        """The same without some LEDs in some views (LED ids by name of view)."""
        return Schedule(
            self.views,
            tuple(
                tuple(b.without(hidden[view.name]) for b in bursts) if hidden.get(view.name) else bursts
                for view, bursts in zip(self.views, self.bursts, strict=True)
            ),
            self.labels,
        )


def expand_view(view: View) -> list[ViewPose]:
    """The poses that one entry of a plan's views stands for: a grid has many."""
    match view:
        case LookAt():
            pose = look_at(view.target_mm, view.distance_mm, view.azimuth_deg, view.elevation_deg, view.roll_deg)
            return [ViewPose(view.name, pose, None, view.target_mm)]
        case Grid():
            return [
                ViewPose(
                    f"{view.name}-az{azimuth:g}-el{elevation:g}",
                    look_at(view.target_mm, view.distance_mm, azimuth, elevation, view.roll_deg),
                    None,
                    view.target_mm,
                )
                for elevation in view.elevations_deg
                for azimuth in view.azimuths_deg
            ]
        case Joints():
            return [ViewPose(view.name, None, view.joints_deg, None)]


def leds_of_plan(plan: Plan, leds: LedTable, base_from_support: Transform) -> NDArray[np.int64]:
    """Rows of the LED table that any view of the plan lights. Raises KeyError as `select_leds`."""
    rows = [select_leds(view.lights or plan.lights, leds, base_from_support) for view in plan.views]
    return np.unique(np.concatenate(rows))


def select_leds(lights: Lights, leds: LedTable, base_from_support: Transform) -> NDArray[np.int64]:
    """Rows of the LED table that are lit, in the order of the table; none for panels and darks.

    Raises KeyError for an LED or a board that the dome does not have (`missing_lights` says it better).
    """
    match lights:
        case AllLights():
            return np.arange(len(leds.ids))
        case LightIds(ids=ids):
            return leds.rows(ids)
        case LightBoards(boards=boards):
            if unknown := set(boards) - set(leds.boards.tolist()):
                raise KeyError(min(unknown))
            return np.flatnonzero(np.isin(leds.boards, boards))
        case EveryLight(every=every, offset=offset):
            return np.arange(offset, len(leds.ids), every)
        case LightCone() as cone:
            position = (leds.positions_mm - base_from_support[:3, 3]) @ inverse(base_from_support)[:3, :3].T
            towards = position / np.linalg.norm(position, axis=1, keepdims=True)
            cosine = towards @ direction(cone.azimuth_deg, cone.elevation_deg)
            return np.flatnonzero(cosine >= np.cos(np.radians(cone.half_angle_deg)))
    return np.zeros(0, np.int64)


def missing_lights(plan: Plan, leds: LedTable) -> list[tuple[tuple[str | int, ...], str]]:
    """Key path and message for each light of the plan that the dome does not have."""
    own = [(("views", i, "lights"), view.lights) for i, view in enumerate(plan.views) if view.lights is not None]
    return [
        (where + key, message)
        for where, lights in [(("lights",), plan.lights), *own]
        for key, message in _missing(lights, leds)
    ]


def _missing(lights: Lights, leds: LedTable) -> list[tuple[tuple[str | int, ...], str]]:
    match lights:
        case LightIds(ids=ids):
            have, key, what = set(leds.ids.tolist()), "ids", "LED"
            asked: tuple[int, ...] = ids
        case LightBoards(boards=boards):
            have, key, what, asked = set(leds.boards.tolist()), "boards", "board", boards
        case EveryLight(offset=offset) if offset >= len(leds.ids):
            return [(("offset",), f"expected less than the dome's {len(leds.ids)} LEDs, found {offset}")]
        case _:
            return []
    return [
        ((key, i), f"the dome has no {what} {n}; it has {min(have)} to {max(have)}")
        for i, n in enumerate(asked)
        if n not in have
    ]


def interleave(boards: NDArray[np.int64]) -> NDArray[np.int64]:
    """Order of LEDs [n] in which neighbours in time sit on different boards: one LED of each board in turn."""
    turn = np.zeros(len(boards), np.int64)
    for board in np.unique(boards):
        mine = np.flatnonzero(boards == board)
        turn[mine] = np.arange(len(mine))
    return np.lexsort((boards, turn))


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


def build_schedule(
    plan: Plan,
    leds: LedTable,
    base_from_support: Transform,
    *,
    rise_us: int,
    readout_us: float,
    exposure_gap_us: int,
    pace: Pace = FASTEST,
) -> Schedule:
    """All bursts of all views. Tables are shared between views: the box need not be loaded anew."""
    bursts_of: dict[Lights, list[Burst]] = {}
    views: list[ViewPose] = []
    bursts: list[list[Burst]] = []
    hardware = plan.trigger == "hardware"
    for view in plan.views:
        lights = view.lights or plan.lights
        if lights not in bursts_of:
            rows = select_leds(lights, leds, base_from_support)
            rows = rows[interleave(leds.boards[rows])]
            lit = [(int(leds.ids[row]), f"led{int(leds.ids[row]):04d}") for row in rows]
            steps = _steps(lights, lit)
            bursts_of[lights] = [
                burst
                for repeat in range(plan.repeats)
                for index, exposure_us in enumerate(plan.exposure.exposures_us)
                for burst in _bursts(
                    steps,
                    burst_timing(
                        exposure_us,
                        rise_us=rise_us,
                        readout_us=readout_us,
                        exposure_gap_us=exposure_gap_us,
                        hardware=hardware,
                        pace=pace,
                    ),
                    index,
                    repeat,
                    darks=plan.darks_per_view if repeat == 0 else 0,
                    hardware=hardware,
                )
            ]
        for pose in expand_view(view):
            views.append(pose)
            bursts.append([replace(burst, view=pose.name) for burst in bursts_of[lights]])
    labels = tuple(tuple(label for burst in mine for label in burst.labels) for mine in bursts)
    return Schedule(tuple(views), tuple(map(tuple, bursts)), labels)


def _bursts(
    steps: list[tuple[int, list[tuple[int, str]]]],
    timing: BurstTiming,
    exposure_index: int,
    repeat: int,
    *,
    darks: int,
    hardware: bool,
) -> Iterator[Burst]:
    """The bursts of one exposure; dark frames are the first one's."""
    ending = f"/e{exposure_index}" + (f"/r{repeat}" if repeat else "")
    for number, (panel, lit) in enumerate(steps):
        own_darks = darks if number == 0 else 0
        yield _burst(lit, own_darks, ending, timing, exposure_index, repeat, panel=panel, hardware=hardware)


def _steps(lights: Lights, lit: list[tuple[int, str]]) -> list[tuple[int, list[tuple[int, str]]]]:
    """Panel and (led, label) of the lit steps of each burst: one burst for LEDs, one for each panel."""
    if isinstance(lights, Panels):
        return [(panel, [(NO_LIGHT, f"panel{panel}")]) for panel in lights.panels]
    return [(0, lit)]


def _burst(
    steps: list[tuple[int, str]],
    darks: int,
    ending: str,
    timing: BurstTiming,
    exposure_index: int,
    repeat: int,
    *,
    panel: int,
    hardware: bool,
) -> Burst:
    # A panel shines all through its burst: what would be dark there is one more picture of the panel.
    mark = f"panel{panel}-mark" if panel else "dark"
    first_dark = MARKS if hardware and not panel else 0
    dark_steps = [(NO_LIGHT, f"dark{first_dark + k}") for k in range(0 if panel else darks)]
    records = np.zeros(len(dark_steps) + len(steps), STEP_DTYPE)
    records["led"] = [led for led, _ in dark_steps + steps]
    records["on_us"], records["trigger_delay_us"] = timing.on_us, timing.trigger_delay_us
    records["period_us"] = timing.period_us
    labels = [label + ending for _, label in dark_steps + steps]
    if hardware:
        marks = [f"{mark}{k}{ending}" for k in range(MARKS)]
        records, labels = _with_marks(records, labels, marks, timing)
    else:
        records["flags"] = FLAG_NO_TRIGGER
    return Burst("", exposure_index, repeat, panel, hardware, timing, records, tuple(labels))


def _with_marks(
    records: NDArray[np.void], labels: list[str], marks: list[str], timing: BurstTiming
) -> tuple[NDArray[np.void], list[str]]:
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
    return table, marks[: len(start)] + labels + marks[len(start) :]
