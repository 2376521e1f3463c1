"""Driver and settings of each device of a rig, in a run or in a dry run, and problems in these settings.

A device is opened as the rig names it, or as its twin in a dry run. A world, if there is one, supplies the
addresses.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import asdict, replace
from typing import Any

from pydantic import BaseModel

from coupole.devices import HostNeed
from coupole.errors import Problem
from coupole.kinematics import Arm, slowed_arm
from coupole.plan.arm_description import ArmDescription, arm_of_driver, read_arm, shipped_arm
from coupole.plan.bursts import DeviceTimes
from coupole.plan.registry import (
    ARMS_OF_DRIVERS,
    CAMERA_STAND_INS,
    DEFAULT_TWINS,
    LEDBOX_STAND_INS,
    RENAMED,
    ROBOT_STAND_INS,
    WORLD,
    StandIn,
    load_class,
    settings_class,
)
from coupole.plan.rig import Device, DriverName, Rig
from coupole.plan.yamlfile import Document

DEVICES = ("ledbox", "camera", "robot")
NOWHERE = {
    "ledbox": {"port": "loop://"},
    "camera": {"address": "/nowhere"},
    "robot": {"listen": "127.0.0.1:0", "address": "127.0.0.1:0", "host": "127.0.0.1"},
}
"""Placeholder for an address that a world's endpoint gives. It is used to check settings before a world runs."""
_MOTION_SETTINGS = {
    "speed_fraction": "speed_fraction",
    "acceleration_deg_s2": "acceleration_deg_s2",
    "jerk_deg_s3": "jerk_deg_s3",
    "settle_dwell_s": "dwell_s",
}
"""Keys of the rig's `motion:` and the corresponding settings of a robot's driver."""
_WORDS = {
    "any_controller_by": "the first sender is taken for the controller",
    "without_realtime_by": "the arm may be answered at normal priority",
}
"""Settings whose value is the name of a person, with the permission that this person gives."""


def device_times(rig: Rig) -> DeviceTimes:
    """Return the times that the rig's LEDs and camera need."""
    sensor = rig.sensor
    return DeviceTimes(rig.led_limits.rise_us, 1e6 / sensor.max_frames_per_s, sensor.exposure_gap_us)


def described_arm(rig: Rig) -> ArmDescription | None:
    """Return the rig's arm, or otherwise the arm of its driver; None if neither is given. A path is relative to
    the working folder (reading a rig's file replaces the path by the description). Raises InputError."""
    if isinstance(rig.arm, ArmDescription):
        return rig.arm
    return read_arm(rig.arm) if rig.arm else arm_of_driver(rig.robot.driver, rig.robot.settings)


def planning_arm(rig: Rig) -> Arm | None:
    """Return the arm of the robot's driver, with the rig's speeds. None if it has no description; then neither
    postures nor collisions can be computed."""
    description = described_arm(rig)
    if description is None:
        return None
    driver, settings = device_for(rig, "robot", dry_run=False)
    model = settings_class(driver)
    if hasattr(model, "arm"):
        arm: Arm = model(**_known_settings(NOWHERE["robot"], model) | settings).arm()  # type: ignore[attr-defined]
        return arm
    motion = rig.motion
    return slowed_arm(
        description.arm,
        speed_fraction=motion.speed_fraction,
        acceleration_deg_s2=motion.acceleration_deg_s2,
        jerk_deg_s3=motion.jerk_deg_s3,
    )


def robot_settings_here(rig: Rig) -> Any:
    """Return the settings of the robot's driver for a controller on this machine, at the rig's cycle."""
    driver, settings = device_for(rig, "robot", dry_run=False)
    model = settings_class(driver)
    return model(**settings | _known_settings(NOWHERE["robot"], model))


def host_needs(rig: Rig) -> Iterator[tuple[str, HostNeed]]:
    """Yield each need of a driver with its kind of device, if the driver says what it needs of this machine. An
    address that a world gives is not a need."""
    for kind in DEVICES:
        driver, settings = device_for(rig, kind, dry_run=False)
        model = settings_class(driver)
        whole: Any = model(**_known_settings(NOWHERE[kind], model) | settings)
        if hasattr(whole, "host_needs"):
            yield from ((kind, need) for need in whole.host_needs())


def runs_tables(rig: Rig) -> bool:
    """True if the rig's LED box runs tables and triggers the camera (`coupole.devices.LedBox.runs_tables`)."""
    return bool(load_class(rig.ledbox.driver).runs_tables)


