"""All checks before the robot moves, in one report, without opening a device.

Pure functions: data from disk and ledger are arguments. A refusal names the view, shot or
LED, the limit and the value.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from coupole.devices import NO_LED
from coupole.geometry import apply
from coupole.motion.itinerary import Itinerary
from coupole.plan.bursts import Burst, BurstTiming
from coupole.plan.led_table import LedTable
from coupole.plan.plan import Plan
from coupole.plan.rig import BoardThermal, LedLimits, Rig
from coupole.plan.rig_devices import upload_s
from coupole.plan.schedule import Schedule

BURST_OVERHEAD_S = 0.14
"""Arm the camera, read the table's CRC back, start, wait for the last frame, sync (simulated cell)."""
SETTLE_CHECK_S = 0.1
"""From the end of a motion to 'settled', without the dwell (measured on the simulated cell)."""
DISK_SHARE = 0.9
"""Share of the disk's measured speed that the frame rate may use."""
PAGE_BYTES = 4096


@dataclass(frozen=True)
class StorageFacts:
    """State of the disk: free bytes, and its measured speed (0: not measured)."""

    free_bytes: int
    write_bytes_s: float = 0.0


@dataclass(frozen=True)
class ViewReport:
    """Duration, size and dose of one view."""

    name: str
    joints_deg: tuple[float, ...] | None
    move_s: float
    burst_s: float
    dose_lux_h: float


@dataclass
class Report:
    """The expected course of a plan, and the refusals."""

    views: list[ViewReport] = field(default_factory=list)
    """In the order of the visits; unreachable ones last."""
    shots: int = 0
    frames: int = 0
    bytes: int = 0
    duration_s: float = 0.0
    ideal_s: float = 0.0
    """Duration of the tables plus motion and settling: a lower bound for any controller."""
    dose_lux_h: float = 0.0
    dose_before_lux_h: float = 0.0
    dose_budget_lux_h: float | None = None
    peak_board_c: float = 0.0
    too_hot: bool = False
    """Boards beyond their limit, or LEDs with too short dark times: a slower pace may help."""
    timings: tuple[BurstTiming, ...] = ()
    """Timing of each exposure, with the limit that determines its period."""
    asked_bytes_s: float = 0.0
    disk_bytes_s: float = 0.0
    refusals: list[str] = field(default_factory=list)
    warnings: list[str] = field(default_factory=list)


def check(
    plan: Plan,
    rig: Rig,
    schedule: Schedule,
    leds: LedTable,
    storage: StorageFacts,
    itinerary: Itinerary,
    *,
    object_points_support_mm: NDArray[np.float64],
    dose_before_lux_h: float = 0.0,
    share_left: float = 1.0,
) -> Report:
    """Check a whole plan. The dose is computed at `object_points_support_mm` [n, 3]; the highest counts.

    For a resumed plan, `share_left` of its light is still to come.
    """
    report = Report(shots=schedule.shots, frames=schedule.frames)
    report.timings = tuple(dict.fromkeys(burst.timing for burst in schedule.bursts[0]))
    report.dose_before_lux_h = dose_before_lux_h
    report.dose_budget_lux_h = plan.object.dose_budget_lux_h if plan.object else None
    report.refusals += itinerary.refusals
    report.refusals += _refuse_names(schedule)
    report.refusals += _refuse_optics(plan, rig)
    report.refusals += _refuse_on_times(schedule.bursts[0], rig.led_limits)
    _time_and_dose(report, plan, rig, schedule, itinerary, leds, object_points_support_mm, share_left)
    _thermal(report, rig.led_limits, [schedule.bursts[index] for index in _order(itinerary)], leds)
    _storage(report, rig, schedule, storage)
    return report


def _refuse_names(schedule: Schedule) -> list[str]:
    names = [view.name for view in schedule.views]
    twice = sorted({name for name in names if names.count(name) > 1})
    return [f"view {name}: expected a name of its own, found it more than once in the plan" for name in twice]


