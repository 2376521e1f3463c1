"""The most common parts of a plan as fields of a form, and a plan's text with changed values.

Comments, and all parts without a field, stay as they are written.
"""

from __future__ import annotations

import io
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from ruamel.yaml import YAML
from ruamel.yaml.comments import CommentedMap, CommentedSeq

from coupole.errors import InputError
from coupole.plan import yamlfile

LONGEST = 100_000
"""Greatest number of characters of a plan that a form can write."""
MOST_AZIMUTHS = 360
_LARGEST = 1e12
"""The form does not show numbers above this; only the text shows them."""
ALL_ROUND = "round"
"""Name of the views that the form makes."""


@dataclass(frozen=True)
class PlanFields:
    """Values of the form's fields. A value is empty or None if the plan does not state it, or states it in a form
    that only the text can show."""

    object_id: str = ""
    mesh: str = ""
    mesh_unit: str = "mm"
    budget_lux_h: float | None = None
    distance_mm: float | None = None
    elevations_deg: tuple[float, ...] = ()
    azimuths: int | None = None
    """Number of views at each elevation, evenly around the object."""
    exposures_us: tuple[int, ...] = ()
    every_led: int | None = None
    """1 for all LEDs, 4 for every fourth LED."""
    darks_per_view: int | None = None
    own_views: bool = False
    """True if the views differ from the form's views."""
    own_lights: bool = False
    """True if the lights differ from the form's lights."""
    own_exposure: bool = False
    """True if the exposure is chosen in the run; times in the form would replace it."""


def fields_of(path: Path, text: str) -> PlanFields:
    """Read the fields from a plan's text. Raises InputError if it is not YAML, or too long for a form."""
    if len(text) > LONGEST:
        raise InputError(f"a text of more than {LONGEST:,} characters: write it in a text editor")
    data = yamlfile.parse(path, text).data
    object_keys = data.get("object") if isinstance(data.get("object"), dict) else {}
    assert isinstance(object_keys, dict)
    exposure = data.get("exposure")
    fields = PlanFields(
        object_id=str(object_keys.get("id", "")),
        mesh=str(object_keys.get("mesh") or ""),
        mesh_unit=str(object_keys.get("mesh_unit", "mm")),
        budget_lux_h=_number(object_keys.get("dose_budget_lux_h")),
        darks_per_view=_whole(data.get("darks_per_view")),
        exposures_us=_exposures(exposure),
        own_exposure=isinstance(exposure, dict) and exposure.get("kind") == "auto",
    )
    return _with_lights(_with_views(fields, data.get("views")), data.get("lights"))


def text_with(path: Path, text: str, fields: PlanFields, target_mm: tuple[float, ...] | None = None) -> str:
    """Return a plan's text with these fields. If the views are the form's, they look at `target_mm`. Raises
    InputError if it is not YAML."""
    before = fields_of(path, text)
    try:
        return _rewritten(text, before, fields, target_mm)
    except (TypeError, ValueError, AttributeError) as error:
        raise InputError("the text has a form that the fields cannot change: edit the text") from error


def _rewritten(text: str, before: PlanFields, fields: PlanFields, target_mm: tuple[float, ...] | None) -> str:
    yaml = YAML(typ="rt")
    yaml.width, yaml.preserve_quotes = 110, True
    data = yaml.load(text)
    object_keys = data.get("object")
    if object_keys is None and (fields.object_id or fields.mesh):
        object_keys = data["object"] = CommentedMap()
    if object_keys is not None:
        _set(object_keys, "id", fields.object_id or None, before.object_id or None)
        _set(object_keys, "mesh", fields.mesh or None, before.mesh or None)
        _set(object_keys, "mesh_unit", fields.mesh_unit, before.mesh_unit)
        _set(object_keys, "dose_budget_lux_h", fields.budget_lux_h, before.budget_lux_h)
    _set(data, "darks_per_view", fields.darks_per_view, before.darks_per_view)
    if fields.exposures_us and fields.exposures_us != before.exposures_us:
        data["exposure"] = _flow(_exposure(fields.exposures_us))
    if fields.every_led and not fields.own_lights and fields.every_led != before.every_led:
        every = fields.every_led
        data["lights"] = _flow({"kind": "all"} if every == 1 else {"kind": "every", "every": every})
    if not fields.own_views and (target_mm is not None or not _same_views(fields, before)):
        data["views"] = _views(fields, target_mm or _target(data.get("views")))
    out = io.StringIO()
    yaml.dump(data, out)
    return out.getvalue()


