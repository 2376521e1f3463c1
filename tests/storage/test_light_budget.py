"""An object's light budget: kept with its ledger, changed by named persons, asked under its lock by whoever gives
light."""

from __future__ import annotations

import fcntl
import json
import math
import threading
from collections.abc import Callable
from pathlib import Path

import cells
import pytest
from cells import CellFolder
from forks import fork_context

from coupole.errors import DoseBudgetReached, InputError, StorageError
from coupole.storage.ledger import Ledger
from coupole.storage.ledger_lines import Asked, LightEntered

EACH = 40


def asked(lux_h: float, plans: float | None = None) -> Asked:
    return Asked(lux_h, plans, plan="a plan", name="an operator")


def give(ledger: Ledger, lux_h: float, plans: float | None = None) -> None:
    ledger.correct(ledger.plan("a run", lux_h, None, asked(lux_h, plans)), lux_h, None)


def test_a_plan_beyond_the_budget_is_not_entered(tmp_path: Path) -> None:
    ledger = Ledger(tmp_path, "shroud")
    ledger.set_budget(1.0, "A. Keeper")
    give(ledger, 0.4)
    give(ledger, 0.6)
    with pytest.raises(
        DoseBudgetReached, match=r"object shroud: .*its budget of 1 lux\.h\. If it may receive more"
    ):
        give(ledger, 0.01)
    assert ledger.read_history().total_lux_h == 1.0


def test_light_entered_by_hand_meanwhile_counts_for_the_next_burst(tmp_path: Path) -> None:
    ours, others = Ledger(tmp_path, "shroud"), Ledger(tmp_path, "shroud")
    ours.set_budget(1.0, "A. Keeper")
    give(ours, 0.4)
    others.enter(0.5, "studio")
    with pytest.raises(DoseBudgetReached):
        give(ours, 0.2)
    give(ours, 0.1)


def test_light_that_was_planned_is_asked_for_again_without_itself(tmp_path: Path) -> None:
    ours, others = Ledger(tmp_path, "shroud"), Ledger(tmp_path, "shroud")
    ours.set_budget(1.0, "A. Keeper")
    plan = ours.plan("a run", 0.8, None, asked(0.8))
    ours.ask_again(asked(0.8), plan)
    others.enter(0.5, "studio")
    ours.ask_again(asked(0.5), plan)
    with pytest.raises(DoseBudgetReached):
        ours.ask_again(asked(0.6), plan)


@pytest.mark.parametrize(("of_the_object", "of_the_plan"), [(1.0, 2.0), (2.0, 1.0), (1.0, None)])
def test_the_smaller_of_both_budgets_holds(
    tmp_path: Path, of_the_object: float, of_the_plan: float | None
) -> None:
    ledger = Ledger(tmp_path, "shroud")
    ledger.set_budget(of_the_object, "A. Keeper")
    give(ledger, 1.0, of_the_plan)
    with pytest.raises(DoseBudgetReached):
        give(ledger, 0.1, of_the_plan)


def test_the_first_budget_of_a_plan_becomes_the_objects_and_holds_for_plans_without_one(tmp_path: Path) -> None:
    give(Ledger(tmp_path, "shroud"), 0.4, 1.0)
    with pytest.raises(DoseBudgetReached):
        give(Ledger(tmp_path, "shroud"), 0.7)
    give(Ledger(tmp_path, "shroud"), 0.1, 5.0)
    (noted,) = Ledger(tmp_path, "shroud").read_history().budgets
    assert (noted.dose_lux_h, noted.name) == (1.0, "an operator")
    assert "a plan" in noted.reason


def test_an_object_without_any_budget_has_no_limit(tmp_path: Path) -> None:
    give(Ledger(tmp_path, "shroud"), 1e6)
    assert Ledger(tmp_path, "shroud").read_history().allowed_lux_h(None) is None


def test_a_budget_is_raised_and_lowered_by_a_named_person_and_its_history_stays(tmp_path: Path) -> None:
    ledger = Ledger(tmp_path, "shroud")
    for lux_h, name in (1.0, "A. Keeper"), (3.0, "B. Curator"), (2.0, "A. Keeper"):
        ledger.set_budget(lux_h, name, "as agreed")
    history = Ledger(tmp_path, "shroud").read_history()
    assert history.budget_lux_h == 2.0
    assert [(one.dose_lux_h, one.name) for one in history.budgets] == [
        (1.0, "A. Keeper"),
        (3.0, "B. Curator"),
        (2.0, "A. Keeper"),
    ]


