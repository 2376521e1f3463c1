"""The light that a session gives the object. It is entered in the object's ledger before it is given, and
corrected afterwards.

Every caller that gives light asks here first, burst by burst (`DoseMeter`) or flash by flash (`FlashMeter`). The
object's budget is checked with all entries of its ledger at that moment. The planned light is on the disk before
the first lamp is lit. For lights that the host switches, the budget is asked again before each light. A session
that ends suddenly (kill -9, power cut) leaves the planned light of one burst, which is at least the light that was
given.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial
from typing import TypeVar

import numpy as np
from numpy.typing import NDArray

from coupole.acquisition.opened_cell import OpenedCell
from coupole.acquisition.recorder import Recorder
from coupole.bounded import DISK, under_way
from coupole.devices import NO_LED
from coupole.errors import DoseBudgetReached
from coupole.geometry import apply
from coupole.plan.bursts import Burst
from coupole.plan.rig_devices import longest_light_s, watchdog_s
from coupole.preflight.job import Job
from coupole.preflight.preflight import BURST_OVERHEAD_S
from coupole.storage.journal_events import BurstBegun
from coupole.storage.ledger import LOCK_S, Ledger, ledger_of
from coupole.storage.ledger_lines import Asked, History
from coupole.storage.run import user_name

LuxHours = NDArray[np.float64]
"""[points] light at each of the object's dose points."""
_CLOCKS_PPM, _START_US = 1000, 1000
"""Allowances for steps that the box's log lacks: one for the error of the box's clock, one for the time that the
box needs to start a table."""
_DIGITS = 9
T = TypeVar("T")


@dataclass(frozen=True)
class _Planned:
    """Light that is entered in the ledger, and perhaps being given."""

    at_most: LuxHours
    w_per_lm: float | None
    """Damaging power of the light, if known."""
    plan_id: str


