"""A change of anything of a rig asks for a part of the commissioning again, unless it is one of a few harmless
keys."""

from __future__ import annotations

import copy
import re
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
from cells import CellFolder
from pydantic import BaseModel, ValidationError
from real_cells import commission
from test_commissioned import DEVICES, checked, real

from coupole.intake.input_files import InputFiles
from coupole.plan.cell import Cell, read_cell
from coupole.plan.registry import settings_class
from coupole.plan.rig import Rig
from coupole.plan.rig_devices import NOWHERE
from coupole.preflight.commissioned import (
    STEPS,
    CommissioningRecord,
    commissioning_refusals,
    empty_record,
    read_commissioning,
    why_outdated,
    write_commissioning,
)
from coupole.preflight.commissioned_rig import HARMLESS, steps_of

__all__ = ["real"]
EXPECTED_HARMLESS = {
    *("schema_version", "arm.schema_version", "name", "arm.name", "licence", "contact"),
    *("storage", "ledger", "controllers", "calibrations", "white_response", "world", "watch"),
    *("lens.f_number", "sensor.bit_depth", "sensor.bayer_pattern", "sensor.black_dn"),
    *("motion.home_joints_deg", "motion.park_joints_deg"),
    *("ledbox.twin", "camera.twin", "robot.twin"),
}
WITHOUT_ALTERNATIVE = {"schema_version", "arm.schema_version", "keep_out.0.kind", "keep_out.1.kind"}
"""Keys that no other value can be given."""
DRIVERS = {
    "ledbox": {"drivers.ledbox:LedBox": {}, "drivers.ledbox.text_lines:TextLineBox": {"led_count": 12}},
    "robot": {
        "drivers.kuka.rsi:KukaRsi": {},
        "drivers.kuka.eki:KukaEki": {"controller_is": "client"},
        "drivers.ur:UrRobot": {},
    },
    "camera": {
        "drivers.camera.aravis:AravisCamera": {},
        "drivers.camera.gentl:GenTLCamera": {"producer": "/nowhere"},
        "drivers.camera.xiapi:XiCamera": {},
        "drivers.camera.raw:RawFiles": {"folder": "/nowhere", "period_us": 1000},
        "sim.devices.memory_camera:MemoryCamera": {},
    },
}

OTHERS: tuple[Any, ...] = (
    *(1, 2, 0.5, "x", None, True, False, {"a": 1}, ["a"], [1.0], [1.0] * 6, "/elsewhere", "10.0.0.7"),
    *("10.0.0.7:9999", "127.0.0.1:9999", "ur5e", {"width_px": 8, "height_px": 8}, {"read": "Lost"}),
    *([-1.0, 1.0], [[1.0]] * 6, 8, 12, 1000),
)
"""Values of which some setting accepts one."""


@pytest.fixture
def full(real: CellFolder) -> tuple[Cell, CommissioningRecord]:
    """A commissioned cell whose rig says everything that a rig can say."""
    spectrum = real.folder / "spectrum.csv"
    spectrum.write_text("nm,power\n" + "".join(f"{nm},1\n" for nm in range(380, 781, 10)))
    meshes = real.folder / "meshes"
    meshes.mkdir()
    for name in ("base_link", *(f"link_{k}" for k in range(1, 7))):
        (meshes / f"{name}.stl").write_text("solid\nendsolid\n")
    twin = {"driver": "drivers.ledbox:LedBox", "settings": {"baud": 1}}
    real.rig_data |= {
        "white_response": {"dn_per_lux_s": 100.0, "f_number": 8.0},
        "keep_out": [
            {"kind": "sphere", "name": "ball", "center_mm": [1, 2, 3], "radius_mm": 4},
            {"kind": "box", "name": "stand", "min_mm": [0, 0, 0], "max_mm": [1, 1, 1]},
        ],
        "link_meshes": str(meshes),
        "ledger": str(real.folder),
        "calibrations": [],
        "licence": "CC0",
        "contact": "somebody",
        "world": {"serves": "dry_run", "join": str(real.folder / "world.json"), "settings": {"seed": 1}},
    }
    real.rig_data["storage"]["state"] = str(real.folder / "state")
    real.rig_data["motion"]["park_joints_deg"] = [90.0, -170.0, 150.0, 0.0, -70.0, 0.0]
    real.rig_data["dome"] |= {"spectrum": str(spectrum), "panel_spectrum": str(spectrum)}
    real.write()
    cell = read_cell(real.rig)
    arm = cell.rig.arm
    assert isinstance(arm, BaseModel)
    devices = {
        kind: {**getattr(cell.rig, kind).model_dump(), "twin": twin} for kind in ("ledbox", "camera", "robot")
    }
    cell = replace(cell, rig=Rig.model_validate({**cell.rig.model_dump(), **devices}))
    commission(cell, DEVICES)
    record = read_commissioning(cell)
    assert record is not None
    return cell, record