@pytest.mark.parametrize(("lux_h", "name"), [(1.0, " "), (-1.0, "A"), (math.nan, "A"), (math.inf, "A")])
def test_a_budget_of_nobody_or_of_no_amount_is_refused(tmp_path: Path, lux_h: float, name: str) -> None:
    with pytest.raises(InputError):
        Ledger(tmp_path, "shroud").set_budget(lux_h, name)
    assert not (tmp_path / "shroud.jsonl").exists()


def _gives_what_it_may(folder: Path, name: str) -> None:
    ledger = Ledger(folder, "shroud")
    for _ in range(EACH):
        try:
            plan = ledger.plan(name, 0.11, None, asked(0.1))
        except DoseBudgetReached:
            continue
        ledger.correct(plan, 0.1, None)


def test_of_two_sessions_and_a_person_who_enter_at_once_the_sum_never_exceeds_the_budget(tmp_path: Path) -> None:
    """Both would give 4 lux h each; 3 are allowed, of which 1 comes by hand."""
    ledger = Ledger(tmp_path, "shroud")
    ledger.set_budget(3.0, "A. Keeper")
    sessions = [fork_context().Process(target=_gives_what_it_may, args=(tmp_path, name)) for name in "ab"]
    for session in sessions:
        session.start()
    for _ in range(10):
        ledger.enter(0.05, "studio")
    for session in sessions:
        session.join(cells.PATIENCE_S)
        assert session.exitcode == 0
    history = ledger.read_history()
    total = 0.0
    for line in map(json.loads, ledger.path.read_text().splitlines()):
        given = {"given": 0.1, "dose": 0.05}.get(line["event"], 0.0)
        total += given
        assert total <= 3.0 + 1e-6
    assert 2.8 < history.total_lux_h <= 3.0 + 1e-6
    assert history.unsettled_lux_h == 0


def test_what_others_entered_while_it_waited_for_the_lock_counts(tmp_path: Path) -> None:
    ledger, waits = Ledger(tmp_path, "shroud"), threading.Event()
    ledger.set_budget(1.0, "A. Keeper")
    take = ledger._take

    def told(lock: int) -> None:
        waits.set()
        take(lock)

    ledger._take = told  # type: ignore[method-assign]
    ended: list[BaseException] = []

    def gives() -> None:
        try:
            give(ledger, 0.6)
        except DoseBudgetReached as error:
            ended.append(error)

    session = threading.Thread(target=gives)
    with ledger.path.open("ab") as held:
        fcntl.flock(held, fcntl.LOCK_EX)
        session.start()
        assert waits.wait(cells.PATIENCE_S)
        held.write(LightEntered(dose_lux_h=0.5, note="studio").model_dump_json().encode() + b"\n")
    session.join()
    assert len(ended) == 1
    assert ledger.read_history().total_lux_h == 0.5


# -- what others write is read without reading all of it anew -----------------------------------------------------


def test_a_ledger_that_grows_is_read_on_and_says_what_one_read_anew_says(tmp_path: Path) -> None:
    reader, writer = Ledger(tmp_path, "shroud"), Ledger(tmp_path, "shroud")
    assert reader.newest().total_lux_h == 0
    for number in range(5):
        plan = writer.plan("a run", 2.0, 0.1)
        assert reader.newest() == Ledger(tmp_path, "shroud").read_history()
        writer.correct(plan, 1.0, 0.05)
        writer.set_budget(100.0 + number, "A. Keeper")
        writer.warn_above(number)
        assert reader.newest() == Ledger(tmp_path, "shroud").read_history()


def test_half_a_line_is_read_when_it_is_whole(tmp_path: Path) -> None:
    ledger = Ledger(tmp_path, "shroud")
    ledger.enter(1.0, "before")
    assert ledger.newest().total_lux_h == 1.0
    line = ledger.path.read_bytes()
    with ledger.path.open("ab") as file:
        file.write(line[:20])
        file.flush()
        assert ledger.newest().total_lux_h == 1.0
        file.write(line[20:])
    assert ledger.newest().total_lux_h == 2.0


@pytest.mark.parametrize("how", ["replaced", "shortened", "edited in its place"])
def test_a_ledger_that_somebody_edits_is_read_anew(tmp_path: Path, how: str) -> None:
    ledger = Ledger(tmp_path, "shroud")
    for _ in range(3):
        ledger.enter(1.0, "before")
    assert ledger.newest().total_lux_h == 3.0
    text = ledger.path.read_text()
    first = text.splitlines(keepends=True)[0]
    if how == "replaced":
        other = tmp_path / "other"
        other.write_text(first + text)
        other.replace(ledger.path)
    else:
        ledger.path.write_text(first if how == "shortened" else text.replace("1.0", "7.0"))
    assert ledger.newest() == Ledger(tmp_path, "shroud").read_history()


