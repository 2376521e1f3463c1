"""The ledger of an object's light: whatever ends a writer, nothing that was given is missing."""

from __future__ import annotations

import json
import math
import os
import pwd
import shutil
from pathlib import Path
from typing import Any

import cells
import pytest
from cells import CellFolder
from forks import fork_context

from coupole.errors import InputError, StorageError
from coupole.plan.cell import read_cell, users_ledger_folder
from coupole.storage import ledger as ledger_module
from coupole.storage.ledger import Ledger, similar_ids

EACH = 15


def lines(ledger: Ledger) -> list[dict[str, Any]]:
    return [json.loads(line) for line in ledger.path.read_text().splitlines()]


def test_what_was_planned_counts_until_what_was_given_is_known(tmp_path: Path) -> None:
    ledger = Ledger(tmp_path, "shroud")
    first, second = ledger.plan("one", 3.0, None), ledger.plan("one", 2.0, None)
    assert ledger.read_history().total_lux_h == 5.0
    ledger.correct(first, 2.5, None)
    history = ledger.read_history()
    assert (history.total_lux_h, history.unsettled_lux_h) == (4.5, 2.0)
    ledger.correct(second, 2.25, None)
    assert (ledger.read_history().total_lux_h, ledger.read_history().unsettled_lux_h) == (4.75, 0.0)


def test_light_is_summed_for_each_object_and_run(tmp_path: Path) -> None:
    ledger = Ledger(tmp_path, "shroud")
    ledger.correct(ledger.plan("one", 1.7, None), 1.7, None)
    ledger.enter(0.4, "photographed in 2019")
    Ledger(tmp_path, "other").enter(9.0, "elsewhere")
    history = ledger.read_history()
    assert history.total_lux_h == pytest.approx(2.1)
    assert history.runs == ["one", "by hand"]
    assert history.of_run("one").total_lux_h == 1.7


def test_an_object_without_a_ledger_has_received_nothing(tmp_path: Path) -> None:
    assert Ledger(tmp_path, "shroud").read_history().total_lux_h == 0.0
    assert list(tmp_path.iterdir()) == []


def test_damage_is_summed_where_it_is_known_and_the_rest_is_told(tmp_path: Path) -> None:
    ledger = Ledger(tmp_path, "shroud")
    ledger.correct(ledger.plan("one", 2.0, 0.004), 1.0, 0.002)
    ledger.enter(7.0, "daylight")
    history = ledger.read_history()
    assert (history.damage_wh_m2, history.of_unknown_spectrum_lux_h) == (0.002, 7.0)


@pytest.mark.parametrize("tail", [b'{"t":"","event":"planned","id":"a","ru', b"\0\0\0\0", b"\xff\xfe\n", b"[1]\n"])
def test_a_torn_or_damaged_line_hides_no_other_and_is_told(tmp_path: Path, tail: bytes) -> None:
    ledger = Ledger(tmp_path, "shroud")
    ledger.enter(1.0, "before")
    with ledger.path.open("ab") as file:
        file.write(tail)
    ledger.enter(2.0, "after")
    history = ledger.read_history()
    assert (history.total_lux_h, history.unreadable) == (3.0, 1)


@pytest.mark.parametrize("dose", ["-1", "1e999", "NaN", '"3"', "null"])
def test_a_line_whose_dose_is_none_is_told_and_not_summed(tmp_path: Path, dose: str) -> None:
    ledger = Ledger(tmp_path, "shroud")
    ledger.enter(1.0, "before")
    with ledger.path.open("a") as file:
        file.write(f'{{"t":"","event":"dose","run":"x","dose_lux_h":{dose}}}\n')
    history = ledger.read_history()
    assert (history.total_lux_h, history.unreadable) == (1.0, 1)
    assert math.isfinite(history.total_lux_h)


def test_a_correction_whose_plan_is_damaged_counts_by_itself(tmp_path: Path) -> None:
    ledger = Ledger(tmp_path, "shroud")
    ledger.correct(ledger.plan("one", 3.0, None), 2.0, None)
    ledger.path.write_text("damaged\n" + ledger.path.read_text().splitlines()[1] + "\n")
    assert ledger.read_history().total_lux_h == 2.0