def _same_views(first: PlanFields, second: PlanFields) -> bool:
    return all(
        getattr(first, name) == getattr(second, name)
        for name in ("distance_mm", "elevations_deg", "azimuths", "own_views")
    )


def _set(mapping: Any, key: str, value: Any, before: Any) -> None:
    """Set a key only if its value has changed; None removes the key."""
    if value == before:
        return
    if value is None:
        mapping.pop(key, None)
    else:
        mapping[key] = value


def _flow(mapping: dict[str, Any]) -> CommentedMap:
    flow_map = CommentedMap(mapping)
    flow_map.fa.set_flow_style()
    return flow_map


def _flow_sequence(values: Any) -> CommentedSeq:
    flow_sequence = CommentedSeq(values)
    flow_sequence.fa.set_flow_style()
    return flow_sequence


def _exposure(exposures_us: tuple[int, ...]) -> dict[str, Any]:
    if len(exposures_us) == 1:
        return {"kind": "fixed", "exposure_us": exposures_us[0]}
    return {"kind": "bracket", "exposures_us": _flow_sequence(sorted(exposures_us))}


def _exposures(exposure: Any) -> tuple[int, ...]:
    if not isinstance(exposure, dict):
        return ()
    several = exposure.get("exposures_us")
    exposures_us = several if isinstance(several, list) else [exposure.get("exposure_us")]
    whole = [value for value in map(_whole, exposures_us) if value is not None]
    return tuple(whole) if len(whole) == len(exposures_us) else ()


def _with_lights(fields: PlanFields, lights: Any) -> PlanFields:
    if isinstance(lights, dict):
        if lights == {"kind": "all"}:
            return replace(fields, every_led=1)
        if set(lights) == {"kind", "every"} and lights["kind"] == "every":
            return replace(fields, every_led=_whole(lights["every"]))
    return replace(fields, own_lights=lights is not None)


def _with_views(fields: PlanFields, views: Any) -> PlanFields:
    if isinstance(views, list) and len(views) == 1 and isinstance(views[0], dict):
        grid = views[0]
        azimuths, elevations = grid.get("azimuths_deg"), grid.get("elevations_deg")
        grid_keys = {"kind", "name", "target_mm", "distance_mm", "azimuths_deg", "elevations_deg"}
        if grid.get("kind") == "grid" and set(grid) == grid_keys and isinstance(azimuths, list):
            even = azimuths == list(_azimuths(len(azimuths)))
            if (
                even
                and isinstance(elevations, list)
                and all(_number(elevation) is not None for elevation in elevations)
            ):
                return replace(
                    fields,
                    azimuths=len(azimuths),
                    elevations_deg=tuple(elevations),
                    distance_mm=_number(grid.get("distance_mm")),
                )
    return replace(fields, own_views=views is not None)


def _views(fields: PlanFields, target_mm: tuple[float, ...]) -> CommentedSeq:
    if not (fields.azimuths and fields.elevations_deg and fields.distance_mm):
        raise InputError("views all round need a distance, elevations, and the number of views at each")
    if not 1 <= fields.azimuths <= MOST_AZIMUTHS:
        raise InputError(f"views at each elevation: expected 1 to {MOST_AZIMUTHS}, found {fields.azimuths}")
    grid = CommentedMap(
        kind="grid",
        name=ALL_ROUND,
        target_mm=_flow_sequence([round(float(value), 1) for value in target_mm]),
        distance_mm=fields.distance_mm,
        azimuths_deg=_flow_sequence(_azimuths(fields.azimuths)),
        elevations_deg=_flow_sequence(fields.elevations_deg),
    )
    return CommentedSeq([grid])


def _azimuths(count: int) -> tuple[float, ...]:
    """Return azimuths evenly around the object, beginning at -90 degrees, the side of a person in front of the
    cell."""
    angles_deg = [round((-90.0 + 360.0 * number / count + 180.0) % 360.0 - 180.0, 3) for number in range(count)]
    return tuple(int(angle) if angle == int(angle) else angle for angle in angles_deg)


def _target(views: Any) -> tuple[float, ...]:
    for view in views or []:
        if isinstance(view, dict) and isinstance(view.get("target_mm"), list):
            return tuple(view["target_mm"])
    return (0.0, 0.0, 0.0)


def _number(value: Any) -> float | None:
    is_one = isinstance(value, int | float) and not isinstance(value, bool)
    return value if is_one and abs(value) <= _LARGEST else None


def _whole(value: Any) -> int | None:
    return value if isinstance(value, int) and not isinstance(value, bool) and abs(value) <= _LARGEST else None
