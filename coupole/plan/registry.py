"""All classes named by strings (drivers, their stand-ins, the simulated world), and their loading.

`coupole` imports neither `drivers` nor `sim`. A rig names a class (`driver: drivers.ledbox:LedBox`), and this
module loads the class on use. A driver's `settings:` are checked by the pydantic model `Settings` in the same
module.
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
"""A simulated scanner's export of the simulated object."""

DEFAULT_TWINS = {
    "ledbox": "drivers.ledbox:LedBox",
    "camera": "sim.devices.memory_camera:MemoryCamera",
    "robot": "drivers.kuka.rsi:KukaRsi",
}
"""Drivers that a dry run uses in place of a real device whose driver has no stand-in."""


@dataclass(frozen=True)
class StandIn:
    """The stand-in for a driver in a world."""

    kind: str
    """Kind of the stand-in, in `world.settings.robot` or `world.settings.ledbox`."""
    alike: tuple[str, ...] = ()
    """Settings of the driver that the stand-in shares. The rig's world may replace them."""
    settings: Mapping[str, Any] = field(default_factory=dict)
    """Further settings of the stand-in. The rig may replace them."""


ROBOT_STAND_INS = {
    "drivers.kuka.rsi:KukaRsi": StandIn(
        "rsi",
        (
            "cycle_ms",
            "corrects",
            "mode",
            "sen_type",
            "measured_tag",
            "delay_tag",
            "correction_tag",
            "stop_tag",
            "delay_counts",
        ),
        {"sends_to": "127.0.0.1:0"},
    ),
    "drivers.kuka.eki:KukaEki": StandIn(
        "eki", ("controller_is", "status_ms", "full_acceleration_deg_s2", "jerk_deg_s3")
    ),
    "drivers.ur:UrRobot": StandIn("ur", ("model",)),
}
"""Stand-ins for the included robot drivers. Each stand-in chooses a free address."""
ANSWER_JITTER = {"drivers.kuka.rsi:KukaRsi": "drivers.kuka.rsi.jitter:measure_jitter"}
"""Functions that measure how soon a driver answers its controller, for drivers that must answer in every cycle."""
ARMS_OF_DRIVERS = {"drivers.kuka.rsi:KukaRsi": "kr10_r1100_sixx", "drivers.kuka.eki:KukaEki": "kr10_r1100_sixx"}
"""The default arm (in `configs/robots`) of each driver."""
UR = "drivers.ur:UrRobot"
"""Driver that moves the arm that its setting `model` names."""
LEDBOX_STAND_INS = {
    "drivers.ledbox:LedBox": StandIn("scpi"),
    "drivers.ledbox.text_lines:TextLineBox": StandIn("text", ("baud", "led_count", "first_led")),
}
"""Stand-ins for the included LED box drivers: `world.settings.ledbox.kind`."""
CAMERA_STAND_INS = {"drivers.camera.aravis:AravisCamera": "gige"}
"""Kinds of stand-in for camera drivers whose stand-in is not the camera in shared memory:
`world.settings.camera.kind`."""

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
"""Names of version 0.1, with the present names."""


def current_name(name: str) -> str:
    """Return the present name of a class that may have a version 0.1 name in a rig."""
    return RENAMED.get(name, name)


def load_class(name: str) -> type[Any]:
    """Return the class for `package.module:Class`. Raises ImportError or AttributeError."""
    module, _, attribute = current_name(name).partition(":")
    named_class: type[Any] = getattr(importlib.import_module(module), attribute)
    return named_class


def settings_class(name: str) -> type[BaseModel]:
    """Return the `Settings` model in the module of a driver's class."""
    settings_model: type[BaseModel] = load_class(current_name(name).partition(":")[0] + ":Settings")
    return settings_model
