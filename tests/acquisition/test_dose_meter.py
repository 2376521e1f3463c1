"""What counts as given: by the box's log, by the time that the table ran, or all that was planned."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import astuple, replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from cells import CellFolder
from places import REPO

from coupole.acquisition.dose import DoseMeter, FlashMeter, led_time_s
from coupole.devices import NO_LED, STEP_RECORD_DTYPE, StepRecord
from coupole.errors import DoseBudgetReached, StorageError
from coupole.plan.bursts import Burst
from coupole.preflight.job import Job, read_job
from coupole.storage.ledger import ledger_of


@pytest.fixture(scope="module")
def job(tmp_path_factory: pytest.TempPathFactory) -> Job:
    cell = CellFolder(tmp_path_factory.mktemp("dose"), write_now=False)
    relief = {"id": "relief", "mesh": str(REPO / "configs/objects/relief.ply")}
    cell.write(lights={"kind": "every", "every": 100}, object=relief)
    return read_job(cell.plan)


@pytest.fixture
def burst(job: Job) -> Burst:
    return job.schedule.bursts[0][0]


class Recorder:
    """Keeps events in memory."""

    name = "a run"

    def __init__(self, before: tuple[float, ...] = ()) -> None:
        self.events: list[Any] = []
        self.committed = 0
        self._before = before

    def light_before_lux_h(self) -> tuple[float, ...]:
        return self._before

    def note(self, event: Any) -> None:
        self.events.append(event)

    def commit(self, *, now: bool) -> None:
        self.committed = len(self.events)


@pytest.fixture(autouse=True)
def ledger_of_its_own(job: Job) -> Iterator[None]:
    yield
    ledger_of(job.cell, "relief").path.unlink(missing_ok=True)


def meter(job: Job, recorder: Recorder | None = None, **cell: Any) -> DoseMeter:
    opened = SimpleNamespace(**{"is_simulated": False, "lights_confirmed": True, **cell})
    return DoseMeter(job, opened, recorder or Recorder())  # type: ignore[arg-type]


def end(meter: DoseMeter, burst: Burst, log: np.ndarray, **times: float) -> tuple[float, ...]:
    """As the burst runner does."""
    given = meter.count(burst, log, **times)
    meter.end(given)
    return given


def log_of(burst: Burst, steps: int) -> np.ndarray:
    records = [
        StepRecord(k, int(row["led"]), True, False, False, False, float(row["on_us"]), 0, 0, 25.0, 700.0)
        for k, row in enumerate(burst.table[:steps])
    ]
    return np.array([astuple(record) for record in records], STEP_RECORD_DTYPE)


def total(job: Job) -> float:
    return ledger_of(job.cell, "relief").read_history().total_lux_h


def lit(burst: Burst) -> np.ndarray:
    return np.flatnonzero(burst.table["led"] != NO_LED)


def test_the_whole_plan_is_entered_first_and_noted_on_disk(job: Job, burst: Burst) -> None:
    recorder = Recorder()
    found = meter(job, recorder)
    found.begin(burst)
    assert recorder.committed == len(recorder.events) == 1
    planned = recorder.events[0].planned_lux_h
    assert total(job) == pytest.approx(max(planned), abs=1e-8)
    given = end(found, burst, log_of(burst, len(burst.table)), table_ran_s=burst.duration_s, panel_s=0.0)
    assert given == pytest.approx(planned)
    assert total(job) == pytest.approx(found.lux_h, abs=1e-8)


def test_the_dose_moves_while_a_burst_is_under_way_and_ends_where_it_is_counted(job: Job, burst: Burst) -> None:
    found = meter(job)
    found.begin(burst)
    on_the_way = [found.lux_h_after(steps) for steps in range(len(burst.table) + 1)]
    assert found.lux_h == on_the_way[0] == 0.0
    assert sorted(on_the_way) == on_the_way
    assert len(set(on_the_way)) == len(lit(burst)) + 1
    end(found, burst, log_of(burst, len(burst.table)), table_ran_s=burst.duration_s, panel_s=0.0)
    assert found.lux_h_after(3) == found.lux_h == pytest.approx(on_the_way[-1])


def test_a_burst_that_ended_early_counts_its_log(job: Job, burst: Burst) -> None:
    found = meter(job)
    found.begin(burst)
    whole = total(job)
    steps = int(lit(burst)[3]) + 1
    ran_s = float(burst.table["period_us"][: steps - 1].sum()) * 1e-6
    end(found, burst, log_of(burst, steps), table_ran_s=ran_s, panel_s=0.0)
    assert 0 < total(job) < 0.6 * whole


def test_steps_that_may_have_begun_count_though_the_log_lacks_them(job: Job, burst: Burst) -> None:
    steps = int(lit(burst)[3]) + 1
    doses = []
    for logged in (steps, 0):
        found = meter(job)
        before = total(job)
        found.begin(burst)
        ran_s = float(burst.table["period_us"][: steps - 1].sum()) * 1e-6
        end(found, burst, log_of(burst, logged), table_ran_s=ran_s, panel_s=0.0)
        doses.append(total(job) - before)
    assert doses[1] == pytest.approx(doses[0], rel=1e-6)


def test_leds_were_on_in_the_steps_that_the_log_lacks_too(burst: Burst) -> None:
    """A program that was frozen in a burst has a log that ends with the freeze; the box went on until its
    watchdog."""
    leds = lit(burst)
    on_s = burst.table["on_us"][leds[0]] * 1e-6
    log, ran_s = log_of(burst, int(leds[3]) + 1), float(burst.table["period_us"][: leds[9]].sum()) * 1e-6
    assert led_time_s(burst, log, 0.0) == pytest.approx(4 * on_s)
    assert led_time_s(burst, log, ran_s) == pytest.approx(10 * on_s)
    assert led_time_s(burst, log_of(burst, 0), ran_s) == pytest.approx(10 * on_s)


def test_a_burst_that_never_started_gave_nothing(job: Job, burst: Burst) -> None:
    found = meter(job)
    found.begin(burst)
    end(found, burst, log_of(burst, 0), table_ran_s=0.0, panel_s=0.0)
    assert total(job) == 0


def test_if_it_is_not_sure_that_the_lights_are_off_all_that_was_planned_counts(job: Job, burst: Burst) -> None:
    found = meter(job, lights_confirmed=False)
    found.begin(burst)
    whole = total(job)
    end(found, burst, log_of(burst, 3), table_ran_s=0.01, panel_s=0.0)
    history = ledger_of(job.cell, "relief").read_history()
    assert history.total_lux_h == history.unsettled_lux_h == whole
    assert found.lux_h == pytest.approx(whole, abs=1e-8)


def test_a_panel_counts_for_its_time_and_is_planned_until_the_boxs_watchdog(job: Job, burst: Burst) -> None:
    panel = replace(burst, panel=1, table=burst.table[:2])
    found = meter(job)
    found.begin(panel)
    watchdog_s = job.cell.rig.ledbox.settings["watchdog_s"]
    lux = job.cell.rig.dome.panel_lux
    assert total(job) == pytest.approx(lux * (panel.duration_s + 0.14 + watchdog_s) / 3600, rel=1e-6)
    end(found, panel, log_of(panel, 0), table_ran_s=0.0, panel_s=1.5)
    assert total(job) == pytest.approx(lux * 1.5 / 3600, rel=1e-6)


def test_a_resumed_run_goes_on_from_the_points_of_its_earlier_sessions(job: Job, burst: Burst) -> None:
    points = len(job.shape.dose_points_mm)
    before = tuple(float(k == 0) for k in range(points))  # one corner has received 1 lux.h
    with pytest.raises(StorageError, match=r"its dose ledger has only .* in all: lines are missing"):
        meter(job, Recorder(before))
    ledger_of(job.cell, "relief").enter(1.0, "the earlier sessions")
    found = meter(job, Recorder(before))
    found.begin(burst)
    given = end(found, burst, log_of(burst, len(burst.table)), table_ran_s=burst.duration_s, panel_s=0.0)
    assert found.lux_h == pytest.approx(1.0 + given[0])
    assert total(job) == pytest.approx(1.0 + given[0], abs=1e-8), "entries sum to the highest point's dose"


def test_a_ledger_that_is_lost_during_a_burst_is_missed_at_its_end_and_the_light_counts(
    job: Job, burst: Burst
) -> None:
    found = meter(job)
    found.begin(burst)
    ledger_of(job.cell, "relief").path.unlink()
    with pytest.raises(StorageError, match="while light was given"):
        end(found, burst, log_of(burst, len(burst.table)), table_ran_s=burst.duration_s, panel_s=0.0)
    assert found.lux_h_in_all == pytest.approx(total(job), abs=1e-8)
    with pytest.raises(StorageError, match="while light was given"):
        found.begin(burst)


def test_a_burst_that_would_exceed_the_budget_is_not_planned(job: Job, burst: Burst) -> None:
    one = meter(job)
    one.begin(burst)
    dose = total(job)
    end(one, burst, log_of(burst, len(burst.table)), table_ran_s=burst.duration_s, panel_s=0.0)
    assert job.plan.object is not None
    limited = job.plan.object.model_copy(update={"dose_budget_lux_h": 2 * dose})
    poor = replace(job, plan=job.plan.model_copy(update={"object": limited}))
    found = meter(poor)
    found.begin(burst)  # exactly to the budget
    end(found, burst, log_of(burst, len(burst.table)), table_ran_s=burst.duration_s, panel_s=0.0)
    with pytest.raises(DoseBudgetReached, match="object relief"):
        found.begin(burst)
    assert total(job) == pytest.approx(2 * dose)


@pytest.mark.parametrize("simulated", [True, False])
def test_a_simulated_cell_enters_nothing_and_asks_the_budget_all_the_same(
    job: Job, burst: Burst, simulated: bool
) -> None:
    ledger_of(job.cell, "relief").enter(5.0, "elsewhere")
    assert job.plan.object is not None
    limited = job.plan.object.model_copy(update={"dose_budget_lux_h": 5.0})
    poor = replace(job, plan=job.plan.model_copy(update={"object": limited}))
    with pytest.raises(DoseBudgetReached):
        meter(poor, is_simulated=simulated).begin(burst)
    found = meter(job, is_simulated=simulated)
    found.begin(burst)
    assert (total(job) == 5.0) is simulated


def test_damage_is_entered_where_the_lamps_spectrum_is_known(job: Job, burst: Burst, tmp_path: Path) -> None:
    known = replace(job, cell=replace(job.cell, led_damage_w_per_lm=1e-3))
    found = meter(known)
    found.begin(burst)
    end(found, burst, log_of(burst, len(burst.table)), table_ran_s=burst.duration_s, panel_s=0.0)
    history = ledger_of(job.cell, "relief").read_history()
    assert history.damage_wh_m2 == pytest.approx(1e-3 * history.total_lux_h, rel=1e-5)
    assert history.of_unknown_spectrum_lux_h == 0


def test_flashes_with_different_highest_points_count_as_the_highest_of_their_sum(job: Job) -> None:
    opened = SimpleNamespace(is_simulated=False, lights_confirmed=True)
    flashes = FlashMeter(job, opened, "bench", 1.0)  # type: ignore[arg-type]
    points = np.eye(len(job.shape.dose_points_mm))
    for lux_h in 1e-3 * points[0], 8e-4 * points[0] + 7e-4 * points[1], 9e-4 * points[1]:
        flashes.begin(lux_h, lux_h)
        told = flashes.total_lux_h
        flashes.settle()
        assert told == pytest.approx(flashes.total_lux_h) == pytest.approx(total(job))
    assert told == pytest.approx(1.8e-3)


# -- what others enter meanwhile ----------------------------------------------------------------------------------


@pytest.mark.parametrize("simulated", [True, False])
def test_light_that_comes_by_hand_between_two_bursts_is_asked_for_before_the_second(
    job: Job, burst: Burst, simulated: bool
) -> None:
    dose = foreseen(job, burst)
    ledger_of(job.cell, "relief").set_budget(3 * dose, "A. Keeper")
    found = meter(job, is_simulated=simulated)
    found.begin(burst)
    end(found, burst, log_of(burst, len(burst.table)), table_ran_s=burst.duration_s, panel_s=0.0)
    ledger_of(job.cell, "relief").enter(1.5 * dose, "studio")
    with pytest.raises(DoseBudgetReached):
        found.begin(burst)


@pytest.mark.parametrize("simulated", [True, False])
def test_light_that_comes_by_hand_during_a_burst_of_the_host_is_asked_for_before_each_light(
    job: Job, burst: Burst, simulated: bool
) -> None:
    dose = foreseen(job, burst)
    ledger_of(job.cell, "relief").set_budget(1.5 * dose, "A. Keeper")
    found, steps = meter(job, is_simulated=simulated), lit(burst)
    by_host = replace(burst, hardware=False)
    found.begin(by_host)
    found.ask_again(by_host, int(steps[-1]))
    ledger_of(job.cell, "relief").enter(dose, "studio")
    found.ask_again(by_host, int(steps[len(steps) // 4]))
    with pytest.raises(DoseBudgetReached):
        found.ask_again(by_host, int(steps[-1]))


def test_light_that_comes_by_hand_is_asked_for_before_the_next_flash_and_those_before_it_are_entered(
    job: Job,
) -> None:
    ledger_of(job.cell, "relief").set_budget(1.0, "A. Keeper")
    flash = np.full(len(job.shape.dose_points_mm), 0.05)
    flashes = FlashMeter(job, SimpleNamespace(is_simulated=False, lights_confirmed=True), "live", 10.0)  # type: ignore[arg-type]
    for _ in range(3):
        flashes.begin(flash, flash)
    ledger_of(job.cell, "relief").enter(0.84, "studio")
    assert flashes.left_lux_h == pytest.approx(0.16)
    with pytest.raises(DoseBudgetReached):
        flashes.begin(flash, flash)
    history = ledger_of(job.cell, "relief").read_history()
    assert (history.total_lux_h, history.unsettled_lux_h) == (pytest.approx(0.99), 0.0)


def test_a_burst_that_nobody_could_count_counts_as_planned_in_what_is_told(job: Job, burst: Burst) -> None:
    found = meter(job)
    found.begin(burst)
    assert found.lux_h == 0.0
    assert found.lux_h_in_all == pytest.approx(total(job), abs=1e-8)
    assert found.lux_h_in_all > 0


def foreseen(job: Job, burst: Burst) -> float:
    """What the burst gives."""
    found = meter(job, is_simulated=True)
    found.begin(burst)
    end(found, burst, log_of(burst, len(burst.table)), table_ran_s=burst.duration_s, panel_s=0.0)
    return found.lux_h