def upload_s(rig: Rig, steps: int) -> float:
    """Return the time to bring a table with this number of steps into the rig's LED box, from its driver; 0 if
    unknown."""
    settings = _ledbox_settings(rig)
    return float(settings.upload_s(steps)) if hasattr(settings, "upload_s") else 0.0


def _ledbox_settings(rig: Rig) -> BaseModel:
    model = settings_class(rig.ledbox.driver)
    return model(**_known_settings(NOWHERE["ledbox"], model) | rig.ledbox.settings)


def longest_light_s(rig: Rig, on_us: int) -> float:
    """Return the longest time for which the rig's LED box leaves a light of `on_us` on if the host dies. The time
    follows from the settings of the driver; without such settings it is `on_us`."""
    settings = _ledbox_settings(rig)
    return float(settings.longest_light_s(on_us)) if hasattr(settings, "longest_light_s") else on_us * 1e-6


def watchdog_s(rig: Rig) -> float:
    """Return the time after which the rig's LED box switches its panels off if the host dies; 0 if unknown."""
    return float(getattr(_ledbox_settings(rig), "watchdog_s", 0.0))


def in_world(rig: Rig, *, dry_run: bool) -> bool:
    """True if the rig's devices are stand-ins in a world."""
    return dry_run or (rig.world is not None and rig.world.serves == "always")


def device_for(rig: Rig, kind: str, *, dry_run: bool) -> tuple[DriverName, dict[str, Any]]:
    """Return the driver and settings to open for a device: its twin's in a dry run, otherwise its own."""
    device: Device = getattr(rig, kind)
    settings = dict(device.settings)
    driver = device.driver
    if dry_run and device.twin is not None:
        driver, settings = device.twin.driver, dict(device.twin.settings)
    elif dry_run and not (rig.world is not None and rig.world.serves == "always"):
        has_stand_in = driver in ROBOT_STAND_INS or driver in LEDBOX_STAND_INS
        driver = driver if has_stand_in else DEFAULT_TWINS[kind]
        settings = _known_settings(settings, settings_class(driver))
    if kind == "robot":
        settings = _known_settings(_robot_settings(rig), settings_class(driver)) | settings
    return driver, settings


def stand_in_for(rig: Rig, *, dry_run: bool) -> StandIn:
    """Return the kind of the robot's stand-in in this rig's world. It follows from the driver, or from the twin's
    driver if the world is for dry runs only. If the driver is not included with Coupole, the rig must give the
    kind."""
    driver, _ = device_for(rig, "robot", dry_run=dry_run or not in_world(rig, dry_run=False))
    robot_settings = rig.world.settings.get("robot") if rig.world else None
    return ROBOT_STAND_INS.get(driver) or StandIn(
        robot_settings.get("kind", "rsi") if isinstance(robot_settings, dict) else "rsi"
    )


def ledbox_stand_in(rig: Rig, *, dry_run: bool) -> StandIn:
    """Return the kind of the LED box's stand-in in this rig's world."""
    driver, _ = device_for(rig, "ledbox", dry_run=dry_run or not in_world(rig, dry_run=False))
    return LEDBOX_STAND_INS.get(driver) or StandIn("scpi")


def camera_kind(rig: Rig, *, dry_run: bool) -> str:
    """Return the kind of the camera's stand-in in this rig's world."""
    driver, _ = device_for(rig, "camera", dry_run=dry_run or not in_world(rig, dry_run=False))
    return CAMERA_STAND_INS.get(driver, "memory")


def trusted_by_name(rig: Rig) -> tuple[str, ...]:
    """Return the permissions that a person has given in the settings of the rig's real devices, in words with the
    person's name. A cell of stand-ins has none, because nobody else can reach its devices."""
    if in_world(rig, dry_run=False):
        return ()
    permissions = ((kind, key, getattr(rig, kind).settings.get(key)) for kind in DEVICES for key in _WORDS)
    return tuple(f"{kind}: {_WORDS[key]}, by the word of {name}" for kind, key, name in permissions if name)