class LightOnObject:
    """Light on one object in one session. The dose is the dose of the point that has received most.

    In a simulated cell nothing is entered in the ledger, but the budget is checked as in a real cell. Without an
    object there is no budget.
    """

    def __init__(
        self, job: Job, cell: OpenedCell, what_for: str, before_lux_h: tuple[float, ...] | LuxHours = ()
    ) -> None:
        """`before_lux_h` [points] was given by earlier sessions of the same run. Raises StorageError if the ledger
        cannot be read and written, or lacks this light."""
        plan_object = job.plan.object
        self._ledger = ledger_of(job.cell, plan_object.id, only_grows=True) if plan_object else None
        self._enters = self._ledger is not None and not cell.is_simulated
        if self._ledger is not None and self._enters:
            _ask_ledger(self._ledger, self._ledger.prove_writable)
        self._id, self._what_for = plan_object.id if plan_object else "", what_for
        self._asked = Asked(
            0.0, plan_object.dose_budget_lux_h if plan_object else None, plan=job.plan.name, name=user_name()
        )
        points = len(job.shape.dose_points_mm)
        self._given_lux_h = np.array(before_lux_h) if len(before_lux_h) else np.zeros(points)
        self._planned: _Planned | None = None
        self._unentered_lux_h = 0.0
        """Dose of this session, in a simulated cell."""
        if self._ledger is not None:
            history = self._ledger.newest()
            if self._enters:
                history.refuse_without_light_of(self._id, what_for, self.lux_h)

    def refuse_lost_ledger(self) -> None:
        """Raise StorageError if the ledger lacks lines that this session has read or written."""
        if self._ledger is not None and self._enters:
            _ask_ledger(self._ledger, self._ledger.newest)

    @property
    def lux_h(self) -> float:
        """Dose of the run so far, or of the live view."""
        return float(self._given_lux_h.max())

    @property
    def lux_h_at_most(self) -> float:
        """Dose of the run so far, or of the live view. Planned light counts in full until its true amount is
        entered."""
        return self.lux_h if self._planned is None else float((self._given_lux_h + self._planned.at_most).max())

    @property
    def given_lux_h(self) -> LuxHours:
        """[points] light of the run so far, or of the live view."""
        return self._given_lux_h

    @property
    def total_lux_h(self) -> float:
        """Dose of the object's life, by its ledger as it is now. Light that is being given is not included."""
        planned_lux_h = self._history.planned_lux_h(self._planned.plan_id) if self._planned else 0.0
        return self._history.total_lux_h - planned_lux_h + self._unentered_lux_h

    @property
    def left_lux_h(self) -> float:
        """Dose that is left until the budget is reached, by the ledger as it is now; infinite without a budget."""
        allowed_lux_h = self._history.allowed_lux_h(self._asked.budget_lux_h)
        return math.inf if allowed_lux_h is None else allowed_lux_h - self.total_lux_h

    @property
    def warning(self) -> str:
        """Reason why the object's light needs attention; empty if there is none."""
        limit = self._history.warn_above_lux_h
        if limit is None or self.total_lux_h <= limit:
            return ""
        return f"object {self._id}: {self.total_lux_h:.3f} lux.h in total; its ledger warns above {limit:g}"

    @property
    def _history(self) -> History:
        return self._ledger.newest() if self._ledger is not None else History()

    def begin(
        self, at_most: LuxHours, expected_lux_h: LuxHours | None = None, w_per_lm: float | None = None
    ) -> None:
        """Enter light that is about to be given: at most `at_most`. The budget is checked for `expected_lux_h`
        (default: the same). `w_per_lm` is the light's damaging power, if known.

        Raises DoseBudgetReached, and StorageError if the light cannot be entered. After an error no light may be
        given.
        """
        request = replace(
            self._asked, lux_h=self.more_lux_h(at_most if expected_lux_h is None else expected_lux_h)
        )
        plan_id = ""
        if self._ledger is not None and self._enters:
            entry = self._entry(at_most, w_per_lm)
            plan_id = _ask_ledger(self._ledger, partial(self._ledger.plan, self._what_for, *entry, request))
        elif self._ledger is not None:
            newest = _ask_ledger(self._ledger, self._ledger.newest)
            request.refuse_beyond(self._id, newest, self._unentered_lux_h)
        self._planned = _Planned(at_most, w_per_lm, plan_id)

    def ask_again(self, so_far: LuxHours) -> None:
        """Check the budget again, for the light given since the last `begin` together with the next light. Raises
        DoseBudgetReached, StorageError."""
        if self._ledger is None or self._planned is None:
            return
        request = replace(self._asked, lux_h=self.more_lux_h(so_far))
        if self._enters:
            _ask_ledger(self._ledger, partial(self._ledger.ask_again, request, self._planned.plan_id))
        else:
            newest = _ask_ledger(self._ledger, self._ledger.newest)
            request.refuse_beyond(self._id, newest, self._unentered_lux_h)

    def end(self, given_lux_h: LuxHours | None) -> LuxHours:
        """Note that the light of the last `begin` is over. If `given_lux_h` is None, the planned light counts.
        Returns the light that counts. Raises StorageError if it cannot be entered; and if earlier lines are
        missing, but then it is entered."""
        plan = self._planned
        if plan is None:
            return np.zeros_like(self._given_lux_h)
        counts = plan.at_most if given_lux_h is None else given_lux_h
        if self._ledger is not None and self._enters and given_lux_h is not None:
            entry = self._entry(counts, plan.w_per_lm)
            _ask_ledger(self._ledger, partial(self._ledger.correct, plan.plan_id, *entry))
        if not self._enters:
            self._unentered_lux_h += self.more_lux_h(counts)
        self._given_lux_h, self._planned = self._given_lux_h + counts, None
        self.refuse_lost_ledger()
        return counts

    @property
    def planned_lux_h(self) -> LuxHours:
        """[points] planned light of the last `begin`, until its `end`."""
        return np.zeros_like(self._given_lux_h) if self._planned is None else self._planned.at_most

    def more_lux_h(self, lux_h: LuxHours) -> float:
        """Return what this light adds to the dose, so that a run's entries sum to the dose of its highest
        point."""
        return float((self._given_lux_h + lux_h).max() - self._given_lux_h.max())

    def _entry(self, lux_h: LuxHours, w_per_lm: float | None) -> tuple[float, float | None]:
        more_lux_h = max(0.0, round(self.more_lux_h(lux_h), _DIGITS))
        return more_lux_h, None if w_per_lm is None else round(more_lux_h * w_per_lm, _DIGITS)


def _ask_ledger(ledger: Ledger, do: Callable[[], T]) -> T:
    """Note the call of the ledger, because its disk may hang. The ledger waits for other writers by itself."""
    with under_way(DISK, str(ledger.path), LOCK_S):
        return do()