def asked_for(cell: Cell, record: CommissioningRecord) -> list[str]:
    return [one.step for one in record.steps if why_outdated(cell, one)]


def others(model: type[BaseModel], plain: dict[str, Any], at: tuple[str | int, ...]) -> Iterator[BaseModel]:
    """The model with another value at a place, as far as it accepts one."""
    value: Any = plain
    for key in at:
        value = value[key]
    words = [*OTHERS]
    if isinstance(value, (int, float)) and not isinstance(value, bool):
        words = [value * 0.9 if isinstance(value, float) and value else value + 1, value - 1, value * 2, *words]
    if isinstance(value, (list, tuple)):
        words = [scaled(value), *words]
    if isinstance(value, str):
        words = [f"{value}x", *words]
    for word in words:
        changed = copy.deepcopy(plain)
        place: Any = changed
        for key in at[:-1]:
            place = place[key]
        place[at[-1]] = word
        try:
            found = model.model_validate(changed)
        except ValidationError as error:
            told = " ".join(str(one.get("ctx", {}).get("expected", "")) for one in error.errors())
            words += [word for word in re.findall(r"'([^']+)'", told) if word not in words]
            continue
        if found.model_dump() != plain:
            yield found


def scaled(value: Any) -> Any:
    """A list of numbers, or of such lists, with other numbers."""
    if isinstance(value, (list, tuple)):
        return [scaled(one) for one in value]
    return value * 0.9 + 0.001 if isinstance(value, float) else value + 1 if isinstance(value, int) else value


def leaves(value: Any, at: tuple[str | int, ...] = ()) -> Iterator[tuple[str | int, ...]]:
    """Places of a plain document; of a list of alike ones the first two only."""
    if isinstance(value, dict) and value:
        for key, inner in value.items():
            yield from leaves(inner, (*at, key))
    elif isinstance(value, (list, tuple)) and value and isinstance(value[0], dict):
        for k, inner in enumerate(value[:2]):
            yield from leaves(inner, (*at, k))
    else:
        yield at


def test_every_key_of_a_rig_is_covered_or_named_as_harmless(full: tuple[Cell, CommissioningRecord]) -> None:
    cell, record = full
    assert asked_for(cell, record) == []
    plain, alike = cell.rig.model_dump(), set()
    for at in leaves(plain):
        key = ".".join(map(str, at))
        if re.fullmatch(r"(ledbox|camera|robot)\.settings\..*", key):
            continue  # below, for every driver
        if key.endswith(".driver") and "twin" not in key and not key.startswith("world"):
            changed = copy.deepcopy(plain)
            changed[at[0]]["driver"] = plain[at[0]]["driver"].partition(":")[0] + ":Settings"
            other: Any = Rig.model_validate(changed)
        else:
            other = next(others(Rig, plain, at), None)
        if other is None:
            alike.add(key)
            continue
        harmless = any(key == place or key.startswith(f"{place}.") for place in EXPECTED_HARMLESS)
        try:
            found = asked_for(replace(cell, rig=other), record)
        except ValidationError:
            continue  # the driver refuses such an arm
        assert bool(found) != harmless, f"{key}: {found}"
    assert alike == WITHOUT_ALTERNATIVE


def test_the_rig_of_this_test_says_everything_that_a_rig_can_say(full: tuple[Cell, CommissioningRecord]) -> None:
    said: dict[str, set[str]] = {}

    def note(value: Any) -> None:
        if isinstance(value, BaseModel):
            fields = said.setdefault(type(value).__name__, set())
            for name in type(value).model_fields:
                inner = getattr(value, name)
                if inner is not None:
                    fields.add(name)
                    note(inner)
        elif isinstance(value, (list, tuple)):
            for inner in value:
                note(inner)

    note(full[0].rig)
    schema = Rig.model_json_schema()
    known = {name: set(one["properties"]) for name, one in schema["$defs"].items() if "properties" in one}
    known["Rig"] = set(schema["properties"])
    # Of the arm the rig of this test has no meshes: the rig's own replace them.
    known["ArmDescription"].discard("link_meshes")
    known["JointDescription"].discard("posture_limits_deg")
    assert {name: fields - said.get(name, set()) for name, fields in known.items() if fields - said[name]} == {}


def test_the_list_of_harmless_keys_is_short_and_says_why() -> None:
    assert set(HARMLESS) == EXPECTED_HARMLESS
    assert all(HARMLESS.values())


def test_a_key_of_tomorrow_asks_for_every_step() -> None:
    assert steps_of("a_key_of_tomorrow.below") == STEPS


