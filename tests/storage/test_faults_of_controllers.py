"""A fault of the arm is found by its controller, however the rig is called and wherever it keeps its runs."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import cells
import pytest
from cells import CellFolder

from coupole.devices import Identity
from coupole.errors import DeviceFault, StorageError
from coupole.plan.cell import Cell, read_cell
from coupole.plan.controller_places import places_of_arm, remember_controller
from coupole.storage.arm_faults import faults_of

ADDRESS = "192.168.1.147"
ARM = Identity("KUKA", "KR10", "601234", "8.6")


def rig(folder: Path, *, storage: str = "storage", state: str = "", **robot: Any) -> Cell:
    """A real cell, whose arm answers at this address."""
    folder.mkdir(exist_ok=True)
    cell = CellFolder(folder, write_now=False)
    cell.rig_data["controllers"] = str(folder.parent / "controllers")
    del cell.rig_data["world"]
    cell.rig_data["name"] = f"cell-of-{folder.name}"
    cell.rig_data["storage"] = {"folder": str(folder / storage), **({"state": state} if state else {})}
    cell.rig_data["ledbox"]["settings"]["port"] = "/dev/nowhere"
    cell.rig_data["camera"]["settings"] = {"address": "/nowhere"}
    if robot:
        del cell.rig_data["robot"]["settings"]["controller"]
    cell.rig_data["robot"]["settings"] |= robot or {"controller": ADDRESS}
    cell.write()
    return read_cell(cell.rig)


def stands(cell: Cell, identity: Identity | None = None) -> bool:
    try:
        faults_of(cell, identity).refuse(cell.document.path)
    except DeviceFault:
        return True
    return False


@pytest.mark.parametrize("changes", [{"storage": "elsewhere"}, {"state": "another-state"}, {}], ids=str)
def test_a_fault_stands_for_a_copied_rig_with_other_folders_and_another_name(
    tmp_path: Path, changes: dict[str, str]
) -> None:
    faults_of(rig(tmp_path / "first")).note("it fell")
    copy = rig(tmp_path / "copy", **changes)
    assert stands(copy)
    assert cells.here("confirm", copy.document.path, "--name", "an operator").code == 0
    assert not stands(copy)
    assert not stands(rig(tmp_path / "first")), "a word that is given once counts for all"


def test_a_fault_is_another_controllers_business(tmp_path: Path) -> None:
    faults_of(rig(tmp_path / "first")).note("it fell")
    assert not stands(rig(tmp_path / "other", controller="192.168.1.148"))


def test_a_fault_is_found_by_the_serial_number_when_the_controller_has_moved(tmp_path: Path) -> None:
    faults_of(rig(tmp_path / "first"), ARM).note("it fell")
    moved = rig(tmp_path / "moved", controller="10.0.0.9")
    assert not stands(moved), "nobody can know before it is opened"
    assert stands(moved, ARM)
    assert not stands(moved, replace(ARM, serial="601235"))
    remember_controller(moved, ARM)
    assert stands(moved), "and from then on before it is opened"
    assert cells.here("confirm", moved.document.path, "--name", "an operator").code == 0
    assert not stands(moved, ARM)
    assert not stands(rig(tmp_path / "first"), ARM)


def test_a_new_fault_stands_though_an_earlier_one_was_confirmed_elsewhere(tmp_path: Path) -> None:
    first, copy = rig(tmp_path / "first"), rig(tmp_path / "copy", storage="elsewhere")
    faults_of(first).note("it fell")
    faults_of(copy).confirm("an operator")
    faults_of(first).note("it fell again")
    (standing,) = faults_of(copy).standing()
    assert standing.message == "it fell again"


def test_a_fault_in_a_state_folder_of_an_earlier_version_still_stands(tmp_path: Path) -> None:
    cell = rig(tmp_path / "first")
    cell.state_folder.mkdir(parents=True)
    old = '{"t":"2026-01-01T00:00:00.000Z","event":"fault","message":"it fell","run":""}\n'
    (cell.state_folder / "arm.jsonl").write_text(old)
    assert stands(cell)
    faults_of(cell).confirm("an operator")
    assert not stands(cell)
    assert "it fell (confirmed by an operator" in faults_of(cell).begin_session("a run")
    assert faults_of(cell).begin_session("the next") == ""


def test_a_fault_stands_though_only_one_place_took_it(tmp_path: Path) -> None:
    cell = rig(tmp_path / "first")
    cell.controllers_folder.write_text("no folder")
    with pytest.raises(StorageError):
        faults_of(cell).note("it fell")
    cell.controllers_folder.unlink()
    assert stands(cell)


def test_a_driver_that_gives_no_serial_number_and_a_stand_in_are_known_by_address_alone(tmp_path: Path) -> None:
    cell = rig(tmp_path / "first")
    for identity in replace(ARM, serial=""), replace(ARM, serial="0"), replace(ARM, simulated=True):
        remember_controller(cell, identity)
        assert places_of_arm(cell, identity) == places_of_arm(cell)
    assert len(places_of_arm(cell)) == 2


def test_without_an_address_of_its_controller_the_arm_is_known_by_the_socket_where_it_calls(
    tmp_path: Path,
) -> None:
    first = rig(tmp_path / "first", listen="0.0.0.0:49152", any_controller_by="A. Keeper")
    faults_of(first).note("it fell")
    assert stands(rig(tmp_path / "copy", listen="0.0.0.0:49152", any_controller_by="A. Keeper"))
    assert not stands(rig(tmp_path / "other", listen="0.0.0.0:49153", any_controller_by="A. Keeper"))


def test_a_simulated_cell_keeps_to_its_own_folder(tmp_path: Path) -> None:
    one, other = (CellFolder(tmp_path / name, write_now=False) for name in ("one", "other"))
    for cell in one, other:
        cell.folder.mkdir()
        cell.rig_data["controllers"] = str(tmp_path / "controllers")
        cell.write()
    faults_of(read_cell(one.rig), ARM).note("it fell")
    remember_controller(read_cell(one.rig), ARM)
    assert stands(read_cell(one.rig))
    assert not stands(read_cell(other.rig))
    assert not (tmp_path / "controllers").exists()


def test_the_rig_names_the_place_or_else_it_is_in_the_users_data_folder(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("XDG_DATA_HOME", str(tmp_path / "data"))
    cell = rig(tmp_path / "first")
    assert cell.controllers_folder == tmp_path / "controllers"
    data = json.loads(cell.document.path.read_text())
    del data["controllers"]
    cell.document.path.write_text(json.dumps(data))
    assert read_cell(cell.document.path).controllers_folder == tmp_path / "data/coupole/controllers"