class FlashMeter:
    """The light of single flashes. It is planned for about a second at a time, so that no file is synced for each
    flash."""

    def __init__(self, job: Job, cell: OpenedCell, what_for: str, flashes_per_s: float) -> None:
        self._light = LightOnObject(job, cell, what_for)
        self._cell = cell
        self._at_once = max(1, round(flashes_per_s))
        self._flash_lux_h: LuxHours | None = None
        self._left = 0
        self._given_lux_h = np.zeros(len(job.shape.dose_points_mm))

    @property
    def warning(self) -> str:
        return self._light.warning

    @property
    def total_lux_h(self) -> float:
        """Dose of the object's life, by its ledger, with the planned light."""
        return self._light.total_lux_h + self._light.more_lux_h(self._given_lux_h)

    @property
    def left_lux_h(self) -> float:
        """Dose that is left until the object's budget is reached; infinite without a budget."""
        return self._light.left_lux_h

    def begin(self, lux_h: LuxHours, at_most_lux_h: LuxHours, w_per_lm: float | None = None) -> None:
        """Enter a flash of `lux_h` [points] that is about to be given. If this process is killed, the box may give
        `at_most_lux_h` instead. `w_per_lm` is the light's damaging power, if known. Raises DoseBudgetReached and
        StorageError; the flash may then not be given."""
        if not self._left or self._flash_lux_h is None or not np.array_equal(lux_h, self._flash_lux_h):
            self.settle()
            count = self._at_once if self._at_once * lux_h.max() <= self._light.left_lux_h else 1
            self._light.begin(count * lux_h + (at_most_lux_h - lux_h), count * lux_h, w_per_lm)
            self._flash_lux_h, self._left = lux_h, count
        else:
            try:
                self._light.ask_again(self._given_lux_h + lux_h)
            except DoseBudgetReached:
                self.settle()
                raise
        self._left -= 1
        self._given_lux_h = self._given_lux_h + lux_h

    def add(self, lux_h: LuxHours) -> None:
        """Add light that the last flash gave in addition."""
        self._given_lux_h = self._given_lux_h + lux_h

    def settle(self) -> None:
        """Enter how much of the last planned light was given. If it is not certain that the lights are off, all
        planned light counts."""
        self._light.end(self._given_lux_h if self._cell.lights_confirmed else None)
        self._given_lux_h, self._left = np.zeros_like(self._given_lux_h), 0


