"""What may enter a queue with what waits there, in which order, and when it is expected; preflight's figures are
given."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from datetime import UTC, datetime, timedelta
from pathlib import Path
from typing import Any

import pytest
from cells import CellFolder
from pydantic import ValidationError

from coupole.console.cell.acquisitions import Acquisitions
from coupole.console.cell.lending import begun_here
from coupole.console.plans.entering import Entering
from coupole.console.plans.entry_preflight import Found
from coupole.console.plans.outlook import expected_times
from coupole.console.plans.plan_queue import Entry, PlanQueue
from coupole.console.routes.messages import NewEntry
from coupole.errors import InputError, Problem
from coupole.plan.cell import read_cell
from coupole.storage.ledger import Ledger

NEEDS = {"duration_s": 100.0, "dose_lux_h": 1.0, "bytes": 1000, "frames": 2, "warnings": [], "refusals": []}


class Desk:
    """A queue that nobody runs, and plans for it: `small` has a budget of 3.5 lux.h, `free` has none."""

    def __init__(self, folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
        self.cell_folder = CellFolder(folder)
        self.needs: dict[str, Any] = dict(NEEDS)
        self.problems: tuple[Problem, ...] = ()
        plan = self.cell_folder.plan_data
        for name, budget in (("small", 3.5), ("free", None), ("strict", 2.0)):
            thing = {**plan["object"], "dose_budget_lux_h": budget}
            (folder / f"{name}.yaml").write_text(json.dumps({**plan, "object": thing}))
        cell = read_cell(self.cell_folder.rig)
        self.queue = PlanQueue(folder / "queue.json")
        self.acquisitions = Acquisitions(self.queue, cell, folder / "output")
        self.entering = Entering(cell, folder, self.queue, self.acquisitions)
        monkeypatch.setattr(self.entering.preflight, "of", lambda *_, **__: Found(self.problems, self.needs))

    def enter(self, **asked: Any) -> Entry:
        return self.entering.enter(NewEntry(**asked), "Ada", by_command_line=False)

    @property
    def names(self) -> list[str]:
        return [entry.words for entry in self.queue.entries]


@pytest.fixture
def desk(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Desk:
    return Desk(tmp_path, monkeypatch)


def test_the_light_of_all_that_waits_counts_against_an_objects_budget(desk: Desk) -> None:
    ledger = Ledger(Path(desk.cell_folder.rig_data["ledger"]), "relief")
    ledger.enter(0.9, "studio")
    for _ in range(2):
        desk.enter(plan="small.yaml")
    with pytest.raises(InputError, match=r"1.00 lux.h after 2.90 lux.h.* its budget is 3.5 lux.h") as refused:
        desk.enter(plan="small.yaml")
    assert [problem.file.rpartition("/")[2] for problem in refused.value.problems] == ["small.yaml"]
    desk.enter(plan="free.yaml")
    desk.enter(hold="turn it")
    assert desk.names == ["small.yaml", "small.yaml", "free.yaml", "hold: turn it"]


def test_the_budget_in_its_ledger_counts_for_plans_that_name_none(desk: Desk) -> None:
    Ledger(Path(desk.cell_folder.rig_data["ledger"]), "relief").set_budget(1.5, "A. Keeper")
    desk.enter(plan="free.yaml")
    with pytest.raises(InputError, match=r"its budget is 1.5 lux.h"):
        desk.enter(plan="free.yaml")


def test_a_run_at_work_counts_with_all_that_it_will_give(desk: Desk) -> None:
    desk.acquisitions.state = {
        "run": "/", "rig": "", "pid": 0, "state": "running", "light_after_lux_h": {"relief": 2.6}
    }  # fmt: skip
    with pytest.raises(InputError, match=r"after 2.60 lux.h"):
        desk.enter(plan="small.yaml")
    desk.acquisitions.state["light_after_lux_h"] = {"another": 2.6}
    desk.enter(plan="small.yaml")


def test_no_order_is_accepted_in_which_a_plan_that_waits_would_get_too_much_light(desk: Desk) -> None:
    strict, free = desk.enter(plan="strict.yaml"), desk.enter(plan="free.yaml")
    last = desk.enter(plan="free.yaml")
    desk.entering.move(last.id, free.id)
    desk.entering.move(free.id, strict.id)
    with pytest.raises(InputError, match=r"strict.yaml: .* its budget is 2 lux.h"):
        desk.entering.move(last.id, strict.id)
    with pytest.raises(InputError, match=r"after 2.00 lux.h.* its budget is 2 lux.h"):
        desk.enter(plan="free.yaml", before=strict.id)
    assert desk.names == ["free.yaml", "strict.yaml", "free.yaml"]
    desk.enter(hold="look", before=strict.id)
    assert desk.names == ["free.yaml", "hold: look", "strict.yaml", "free.yaml"]
    assert PlanQueue(desk.cell_folder.folder / "queue.json").entries == desk.queue.entries


def test_the_disk_must_take_all_that_waits(desk: Desk, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(
        "coupole.console.plans.entering.shutil.disk_usage", lambda _: type("Usage", (), {"free": 2500})
    )
    for _ in range(2):
        desk.enter(plan="free.yaml")
    with pytest.raises(InputError, match=r"storage .* the plans that run and wait need 0.00 GB"):
        desk.enter(plan="free.yaml")
    assert len(desk.names) == 2


def test_what_preflight_refuses_or_cannot_say_is_not_entered(desk: Desk) -> None:
    desk.problems = tuple(
        Problem("free.yaml", 0, 0, "", one) for one in ("view top: unreachable", "storage: full")
    )
    with pytest.raises(InputError) as refused:
        desk.enter(plan="free.yaml")
    assert [problem.message for problem in refused.value.problems] == ["view top: unreachable", "storage: full"]
    for name in ("\0", "free.yaml/below", "x" * 2000, "."):
        for asked in ({"plan": name}, {"resume": name}):
            with pytest.raises(InputError):
                desk.enter(**asked)
    assert desk.names == []


@pytest.mark.parametrize("hold", ["turn\x1b[2Jit", "turn it\nand go", "bell\a"])
def test_words_for_others_cannot_steer_their_terminal(desk: Desk, hold: str) -> None:
    with pytest.raises(ValidationError, match="one line without control characters"):
        desk.enter(hold=hold)


def test_only_what_waits_is_moved_and_only_before_what_waits(desk: Desk) -> None:
    first, second = desk.enter(plan="free.yaml"), desk.enter(hold="look")
    for number, before in ((first.id, first.id), (first.id, "nothing"), ("nothing", first.id)):
        with pytest.raises(InputError):
            desk.entering.move(number, before)
    desk.queue.change(first.id, state="running")
    for number, before in ((first.id, second.id), (second.id, first.id)):
        with pytest.raises(InputError, match="is running"):
            desk.entering.move(number, before)
    with pytest.raises(InputError, match=r"free.yaml is being acquired"):
        desk.enter(plan="free.yaml", now=True)


def test_after_a_plan_that_failed_another_begins_at_once_but_not_past_a_hold(desk: Desk) -> None:
    failed = desk.enter(plan="free.yaml", now=True)
    desk.queue.conclude(failed.id, state="failed", ended="2026-01-01T00:00:00.000Z", halt="free.yaml: no light")
    begun = desk.enter(plan="free.yaml", now=True)
    assert (desk.queue.halt_reason, desk.queue.following) == ("", begun)
    desk.queue.remove(begun.id)
    hold = desk.enter(hold="turn it")
    desk.queue.conclude(hold.id, state="done", ended="2026-01-01T00:00:00.000Z", halt=hold.words)
    with pytest.raises(InputError, match="hold: turn it"):
        desk.enter(plan="free.yaml", now=True)


def test_times_are_expected_up_to_what_a_person_decides(desk: Desk) -> None:
    now = datetime(2026, 1, 1, 12, tzinfo=UTC)
    first, second = desk.enter(plan="free.yaml"), desk.enter(plan="free.yaml")
    hold, last = desk.enter(hold="turn it"), desk.enter(plan="free.yaml")
    found = expected_times(desk.queue.entries, now, left_s=None, is_halted=False)
    assert found[first.id][0] == now
    assert found[first.id][1] == found[second.id][0]
    assert timedelta(seconds=100) <= found[second.id][0] - now < timedelta(seconds=120)
    assert found[hold.id] == (found[second.id][1], None)
    assert found[last.id] == (None, None)
    desk.queue.change(first.id, state="running", begun="2026-01-01T11:59:00.000Z")
    found = expected_times(desk.queue.entries, now, left_s=30.0, is_halted=False)
    assert found[first.id] == (now - timedelta(seconds=60), now + timedelta(seconds=30))
    assert found[second.id][0] == now + timedelta(seconds=30)
    halted = expected_times(desk.queue.entries, now, left_s=30.0, is_halted=True)
    assert (halted[first.id][1], halted[second.id]) == (now + timedelta(seconds=30), (None, None))


def test_a_process_of_the_consoles_own_is_told_from_others() -> None:
    with subprocess.Popen([sys.executable, "-c", "input()"], stdin=subprocess.PIPE) as child:
        assert begun_here(child.pid)
        child.communicate(b"\n")
    assert not begun_here(os.getppid())
    assert not begun_here(os.getpid())
    assert not begun_here(2**22 + 1)
