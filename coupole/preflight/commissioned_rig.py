"""Parts of a rig that each step of a commissioning covers: everything, except what is named as harmless here.

A key of the rig, of its arm's description or of a driver's settings is covered as soon as it exists. `_STEPS` says
which steps must be repeated after a change of a key. For a key that is not in `_STEPS`, all steps must be
repeated. Files count by their content.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any, Literal, get_args

from coupole.plan.cell import Cell
from coupole.plan.link_meshes import LINKS, link_mesh_path
from coupole.plan.registry import settings_class
from coupole.plan.rig_devices import DEVICES, NOWHERE, described_arm, device_for

Step = Literal[
    "cycle", "axes", "stopping", "geometry", "lamps", "trigger", "watchdog", "presence", "emergency-stop"
]
STEPS: tuple[Step, ...] = get_args(Step)
"""Steps in the order in which they are done."""
ARM: tuple[Step, ...] = ("cycle", "axes", "stopping", "emergency-stop")
GEOMETRY: tuple[Step, ...] = ("geometry",)
LAMPS: tuple[Step, ...] = ("lamps", "trigger", "watchdog")

HARMLESS: Mapping[str, str] = {
    "schema_version": "version of the file's format; there is only one",
    "arm.schema_version": "of the format",
    "name": "stands in reports only",
    "arm.name": "stands in messages only",
    "licence": "terms for data",
    "contact": "the person to ask about data",
    "storage": "where runs are kept and how",
    "ledger": "where the objects' light is kept",
    "controllers": "where faults and commissioning are kept",
    "calibrations": "records carry limits and a checksum of their own, and move neither arm nor lamps",
    "white_response": "advice about exposures",
    "watch": "limits for findings in frames",
    "lens.f_number": "how bright pictures are",
    "sensor.bit_depth": "how pixels are coded",
    "sensor.bayer_pattern": "how pixels are coded",
    "sensor.black_dn": "how pixels are coded",
    "motion.home_joints_deg": "a posture among others: paths to it are planned and checked",
    "motion.park_joints_deg": "a posture among others: paths to it are planned and checked",
    "ledbox.twin": "opened in dry runs only",
    "camera.twin": "opened in dry runs only",
    "robot.twin": "opened in dry runs only",
    "world": "stand-ins are opened, and no real device",
}
"""Keys, with all keys below them, that no collision and no lamp depends on, and the reason. The addresses of
`NOWHERE` are harmless too, because the device at an address is identified by its serial number when it is
opened."""

_STEPS: Mapping[str, tuple[Step, ...]] = {
    "robot": ARM,
    "motion": ARM,
    "arm.joints": ARM + GEOMETRY,
    "arm.link_6_from_flange": ARM + GEOMETRY,
    "arm": GEOMETRY,
    "link_meshes": GEOMETRY,
    "flange_from_camera": GEOMETRY,
    "lens": GEOMETRY,
    "tool": GEOMETRY,
    "support": GEOMETRY,
    "keep_out": GEOMETRY,
    "clearances": GEOMETRY,
    "sensor.max_frames_per_s": ("trigger",),
    "sensor.exposure_gap_us": ("trigger",),
    "sensor": GEOMETRY,
    "camera.driver": ("trigger", *GEOMETRY),
    "camera.settings.region": ("trigger", *GEOMETRY),
    "camera": ("trigger",),
    "ledbox.driver": (*LAMPS, "presence"),
    "ledbox": LAMPS,
    "led_limits.rise_us": ("trigger",),
    "led_limits": ("lamps",),
    "dome.leds": ("lamps", *GEOMETRY),
    "dome": ("lamps",),
    "console": ("presence",),
}
"""The steps that a key, and all keys below it, concerns. The first entry that fits counts."""


def steps_of(key: str) -> tuple[Step, ...]:
    """Return the steps that must be repeated after a change of this key of the rig; none for a harmless key."""
    if any(_is_at(key, place) for place in HARMLESS) or _is_address(key):
        return ()
    return next((steps for place, steps in _STEPS.items() if _is_at(key, place)), STEPS)


def covered_settings(cell: Cell, step: Step) -> dict[str, Any]:
    """Return all settings of the rig that the result of a step depends on: values by their key, such as
    `keep_out.0.min_mm`."""
    return {key: _value(cell, value) for key, value in everything(cell).items() if step in steps_of(key)}


def everything(cell: Cell) -> dict[str, Any]:
    """Return all settings of a rig, harmless or not: its own keys, its arm's, and its drivers' settings with their
    defaults."""
    rig = cell.rig
    plain = rig.model_dump()
    arm = described_arm(rig)
    plain["arm"] = None if arm is None else arm.model_dump()
    for kind in DEVICES:
        plain[kind] |= {"settings": _complete_settings(cell, kind)}
    for place in (plain, plain["arm"] or {}):
        if place.get("link_meshes") is not None:
            folder = cell.document.resolve(place["link_meshes"])
            place["link_meshes"] = {path.name: path for path in (link_mesh_path(folder, k) for k in range(LINKS))}
    return dict(_leaves("", plain))


def _complete_settings(cell: Cell, kind: str) -> dict[str, Any]:
    """Return the settings of the driver that a run opens, with its defaults. The arm is left out, because it has
    keys of its own."""
    driver, settings = device_for(cell.rig, kind, dry_run=False)
    model = settings_class(driver)
    places = {name: value for name, value in NOWHERE[kind].items() if name in model.model_fields}
    return model(**{**places, **settings}).model_dump(mode="json", exclude={"arm_model"})


def _is_at(key: str, place: str) -> bool:
    return key == place or key.startswith(f"{place}.")


def _is_address(key: str) -> bool:
    kind, _, setting = key.partition(".settings.")
    return setting in NOWHERE.get(kind, {})


def _leaves(at: str, value: Any) -> Iterator[tuple[str, Any]]:
    """Keys and values of a plain document; a list of numbers or words is one value."""
    if isinstance(value, dict) and value:
        for key, inner in value.items():
            yield from _leaves(f"{at}.{key}" if at else str(key), inner)
    elif isinstance(value, (tuple, list)) and any(isinstance(inner, dict) for inner in value):
        for k, inner in enumerate(value):
            yield from _leaves(f"{at}.{k}", inner)
    else:
        yield at, value


def _value(cell: Cell, value: Any) -> Any:
    """Return a value in JSON form; a file becomes the SHA-256 of its content."""
    if isinstance(value, Path):
        path = cell.document.resolve(value)
        return cell.files.sha256(path) if cell.files.there(path) else str(value)
    if isinstance(value, (tuple, list)):
        return [_value(cell, inner) for inner in value]
    return value