class DoseMeter:
    """The light of bursts."""

    def __init__(self, job: Job, cell: OpenedCell, recorder: Recorder) -> None:
        rig = job.cell.rig
        points_base = apply(rig.support.base_from_support.matrix(), job.shape.dose_points_mm)
        self._lux = job.cell.leds.illuminance_lux(points_base, emission=rig.dome.emission)
        self._row_of_led = {int(led): row for row, led in enumerate(job.cell.leds.ids)}
        self._job, self._cell, self._recorder = job, cell, recorder
        self._light = LightOnObject(job, cell, recorder.name, recorder.light_before_lux_h())
        self._under_way_lux_h = np.zeros(1)
        """[steps + 1] dose of the run after each step of the present burst, at the point that has received most at
        the burst's end."""

    @property
    def lux_h(self) -> float:
        """Dose of the run so far, all its sessions; without the burst under way."""
        return self._light.lux_h

    @property
    def lux_h_in_all(self) -> float:
        """Dose of the run in all its sessions, as in journal and ledger. If nobody could count a burst's light,
        its planned light counts."""
        return self._light.lux_h_at_most

    def lux_h_after(self, steps: int) -> float:
        """Return the dose of the run so far, with this number of steps of the present burst. The light of a panel
        counts when it has ended."""
        return max(self.lux_h, float(self._under_way_lux_h[min(steps, len(self._under_way_lux_h) - 1)]))

    def refuse_lost_ledger(self) -> None:
        """Raise StorageError if the ledger lacks lines that this session has read or written."""
        self._light.refuse_lost_ledger()

    def begin(self, burst: Burst) -> None:
        """Enter the planned light of a burst before it is given. It is on the disk when this returns.

        Raises DoseBudgetReached and StorageError: after an error no light may be given.
        """
        rig, cell = self._job.cell.rig, self._job.cell
        expected_lux_h = self._of_leds(burst.table["led"], burst.table["on_us"])
        at_most = expected_lux_h
        if burst.panel:
            expected_lux_h = expected_lux_h + self._of_panel(burst.duration_s + BURST_OVERHEAD_S)
            at_most = expected_lux_h + self._of_panel(watchdog_s(rig))
        elif not burst.hardware:
            lit = np.flatnonzero(burst.table["led"] != NO_LED)
            over_us = longest_light_s(rig, burst.timing.on_us) * 1e6 - burst.timing.on_us
            rows = [self._row_of_led[int(led)] for led in burst.table["led"][lit]]
            if rows:
                at_most = expected_lux_h + self._lux[:, rows].max(axis=1) * max(0.0, over_us) / 3.6e9
        w_per_lm = cell.panel_damage_w_per_lm if burst.panel else cell.led_damage_w_per_lm
        self._light.begin(at_most, expected_lux_h, w_per_lm)
        self._under_way_lux_h = self._course(burst.table["led"], burst.table["on_us"])
        planned_lux_h = tuple(np.round(at_most, _DIGITS).tolist())
        self._recorder.note(BurstBegun(view=burst.view, planned_lux_h=planned_lux_h))
        self._recorder.commit(now=True)

    def ask_again(self, burst: Burst, step: int) -> None:
        """Ask the budget again before the host lights a step of the burst that has begun. Raises
        DoseBudgetReached."""
        so_far = burst.table[: step + 1]
        share = len(so_far) / len(burst.table)
        panel_s = share * (burst.duration_s + BURST_OVERHEAD_S) if burst.panel else 0.0
        self._light.ask_again(self._of_leds(so_far["led"], so_far["on_us"]) + self._of_panel(panel_s))

    def count(
        self, burst: Burst, log: NDArray[np.void], *, table_ran_s: float, panel_s: float
    ) -> tuple[float, ...]:
        """Return the light that a burst has given [points]. It is the light of the steps in its `log`
        (STEP_RECORD_DTYPE [n]), of steps that the log lacks but that may have begun in `table_ran_s`, and of a
        panel that was on for `panel_s`.

        If it is not sure that the lights are off, all planned light counts. Pass the result to the journal, then
        to `end`.
        """
        if not self._cell.lights_confirmed:
            return tuple(np.round(self._light.planned_lux_h, _DIGITS).tolist())
        unlogged_steps = steps_without_log(burst, log, table_ran_s)
        of_leds_lux_h = self._of_leds(log["led"], log["on_us"]) + self._of_leds(
            unlogged_steps["led"], unlogged_steps["on_us"]
        )
        return tuple(np.round(of_leds_lux_h + self._of_panel(panel_s), _DIGITS).tolist())

    def end(self, given_lux_h: tuple[float, ...]) -> None:
        """Enter the result of `count` once it is in the journal. Until then all planned light counts. So journal
        and ledger agree even if the journal could not be written."""
        self._under_way_lux_h = np.zeros(1)
        self._light.end(np.array(given_lux_h) if self._cell.lights_confirmed else None)

    def give_up(self) -> None:
        """Let all planned light of the present burst count, as in the ledger, because nobody will know how the
        burst ended."""
        self._under_way_lux_h = np.zeros(1)
        self._light.end(None)

    def _course(self, leds: NDArray[np.int64], on_us: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return [steps + 1], the dose of the run step by step, at the point that has received most when the burst
        is over."""
        before = self._light.given_lux_h
        highest = int(np.argmax(before + self._of_leds(leds, on_us)))
        lux = np.array([self._lux[highest, self._row_of_led[int(led)]] if led != NO_LED else 0.0 for led in leds])
        return np.asarray(before[highest] + np.concatenate([[0.0], np.cumsum(lux * on_us) / 3.6e9]))

    def _of_leds(self, leds: NDArray[np.int64], on_us: NDArray[np.float64]) -> LuxHours:
        lit = leds != NO_LED
        rows = [self._row_of_led[int(led)] for led in leds[lit]]
        return np.asarray(self._lux[:, rows] @ on_us[lit] / 3.6e9)

    def _of_panel(self, seconds: float) -> LuxHours:
        return np.full(len(self._lux), self._job.cell.rig.dome.panel_lux * seconds / 3600.0)


def steps_without_log(burst: Burst, log: NDArray[np.void], table_ran_s: float) -> NDArray[np.void]:
    """Return the steps of a burst's table that its `log` (STEP_RECORD_DTYPE [n]) lacks, and that may have begun
    while the box ran the table for `table_ran_s`."""
    begins_us = np.cumsum(burst.table["period_us"]) - burst.table["period_us"]
    allowed_us = table_ran_s * (1e6 + _CLOCKS_PPM) + _START_US
    has_begun = (begins_us <= allowed_us) if table_ran_s > 0 else np.zeros(len(begins_us), bool)
    return burst.table[has_begun & ~np.isin(np.arange(len(has_begun)), log["step"])]


def led_time_s(burst: Burst, log: NDArray[np.void], table_ran_s: float) -> float:
    """Return the sum of the times for which LEDs were on in a burst, by its log. Steps that the log lacks and that
    may have begun count fully."""
    parts = (log, steps_without_log(burst, log, table_ran_s))
    return float(sum(part["on_us"][part["led"] != NO_LED].sum() for part in parts)) * 1e-6