def driver_problems(document: Document, rig: Rig) -> list[Problem]:
    """Return drivers that cannot be found, and settings that drivers do not accept."""
    problems = []
    for kind in DEVICES:
        device: Device = getattr(rig, kind)
        for at, part, has_endpoint in (
            ((kind,), device, in_world(rig, dry_run=False)),
            ((kind, "twin"), device.twin, True),
        ):
            if part is not None:
                given_settings = NOWHERE[kind] if has_endpoint else {}
                if kind == "robot":
                    given_settings = given_settings | _robot_settings(rig)
                problems += _settings_problems(document, at, part.driver, given_settings)
    if not problems and not hasattr(load_class(rig.ledbox.driver), "runs_tables"):
        message = "expected a class that declares `runs_tables`, as `coupole.devices.LedBox` asks"
        problems.append(document.problem(("ledbox", "driver"), message))
    if not problems:
        problems += _unlike_stand_in(document, rig)
    if rig.world is not None:
        problems += world_problems(document, rig, rig.world.settings)
        kinds = {"camera": camera_kind(rig, dry_run=False), "ledbox": ledbox_stand_in(rig, dry_run=False).kind}
        for name, other_end in kinds.items():
            end_settings = rig.world.settings.get(name)
            if isinstance(end_settings, dict) and end_settings.get("kind", other_end) != other_end:
                message = f"expected {other_end}, which is at the other end of the {name}'s driver"
                problems.append(document.problem(("world", "settings", name, "kind"), message))
    return problems


def _unlike_stand_in(document: Document, rig: Rig) -> list[Problem]:
    """Refuse, in a rig of stand-ins, an arm other than the one that the stand-in moves. Otherwise the poses would
    come from the arm, but the pictures from the stand-in. (A UR's stand-in moves the driver's `model`, or its
    settings are refused.)
    """
    moved_arm, arm = ARMS_OF_DRIVERS.get(rig.robot.driver), described_arm(rig)
    if moved_arm is None or arm is None or not in_world(rig, dry_run=False):
        return []
    stand_in = shipped_arm(moved_arm)
    if arm.arm.chain == stand_in.arm.chain:
        return []
    message = (
        f"expected the chain of a {stand_in.name}, the only arm that the stand-in of `{rig.robot.driver}` moves, "
        f"found the chain of `{arm.name}`. Name your devices and leave `world:` out; `check` and `view` open none"
    )
    return [document.problem(("arm",), message)]


def world_problems(document: Document, rig: Rig, settings: Mapping[str, Any]) -> list[Problem]:
    """Return problems in the settings of the rig's world, completed with values from the rig."""
    stand_in, robot = stand_in_for(rig, dry_run=False), settings.get("robot", {})
    if isinstance(robot, dict):
        if robot.get("kind", stand_in.kind) != stand_in.kind:
            message = f"expected {stand_in.kind}, the controller to which the robot's driver talks"
            return [document.problem(("world", "settings", "robot", "kind"), message)]
        robot = {"kind": stand_in.kind, **robot}
    camera = settings.get("camera", {})
    if isinstance(camera, dict):
        camera = {"kind": camera_kind(rig, dry_run=False), **camera}
    ledbox = settings.get("ledbox", {})
    if isinstance(ledbox, dict):
        ledbox = {"kind": ledbox_stand_in(rig, dry_run=False).kind, **ledbox}
    completed_settings = {**settings, "robot": robot, "camera": camera, "ledbox": ledbox}
    completed_document = replace(document, data={**document.data, "world": {"settings": completed_settings}})
    return _settings_problems(completed_document, ("world",), rig.world.driver if rig.world else WORLD, {})


def _settings_problems(
    document: Document, at: tuple[str, ...], driver: DriverName, given_settings: dict[str, Any]
) -> list[Problem]:
    try:
        load_class(driver)
        model = settings_class(driver)
    except (ImportError, AttributeError) as error:
        return [document.problem((*at, "driver"), f"cannot find `{driver}`: {error}")]
    return document.problems(model, (*at, "settings"), given_values=_known_settings(given_settings, model))[1]


def _robot_settings(rig: Rig) -> dict[str, Any]:
    """Return settings for a robot's driver from the rig's `motion:` and arm."""
    description = described_arm(rig)
    arm = {"arm_model": asdict(description.arm)} if description else {}
    return arm | {setting: getattr(rig.motion, figure) for figure, setting in _MOTION_SETTINGS.items()}


def _known_settings(settings: Mapping[str, Any], model: type[BaseModel]) -> dict[str, Any]:
    """Return the settings that the model has."""
    return {name: value for name, value in settings.items() if name in model.model_fields}


def renamed_drivers(document: Document) -> list[str]:
    """Return a warning for each class that the rig's file names by its version 0.1 name."""
    places: list[tuple[str | int, ...]] = [(*at, "driver") for at in (*((kind,) for kind in DEVICES), ("world",))]
    places += [(kind, "twin", "driver") for kind in DEVICES]
    remarks = []
    for place in places:
        value: Any = document.data
        for key in place:
            value = value.get(key) if isinstance(value, dict) else None
        if isinstance(value, str) and value in RENAMED:
            remarks.append(str(document.problem(place, f"`{value}` is now called `{RENAMED[value]}`")))
    return remarks
