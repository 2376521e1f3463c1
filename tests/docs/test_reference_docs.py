"""The reference names every key that a plan or a rig may have, and every export with what it loses."""

from __future__ import annotations

import inspect
import re
from types import ModuleType

import pytest
from places import REPO

from coupole.commands.export_options import OF_RUNS
from coupole.exchange.of_results import FORMATS as OF_RESULTS
from coupole.plan import arm_description, plan, rig
from coupole.reflectance.new_light import light_kinds

REFERENCE = REPO / "docs" / "reference"


@pytest.mark.parametrize(
    ("module", "page"),
    [(plan, "plan.md"), (rig, "rig.md"), (arm_description, "robot.md"), (light_kinds, "lights.md")],
)
def test_the_reference_names_every_key(module: ModuleType, page: str) -> None:
    text = (REFERENCE / page).read_text(encoding="utf-8")
    models = [
        model
        for _, model in inspect.getmembers(module, inspect.isclass)
        if issubclass(model, plan.Model) and model.__module__ == module.__name__
    ]
    keys = {f"{model.__name__}.{key}" for model in models for key in model.model_fields}
    assert sorted(key for key in keys if not re.search(rf"\b{key.split('.')[1]}\b", text)) == []


def test_exports_of_results_have_a_row_and_figures_each() -> None:
    text = (REFERENCE / "exports.md").read_text(encoding="utf-8")
    assert [name for name in OF_RESULTS if text.count(f"\n| `{name}` |") != 2] == []
    assert [name for name in OF_RUNS if f"`{name}`" not in text] == []
