"""An object's light budget holds in runs of real cells, whatever else gives it light meanwhile."""

from __future__ import annotations

import threading
from collections.abc import Callable, Iterator
from contextlib import ExitStack
from pathlib import Path
from typing import Any

import cells
import pytest
from cells import CellFolder
from real_cells import HOME, real_cell, true_dose_lux_h

from coupole.acquisition import burst_runner
from coupole.acquisition.run_control import ask
from coupole.storage.ledger import Ledger
from sim.world.client import World

BRACKET = {"kind": "bracket", "exposures_us": [2000, 8000]}
"""Two bursts a view."""
QUARTZ = 1e-4


@pytest.fixture(scope="module")
def opened(tmp_path_factory: pytest.TempPathFactory) -> Iterator[tuple[CellFolder, World]]:
    with real_cell(tmp_path_factory.mktemp("real"), exposure=BRACKET) as (cell, world):
        yield cell, world


@pytest.fixture
def real(opened: tuple[CellFolder, World], request: pytest.FixtureRequest) -> CellFolder:
    """A real cell with an object that has received no light yet."""
    cell, _ = opened
    cell.rig_data["storage"]["folder"] = str(cell.folder / request.node.name / "storage")
    cell.write(object={"id": f"relief-{abs(hash(request.node.name))}", "mesh": str(cells.COARSE_RELIEF)})
    return cell


def ledger_of(cell: CellFolder) -> Ledger:
    return Ledger(Path(cell.rig_data["ledger"]), cell.plan_data["object"]["id"])


def foreseen_lux_h(cell: CellFolder) -> float:
    found: float = cells.here("check", cell.plan, "--no-paths", "--json").document["dose_lux_h"]
    return found


def when_a_burst_begins(monkeypatch: pytest.MonkeyPatch, act: Callable[[], object]) -> list[int]:
    """Do it once the box runs the first table; the list grows with each table that is run."""
    begun: list[int] = []
    table_box = burst_runner.table_box

    def watched(box: Any) -> Any:
        start = vars(box).setdefault("unwatched", box.start)

        def starts(table: Any) -> None:
            start(table)
            begun.append(len(table))
            if len(begun) == 1:
                act()

        box.start = starts
        return table_box(box)

    monkeypatch.setattr(burst_runner, "table_box", watched)
    return begun


def assert_refused_and_resumable(cell: CellFolder, ended: cells.Ended) -> None:
    assert ended.code == 3, ended.err
    assert "would exceed its budget" in ended.document["error"]
    assert f"coupole dose {cell.plan_data['object']['id']} --budget" in ended.document["error"]
    run = Path(ended.document["run"])
    ledger = ledger_of(cell)
    allowed = ledger.read_history().budget_lux_h
    assert allowed is not None
    assert ledger.read_history().total_lux_h <= allowed
    assert ledger.read_history().unsettled_lux_h == 0
    ledger.set_budget(allowed + 10.0, "A. Keeper", "the run may be ended")
    resumed = cell.acquire("--resume", run)
    assert resumed.code == 0, resumed.err
    cells.assert_each_shot_proven_once(run)


def test_light_entered_by_hand_during_a_burst_is_asked_for_before_the_next(
    real: CellFolder, monkeypatch: pytest.MonkeyPatch
) -> None:
    ledger, foreseen = ledger_of(real), foreseen_lux_h(real)
    ledger.set_budget(2.0 * foreseen, "A. Keeper")
    begun = when_a_burst_begins(monkeypatch, lambda: ledger_of(real).enter(1.5 * foreseen, "studio"))
    ended = real.acquire()
    assert len(begun) == 1, "the second burst was not lit"
    assert_refused_and_resumable(real, ended)


def test_light_entered_by_hand_during_a_pause_is_asked_for_before_the_next_burst(
    real: CellFolder, monkeypatch: pytest.MonkeyPatch
) -> None:
    ledger, foreseen = ledger_of(real), foreseen_lux_h(real)
    ledger.set_budget(2.0 * foreseen, "A. Keeper")
    storage = Path(real.rig_data["storage"]["folder"])

    def person() -> None:
        run = next(storage.glob("2*"))
        cells.wait_until(lambda: cells.events(run, "pause"), "the pause")
        asked = ("dose", ledger.object_id, "--rig", real.rig)
        assert cells.command(*asked, "--add", str(1.5 * foreseen), "--note", "studio").code == 0
        ask(run, "go-on")

    thread = threading.Thread(target=person)

    def pauses() -> None:
        ask(next(storage.glob("2*")), "pause")
        thread.start()

    begun = when_a_burst_begins(monkeypatch, pauses)
    ended = real.acquire()
    thread.join()
    assert len(begun) == 1
    assert_refused_and_resumable(real, ended)


