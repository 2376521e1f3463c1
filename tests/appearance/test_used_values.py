"""Values of a material that are shown are those that change it, and no others."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from pydantic import TypeAdapter

from coupole.appearance.render.materials import Material, bsdf, used_values

RED = {"kind": "shape", "name": "red_shape"}
OTHERS: dict[str, Any] = {
    "ground": {"kind": "constant", "value": 0.7},
    "bole": {"kind": "constant", "value": 0.7},
    "films": [{"index": 1.6, "thickness_nm": 40}],
    "distribution": "beckmann",
    "face": False,
    "gold": 0.5,
    "uncovered": 0.3,
    "holes": 0.2,
    "ground_mirror": 0.4,
    "index": 1.7,
    "roughness": 0.5,
    "bole_roughness": 0.5,
    "ground_roughness": 0.6,
    "scattering_per_mm": 90.0,
    "thickness_nm": 1000.0,
    "thickness_mm": 0.02,
    "depth_mm": 0.05,
}
"""Another value for each key."""


@pytest.mark.parametrize(
    ("given", "unused"),
    [
        ({"kind": "paint", "pigment": RED}, {"thickness_mm", "ground", "scattering_per_mm"}),
        ({"kind": "paint", "pigment": RED, "thickness_mm": 0.01}, set()),
        ({"kind": "gilt", "thickness_nm": 200}, {"index", "holes", "uncovered", "bole", "bole_roughness"}),
        ({"kind": "gilt", "thickness_nm": 15}, {"index", "holes", "uncovered", "bole_roughness"}),
        ({"kind": "gilt", "uncovered": 0.2}, {"index", "holes"}),
        ({"kind": "gilt", "uncovered": 1}, {"index", "holes", "gold", "roughness", "thickness_nm"}),
        ({"kind": "metal"}, {"index", "depth_mm", "face"}),
        ({"kind": "metal", "depth_mm": 0.02}, {"index"}),
        ({"kind": "films", "films": [{"index": 1.5, "thickness_nm": 20}]}, {"index"}),
        ({"kind": "films", "films": [{"index": 1.5, "thickness_nm": 20}], "gold": None}, {"gold"}),
    ],
)
def test_what_is_shown_has_an_effect_and_nothing_else_has(given: dict[str, Any], unused: set[str]) -> None:
    material = material_of(given)
    assert set(type(material).model_fields) - set(used_values(material, Path())) == unused
    here = bsdf(material, Path())
    for key in material.model_dump().keys() - {"kind", "pigment", "index", "holes", "uncovered", "depth_mm"}:
        if getattr(material, key) is not None:
            is_changed = not same(bsdf(material_of({**given, key: OTHERS[key]}), Path()), here)
            assert is_changed == (key not in unused), key


@pytest.mark.parametrize(
    ("given", "unused"),
    [
        ({"kind": "layers", "layers": [{"kind": "leaf"}]}, {"roughness"}),
        ({"kind": "layers", "layers": [{"kind": "paint", "pigment": RED, "thickness_mm": 0.01}]}, set()),
        ({"kind": "measured", "path": "a.binary"}, {"fit", "cluster", "triangles"}),
        ({"kind": "measured", "path": "result"}, {"cluster", "triangles"}),
    ],
)
def test_keys_of_layers_and_measured_materials(given: dict[str, Any], unused: set[str], tmp_path: Path) -> None:
    (tmp_path / "result").mkdir()
    material = material_of(given)
    assert set(type(material).model_fields) - set(used_values(material, tmp_path)) == unused


def test_materials_inside_others_are_told_in_the_same_way() -> None:
    opaque = {"kind": "paint", "pigment": {"kind": "paint_file", "path": "a.paint.csv"}}
    layer = {**opaque, "thickness_mm": 0.01}
    worn = {"kind": "worn", "share": 0.1, "over": opaque, "under": {"kind": "layers", "layers": [layer]}}
    used = used_values(material_of(worn), Path())
    assert used["over"] == {**opaque, "index": 1.5, "roughness": 0.25}
    assert used["under"]["layers"] == [layer]
    assert used["pattern"] == {"kind": "uniform"}


def material_of(given: dict[str, Any]) -> Any:
    return TypeAdapter(Material).validate_python(given)


def same(one: Any, other: Any) -> bool:
    if isinstance(one, dict):
        return one.keys() == other.keys() and all(same(one[key], other[key]) for key in one)
    if isinstance(one, np.ndarray):
        return bool(np.allclose(one, other, rtol=1e-9, atol=0.0))
    return bool(one == other)
