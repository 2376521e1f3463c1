"""A real cell runs no plan without a record of its commissioning that passed and fits."""

from __future__ import annotations

import json
import shutil
from dataclasses import replace
from pathlib import Path

import cells
import pytest
from at_a_terminal import at_a_terminal
from cells import CellFolder
from real_cells import commission

from coupole.acquisition.operator import refuse_uncommissioned
from coupole.devices import Identity
from coupole.errors import InputError, PreflightRefused
from coupole.plan.cell import Cell, read_cell
from coupole.plan.rig import WorldSection
from coupole.preflight.commissioned import (
    commissioning_refusals,
    empty_record,
    read_commissioning,
    record_path,
    write_commissioning,
)
from coupole.storage.arm_faults import faults_of

DEVICES = {
    "ledbox": Identity("Coupole", "LED control box", "0017", "1.0"),
    "camera": Identity("Ximea", "CB120CG-CM", "4711", "1.0"),
    "robot": Identity("KUKA", "KR10", "88", "8.6"),
}


@pytest.fixture
def real(tmp_path: Path) -> CellFolder:
    """The rig of a real cell: it names devices, and no world."""
    cell = CellFolder(tmp_path, write_now=False)
    del cell.rig_data["world"]
    cell.rig_data["ledbox"]["settings"]["port"] = "/dev/nowhere"
    cell.rig_data["camera"]["settings"] = {"address": "/nowhere"}
    cell.write()
    return cell


def checked(real: CellFolder) -> list[str]:
    """Refusals of `coupole check` that are about commissioning."""
    ended = cells.here("check", real.plan, "--no-paths", "--json")
    return [why for why in ended.document["refusals"] if why.startswith("commissioning")]


def test_a_real_cell_without_a_record_is_refused_and_the_command_is_named(real: CellFolder) -> None:
    (why,) = checked(real)
    assert f"coupole commission {real.rig}" in why
    assert cells.here("check", real.plan, "--no-paths").code == 3


def test_a_simulated_cell_needs_none(cell: CellFolder) -> None:
    assert commissioning_refusals(read_cell(cell.rig), DEVICES) == []


def test_a_record_that_passed_and_fits_is_accepted(real: CellFolder) -> None:
    commission(read_cell(real.rig), DEVICES)
    assert checked(real) == []
    refuse_uncommissioned(read_cell(real.rig), DEVICES)


@pytest.mark.parametrize("how", ["missed", "no"])
def test_a_step_that_did_not_pass_is_refused(real: CellFolder, how: str) -> None:
    commission(read_cell(real.rig), DEVICES, **{how: "watchdog"})
    (why,) = checked(real)
    assert "the step watchdog did not pass" in why


def test_a_changed_setting_asks_for_the_steps_that_depend_on_it_and_for_no_others(real: CellFolder) -> None:
    commission(read_cell(real.rig), DEVICES)
    real.rig_data["motion"]["acceleration_deg_s2"] = 500.0
    real.write()
    refusals = checked(real)
    assert [why.split()[3] for why in refusals] == ["cycle", "axes", "stopping", "emergency-stop"]
    assert "robot.settings.acceleration_deg_s2 is 500.0, was 300.0" in refusals[0]


def test_another_watchdog_time_is_refused(real: CellFolder) -> None:
    commission(read_cell(real.rig), DEVICES)
    real.rig_data["ledbox"]["settings"]["watchdog_s"] = 0
    real.write()
    assert [why.split()[3] for why in checked(real)] == ["lamps", "trigger", "watchdog"]


def test_another_led_table_asks_for_the_lamps_and_the_domes_place(real: CellFolder) -> None:
    commission(read_cell(real.rig), DEVICES)
    table = Path(real.rig_data["dome"]["leds"]).read_text()
    (real.folder / "other.csv").write_text(table + "\n")
    real.rig_data["dome"]["leds"] = "other.csv"
    real.write()
    assert [why.split()[3] for why in checked(real)] == ["geometry", "lamps"]


def test_another_address_is_no_other_cell(real: CellFolder) -> None:
    commission(read_cell(real.rig), DEVICES)
    real.rig_data["ledbox"]["settings"]["port"] = "/dev/ttyACM7"
    real.write()
    assert checked(real) == []


def test_another_box_is_refused_when_it_is_opened(real: CellFolder) -> None:
    commission(read_cell(real.rig), DEVICES)
    others = DEVICES | {"ledbox": replace(DEVICES["ledbox"], serial="0018")}
    with pytest.raises(PreflightRefused, match=r"LED control box 0018 .*was .* 0017") as refused:
        refuse_uncommissioned(read_cell(real.rig), others)
    assert [why.split()[3] for why in refused.value.refusals] == ["lamps", "trigger", "watchdog", "presence"]


