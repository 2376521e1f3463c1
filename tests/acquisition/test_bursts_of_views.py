"""Bursts that are chosen in a run stay within what preflight has checked, whatever a chooser says."""

from __future__ import annotations

import threading
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from cells import CellFolder, wait_until

from coupole.acquisition import bursts_of_views
from coupole.acquisition.bursts_of_views import BurstsOfViews
from coupole.acquisition.memory_recorder import DryRecorder
from coupole.devices import NO_LED
from coupole.plan.choices import Choice, Chooser, ChosenBurst, FrameSample, OpenView, next_choice
from coupole.plan.shot_id import ShotLabel
from coupole.preflight.job import Job, read_job
from coupole.preflight.led_limits import heat_of
from coupole.storage.journal_events import BurstsChosen

ADAPTIVE = {"kind": "adaptive", "first_lights": 30, "burst_lights": 30, "until": {"lights": 60}}


class Stubborn(Chooser):
    """Chooses the same LEDs, whatever it is shown."""

    def __init__(self, leds: Callable[[OpenView], list[int]]) -> None:
        self._leds = leds

    def choose(self, view: OpenView, choices: object, samples: object) -> Choice:
        del choices, samples
        leds = tuple(sorted(self._leds(view)))
        return Choice(bursts=(ChosenBurst(exposure=0, exposure_us=8000, leds=leds),), reason="it likes them")


class Foresighted(Chooser):
    """Chooses 10 further LEDs while the last ones are lit, as soon as it may."""

    def __init__(self) -> None:
        self.may_say = threading.Event()
        self.fails: Exception | None = None

    def choose(self, view: OpenView, choices: Sequence[Choice], samples: object) -> Choice:
        del samples
        leds = tuple(sorted(view.leds[10 * len(choices) :][:10].tolist()))
        return Choice(bursts=(ChosenBurst(exposure=0, exposure_us=8000, leds=leds),), reason="the next ones")

    def choose_ahead(self, view: OpenView, choices: Sequence[Choice], samples: object) -> Choice | None:
        assert self.may_say.wait(30.0)
        if self.fails:
            raise self.fails
        return self.choose(view, choices, samples) if len(choices) < 3 else None


def _bursts(job: Job, monkeypatch: pytest.MonkeyPatch, chooser: Chooser) -> tuple[BurstsOfViews, DryRecorder]:
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


def _notes(recorder: DryRecorder) -> int:
    return sum(isinstance(event, BurstsChosen) for event in recorder.events)


def test_what_follows_is_noted_while_the_last_burst_is_fired(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    cell = CellFolder(tmp_path)
    cell.write(lights={**ADAPTIVE, "first_lights": 10, "burst_lights": 10})
    chooser = Foresighted()
    chosen, recorder = _bursts(read_job(cell.plan), monkeypatch, chooser)
    assert len(chosen.more(0)) == 1
    chosen.think_ahead(0)
    assert chosen.following(0) is None, "it is not made yet"
    assert _notes(recorder) == 1
    chooser.may_say.set()
    wait_until(lambda: chosen.following(0), "the choice")
    assert _notes(recorder) == 2
    following = [chosen.more(0)]
    assert _notes(recorder) == 2
    for _ in range(2):  # one that is waited for, and one that is made only after the last frames
        chosen.think_ahead(0)
        following.append(chosen.more(0))
    assert [[burst.labels for burst in bursts] for bursts in following] == [
        [burst.labels] for burst in chosen.bursts(0)[1:]
    ]
    leds = [led for burst in chosen.bursts(0) for led in burst.table["led"][burst.is_light()].tolist()]
    assert len(set(leds)) == len(leds) == 40
    chosen.end()


def test_a_choice_that_fails_does_not_end_the_burst_that_is_fired(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    cell = CellFolder(tmp_path)
    cell.write(lights=ADAPTIVE)
    chooser = Foresighted()
    chooser.fails = ZeroDivisionError("a defect of the chooser")
    chooser.may_say.set()
    chosen, recorder = _bursts(read_job(cell.plan), monkeypatch, chooser)
    chosen.more(0)
    chosen.think_ahead(0)
    wait_until(lambda: chosen._choice_ahead is not None and chosen._choice_ahead.done(), "its end")
    assert chosen.following(0) is None
    with pytest.raises(ZeroDivisionError, match="a defect of the chooser"):
        chosen.more(0)
    assert _notes(recorder) == 1


def test_a_choice_that_is_made_late_does_not_see_the_last_frames_either() -> None:
    """So a run that was interrupted chooses as one that nobody disturbed."""

    class Looks(Foresighted):
        def choose_ahead(self, view: object, choices: object, samples: Mapping[ShotLabel, FrameSample]) -> Choice:
            del view, choices
            return Choice(bursts=(), reason=", ".join(map(str, samples)))

    bursts = [ChosenBurst(exposure=0, exposure_us=8000, leds=(led,)) for led in (3, 7)]
    choices = [Choice(bursts=(burst,), reason="") for burst in bursts]
    sample = FrameSample(0.0, np.zeros(4, np.int16), 4031)
    samples = {label: sample for burst in bursts for label in burst.labels()}
    view: Any = None
    assert next_choice(Looks(), view, choices, samples).reason == "led0003/e0"
