"""From plan to ordered views, shots and bursts. Pure: no device, no file.

A *burst* is what one table in the box fires without the host, or the host light by light: dark marks, dark
frames, lights, marks again (`coupole.plan.marks`). All frames of a burst have one exposure. A shot's id is
`<view>/<light>/e<exposure>`, for repeats after the first with `/r<repeat>` behind: `top/led0417/e0`,
`top/dark0/e0`, `top/panel2/e1/r3`.
"""

from __future__ import annotations

from collections.abc import Collection, Iterator, Mapping
from dataclasses import astuple, dataclass, replace
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from coupole.devices import NO_LED, STEP_DTYPE, Step
from coupole.geometry import Transform, direction, inverse, look_at
from coupole.plan.led_table import LedTable
from coupole.plan.marks import MARKS_AT_ENDS, Marks, with_marks
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
    """The steps of one burst and the shots that its frames are.

    `labels[i]` is the id, without its view, of the frame that step i fires; empty for a mark whose frame is
    not wanted any more (in a re-shot burst).
    """

    view: str
    exposure_index: int
    repeat: int
    panel: int
    hardware: bool
    """The box triggers the camera; else the host does, light by light."""
    marks: Marks
    timing: BurstTiming
    table: NDArray[np.void]
    """STEP_DTYPE [steps]."""
    labels: tuple[str, ...]

    @cached_property
    def duration_s(self) -> float:
        """The table's own time."""
        return float(self.table["period_us"].sum()) / 1e6

    @property
    def inner(self) -> range:
        """Steps between the marks."""
        start, end = MARKS_AT_ENDS[self.marks]
        return range(start, len(self.labels) - end)

    @property
    def shot_ids(self) -> list[str]:
        """Ids with the view in front, step by step; empty for unwanted frames."""
        return [f"{self.view}/{label}" if label else "" for label in self.labels]

    def is_light(self) -> NDArray[np.bool_]:
        """[steps] True for shots, False for marks and dark frames."""
        return np.array(["dark" not in label and "mark" not in label and label != "" for label in self.labels])

    def without(self, leds: Collection[int]) -> Burst:
        """The same burst without the shots under these LEDs."""
        dropped = np.isin(self.table["led"], list(leds)) & (self.table["led"] != NO_LED)
        return self.only({label for label, drop in zip(self.labels, dropped, strict=True) if not drop})

    def only(self, wanted: set[str]) -> Burst:
        """The same burst with those shots only (ids without view), and marks anew."""
        inner = self.inner
        keep = [i for i in inner if self.labels[i] in wanted]
        marks = [label if label in wanted else "" for i, label in enumerate(self.labels) if i not in inner]
        table, labels = self.table[keep], [self.labels[i] for i in keep]
        dark = _dark_step(self.timing, sends_edge=self.hardware)
        table, labels = with_marks(self.marks, table, labels, marks, dark)
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
    runs_tables: bool = True,
) -> Schedule:
    """All bursts of all views. Tables are shared between views: the box need not be loaded anew.

    Of a box that does not run tables, and so keeps no log, only marks can tell that its lights went off.
    """
    bursts_of: dict[Lights, list[Burst]] = {}
    views: list[ViewPose] = []
    bursts: list[list[Burst]] = []
    hardware = plan.trigger == "hardware"
    marks: Marks = "coded" if hardware else "none" if runs_tables else "plain"
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
                    marks=marks,
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
    marks: Marks,
) -> Iterator[Burst]:
    """The bursts of one exposure; dark frames are the first one's."""
    ending = f"/e{exposure_index}" + (f"/r{repeat}" if repeat else "")
    for number, (panel, lit) in enumerate(steps):
        own_darks = darks if number == 0 else 0
        yield _burst(lit, own_darks, ending, timing, exposure_index, repeat, panel=panel, marks=marks)


def _steps(lights: Lights, lit: list[tuple[int, str]]) -> list[tuple[int, list[tuple[int, str]]]]:
    """Panel and (led, label) of the lit steps of each burst: one burst for LEDs, one for each panel."""
    if isinstance(lights, Panels):
        return [(panel, [(NO_LED, f"panel{panel}")]) for panel in lights.panels]
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
    marks: Marks,
) -> Burst:
    # A panel shines all through a burst that the box runs: what would be dark is one more picture of the panel.
    mark = f"panel{panel}-mark" if panel else "dark"
    hardware, mark_count = marks == "coded", sum(MARKS_AT_ENDS[marks])
    first_dark = 0 if panel else mark_count
    dark_steps = [(NO_LED, f"dark{first_dark + k}") for k in range(0 if panel else darks)]
    dark = _dark_step(timing, sends_edge=hardware)
    records = np.repeat(dark, len(dark_steps) + len(steps))
    records["led"] = [led for led, _ in dark_steps + steps]
    labels = [label + ending for _, label in dark_steps + steps]
    named = [f"{mark}{k}{ending}" for k in range(mark_count)]
    records, labels = with_marks(marks, records, labels, named, dark)
    return Burst("", exposure_index, repeat, panel, hardware, marks, timing, records, tuple(labels))


def _dark_step(timing: BurstTiming, *, sends_edge: bool) -> NDArray[np.void]:
    """One step (STEP_DTYPE [1]) without light."""
    step = Step(NO_LED, timing.on_us, timing.trigger_delay_us, timing.period_us, sends_edge)
    return np.array([astuple(step)], STEP_DTYPE)