def _refuse_optics(plan: Plan, rig: Rig) -> list[str]:
    refusals = []
    for name, asked, have in (
        ("focus distance", plan.optics.focus_distance_mm, rig.lens.focus_distance_mm),
        ("f-number", plan.optics.f_number, rig.lens.f_number),
    ):
        if asked is not None and abs(asked - have) > 1e-3 * have:
            refusals.append(f"optics: the plan is for {name} {asked:g}, the rig's lens is set to {have:g}")
    return refusals


def _refuse_on_times(bursts: Sequence[Burst], limits: LedLimits) -> list[str]:
    low_us, high_us = limits.on_us
    refusals = []
    for burst in bursts:
        lit = burst.table["led"] != NO_LED
        wrong = lit & ((burst.table["on_us"] < low_us) | (burst.table["on_us"] > high_us))
        if wrong.any():
            first = int(np.flatnonzero(wrong)[0])
            refusals.append(
                f"shot {burst.labels[first]}: LED {burst.table['led'][first]} would be on for "
                f"{burst.table['on_us'][first]} us; the limits are {low_us} to {high_us} us"
            )
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
    share_left: float,
) -> None:
    points_base = apply(rig.support.base_from_support.matrix(), points_support_mm)
    lux = leds.illuminance_lux(points_base, emission=rig.dome.emission)
    row_of_id = {int(led): row for row, led in enumerate(leds.ids)}
    dose_of_table: dict[int, NDArray[np.float64]] = {}
    total = np.zeros(len(points_support_mm))
    for index in _order(itinerary):
        view, visit, bursts = schedule.views[index], itinerary.visits[index], schedule.bursts[index]
        move_s = (visit.leg.duration_s if visit and visit.leg.waypoints else 0.0) + rig.motion.settle_dwell_s
        burst_s = sum(b.duration_s for b in bursts)
        dose = np.zeros(len(total))
        for burst in bursts:
            if id(burst.table) not in dose_of_table:
                lit = burst.table[burst.table["led"] != NO_LED]
                rows = [row_of_id[int(led)] for led in lit["led"]]
                dose_of_table[id(burst.table)] = lux[:, rows] @ lit["on_us"] / 3.6e9
            dose += dose_of_table[id(burst.table)]
            if burst.panel:
                dose += rig.dome.panel_lux * (burst.duration_s + BURST_OVERHEAD_S) / 3600.0
        total += dose
        waiting_s = max(0.0, upload_s(rig, len(bursts[0].table)) - move_s) if not report.views else 0.0
        report.ideal_s += move_s + burst_s
        report.duration_s += move_s + SETTLE_CHECK_S + waiting_s + burst_s + BURST_OVERHEAD_S * len(bursts)
        report.views.append(
            ViewReport(
                view.name,
                None if visit is None else tuple(visit.joints_deg.tolist()),
                move_s,
                burst_s,
                float(dose.max()),
            )
        )
    report.dose_lux_h = float(total.max()) * share_left
    budget = report.dose_budget_lux_h
    if budget is not None and report.dose_lux_h + report.dose_before_lux_h > budget:
        assert plan.object is not None
        report.refusals.append(
            f"object {plan.object.id}: the plan gives it {report.dose_lux_h:.2f} lux.h after "
            f"{report.dose_before_lux_h:.2f} lux.h before; its budget is {budget:g} lux.h"
        )


