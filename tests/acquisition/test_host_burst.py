"""Bursts that the host fires: which frames count as proven, with a box and a camera that do as the test says.

What devices can be made to do in a world is tested there (tests/runs/test_text_dome.py); here are the moments that
no world can be made to hit.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from coupole.acquisition.host_burst import HostBurst, Overseer, too_bright
from coupole.acquisition.verdict import Verdict
from coupole.devices import NO_LED, UNKNOWN_NS, CameraStatistics, Frame, FrameFormat, StepRecord
from coupole.errors import DoseBudgetReached
from coupole.plan.bursts import Burst, DeviceTimes
from coupole.plan.led_table import LedTable
from coupole.plan.plan import Plan
from coupole.plan.schedule import build_schedule
from coupole.plan.shot_id import ShotId

FORMAT = FrameFormat(8, 8, 12, "MONO", 64, 4095)
LEDS = [3, 0, 2, 1]


def burst_of(*, runs_tables: bool = False, lights: dict[str, Any] | None = None) -> Burst:
    index = np.arange(4)
    leds = LedTable(index, index, np.full((4, 3), 1e3), np.full((4, 3), -1 / 3**0.5), np.ones(4))
    plan = Plan.model_validate(
        {
            "schema_version": 1,
            "name": "p",
            "rig": "r",
            "views": [{"kind": "joints", "name": "v", "joints_deg": [0, -90, 90, 0, 90, 0]}],
            "lights": lights or {"kind": "ids", "ids": LEDS},
            "exposure": {"kind": "fixed", "exposure_us": 1000},
            "darks_per_view": 0,
            "trigger": "software",
        }
    )
    times = DeviceTimes(1000, 10_000.0, 100)
    return build_schedule(plan, leds, np.eye(4), times, runs_tables=runs_tables).bursts[0][0]


@dataclass
class Cell:
    """Box, camera, arm, recorder and clock in one: each step of the burst goes as `script` says."""

    script: Mapping[int, str] = field(default_factory=dict)
    """By step: `dark` (ended before the frame came), `twice` (exposed twice), `none` (no frame), `bright`,
    `fails` (the camera raises), `all fail` (and so does the box when all is to be switched off)."""
    counts: bool = True
    """The camera counts its exposures."""
    done: list[str] = field(default_factory=list)
    proven: dict[ShotId, Mapping[str, int]] = field(default_factory=dict)
    freed: list[int] = field(default_factory=list)
    marks_seen: list[int] = field(default_factory=list)
    """Steps of marks without a label, in slots that were not freed yet."""
    noted: list[Any] = field(default_factory=list)
    asked: list[int] = field(default_factory=list)
    too_much_at: int = -1
    now_ns_: int = 0
    step: int = -1
    frames: int = 0
    slots: int = 0
    delivery_s: float = 0.1

    def what(self) -> str:
        return self.script.get(self.step, "")

    # clock
    def now_ns(self) -> int:
        return self.now_ns_

    def sleep(self, seconds: float, at_most_s: float = math.inf) -> None:
        self.now_ns_ += round(seconds * 1e9)

    # box
    def flash(self, led: int, on_us: int) -> None:
        self.step += 1
        self.done.append(f"on {led}")

    def lit(self) -> bool:
        return self.what() != "dark"

    def end_flash(self) -> StepRecord:
        self.done.append("off")
        led = int(self.done[-4].split()[1])
        nothing = float("nan")
        return StepRecord(0, led, False, False, False, False, 9.0, UNKNOWN_NS, UNKNOWN_NS, nothing, nothing)

    def lights_off(self) -> None:
        self.done.append("all off")
        if self.what() == "all fail":
            self.now_ns_ += 700_000_000
            raise ZeroDivisionError

    def panel(self, panel: int, on: bool) -> None:
        self.done.append(f"panel {panel}")

    # camera
    def arm(self, buffers: int) -> None:
        self.done.append("arm")
        self.frames = 0

    def trigger(self) -> None:
        self.done.append("trigger")
        self.frames = {"none": 0, "twice": 2}.get(self.what(), 1)

    def next_frame(self, timeout_s: float) -> Frame | None:
        if timeout_s:
            self.done.append("frame")
        if self.what() in ("fails", "all fail"):
            raise ZeroDivisionError
        if not self.frames:
            return None
        self.frames -= 1
        return Frame(1, 1, np.full((8, 8), 500 if self.what() == "bright" else 64, np.uint16))

    def statistics(self) -> CameraStatistics:
        exposed = {"none": 0, "twice": 2}.get(self.what(), 1)
        return CameraStatistics(exposed if self.counts else -1, 0, 0, 0, 0)

    def disarm(self) -> None:
        self.done.append("disarm")

    # recorder
    def store(self, frame: Frame, exposure_us: int) -> int:
        self.slots += 1
        return self.slots

    def prove(self, slot: int, shot: str, fields: Mapping[str, int]) -> None:
        self.proven[shot] = fields

    def see_mark(self, slot: int, burst: Burst, step: int) -> None:
        assert slot not in self.freed
        self.marks_seen.append(step)

    def free(self, slot: int) -> None:
        self.freed.append(slot)

    def commit(self, *, now: bool) -> None:
        pass

    # the object's light
    def begin(self, burst: Burst) -> None:
        self.done.append("begin")

    def ask_again(self, burst: Burst, step: int) -> None:
        self.asked.append(step)
        if step == self.too_much_at:
            raise DoseBudgetReached("too much")

    def fire(self, burst: Burst) -> Verdict:
        arm = SimpleNamespace(attend=lambda: None, await_news=lambda: None, was_held=lambda error: False)
        robot = SimpleNamespace(measured=lambda: None)
        cell = SimpleNamespace(ledbox=self, camera=self, clock=self, robot=robot, make_safe=lambda: None)
        note = lambda *given, **more: self.noted.append(given)  # noqa: E731
        runner = HostBurst(  # type: ignore[arg-type]
            cell, self, arm, Overseer(lambda *_: None, lambda: None), self, note
        )
        return runner.fire(burst, FORMAT)


def leds_proven(cell: Cell) -> list[int]:
    return [fields["led"] for shot, fields in cell.proven.items() if "led" in str(shot.light)]


def test_all_frames_are_proven_where_all_is_well() -> None:
    cell, burst = Cell(), burst_of()
    assert cell.fire(burst).match.reason == ""
    assert set(cell.proven) == set(burst.shots)
    assert sorted(leds_proven(cell)) == sorted(LEDS)
    assert cell.freed == []


def test_marks_of_what_is_taken_again_are_seen_and_not_kept() -> None:
    cell, whole = Cell(), burst_of()
    lost = next(label for label in whole.labels if label and label.is_shot)
    burst = whole.only({lost})
    assert burst.labels == (None, lost, None)
    assert cell.fire(burst).match.reason == ""
    assert cell.marks_seen == [0, 2]
    assert len(cell.freed) == 2
    assert [str(shot) for shot in cell.proven] == [f"v/{lost}"]


def test_each_step_is_armed_in_the_dark_lit_triggered_taken_and_ended_in_this_order() -> None:
    cell = Cell()
    cell.fire(burst_of())
    assert cell.done[8:15] == [
        "arm",
        f"on {cell.done[9].split()[1]}",
        "trigger",
        "frame",
        "off",
        "all off",
        "disarm",
    ]


def test_a_step_takes_its_whole_period() -> None:
    cell, burst = Cell(), burst_of()
    cell.fire(burst)
    assert cell.now_ns_ == burst.table["period_us"].sum() * 1000


@pytest.mark.parametrize("what", ["dark", "twice", "none"])
def test_a_frame_that_may_not_be_the_lights_own_is_not_proven(what: str) -> None:
    cell, burst = Cell({2: what}), burst_of()
    cell.fire(burst)
    assert set(burst.shots) - set(cell.proven) == {burst.shots[2]}


@pytest.mark.parametrize("what", ["dark", "twice", "none"])
def test_the_same_with_a_camera_that_does_not_count(what: str) -> None:
    cell, burst = Cell({2: what}, counts=False), burst_of()
    cell.fire(burst)
    assert set(burst.shots) - set(cell.proven) == {burst.shots[2]}


@pytest.mark.parametrize("mark", [0, 5])
@pytest.mark.parametrize(
    ("what", "reason"),
    [("bright", "shows light"), ("none", "not seen"), ("dark", "not seen"), ("twice", "not seen")],
)
def test_nothing_is_proven_unless_both_marks_were_seen_and_dark(mark: int, what: str, reason: str) -> None:
    cell = Cell({mark: what})
    assert reason in cell.fire(burst_of()).match.reason
    assert cell.proven == {}
    assert len(cell.freed) == cell.slots


def test_a_light_that_is_bright_is_no_fault() -> None:
    cell, burst = Cell({2: "bright"}), burst_of()
    cell.fire(burst)
    assert set(cell.proven) == set(burst.shots)


def test_of_a_box_with_a_log_each_frame_is_proven_when_it_has_come() -> None:
    cell, burst = Cell({2: "fails"}), burst_of(runs_tables=True)
    with pytest.raises(ZeroDivisionError):
        cell.fire(burst)
    assert set(cell.proven) == set(burst.shots[:2])


def test_a_failure_leaves_no_light_and_notes_what_was_given() -> None:
    cell, burst = Cell({2: "fails"}), burst_of()
    with pytest.raises(ZeroDivisionError):
        cell.fire(burst)
    assert cell.done[-2:] == ["all off", "disarm"]
    assert cell.proven == {}
    assert len(cell.freed) == cell.slots == 2
    ((_, log, *_),) = cell.noted
    assert list(log["led"]) == list(burst.table["led"][:3])
    assert log["on_us"][2] >= burst.timing.trigger_delay_us  # the light was on when the camera failed


def test_a_light_that_cannot_be_switched_off_is_counted_as_long_as_that_was_tried() -> None:
    cell, burst = Cell({1: "all fail"}), burst_of()
    with pytest.raises(ZeroDivisionError):
        cell.fire(burst)
    assert cell.done[-1] == "disarm"
    ((_, log, *_),) = cell.noted
    assert list(log["led"]) == list(burst.table["led"][:2])
    assert log["on_us"][1] >= 700_000


def test_a_panel_is_dark_in_its_marks() -> None:
    cell = Cell()
    cell.fire(burst_of(lights={"kind": "panels", "panels": [2]}))
    assert [one for one in cell.done if one.startswith(("panel", "on"))] == ["on -1", "panel 2", "on -1", "on -1"]


def frame_of(lit_pixels: int, dn: int, *, rendered: bool = True) -> Frame:
    pixels = np.full(10_000, 64, np.uint16)
    pixels[:lit_pixels] = dn
    return Frame(1, 1, pixels.reshape(100, 100), rendered=rendered)


def test_a_mark_is_bright_when_more_than_a_hundredth_of_it_is() -> None:
    assert too_bright(frame_of(99, 4095), FORMAT) == ""
    assert "146 DN, 145 at most" in too_bright(frame_of(150, 146), FORMAT)
    assert too_bright(frame_of(10_000, 144), FORMAT) == ""


def test_a_mark_without_a_picture_is_taken_for_dark_in_a_rehearsal() -> None:
    assert too_bright(frame_of(10_000, 4095, rendered=False), FORMAT) == ""


def test_the_burst_is_planned_before_its_first_light() -> None:
    cell = Cell()
    cell.fire(burst_of())
    assert cell.done[0] == "begin"
    assert sum(one == "begin" for one in cell.done) == 1


def test_a_burst_that_may_not_begin_gives_no_light() -> None:
    cell = Cell()
    cell.begin = lambda _: 1 // 0  # type: ignore[assignment,method-assign]
    with pytest.raises(ZeroDivisionError):
        cell.fire(burst_of())
    assert not [one for one in cell.done if one.startswith(("on", "panel"))]


# -- the object's budget ------------------------------------------------------------------------------------------


def test_the_budget_is_asked_again_before_each_light_and_for_no_dark_step() -> None:
    cell, burst = Cell(), burst_of()
    cell.fire(burst)
    assert cell.asked == [step for step, row in enumerate(burst.table) if row["led"] != NO_LED]


def test_a_light_that_would_be_too_much_is_not_given_and_those_before_it_are_counted() -> None:
    burst = burst_of()
    second = [step for step, row in enumerate(burst.table) if row["led"] != NO_LED][1]
    cell = Cell(too_much_at=second)
    with pytest.raises(DoseBudgetReached):
        cell.fire(burst)
    lit = [word for word in cell.done if word.startswith("on ") and word != f"on {NO_LED}"]
    assert len(lit) == 1
    (noted,) = cell.noted
    assert [int(row["led"]) for row in noted[1] if row["led"] != NO_LED] == [int(lit[0].split()[1])]