@pytest.mark.parametrize(("kind", "driver"), [(kind, name) for kind, names in DRIVERS.items() for name in names])
def test_every_setting_of_every_driver_is_covered_but_addresses(
    full: tuple[Cell, CommissioningRecord], kind: str, driver: str
) -> None:
    cell, model = full[0], settings_class(driver)
    given = DRIVERS[kind][driver]
    places = {name: value for name, value in NOWHERE[kind].items() if name in model.model_fields}

    def with_settings(settings: dict[str, Any]) -> Cell:
        device = getattr(cell.rig, kind).model_copy(update={"driver": driver, "settings": settings})
        return replace(cell, rig=cell.rig.model_copy(update={kind: device}))

    before = with_settings({**places, **given})
    commission(before, DEVICES)
    record = read_commissioning(before)
    assert record is not None
    assert asked_for(before, record) == []
    for name in model.model_fields:
        if name == "arm_model":
            continue  # the arm's keys
        for other in settings_with_another(model, {**places, **given}, name, cell):
            found = asked_for(with_settings(other), record)
            assert bool(found) != (name in NOWHERE[kind]), f"{driver} {name}: {found}"
            break
        else:
            raise AssertionError(f"{driver} {name}: no other value was found for the test")


def settings_with_another(
    model: type[BaseModel], given: dict[str, Any], name: str, cell: Cell
) -> Iterator[dict[str, Any]]:
    from dataclasses import asdict

    from coupole.plan.rig_devices import described_arm

    described = described_arm(cell.rig)
    assert described is not None
    arm = {"arm_model": asdict(described.arm)} if "arm_model" in model.model_fields else {}
    plain = model.model_validate({**given, **arm}).model_dump(mode="json")
    for found in others(model, plain, (name,)):
        value = found.model_dump(mode="json")[name]
        if value != plain[name]:
            yield {**given, name: value}


GEOMETRY = {
    "no keep-outs": {"keep_out": []},
    "no tool": {"tool": []},
    "no clearances": {"clearances": {"object_mm": 0, "support_mm": 0, "dome_mm": 0}},
    "the support 50 mm higher": {"support": {"base_from_support": {"translation_mm": [200, 0, 1400]}}},
    "the camera 60 mm shorter": {"flange_from_camera": {"translation_mm": [0, 0, 60]}},
}


@pytest.mark.parametrize("change", GEOMETRY.values(), ids=GEOMETRY)
def test_another_geometry_asks_for_the_step_geometry_alone_and_says_what_changed(
    real: CellFolder, change: dict[str, Any]
) -> None:
    commission(read_cell(real.rig), DEVICES)
    assert checked(real) == []
    for key, value in change.items():
        if isinstance(value, dict):
            for inner, one in value.items():
                old = real.rig_data[key].get(inner)
                real.rig_data[key][inner] = {**old, **one} if isinstance(one, dict) else one
        else:
            real.rig_data[key] = value
    real.write()
    (why,) = checked(real)
    assert why.startswith("commissioning: the step geometry does not fit any more: ")
    assert f"{next(iter(change))}." in why


def test_both_values_of_a_changed_key_are_told(real: CellFolder) -> None:
    commission(read_cell(real.rig), DEVICES)
    real.rig_data["support"]["base_from_support"]["translation_mm"] = [200, 0, 1400]
    real.write()
    (why,) = checked(real)
    assert "support.base_from_support.translation_mm is [200.0, 0.0, 1400.0], was [200.0, 0.0, 1450.0]. Say" in why


def test_a_mesh_of_a_link_that_is_replaced_asks_for_the_geometry(full: tuple[Cell, CommissioningRecord]) -> None:
    cell, record = full
    assert isinstance(cell.rig.link_meshes, Path)
    (cell.rig.link_meshes / "link_3.stl").write_text("solid other\nendsolid\n")
    assert asked_for(replace(cell, files=InputFiles()), record) == ["geometry"]


def test_a_record_of_an_earlier_version_is_read_and_says_what_it_lacks(real: CellFolder) -> None:
    cell = read_cell(real.rig)
    commission(cell, DEVICES)
    record = read_commissioning(cell)
    assert record is not None
    old = empty_record(cell)
    for result in record.steps:
        known = ("robot", "ledbox", "camera", "led_limits.rise_us")
        settings = {key: value for key, value in result.settings.items() if key.startswith(known)}
        if result.step == "lamps":
            settings = {**settings, "dome.leds": result.settings["dome.leds"]}
        if result.step != "geometry":
            old = old.with_result(result.model_copy(update={"covers": None, "settings": settings}))
    write_commissioning(cell, old)
    assert "covers" not in cell.state_folder.joinpath("commissioning.yaml").read_text()
    by_step = {why.split()[3]: why for why in commissioning_refusals(cell)}
    assert "the step geometry was not done; it covers arm, camera, clearances, " in by_step["geometry"]
    assert "an earlier version did this step, and did not cover arm, " in by_step["axes"]
    assert "an earlier version did this step, and did not cover dome, led_limits." in by_step["lamps"]
    assert "watchdog" not in by_step, "all that it covers was in the old record"
