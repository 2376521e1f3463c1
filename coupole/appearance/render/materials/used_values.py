"""Values from which a material is computed. Values without effect in the given case are left out."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from pydantic import BaseModel

from coupole.appearance.render.materials.coatings import FourFlux, Layers, Leaf, PaintLayer
from coupole.appearance.render.materials.measured_material import MeasuredMaterial
from coupole.appearance.render.materials.plain import Films, Gilt, Metal, Paint, seen_of_gilt
from coupole.appearance.render.spectra import MeasuredPaint

_OF_LEAF = {"gold", "index", "holes", "roughness"}


def used_values(material: BaseModel, folder: Path) -> dict[str, Any]:
    """Return a material in JSON's types, without keys that have no effect, such as the `ground` of an opaque
    paint. Paths of its files are relative to `folder`. Raises InputError for files that cannot be read."""
    unused_names = _unused_names(material, folder)
    return {
        name: _plain(value, folder) for name, value in material if value is not None and name not in unused_names
    }


def _plain(value: Any, folder: Path) -> Any:
    if isinstance(value, BaseModel):
        return used_values(value, folder)
    if isinstance(value, tuple):
        return [_plain(part, folder) for part in value]
    return value.as_posix() if isinstance(value, Path) else value


def _unused_names(material: BaseModel, folder: Path) -> set[str]:
    match material:
        case Paint() | PaintLayer():
            return _unused_of_paint(material)
        case Gilt():
            return _unused_of_gilt(material, folder)
        case Metal():
            return _unused_of_alloy(material) | ({"face"} if material.depth_mm is None else set())
        case Leaf():
            return _unused_of_alloy(material) | {
                name for name in ("holes", "uncovered") if not getattr(material, name)
            }
        case Films():
            return set() if material.gold is None else {"index"}
        case FourFlux():
            return set() if material.ground_mirror else {"ground_mirror", "ground_roughness"}
        case Layers():
            return {"roughness"} if isinstance(material.layers[0], Leaf) else set()
        case MeasuredMaterial():
            return set() if (folder / material.path).is_dir() else {"fit"}
        case _:
            return set()


def _unused_of_paint(paint: Paint | PaintLayer) -> set[str]:
    """Return the unused keys of an opaque paint: it hides its ground, and its colour depends only on K / S."""
    if paint.thickness_mm is None:
        return {"ground", "scattering_per_mm"}
    return {"scattering_per_mm"} if isinstance(paint.pigment, MeasuredPaint) else set()


def _unused_of_gilt(gilt: Gilt, folder: Path) -> set[str]:
    leaf_is_seen, bole_is_lit, bole_is_bare = seen_of_gilt(gilt, folder)
    unused_names = _unused_of_alloy(gilt) | {name for name in ("holes", "uncovered") if not getattr(gilt, name)}
    if not leaf_is_seen:
        unused_names |= _OF_LEAF | ({"thickness_nm"} if gilt.uncovered == 1.0 else set())
    if not bole_is_lit:
        unused_names.add("bole")
    return unused_names if bole_is_bare else unused_names | {"bole_roughness"}


def _unused_of_alloy(metal: Metal | Gilt | Leaf) -> set[str]:
    """Return the unused keys of a metal with an index from a file, which is not an alloy of gold and silver."""
    return set() if metal.index is None else {"gold"}
