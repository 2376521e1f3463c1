"""Every class that is named by a string: drivers, their stand-ins, the simulated world. And how they are loaded.

`coupole` imports neither `drivers` nor `sim`: a rig names a class (`driver: drivers.ledbox:LedBox`), and it is
loaded from here when it is needed. A driver's `settings:` are checked by the pydantic model `Settings` that stands
beside its class.
"""

from __future__ import annotations

import importlib
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

from pydantic import BaseModel

WORLD = "sim.world.client:World"
"""The simulated cell, started as a process or joined."""
STILLS = "sim.world.stills:Stills"
"""Frames of the simulated cell without devices."""
SCANNER_EXPORT = "sim.devices.scanner:export_scan"
"""What a scanner would export of the simulated object."""

DEFAULT_TWINS = {
    "ledbox": "drivers.ledbox:LedBox",
    "camera": "sim.devices.memory_camera:MemoryCamera",
    "robot": "drivers.kuka.rsi:KukaRsi",
}
"""What a dry run opens in place of a real device whose driver has no stand-in of its own."""


@dataclass(frozen=True)
class StandIn:
    """What a world has at the other end of a driver's wire."""

    kind: str
    """In `world.settings.robot` or `world.settings.ledbox`."""
    alike: tuple[str, ...] = ()
    """Settings of the driver that must be the stand-in's too."""
    settings: Mapping[str, Any] = field(default_factory=dict)
    """More of the stand-in's, where the rig does not say otherwise."""


ROBOT_STAND_INS = {
    "drivers.kuka.rsi:KukaRsi": StandIn(
        "rsi",
        ("cycle_ms", "corrects", "mode", "sen_type", "measured_tag", "delay_tag", "correction_tag"),
        {"sends_to": "127.0.0.1:0"},
    ),
    "drivers.kuka.eki:KukaEki": StandIn(
        "eki", ("controller_is", "status_ms", "full_acceleration_deg_s2", "jerk_deg_s3")
    ),
    "drivers.ur:UrRobot": StandIn("ur", ("model",)),
}
"""For the robot drivers that come with Coupole; all choose an address that is free."""
ARMS_OF_DRIVERS = {"drivers.kuka.rsi:KukaRsi": "kr10_r1100_sixx", "drivers.kuka.eki:KukaEki": "kr10_r1100_sixx"}
"""The arm (in `configs/robots`) that a driver moves where the rig does not say it."""
UR = "drivers.ur:UrRobot"
"""Moves the arm that its setting `model` names."""
LEDBOX_STAND_INS = {
    "drivers.ledbox:LedBox": StandIn("scpi"),
    "drivers.ledbox.text_lines:TextLineBox": StandIn("text", ("baud", "led_count", "first_led")),
}
"""For the LED boxes' drivers that come with Coupole: `world.settings.ledbox.kind`."""
CAMERA_STAND_INS = {"drivers.camera.aravis:AravisCamera": "gige"}
"""For camera drivers whose stand-in is not the camera in shared memory: `world.settings.camera.kind`."""

RENAMED = {
    "drivers.kuka_rsi:KukaRsi": "drivers.kuka.rsi:KukaRsi",
    "drivers.kuka_eki:KukaEki": "drivers.kuka.eki:KukaEki",
    "drivers.aravis:AravisCamera": "drivers.camera.aravis:AravisCamera",
    "drivers.gentl:GenTLCamera": "drivers.camera.gentl:GenTLCamera",
    "drivers.xiapi:XiCamera": "drivers.camera.xiapi:XiCamera",
    "drivers.raw_files:RawFiles": "drivers.camera.raw:RawFiles",
    "sim.memory_camera:MemoryCamera": "sim.devices.memory_camera:MemoryCamera",
    "sim.client:World": WORLD,
}
"""Names of version 0.1, and those of today."""


def current_name(name: str) -> str:
    """Today's name of a class that a rig of version 0.1 may name otherwise."""
    return RENAMED.get(name, name)


def load_class(name: str) -> type[Any]:
    """The class behind `package.module:Class`. Raises ImportError or AttributeError."""
    module, _, attribute = current_name(name).partition(":")
    found: type[Any] = getattr(importlib.import_module(module), attribute)
    return found


def settings_class(name: str) -> type[BaseModel]:
    """The `Settings` model that stands beside a driver's class."""
    found: type[BaseModel] = load_class(current_name(name).partition(":")[0] + ":Settings")
    return found
