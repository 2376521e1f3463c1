"""All checks before the robot moves, in one report. No device is opened.

Pure functions: data from disk and ledger are arguments. A refusal names the view, shot or
LED, the limit and the value.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from coupole.devices import NO_LED
from coupole.geometry import apply
from coupole.motion.itinerary import Itinerary
from coupole.plan.bursts import BurstTiming
from coupole.plan.choices import MOST_CHOICES, OpenView
from coupole.plan.led_table import LedTable
from coupole.plan.plan import AdaptiveViews, EnoughViews, Plan
from coupole.plan.rig import Rig
from coupole.plan.rig_devices import upload_s
from coupole.plan.schedule import Schedule
from coupole.preflight.exposure_scale import ExposedWhite
from coupole.preflight.framing import ObjectCheck
from coupole.preflight.led_limits import heat_of, refuse_on_times
from coupole.storage.frame_file import SPARE_SLOTS
from coupole.storage.run import Occupied

BURST_OVERHEAD_S = 0.14
"""Time to arm the camera, read the table's CRC back, start, wait for the last frame, and sync (simulated cell)."""
CHOICE_S = 2.0
"""Time of a choice in the run: of bursts for 1080 LEDs on a busy machine (`tools/prove_auto_exposure.py`), or of a
view."""
SETTLE_CHECK_S = 0.1
"""Time from the end of a motion to 'settled', without the dwell (measured on the simulated cell)."""
DISK_SHARE = 0.9
"""Share of the disk's measured speed that the frame rate may use."""
PAGE_BYTES = 4096
_NOTE_BYTES, _SMALL_BYTES = 1000, 4_000_000
"""Bytes of a frame's records and lines of the journal (measured: 920), and of a run's report and inputs
without large meshes (measured: 2.8 million in the demonstration)."""


@dataclass(frozen=True)
class StorageFacts:
    """State of the disk on which the run would be."""

    free_bytes: int
    write_bytes_s: float = 0.0
    """Measured; 0: not measured."""
    folder: Path | None = None
    """Folder in which the run would be, or is; None: the rig's."""
    occupied_space: Occupied = field(default_factory=Occupied)
    """Disk space that the views of a resumed run already occupy. Their files are allocated completely at their
    begin."""
    trouble: str = ""
    """Reason why nothing can be written to the disk."""
    no_holes: str = ""
    """Reason why the disk cannot give back parts of files, if this is required."""


@dataclass(frozen=True)
class ViewReport:
    """Duration, size and dose of one view."""

    name: str
    joints_deg: tuple[float, ...] | None
    move_s: float
    burst_s: float
    dose_lux_h: float


@dataclass(frozen=True)
class Whole:
    """The same figures for a whole run that is partly done."""

    views: int
    shots: int
    frames: int
    bytes: int
    duration_s: float
    """Duration without regard to collisions."""
    dose_lux_h: float


@dataclass
class Report:
    """The expected course of a plan or of the rest of a run, and the refusals."""

    is_bound: bool = False
    """True if the figures are upper bounds, because bursts or views are chosen in the run."""
    candidates: int | None = None
    """Number of views from which the run chooses; None if the plan itself gives the views."""
    view_count: int = 0
    """Number of views that are taken; the greatest one if views are chosen."""
    whole: Whole | None = None
    """Figures of the whole run, if it is resumed; None otherwise."""
    views: list[ViewReport] = field(default_factory=list)
    """Views in the order of the visits; unreachable ones last."""
    shots: int = 0
    """Frames under a light."""
    frames: int = 0
    """Shots and dark frames."""
    bytes: int = 0
    """Size of all frames on the disk."""
    peak_bytes: int | None = None
    """Most bytes that the run needs on the disk at any time, with samples and fits, if frames are discarded; None
    if all are kept."""
    staying_bytes: int | None = None
    """Most bytes that the whole run leaves on the disk, with samples and fits, if frames are discarded; None if
    all are kept."""
    duration_s: float = 0.0
    """Expected duration, s."""
    ideal_s: float = 0.0
    """Duration of the tables with motion and settling: a lower bound for any controller."""
    dose_lux_h: float = 0.0
    """Light at the object's point that receives most, lux h."""
    dose_before_lux_h: float = 0.0
    """Light that the object has received before, by its ledger, lux h."""
    dose_budget_lux_h: float | None = None
    """Light that it may receive in its life, lux h; None without a limit."""
    peak_board_c: float = 0.0
    """Temperature of the hottest LED board, C."""
    too_hot: bool = False
    """True if boards exceed their limit, or LEDs have too short dark times. A slower pace may help."""
    timings: tuple[BurstTiming, ...] = ()
    """Timing of each exposure, with the limit that determines its period."""
    asked_bytes_s: float = 0.0
    """Rate at which frames come in a burst, bytes per second."""
    disk_bytes_s: float = 0.0
    """Measured speed of the disk, bytes per second; 0 if it was not measured."""
    exposure_scale: str | None = None
    """Record or rig setting that gives the expected brightness of white; None: it is not known."""
    white: tuple[ExposedWhite, ...] = ()
    """Brightness of white in each exposure, if that is known."""
    object_check: ObjectCheck | None = None
    """None without a mesh."""
    refusals: list[str] = field(default_factory=list)
    """Reasons why the plan must not be run, a sentence each."""
    warnings: list[str] = field(default_factory=list)
    """Remarks for the operator, a sentence each."""