def _plan_and_correct(folder: Path, name: str) -> None:
    for _ in range(EACH):
        ledger = Ledger(folder, "shroud")
        ledger.correct(ledger.plan(name, 2.0, None), 1.0, None)


def test_two_processes_at_once_lose_nothing(tmp_path: Path) -> None:
    writers = [fork_context().Process(target=_plan_and_correct, args=(tmp_path, name)) for name in ("a", "b")]
    for writer in writers:
        writer.start()
    for writer in writers:
        writer.join(cells.PATIENCE_S)
        assert writer.exitcode == 0
    history = Ledger(tmp_path, "shroud").read_history()
    assert history.total_lux_h == 2 * EACH
    assert len(history.entries) == 2 * EACH
    assert history.unreadable == 0


def test_a_line_is_appended_only_under_the_files_lock(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    import fcntl

    monkeypatch.setattr(ledger_module, "LOCK_S", 0.05)
    ledger = Ledger(tmp_path, "shroud")
    ledger.enter(1.0, "before")
    with ledger.path.open() as held:
        fcntl.flock(held, fcntl.LOCK_EX)
        with pytest.raises(StorageError, match="another process"):
            ledger.enter(1.0, "while another writes")
    ledger.enter(1.0, "after")
    assert [line["note"] for line in lines(ledger)] == ["before", "after"]


def test_a_line_is_synced_before_the_call_returns(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    synced: list[tuple[str, int]] = []

    def note(fd: int) -> None:
        place = Path(f"/proc/self/fd/{fd}").readlink()
        synced.append((place.name, place.stat().st_size if place.is_file() else 0))

    monkeypatch.setattr(os, "fdatasync", note)
    monkeypatch.setattr(os, "fsync", note)
    ledger = Ledger(tmp_path / "new/folder", "shroud")
    ledger.plan("one", 1.0, None)
    size = ledger.path.stat().st_size
    assert ("shroud.jsonl", size) in synced
    assert {name for name, _ in synced} >= {"folder", "new", tmp_path.name}, "and the folders' entries"


def test_a_ledger_that_cannot_be_written_is_refused(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("")
    with pytest.raises(StorageError, match="cannot write the dose ledger"):
        Ledger(tmp_path / "file", "shroud").prove_writable()


# -- where it is ----------------------------------------------------------------------------------------------

OLD = '{"event":"dose","t":"2025-05-05T00:00:00.000Z","run":"20250505T000000Z-old","dose_lux_h":1.5}\n'


def test_entries_in_the_place_of_version_0_1_count_once(tmp_path: Path) -> None:
    new, old = tmp_path / "ledger", tmp_path / "storage/ledger"
    old.mkdir(parents=True)
    (old / "shroud.jsonl").write_text(OLD)
    ledger = Ledger(new, "shroud", old)
    ledger.enter(1.0, "here")
    assert ledger.read_history().total_lux_h == 2.5
    with ledger.path.open("a") as file:
        file.write(OLD)  # as someone does who copies the old file's lines
    assert ledger.read_history().total_lux_h == 2.5
    assert Ledger(old, "shroud", old).read_history().total_lux_h == 1.5
    linked = tmp_path / "linked"
    linked.symlink_to(old)
    assert Ledger(linked, "shroud", old).read_history().total_lux_h == 1.5


def test_the_rig_names_the_place_or_else_it_is_in_the_users_data_folder(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    cell = CellFolder(tmp_path, write_now=False)
    cell.rig_data["ledger"] = "of-all-rigs"
    cell.write()
    assert read_cell(cell.rig).ledger_folder == tmp_path / "of-all-rigs"
    del cell.rig_data["ledger"]
    cell.write()
    monkeypatch.setenv("XDG_DATA_HOME", str(tmp_path / "data"))
    assert read_cell(cell.rig).ledger_folder == tmp_path / "data/coupole/ledger"
    monkeypatch.setenv("XDG_DATA_HOME", "relative/is/ignored")
    monkeypatch.setenv("HOME", str(tmp_path))
    assert users_ledger_folder() == tmp_path / ".local/share/coupole/ledger"


@pytest.mark.parametrize("home", ["", "rel", None])
def test_a_home_that_is_no_absolute_path_is_ignored_for_that_of_passwd(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, home: str | None
) -> None:
    cell = CellFolder(tmp_path, write_now=False)
    monkeypatch.delenv("XDG_DATA_HOME", raising=False)
    if home is None:
        monkeypatch.delenv("HOME")
    else:
        monkeypatch.setenv("HOME", home)
    at_home = Path(pwd.getpwuid(os.getuid()).pw_dir)
    assert users_ledger_folder() == at_home / ".local/share/coupole/ledger"
    cell.rig_data["ledger"] = "~/of-all-rigs"
    cell.write()
    assert read_cell(cell.rig).ledger_folder == (at_home / "of-all-rigs").resolve()


def test_without_any_home_the_ledger_has_no_place_which_is_bad_input(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def unknown(_: int) -> None:
        raise KeyError

    monkeypatch.setattr(pwd, "getpwuid", unknown)  # as a user of a container that its passwd does not list
    monkeypatch.setenv("HOME", "rel")
    monkeypatch.delenv("XDG_DATA_HOME", raising=False)
    with pytest.raises(InputError, match="HOME: expected the absolute path of a folder, found 'rel'"):
        users_ledger_folder()
    monkeypatch.setenv("XDG_DATA_HOME", str(tmp_path))
    assert users_ledger_folder() == tmp_path / "coupole/ledger"


@pytest.mark.parametrize("name", ["my bunny", "../escape", "", ".hidden", "a/b", "x" * 65, "a\0b", "a\n"])
def test_an_id_that_no_plan_can_have_is_refused(tmp_path: Path, name: str) -> None:
    with pytest.raises(InputError, match="expected an id as in a plan"):
        Ledger(tmp_path, name)


def test_ids_that_differ_in_case_or_blanks_only_are_found(tmp_path: Path) -> None:
    for name in ("My-Bunny", "mybunny2", "vase"):
        Ledger(tmp_path, name).enter(1.0, "x")
    assert similar_ids(tmp_path, "my_bunny") == ["My-Bunny"]
    assert similar_ids(tmp_path, "My-Bunny") == []
    with pytest.raises(InputError, match="did you mean `My-Bunny`"):
        Ledger(tmp_path, "my bunny")


# -- coupole dose -------------------------------------------------------------------------------------------------


def dose(cell: CellFolder, *options: str) -> cells.Ended:
    return cells.here("dose", *options, "--rig", cell.rig)


def test_light_given_elsewhere_is_entered_by_hand_and_shown(cell: CellFolder) -> None:
    assert dose(cell, "relief", "--add", "120", "--note", "photographed in 2019").code == 0
    shown = dose(cell, "relief", "--json").document
    assert shown["dose_lux_h"] == 120
    assert shown["of_unknown_spectrum_lux_h"] == 120
    assert shown["runs"]["by hand"]["dose_lux_h"] == 120
    assert [entry["note"] for entry in shown["entries"]] == ["photographed in 2019"]
    assert set(shown["entries"][0]) == {"t", "run", "dose_lux_h", "damage_wh_m2", "note", "settled"}
    table = dose(cell, "relief").err
    assert "120.000" in table
    assert "not known" in table
    assert "photographed in 2019" in table


@pytest.mark.parametrize(
    "options", [("--add", "120"), ("--note", "x"), ("--add", "120", "--note", " "), ("--add", "-1", "--note", "x")]
)
def test_half_an_entry_is_refused(cell: CellFolder, options: tuple[str, ...]) -> None:
    assert dose(cell, "relief", *options).code == 2
    assert not (cell.folder / "ledger").exists()


def test_a_total_above_the_warning_threshold_is_told(cell: CellFolder) -> None:
    dose(cell, "relief", "--add", "39", "--note", "x")
    assert dose(cell, "relief", "--warn-above", "40", "--json").document["above_warning"] is False
    assert "above 40 lux.h" not in dose(cell, "relief").err
    dose(cell, "relief", "--add", "2", "--note", "y")
    assert dose(cell, "relief", "--json").document["above_warning"] is True
    assert "above 40 lux.h" in dose(cell, "relief").err


def test_check_tells_of_the_threshold_and_of_objects_with_nearly_the_same_id(cell: CellFolder) -> None:
    dose(cell, "relief", "--warn-above", "0.001")
    dose(cell, "RELIEF", "--add", "2", "--note", "y")
    warnings = "\n".join(cells.here("check", cell.plan, "--no-paths", "--json").document["warnings"])
    assert "its ledger warns above 0.001 lux.h" in warnings
    assert "there is also a ledger of `RELIEF`" in warnings
    assert "there is also a ledger of `RELIEF`" in dose(cell, "relief").err


def test_a_ledger_that_was_moved_away_while_light_was_given_is_missed(tmp_path: Path) -> None:
    """What was given is entered where the ledger was; whoever lights next is told that the rest is missing."""
    ledger = Ledger(tmp_path, "shroud")
    ledger.correct(ledger.plan("one", 40.0, None), 40.0, None)
    under_way = ledger.plan("two", 3.0, None)
    whole = ledger.path.rename(tmp_path / "elsewhere.jsonl")
    ledger.correct(under_way, 2.5, None)
    with pytest.raises(StorageError, match="earlier lines are missing") as refused:
        Ledger(tmp_path, "shroud").plan("three", 1.0, None)
    assert "coupole dose shroud --add LUX_H --note WHY" in str(refused.value)
    left = ledger.path.read_bytes()
    ledger.path.write_bytes(whole.read_bytes() + left)
    ledger = Ledger(tmp_path, "shroud")
    ledger.plan("three", 1.0, None)
    assert ledger.read_history().total_lux_h == 43.5

    lost = Ledger(tmp_path, "statue")
    lost.path.write_bytes(left)
    lost.enter(40.0, "of a ledger that was lost")
    lost.plan("three", 1.0, None)
    assert lost.read_history().total_lux_h == 43.5


@pytest.mark.parametrize("loss", ["removed", "moved", "an older copy"])
def test_a_ledger_that_is_lost_while_the_first_light_is_given_is_missed_at_once(tmp_path: Path, loss: str) -> None:
    """The light is entered all the same, and no more is given; also if nothing had been entered before."""
    ledger = Ledger(tmp_path / "ledgers", "shroud", only_grows=True)
    if loss == "an older copy":
        Ledger(tmp_path / "ledgers", "shroud").enter(5.0, "in a studio")
    earlier = ledger.path.read_bytes() if ledger.path.exists() else b""
    plan_id = ledger.plan("one", 3.0, None)
    if loss == "removed":
        shutil.rmtree(ledger.folder)
    elif loss == "moved":
        ledger.folder.rename(tmp_path / "elsewhere")
    else:
        ledger.path.write_bytes(earlier)
    ledger.correct(plan_id, 2.5, None)
    with pytest.raises(StorageError, match="while light was given"):
        ledger.newest()
    assert ledger.read_history().total_lux_h == 2.5 + 5.0 * (loss == "an older copy")
    with pytest.raises(StorageError, match="while light was given"):
        ledger.plan("one", 3.0, None)
    with pytest.raises(StorageError, match="earlier lines are missing"):
        Ledger(tmp_path / "ledgers", "shroud").plan("two", 3.0, None)


def test_a_ledger_that_is_lost_after_the_last_light_is_missed_when_asked(tmp_path: Path) -> None:
    ledger = Ledger(tmp_path, "shroud", only_grows=True)
    ledger.correct(ledger.plan("one", 3.0, None), 2.5, None)
    Ledger(tmp_path, "shroud").enter(5.0, "in a studio")
    ledger.newest()
    ledger.path.unlink()
    with pytest.raises(StorageError, match="was removed while light was given"):
        ledger.newest()
