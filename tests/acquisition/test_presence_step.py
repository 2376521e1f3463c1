"""The step presence: the switch is seen to be held and released, or the record says that there is none."""

from __future__ import annotations

from pathlib import Path
from types import SimpleNamespace
from typing import Any

import cells
import pytest
from cells import CellFolder, here
from commissioned_cells import Onlooker

from coupole.acquisition.cell_bench import enabling_switch
from coupole.acquisition.cell_bench.enabling_switch import EnablingSwitch, ReleasedError
from coupole.acquisition.commissioning import presence_step
from coupole.acquisition.commissioning.bench import Bench, Findings, StepFailedError
from coupole.acquisition.observer import Control
from coupole.clock import SystemClock


class Box:
    """A box whose switch a person holds."""

    def __init__(self, held: bool | None) -> None:
        self.held, self.asked = held, 0

    def presence(self) -> bool | None:
        self.asked += 1
        return self.held


def bench_with(box: Box, person: Onlooker, *, must_exist: bool = False) -> Bench:
    """Of a cell with nothing but this box."""
    rig = SimpleNamespace(console=SimpleNamespace(enabling_switch=must_exist))
    parts: Any = {
        "cell": SimpleNamespace(rig=rig),
        "opened": SimpleNamespace(ledbox=box, clock=SystemClock()),
        "person": person,
        "control": Control(),
    }
    return Bench(bodies=None, velocity_deg_s=None, findings=Findings(), **parts)  # type: ignore[arg-type]


def missed(bench: Bench) -> list[str]:
    return [one.what for one in bench.findings.limits if not one.is_met]


def test_a_switch_that_follows_the_person_passes() -> None:
    box = Box(held=False)
    bench = bench_with(box, Onlooker(hold=lambda held: setattr(box, "held", held)))
    presence_step.presence(bench)
    assert missed(bench) == []
    assert len(bench.findings.limits) == 5


@pytest.mark.parametrize(
    ("held", "what"),
    [
        (True, "switches that read as held although nobody holds them"),
        (False, "the switch was not seen to be held within 0.2 s"),
    ],
)
def test_a_switch_that_is_stuck_is_found(monkeypatch: pytest.MonkeyPatch, held: bool, what: str) -> None:
    monkeypatch.setattr(presence_step, "_WITHIN_S", 0.2)
    bench = bench_with(Box(held), Onlooker())
    presence_step.presence(bench)
    assert missed(bench) == [what]


def test_a_cell_without_a_switch_passes_and_its_record_says_so(tmp_path: Path) -> None:
    bench = bench_with(Box(None), Onlooker())
    presence_step.presence(bench)
    assert missed(bench) == []
    assert "nothing shows whether anybody is at the cell" in bench.findings.remarks[0]


def test_a_cell_whose_rig_has_a_switch_needs_one() -> None:
    with pytest.raises(StepFailedError, match="reports no input"):
        presence_step.presence(bench_with(Box(None), Onlooker(), must_exist=True))


def test_the_command_sees_the_simulated_switch_held_and_released(tmp_path: Path) -> None:
    cell = CellFolder(tmp_path, speed=8.0, write_now=False)
    cell.world_settings["ledbox"] = {"enabling_switch": "released"}
    cell.rig_data["console"] = {"enabling_switch": True}
    cell.write()
    ended = here("commission", cell.rig, "--name", "A", "--yes", "--json", "--only", "presence")
    assert ended.code == 0, ended.err
    assert ended.document["steps"] == {"presence": True}
    record = Path(ended.document["record"]).read_text()
    assert "the switch was not seen to be released within 30 s" in record


class ClockByHand:
    """For `enabling_switch.time`: it goes on only when it is told to, and counts who looks at it."""

    def __init__(self) -> None:
        self.now_s, self.looks = 0.0, 0

    def monotonic(self) -> float:
        self.looks += 1
        return self.now_s

    def wait_for_looks(self, count: int) -> None:
        until = self.looks + count
        cells.wait_until(lambda: self.looks >= until, "looks at the clock")


def test_the_box_is_not_asked_for_a_caller_that_hangs_and_the_motion_goes_on_after_a_rest(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    clock, box = ClockByHand(), Box(held=True)
    monkeypatch.setattr(enabling_switch, "time", clock)
    switch: Any = box
    with EnablingSwitch(switch, must_exist=True).release_check() as check:
        check()
        cells.wait_until(lambda: box.asked > 1, "a question for a caller that looks")
        clock.now_s = 10.0
        clock.wait_for_looks(3)  # a question may have been under way
        before = box.asked
        clock.wait_for_looks(5)
        assert box.asked == before, "a helper must not beat for a thread that hangs"
        check()
        cells.wait_until(lambda: box.asked > before, "a question after a rest")
        check()
        box.held = False

        def is_unheard_of() -> bool:
            check()
            return False

        with pytest.raises(ReleasedError, match="was released"):
            cells.wait_until(is_unheard_of, "the news")