def _thermal(
    report: Report, limits: LedLimits, bursts_of_views: Sequence[Sequence[Burst]], leds: LedTable
) -> None:
    """Board temperatures (first order) and dark times of each LED, over the bursts of the report's views."""
    model = limits.board
    board_of_led = dict(zip(leds.ids.tolist(), leds.boards.tolist(), strict=True))
    n_boards = int(leds.boards.max()) + 1
    rise = np.zeros(n_boards)
    off_since = np.full(int(leds.ids.max()) + 1, -np.inf)
    peak = 0.0
    t_s = 0.0
    for bursts, view in zip(bursts_of_views, report.views, strict=True):
        rise *= np.exp(-view.move_s / model.time_constant_s)
        t_s += view.move_s
        for burst in bursts:
            starts_s = np.concatenate([[0.0], np.cumsum(burst.table["period_us"][:-1], dtype=np.int64)]) / 1e6
            lit = np.flatnonzero(burst.table["led"] != NO_LED)
            led = burst.table["led"][lit]
            on_s = burst.table["on_us"][lit] / 1e6
            rest_s = t_s + starts_s[lit] - off_since[led]
            short = rest_s < limits.cooldown_ratio * on_s
            if short.any() and not report.too_hot:
                report.too_hot = True
                k = int(np.flatnonzero(short)[0])
                report.refusals.append(
                    f"shot {burst.view}/{burst.labels[lit[k]]}: LED {led[k]} rests {rest_s[k]:.3f} s before it is "
                    f"lit for {on_s[k]:.3f} s; it needs {limits.cooldown_ratio * on_s[k]:.3f} s"
                )
            off_since[led] = t_s + starts_s[lit] + on_s
            boards = np.array([board_of_led[int(n)] for n in led], np.int64)
            last_s = np.zeros(n_boards)
            peak = max(peak, _heat(rise, last_s, boards, starts_s[lit] + on_s, on_s, model))
            rise *= np.exp(-(burst.duration_s - last_s) / model.time_constant_s)
            t_s += burst.duration_s
    report.peak_board_c = model.ambient_c + peak
    if report.peak_board_c > model.limit_c:
        report.too_hot = True
        report.refusals.append(
            f"LED boards: the hottest would reach {report.peak_board_c:.1f} C; the limit is {model.limit_c:g} C"
        )


def _heat(
    rise: NDArray[np.float64],
    last_s: NDArray[np.float64],
    boards: NDArray[np.int64],
    ends_s: NDArray[np.float64],
    on_s: NDArray[np.float64],
    model: BoardThermal,
) -> float:
    """Warm `rise` [boards] by lit LEDs in order of time, all boards at once; returns the highest rise."""
    peak = 0.0
    turn = np.zeros(len(boards), np.int64)
    order = np.argsort(boards, kind="stable")
    sorted_boards = boards[order]
    first = np.searchsorted(sorted_boards, sorted_boards, side="left")
    turn[order] = np.arange(len(boards)) - first
    for k in range(int(turn.max()) + 1 if len(turn) else 0):
        now = turn == k
        b = boards[now]
        rise[b] *= np.exp(-(ends_s[now] - last_s[b]) / model.time_constant_s)
        rise[b] += model.rise_c_per_j * model.led_power_w * on_s[now]
        last_s[b] = ends_s[now]
        peak = max(peak, float(rise[b].max()))
    return peak


def _storage(report: Report, rig: Rig, schedule: Schedule, storage: StorageFacts) -> None:
    frame_bytes = rig.frame_bytes
    report.bytes = report.frames * frame_bytes
    shortest_us = min(int(b.table["period_us"].min()) for b in schedule.bursts[0])
    report.asked_bytes_s = frame_bytes / (shortest_us * 1e-6)
    report.disk_bytes_s = storage.write_bytes_s
    if report.bytes + rig.storage.reserve_bytes > storage.free_bytes:
        report.refusals.append(
            f"storage {rig.storage.folder}: the run needs {report.bytes / 1e9:.2f} GB and "
            f"{rig.storage.reserve_bytes / 1e9:.2f} GB must stay free; {storage.free_bytes / 1e9:.2f} GB are free"
        )
    if frame_bytes % PAGE_BYTES:
        report.warnings.append(
            f"a frame of {rig.sensor.width_px} x {rig.sensor.height_px} is no multiple of {PAGE_BYTES} bytes: "
            "it is written through the page cache, which is slower"
        )