@dataclass(frozen=True)
class ObjectLight:
    """The object, as far as light harms it."""

    points_support_mm: NDArray[np.float64]
    """[n, 3] points at which the dose is computed, support frame. The highest dose counts."""
    dose_before_lux_h: float = 0.0
    """Light that the object has received before, by its ledger."""
    dose_budget_lux_h: float | None = None
    """Budget of the object, as its ledger has it; a plan's budget can be stricter."""


@dataclass(frozen=True)
class Course:
    """The bursts that are taken, and the arm's way to their views."""

    schedule: Schedule
    itinerary: Itinerary
    """Visits of the schedule's views, by their numbers."""


def check(
    plan: Plan,
    rig: Rig,
    leds: LedTable,
    course: Course,
    storage: StorageFacts,
    object_light: ObjectLight,
    whole: Whole | None = None,
) -> Report:
    """Check the course of a whole plan, or the course of the rest of the run `whole`."""
    schedule, itinerary = course.schedule, course.itinerary
    report = Report(
        is_bound=schedule.is_open or plan.chooses_views,
        candidates=None if schedule.most_views is None else len(schedule.views),
        view_count=schedule.view_count,
        whole=whole,
        shots=schedule.shots,
        frames=schedule.frames,
    )
    report.timings = tuple(dict.fromkeys(burst.timing for bursts in schedule.bursts for burst in bursts))
    report.dose_before_lux_h = object_light.dose_before_lux_h
    budgets = [object_light.dose_budget_lux_h, plan.object.dose_budget_lux_h if plan.object else None]
    report.dose_budget_lux_h = min(
        (budget_lux_h for budget_lux_h in budgets if budget_lux_h is not None), default=None
    )
    report.refusals += itinerary.refusals
    report.refusals += _refuse_names(schedule)
    report.refusals += _refuse_optics(plan, rig)
    report.refusals += refuse_on_times(schedule.bursts, rig.led_limits)
    _time_and_dose(report, plan, rig, schedule, itinerary, leds, object_light.points_support_mm)
    bursts = [schedule.bursts[index] for index in _order(itinerary)]
    moves_s = [view.move_s for view in report.views]
    if itinerary.is_from_home:  # the views with most light, each a moment after the other
        bursts = sorted(bursts, key=lambda of_view: -sum(int(b.is_light().sum()) for b in of_view))
        bursts = bursts[: schedule.view_count]
        moves_s = [rig.motion.settle_dwell_s] * len(bursts)
    heat = heat_of(bursts, moves_s, rig.led_limits, leds)
    report.peak_board_c, report.too_hot = heat.peak_c, heat.too_hot
    report.refusals += heat.refusals
    _storage(report, rig, schedule, storage, keeps_all=plan.discard is None)
    return report


def _refuse_names(schedule: Schedule) -> list[str]:
    names = [view.name for view in schedule.views]
    twice = sorted({name for name in names if names.count(name) > 1})
    return [f"view {name}: expected a name of its own, found it more than once in the plan" for name in twice]


def _refuse_optics(plan: Plan, rig: Rig) -> list[str]:
    refusals = []
    for name, plan_setting, have in (
        ("focus distance", plan.optics.focus_distance_mm, rig.lens.focus_distance_mm),
        ("f-number", plan.optics.f_number, rig.lens.f_number),
    ):
        if plan_setting is not None and abs(plan_setting - have) > 1e-3 * have:
            refusals.append(f"optics: the plan is for {name} {plan_setting:g}, the rig's lens is set to {have:g}")
    return refusals