def _removed(path: Path) -> None:
    path.rename(path.with_suffix(".elsewhere"))


def _emptied(path: Path) -> None:
    path.write_bytes(b"")


def _another(path: Path) -> None:
    path.unlink()
    Ledger(path.parent, path.stem).enter(0.1, "somebody else's file")


def _in_utf_16(path: Path) -> None:
    path.write_bytes(path.read_bytes() + "\n".join(["{}", "{}", ""]).encode("utf-16"))


@pytest.mark.parametrize("harm", [_removed, _emptied, _another, _in_utf_16])
@pytest.mark.parametrize("reads", ["newest", "plan", "ask_again"])
def test_whoever_gives_light_does_not_forget_a_budget_with_the_file_that_had_it(
    tmp_path: Path, harm: Callable[[Path], None], reads: str
) -> None:
    Ledger(tmp_path, "shroud").set_budget(1.0, "A. Keeper")
    ours = Ledger(tmp_path, "shroud", only_grows=True)
    plan = ours.plan("a run", 0.4, None, asked(0.4))
    Ledger(tmp_path, "shroud").enter(0.1, "studio")
    assert ours.newest().total_lux_h == pytest.approx(0.5)
    harm(ours.path)
    asks: dict[str, Callable[[], object]] = {
        "newest": ours.newest,
        "plan": lambda: ours.plan("a run", 0.7, None, asked(0.7)),
        "ask_again": lambda: ours.ask_again(asked(0.7), plan),
    }
    for _ in range(2):  # nor when it is asked again
        with pytest.raises(StorageError, match="it is not known what the object may still"):
            asks[reads]()


def test_a_copy_of_a_ledger_with_more_lines_may_take_its_place(tmp_path: Path) -> None:
    """As a network disk's client or an editor leaves it."""
    ours = Ledger(tmp_path, "shroud", only_grows=True)
    give(ours, 0.4)
    copy = tmp_path / "copy"
    copy.write_bytes(ours.path.read_bytes())
    copy.replace(ours.path)
    Ledger(tmp_path, "shroud").enter(0.1, "studio")
    assert ours.newest().total_lux_h == pytest.approx(0.5)


def test_a_ledger_with_a_former_place_counts_that_too(tmp_path: Path) -> None:
    ledger = Ledger(tmp_path / "new", "shroud", tmp_path / "old")
    Ledger(tmp_path / "old", "shroud").enter(0.9, "before")
    ledger.set_budget(1.0, "A. Keeper")
    with pytest.raises(DoseBudgetReached):
        give(ledger, 0.2)


# -- coupole dose -------------------------------------------------------------------------------------------------


def dose(cell: CellFolder, *options: str) -> cells.Ended:
    return cells.here("dose", "relief", "--rig", cell.rig, *options)


def test_a_person_sets_the_budget_and_all_are_shown(cell: CellFolder) -> None:
    assert "it has no light budget" in dose(cell).err
    assert dose(cell, "--budget", "40", "--name", "A. Keeper").code == 0
    assert dose(cell, "--budget", "20", "--name", "B. Curator", "--reason", "the silk").code == 0
    found = dose(cell, "--json").document
    assert found["budget_lux_h"] == 20
    assert [(one["dose_lux_h"], one["name"]) for one in found["budgets"]] == [
        (40, "A. Keeper"),
        (20, "B. Curator"),
    ]
    told = dose(cell).err
    assert "earlier budget 40 lux.h, by A. Keeper" in told
    assert "budget 20 lux.h, by B. Curator" in told
    assert "the silk" in told


@pytest.mark.parametrize(
    "options", [("--budget", "4"), ("--name", "A"), ("--reason", "x"), ("--budget", "-1", "--name", "A")]
)
def test_half_a_budget_is_refused(cell: CellFolder, options: tuple[str, ...]) -> None:
    assert dose(cell, *options).code == 2
    assert not (cell.folder / "ledger").exists()


def test_preflight_asks_the_objects_budget_for_a_plan_that_names_none(cell: CellFolder) -> None:
    dose(cell, "--budget", "0.001", "--name", "A. Keeper")
    checked = cells.here("check", cell.plan, "--no-paths", "--json")
    assert checked.code == 3
    assert "its budget is 0.001 lux.h" in checked.document["refusals"][0]
    assert checked.document["dose_budget_lux_h"] == 0.001
    assert "of 0.001 allowed" in cells.here("check", cell.plan, "--no-paths").err