def test_a_record_that_was_edited_is_refused(real: CellFolder) -> None:
    cell = read_cell(real.rig)
    commission(cell, DEVICES, no="axes")
    path = record_path(cell)
    path.write_text(path.read_text().replace('"yes": false', '"yes": true'))
    with pytest.raises(InputError, match="edited"):
        read_commissioning(cell)
    (why,) = checked(real)
    assert "edited" in why


def test_a_record_of_a_simulated_cell_does_not_serve_a_real_one(real: CellFolder) -> None:
    cell = read_cell(real.rig)
    simulated = replace(cell, rig=cell.rig.model_copy(update={"world": WorldSection()}))
    write_commissioning(cell, empty_record(simulated))
    (why,) = commissioning_refusals(cell)
    assert "simulated" in why


@pytest.mark.parametrize(
    ("options", "told"),
    [
        (("--yes", "--name", "A"), "a person must see and answer"),
        (("--name", " "), "--name"),
        (("--name", "A", "--only", "axis"), "stopping"),
    ],
)
def test_what_cannot_be_commissioned_is_told_with_two(
    real: CellFolder, options: tuple[str, ...], told: str
) -> None:
    ended = cells.here("commission", real.rig, *options)
    assert ended.code == 2
    assert told in ended.err


# -- found by the controller --------------------------------------------------------------------------------------


def copied(real: CellFolder, **changes: object) -> Cell:
    """The same cell by a rig of another name, which keeps its runs elsewhere."""
    data = {**real.rig_data, "name": "a-copy", "storage": {"folder": str(real.folder / "elsewhere")}, **changes}
    path = real.folder / "copy.yaml"
    path.write_text(json.dumps(data))
    return read_cell(path)


def test_a_copied_rig_that_keeps_its_runs_elsewhere_is_commissioned(real: CellFolder) -> None:
    commission(read_cell(real.rig), DEVICES)
    copy = copied(real)
    assert commissioning_refusals(copy, DEVICES) == []
    record = read_commissioning(copy)
    assert record is not None
    assert record.rig == "a-copy"


def test_a_copied_rig_with_another_setting_asks_for_the_steps_that_depend_on_it(real: CellFolder) -> None:
    commission(read_cell(real.rig), DEVICES)
    motion = {**real.rig_data["motion"], "acceleration_deg_s2": 500.0}
    refusals = commissioning_refusals(copied(real, motion=motion), DEVICES)
    assert [why.split()[3] for why in refusals] == ["cycle", "axes", "stopping", "emergency-stop"]


def test_commissioning_the_copy_takes_nothing_from_the_first_rig(real: CellFolder) -> None:
    commission(read_cell(real.rig), DEVICES)
    motion = {**real.rig_data["motion"], "acceleration_deg_s2": 500.0}
    copy = copied(real, motion=motion)
    commission(copy, DEVICES)
    assert commissioning_refusals(copy, DEVICES) == []
    assert commissioning_refusals(read_cell(real.rig), DEVICES) == []


def test_a_step_that_failed_since_counts_though_it_passed_by_another_rig(real: CellFolder) -> None:
    commission(read_cell(real.rig), DEVICES)
    commission(copied(real), DEVICES, no="stopping")
    (why,) = commissioning_refusals(read_cell(real.rig), DEVICES)
    assert "the step stopping did not pass" in why


def test_another_controller_is_another_cell(real: CellFolder) -> None:
    commission(read_cell(real.rig), DEVICES)
    robot = {
        **real.rig_data["robot"],
        "settings": {**real.rig_data["robot"]["settings"], "controller": "10.0.0.9"},
    }
    (why,) = commissioning_refusals(copied(real, robot=robot), DEVICES)
    assert "has no record" in why


def test_a_record_of_an_earlier_version_in_the_state_folder_is_found(real: CellFolder) -> None:
    cell = read_cell(real.rig)
    commission(cell, DEVICES)
    shutil.rmtree(cell.controllers_folder)
    assert commissioning_refusals(cell, DEVICES) == []


def test_a_cell_with_a_fault_of_the_arm_is_not_commissioned_before_a_persons_word(
    real: CellFolder,
) -> None:
    faults_of(read_cell(real.rig)).note("it fell")
    with at_a_terminal("commission", real.rig, "--name", "A") as person:
        person.waits_for("coupole confirm")
        assert person.process.wait(30.0) == 4