def _order(itinerary: Itinerary) -> list[int]:
    """Views in the order of the visits, then unreachable ones."""
    return [*itinerary.order, *sorted(set(range(len(itinerary.visits))) - set(itinerary.order))]


def _time_and_dose(
    report: Report,
    plan: Plan,
    rig: Rig,
    schedule: Schedule,
    itinerary: Itinerary,
    leds: LedTable,
    points_support_mm: NDArray[np.float64],
) -> None:
    costs = CostOfViews(plan, rig, schedule, leds, points_support_mm)
    doses = np.zeros((len(schedule.views), len(points_support_mm)))
    durations_s, ideals_s = np.zeros((2, len(schedule.views)))
    for number, index in enumerate(_order(itinerary)):
        view, visit, bursts = schedule.views[index], itinerary.visits[index], schedule.bursts[index]
        leg_s = visit.leg.duration_s if visit and visit.leg.waypoints else 0.0
        move_s = (2.0 if itinerary.is_from_home else 1.0) * leg_s + rig.motion.settle_dwell_s
        burst_s = sum(b.duration_s for b in bursts)
        doses[number] = costs.dose_lux_h(index)
        waiting_s = max(0.0, upload_s(rig, len(bursts[0].table)) - move_s) if number == 0 else 0.0
        ideals_s[number] = move_s + burst_s
        durations_s[number] = move_s + waiting_s + costs.standing_s(index)
        report.views.append(
            ViewReport(
                view.name,
                None if visit is None else tuple(visit.joints_deg.tolist()),
                move_s,
                burst_s,
                float(doses[number].max()),
            )
        )
    report.ideal_s, report.duration_s = _most(ideals_s, schedule), _most(durations_s, schedule)
    report.dose_lux_h = float(np.sort(doses, axis=0)[::-1][: schedule.view_count].sum(axis=0).max())
    if isinstance(plan.views, AdaptiveViews):
        least_s = durations_s - ideals_s + [view.move_s / 2.0 + view.burst_s for view in report.views]
        frames = [sum(len(burst.labels) for burst in bursts) for bursts in schedule.bursts]
        least = {"frames": min(frames, default=0), "seconds": least_s.min(initial=np.inf)}
        report.refusals += _too_strict(plan.views.until, least | {"lux_h": doses.max(axis=1).min(initial=np.inf)})
        _limit(report, plan.views.until)
    budget = report.dose_budget_lux_h
    if budget is not None and report.dose_lux_h + report.dose_before_lux_h > budget:
        assert plan.object is not None
        report.refusals.append(
            f"object {plan.object.id}: the plan {'may give' if report.is_bound else 'gives'} it "
            f"{report.dose_lux_h:.2f} lux.h after "
            f"{report.dose_before_lux_h:.2f} lux.h before; its budget is {budget:g} lux.h"
        )


def _most(figure_of_views: NDArray[np.float64], schedule: Schedule) -> float:
    """Return the sum of a figure [views] of the views, the greatest possible one if views are chosen."""
    return float(np.sort(figure_of_views)[::-1][: schedule.view_count].sum())


def _too_strict(until: EnoughViews, least: Mapping[str, float]) -> list[str]:
    """Return refusals of limits that allow not a single view. `least` has the least figures of a view."""
    return [
        f"views: `{key}` of `until` allows no view: expected at least {least[key]:.4g}, found {limit:g}"
        for key, limit in (("frames", until.frames), ("seconds", until.seconds), ("lux_h", until.lux_h))
        if limit is not None and np.isfinite(least[key]) and least[key] > limit
    ]


def _limit(report: Report, until: EnoughViews) -> None:
    """Limit the figures to the limits that the plan sets: no view that would exceed them is begun. The time of the
    choices comes on top."""
    if until.frames is not None:
        report.frames = min(report.frames, until.frames)
        report.shots = min(report.shots, report.frames)
    if until.seconds is not None:
        report.duration_s = min(report.duration_s, until.seconds)
        report.ideal_s = min(report.ideal_s, report.duration_s)
    report.duration_s += CHOICE_S * report.view_count
    if until.lux_h is not None:
        report.dose_lux_h = min(report.dose_lux_h, until.lux_h)


