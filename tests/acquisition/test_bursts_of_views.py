"""Bursts that are chosen in a run stay within what preflight has checked, whatever a chooser says."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from cells import CellFolder

from coupole.acquisition import bursts_of_views
from coupole.acquisition.bursts_of_views import BurstsOfViews
from coupole.acquisition.memory_recorder import DryRecorder
from coupole.devices import NO_LED
from coupole.plan.choices import Choice, ChosenBurst, OpenView
from coupole.preflight.job import Job, read_job
from coupole.preflight.led_limits import heat_of
from coupole.storage.journal_events import BurstsChosen

ADAPTIVE = {"kind": "adaptive", "first_lights": 30, "burst_lights": 30, "until": {"lights": 60}}


class Stubborn:
    """Chooses the same LEDs, whatever it is shown."""

    def __init__(self, leds: Callable[[OpenView], list[int]]) -> None:
        self._leds = leds

    def choose(self, view: OpenView, choices: object, samples: object) -> Choice:
        del choices, samples
        leds = tuple(sorted(self._leds(view)))
        return Choice(bursts=(ChosenBurst(exposure=0, exposure_us=8000, leds=leds),), reason="it likes them")


def _bursts(job: Job, monkeypatch: pytest.MonkeyPatch, chooser: Stubborn) -> tuple[BurstsOfViews, DryRecorder]:
    monkeypatch.setattr(bursts_of_views, "chooser_of", lambda _: chooser)
    recorder = DryRecorder()
    return BurstsOfViews(job, recorder), recorder


def test_more_leds_than_the_bound_are_not_even_noted(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    cell = CellFolder(tmp_path)
    cell.write(lights=ADAPTIVE)
    chosen, recorder = _bursts(read_job(cell.plan), monkeypatch, Stubborn(lambda view: view.leds[:61].tolist()))
    with pytest.raises(RuntimeError, match="where preflight has checked"):
        chosen.more(0)
    assert not recorder.events


def test_the_same_leds_again_are_beyond_the_bound(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    cell = CellFolder(tmp_path)
    cell.write(lights=ADAPTIVE)
    chosen, recorder = _bursts(read_job(cell.plan), monkeypatch, Stubborn(lambda view: view.leds[:30].tolist()))
    assert len(chosen.more(0)) == 1
    with pytest.raises(RuntimeError, match="LEDs that would be lit for longer"):
        chosen.more(0)
    assert sum(isinstance(event, BurstsChosen) for event in recorder.events) == 1


def test_leds_that_lie_together_on_one_board_are_lit_slowly_enough(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The bound's LEDs lie on all boards and stay cool at full pace; those that are chosen do not."""
    cell = CellFolder(tmp_path)
    cell.rig_data["led_limits"] = {"board": {"rise_c_per_j": 60.0, "limit_c": 60.0, "time_constant_s": 0.5}}
    cell.write(lights=ADAPTIVE)
    job = read_job(cell.plan)
    limits, leds = job.cell.rig.led_limits, job.cell.leds
    assert not heat_of(job.schedule.bursts, [0.0], limits, leds).too_hot
    board = leds.ids[leds.boards == leds.boards[0]].tolist()
    chosen, _ = _bursts(job, monkeypatch, Stubborn(lambda _: board))
    whole = job.schedule.open_view(0).burst(0)
    (burst,) = chosen.more(0)
    lit = burst.table["led"] != NO_LED
    assert sorted(burst.table["led"][lit].tolist()) == sorted(board)
    assert burst.timing.period_us > whole.timing.period_us
    assert np.all(burst.table["on_us"][lit] == whole.timing.on_us)
    assert not heat_of([[burst]], [0.0], limits, leds).too_hot