def test_a_run_stopped_by_the_stricter_budget_of_its_plan_goes_on_with_the_raised_one(
    real: CellFolder, monkeypatch: pytest.MonkeyPatch
) -> None:
    foreseen, thing = foreseen_lux_h(real), real.plan_data["object"]
    ledger_of(real).set_budget(100.0 * foreseen, "A. Keeper")
    real.write(object={**thing, "dose_budget_lux_h": 2.0 * foreseen})
    begun = when_a_burst_begins(monkeypatch, lambda: ledger_of(real).enter(1.5 * foreseen, "studio"))
    ended = real.acquire()
    assert (ended.code, len(begun)) == (3, 1)
    assert "Raise `dose_budget_lux_h` in the plan" in ended.document["error"]
    run = Path(ended.document["run"])
    real.write(object={**thing, "dose_budget_lux_h": 9.0 * foreseen})
    again = cells.here("acquire", "--resume", run, "--yes", "--json")
    assert again.code == 3, "the run's own copy has the old budget"
    lights = real.plan_data["lights"]
    real.write(lights={"kind": "ids", "ids": [3]})
    other = cells.here("acquire", real.plan, "--resume", run, "--yes", "--json")
    assert other.code == 2, "nothing else of the plan may change with it"
    real.write(lights=lights)
    resumed = cells.here("acquire", real.plan, "--resume", run, "--yes", "--json")
    assert resumed.code == 0, resumed.err
    cells.assert_each_shot_proven_once(run)
    assert cells.here("verify", run).code == 0
    told = cells.here("status", run, "--json").document["dose_budget_lux_h"]
    assert told == pytest.approx(9.0 * foreseen), "the one that holds, not the first one"


def test_the_first_budget_of_a_plan_holds_for_the_plans_that_follow(real: CellFolder) -> None:
    thing = real.plan_data["object"]
    real.write(object={**thing, "dose_budget_lux_h": 1.5 * foreseen_lux_h(real)})
    assert real.acquire().code == 0
    real.write(object=thing)
    ended = real.acquire()
    assert ended.code == 3
    assert "its budget is" in ended.document["error"]
    told = cells.here("dose", thing["id"], "--rig", real.rig).err
    assert "the first budget, by the plan small" in told


def test_the_budget_is_shown_before_and_after_a_run(real: CellFolder) -> None:
    ledger_of(real).set_budget(7.5, "A. Keeper")
    ended = real.acquire()
    assert ended.code == 0, ended.err
    run = Path(ended.document["run"])
    assert "the object may receive 7.5 in its life" in (run / "report.html").read_text()
    assert cells.here("status", run, "--json").document["dose_budget_lux_h"] == 7.5
    assert "of 7.5 allowed" in cells.here("check", real.plan, "--no-paths").err


def test_an_object_without_a_budget_is_remarked_upon_on_a_real_cell(real: CellFolder) -> None:
    warnings = cells.here("check", real.plan, "--no-paths", "--json").document["warnings"]
    assert any("nobody has set how much light it may receive" in one for one in warnings)


def test_two_cells_at_once_give_one_object_no_more_than_its_budget(tmp_path: Path) -> None:
    """Each would give it all."""
    with ExitStack() as stack:
        both = []
        for name in "ab":
            (tmp_path / name).mkdir()
            cell, world = stack.enter_context(
                real_cell(tmp_path / name, exposure=BRACKET, views=[HOME], repeats=4)
            )
            cell.rig_data["ledger"] = str(tmp_path / "ledger")
            cell.write()
            both.append((cell, world))
        budget = 1.3 * foreseen_lux_h(both[0][0])
        Ledger(tmp_path / "ledger", "relief").set_budget(budget, "A. Keeper")
        running = [cell.start_acquire() for cell, _ in both]
        codes = [cells.finish(process).code for process in running]
        true = sum(float(true_dose_lux_h(cell, world).max()) for cell, world in both)
        history = Ledger(tmp_path / "ledger", "relief").read_history()
    assert 3 in codes
    assert set(codes) <= {0, 3}
    assert 0.7 * budget < true <= budget * (1 + QUARTZ)
    assert history.total_lux_h <= budget * (1 + 1e-6)