class CostOfViews:
    """Greatest time and light of each view of a schedule, without the way to it."""

    def __init__(
        self,
        plan: Plan,
        rig: Rig,
        schedule: Schedule,
        leds: LedTable,
        points_support_mm: NDArray[np.float64],
    ) -> None:
        """The light is computed at `points_support_mm` [n, 3]."""
        points_base = apply(rig.support.base_from_support.matrix(), points_support_mm)
        self._lux = leds.illuminance_lux(points_base, emission=rig.dome.emission)
        self._row_of_id = {int(led): row for row, led in enumerate(leds.ids)}
        self._plan, self._rig, self._schedule = plan, rig, schedule
        self._dose_of_table: dict[int, NDArray[np.float64]] = {}

    def standing_s(self, number: int) -> float:
        """Return the longest time of a view after the motion to it: settling, bursts and choices of bursts."""
        bursts = self._schedule.bursts[number]
        standing_s = SETTLE_CHECK_S + sum(b.duration_s for b in bursts) + BURST_OVERHEAD_S * len(bursts)
        if self._schedule.is_open:  # a table is uploaded when it has been chosen
            choices = len(bursts) if self._plan.chooses_lights else MOST_CHOICES
            standing_s += choices * (CHOICE_S + upload_s(self._rig, max(len(burst.table) for burst in bursts)))
        return standing_s

    def dose_lux_h(self, number: int) -> NDArray[np.float64]:
        """[n] most light of a view at each point."""
        if self._plan.chooses_lights:
            return _most_dose(self._schedule.open_view(number), self._lux, self._row_of_id)
        dose = np.zeros(len(self._lux))
        for burst in self._schedule.bursts[number]:
            if id(burst.table) not in self._dose_of_table:
                lit = burst.table[burst.table["led"] != NO_LED]
                rows = [self._row_of_id[int(led)] for led in lit["led"]]
                self._dose_of_table[id(burst.table)] = self._lux[:, rows] @ lit["on_us"] / 3.6e9
            dose += self._dose_of_table[id(burst.table)]
            if burst.panel:
                dose += self._rig.dome.panel_lux * (burst.duration_s + BURST_OVERHEAD_S) / 3600.0
        return dose


def _most_dose(view: OpenView, lux: NDArray[np.float64], row_of_id: Mapping[int, int]) -> NDArray[np.float64]:
    """Return the greatest light [points] that a view can give whose LEDs are chosen in the run. At each point the
    brightest of the LEDs get the longest on-times."""
    if not view.bound:
        return np.zeros(len(lux))
    on_us = np.concatenate([burst.table["on_us"][burst.is_light()] for burst in view.bound])
    rows = [row_of_id[led] for led in view.leds.tolist()]
    brightest = np.sort(lux[:, rows], axis=1)[:, ::-1][:, : len(on_us)]
    return np.asarray(brightest @ np.sort(on_us)[::-1].astype(np.float64) / 3.6e9)


def room_bytes(frames: int, views: int, frame_bytes: int) -> int:
    """Return the bytes that a run of so many frames and views needs on the disk."""
    return (frames + SPARE_SLOTS * views) * frame_bytes + frames * _NOTE_BYTES + _SMALL_BYTES


def _storage(report: Report, rig: Rig, schedule: Schedule, storage: StorageFacts, *, keeps_all: bool) -> None:
    frame_bytes = rig.frame_bytes
    folder = storage.folder or rig.storage.folder
    report.bytes = report.frames * frame_bytes
    periods_us = [int(b.table["period_us"].min()) for bursts in schedule.bursts for b in bursts]
    report.asked_bytes_s = frame_bytes / (min(periods_us) * 1e-6) if periods_us else 0.0
    report.disk_bytes_s = storage.write_bytes_s
    whole = report.whole or report
    views = report.whole.views if report.whole else report.view_count
    needed_bytes = max(0, room_bytes(whole.frames, views, frame_bytes) - storage.occupied_space.bytes)
    if storage.trouble:
        report.refusals.append(f"storage {folder}: expected a folder that can be written; {storage.trouble}")
    if keeps_all and needed_bytes + rig.storage.reserve_bytes > storage.free_bytes:
        report.refusals.append(
            f"storage {folder}: the run needs {needed_bytes / 1e9:.3f} GB and "
            f"{rig.storage.reserve_bytes / 1e9:.3f} GB must stay free; {storage.free_bytes / 1e9:.3f} GB are free"
        )
    if frame_bytes % PAGE_BYTES:
        report.warnings.append(
            f"a frame of {rig.sensor.width_px} x {rig.sensor.height_px} is not a multiple of {PAGE_BYTES} bytes: "
            "it is written through the page cache, which is slower"
        )
