"""The reference names every key that a plan or a rig may have, and every export with what it loses."""

from __future__ import annotations

import importlib
import inspect
import re
from types import ModuleType
from typing import get_args

import pytest
from places import REPO
from pydantic import BaseModel

from coupole.appearance.render.materials import coatings, measured_material, plain, weathering
from coupole.exchange.formats import FORMATS, Writer
from coupole.heritage.restoration import parts_file, restoration_file
from coupole.heritage.restoration.restoration_file import Stage
from coupole.plan import arm_description, exposures, plan, plan_lights, rig
from coupole.plan.base_model import Model
from coupole.reflectance.new_light import light_kinds

REFERENCE = REPO / "docs" / "reference"


@pytest.mark.parametrize(
    ("module", "page"),
    [
        (plan, "plan.md"),
        (plan_lights, "plan.md"),
        (exposures, "plan.md"),
        (rig, "rig.md"),
        (arm_description, "robot.md"),
        (light_kinds, "lights.md"),
    ],
)
def test_the_reference_names_every_key(module: ModuleType, page: str) -> None:
    text = (REFERENCE / page).read_text(encoding="utf-8")
    models = [
        model
        for _, model in inspect.getmembers(module, inspect.isclass)
        if issubclass(model, Model) and model.__module__ == module.__name__
    ]
    keys = {f"{model.__name__}.{key}" for model in models for key in model.model_fields}
    assert sorted(key for key in keys if not re.search(rf"\b{key.split('.')[1]}\b", text)) == []


@pytest.mark.parametrize("module", [plain, coatings, measured_material, weathering])
def test_the_page_of_scenes_names_every_key_of_a_material(module: ModuleType) -> None:
    text = (REFERENCE / "scene.md").read_text(encoding="utf-8")
    models = [
        model
        for _, model in inspect.getmembers(module, inspect.isclass)
        if issubclass(model, BaseModel) and model.__module__ == module.__name__
    ]
    keys = {key for model in models for key in model.model_fields}
    kinds = {kind for model in models if "kind" in model.model_fields for kind in _kinds(model)}
    assert kinds
    assert sorted(key for key in keys if not re.search(rf"\b{key}\b", text)) == []
    assert sorted(kind for kind in kinds if f"`{kind}`" not in text) == []


def _kinds(model: type[BaseModel]) -> tuple[str, ...]:
    return get_args(model.model_fields["kind"].annotation)


def test_the_reference_names_every_key_of_parts_and_restorations() -> None:
    text = (REFERENCE / "restorations.md").read_text(encoding="utf-8")
    models = [
        model
        for module in (parts_file, restoration_file)
        for _, model in inspect.getmembers(module, inspect.isclass)
        if issubclass(model, BaseModel) and model.__module__ == module.__name__ and model is not Stage
    ]
    keys = {key for model in models for key in model.model_fields}
    assert len(keys) > 30
    assert sorted(key for key in keys if not re.search(rf"\b{key}\b", text)) == []


@pytest.mark.parametrize(
    ("module", "driver"),
    [
        ("drivers.ledbox.driver", "drivers.ledbox:LedBox"),
        ("drivers.camera.gentl.settings", "drivers.camera.gentl:GenTLCamera"),
        ("drivers.camera.raw.driver", "drivers.camera.raw:RawFiles"),
        ("drivers.kuka.rsi.settings", "drivers.kuka.rsi:KukaRsi"),
        ("drivers.kuka.eki.driver", "drivers.kuka.eki:KukaEki"),
        ("drivers.ur.driver", "drivers.ur:UrRobot"),
    ],
)
def test_the_reference_has_every_setting_of_a_driver_with_its_default(module: str, driver: str) -> None:
    section = (
        (REFERENCE / "drivers.md").read_text(encoding="utf-8").partition(f"`{driver}`\n")[2].partition("\n## ")[0]
    )
    rows = {
        key: row.split(" | ")[-1]
        for row in section.splitlines()
        for key in re.findall(r"`(\w+)`", row.split(" | ")[0])
    }
    fields = importlib.import_module(module).Settings.model_fields
    assert sorted(rows) == sorted(fields)
    numbers = {
        key: f"{field.default:g}"
        for key, field in fields.items()
        if isinstance(field.default, int | float) and not isinstance(field.default, bool)
    }
    from_the_rig = {"speed_fraction", "acceleration_deg_s2", "jerk_deg_s3"}
    wrong = [key for key, number in numbers.items() if number not in re.findall(r"[\d.]+", rows[key])]
    assert sorted(set(wrong) - from_the_rig) == []


def test_exports_of_results_have_a_row_and_figures_each() -> None:
    text = (REFERENCE / "exports.md").read_text(encoding="utf-8")
    of_results = [name for name, one in FORMATS.items() if one.writer is Writer.RESULT]
    assert [name for name in of_results if text.count(f"\n| `{name}` |") != 2] == []
    assert [name for name in FORMATS if f"`{name}`" not in text] == []
