"""The rig: which devices there are, where they stand, what they may do; and how they are opened.

This is the only module that imports drivers, and it does so by the name in the rig's YAML
(`driver: drivers.ledbox:LedBox`). A driver's `settings:` are checked by that class's own pydantic `Settings`.
"""

from __future__ import annotations

import importlib
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Annotated, Any, Literal

from pydantic import BaseModel, Field

from coupole.errors import Problem
from coupole.kinematics import Arm
from coupole.plan.plan import Model, Name, Pose, Vector
from coupole.plan.yamlfile import Document

DriverName = Annotated[str, Field(pattern=r"^[A-Za-z_][\w.]*:[A-Za-z_]\w*$")]


class Twin(Model):
    """The simulated counterpart that `--dry-run` opens in a device's place."""

    driver: DriverName
    settings: dict[str, Any] = Field(default_factory=dict)


class Device(Model):
    """A driver and its settings. On a simulated rig the world's endpoint fills in the address."""

    driver: DriverName
    settings: dict[str, Any] = Field(default_factory=dict)
    twin: Twin | None = None


class Sensor(Model):
    """What the camera's frames look like; compared with what the camera says when it is opened."""

    width_px: Annotated[int, Field(ge=8, le=65536)]
    height_px: Annotated[int, Field(ge=8, le=65536)]
    pixel_pitch_um: Annotated[float, Field(gt=0)]
    bit_depth: Annotated[int, Field(ge=8, le=16)] = 12
    bayer_pattern: Literal["GBRG", "GRBG", "RGGB", "BGGR", "MONO"] = "GBRG"
    black_dn: Annotated[int, Field(ge=0)] = 64
    max_frames_per_s: Annotated[float, Field(gt=0)] = 100.0
    exposure_gap_us: Annotated[int, Field(ge=0)] = 100
    """Least time between the end of one exposure and the start of the next."""

    @property
    def white_dn(self) -> int:
        return (1 << self.bit_depth) - 1


class Lens(Model):
    focal_length_mm: Annotated[float, Field(gt=0)]
    f_number: Annotated[float, Field(gt=0)]
    focus_distance_mm: Annotated[float, Field(gt=0)]
    """From the projection centre to the plane of best focus."""


class Dome(Model):
    """The LEDs: a CSV with columns id, board, x_mm, y_mm, z_mm, nx, ny, nz (base frame), flux_lm."""

    leds: Path
    emission: Literal["lambertian", "paper"] = "lambertian"
    panel_lux: Annotated[float, Field(ge=0)] = 0.0
    """Illuminance at the support's centre with one flat panel on, for the light dose."""


class BoardThermal(Model):
    """First-order thermal model of an LED board: each joule lifts it, it cools with one time constant."""

    led_power_w: Annotated[float, Field(gt=0)] = 15.0
    rise_c_per_j: Annotated[float, Field(gt=0)] = 0.02
    time_constant_s: Annotated[float, Field(gt=0)] = 240.0
    ambient_c: float = 22.0
    limit_c: float = 70.0


class LedLimits(Model):
    """What an LED and its board may be asked; the box refuses more by itself as well."""

    on_us: tuple[Annotated[int, Field(ge=1)], Annotated[int, Field(ge=1)]] = (1_000, 2_000_000)
    rise_us: Annotated[int, Field(ge=0)] = 1_000
    """From switching on to full current: the trigger waits for it (facts: 1 ms)."""
    cooldown_ratio: Annotated[float, Field(ge=0)] = 2.0
    """An LED that was lit for t rests at least `cooldown_ratio` * t."""
    board: BoardThermal = BoardThermal()


class Motion(Model):
    """How the arm moves between views: share of its joint speeds, acceleration, jerk, and how it settles."""

    speed_fraction: Annotated[float, Field(gt=0, le=1)] = 0.3
    acceleration_deg_s2: Annotated[float, Field(gt=0)] = 300.0
    jerk_deg_s3: Annotated[float, Field(gt=0)] = 3000.0
    settle_dwell_s: Annotated[float, Field(ge=0)] = 0.3
    still_deg: Annotated[float, Field(gt=0)] = 0.01
    """An axis that moves farther than this during a burst has moved: what was not proven before is taken again."""
    home_joints_deg: tuple[float, float, float, float, float, float] = (0.0, -170.0, 150.0, 0.0, -70.0, 0.0)
    """Where the arm is taken to be when a plan is checked without it."""


class Support(Model):
    """The disk that carries the object, and the origin of the support frame."""

    base_from_support: Pose
    diameter_mm: Annotated[float, Field(gt=0)] = 1480.0


class KeepOutSphere(Model):
    """A volume of the support frame that the flange must stay out of."""

    kind: Literal["sphere"]
    name: Name
    center_mm: Vector
    radius_mm: Annotated[float, Field(gt=0)]


class KeepOutBox(Model):
    kind: Literal["box"]
    name: Name
    min_mm: Vector
    max_mm: Vector


KeepOut = Annotated[KeepOutSphere | KeepOutBox, Field(discriminator="kind")]


class ToolBody(Model):
    """Something that the flange carries: a capsule in the flange's frame."""

    name: Name
    from_mm: Vector
    to_mm: Vector
    radius_mm: Annotated[float, Field(gt=0)]


class Keep(Model):
    """Distances that the arm keeps from what stands round it, mm."""

    object_mm: Annotated[float, Field(ge=0)] = 50.0
    support_mm: Annotated[float, Field(ge=0)] = 10.0
    dome_mm: Annotated[float, Field(ge=0)] = 20.0
    self_mm: Annotated[float, Field(ge=0)] = 0.0
    keep_out_mm: Annotated[float, Field(ge=0)] = 0.0


class Storage(Model):
    folder: Path
    reserve_bytes: Annotated[int, Field(ge=0)] = 256 * 1024**2
    """Free space that a run must leave on the disk."""
    pixels: Literal["uint16", "packed12"] = "uint16"
    """How frames lie on the disk: two bytes a pixel, or two pixels of at most 12 bits in three bytes."""


class WorldSection(Model):
    """The stand-ins: started with the rig (or for dry runs only), or joined where they already run."""

    serves: Literal["always", "dry_run"] = "always"
    join: Path | None = None
    """File with the JSON line of a `coupole sim` that is running already."""
    driver: DriverName = "sim.world.client:World"
    settings: dict[str, Any] = Field(default_factory=dict)


class Rig(Model):
    """One cell: devices, geometry, limits, storage."""

    schema_version: Literal[1]
    name: Name
    ledbox: Device
    camera: Device
    robot: Device
    sensor: Sensor
    lens: Lens
    flange_from_camera: Pose
    dome: Dome
    support: Support
    tool: tuple[ToolBody, ...]
    link_meshes: Path | None = None
    """Folder of meshes (`base_link.stl`, `link_1.stl` to `link_6.stl`) that stand for the arm's links, in place of
    capsules round them."""
    clearances: Keep = Keep()
    keep_out: tuple[KeepOut, ...] = ()
    led_limits: LedLimits = LedLimits()
    motion: Motion = Motion()
    storage: Storage
    calibrations: Literal["none"] | tuple[Path, ...] = "none"
    """Records that must be in force for plans that do not say otherwise."""
    world: WorldSection | None = None

    @property
    def frame_bytes(self) -> int:
        """Of a frame on the disk."""
        pixels = self.sensor.width_px * self.sensor.height_px
        return pixels * 3 // 2 if self.storage.pixels == "packed12" else pixels * 2


DEVICES = ("ledbox", "camera", "robot")
NOWHERE = {
    "ledbox": {"port": "loop://"},
    "camera": {"address": "/nowhere"},
    "robot": {"listen": "127.0.0.1:0", "address": "127.0.0.1:0", "host": "127.0.0.1"},
}
"""Stands for what a world's endpoint will fill in, while settings are checked and no world runs yet."""
DEFAULT_TWINS = {
    "ledbox": "drivers.ledbox:LedBox",
    "camera": "sim.devices.memory_camera:MemoryCamera",
    "robot": "drivers.kuka.rsi:KukaRsi",
}
DEFAULT_WORLD = "sim.world.client:World"


@dataclass(frozen=True)
class StandIn:
    """What a world has at the other end of a robot driver's wire."""

    kind: str
    """In `world.settings.robot`."""
    alike: tuple[str, ...] = ()
    """Settings of the driver that must be the stand-in's too."""
    settings: Mapping[str, Any] = field(default_factory=dict)
    """More of the stand-in's, where the rig does not say otherwise."""


STAND_INS = {
    "drivers.kuka.rsi:KukaRsi": StandIn(
        "rsi",
        ("cycle_ms", "corrects", "mode", "sen_type", "measured_tag", "delay_tag", "correction_tag"),
        {"sends_to": "127.0.0.1:0"},
    ),
    "drivers.kuka.eki:KukaEki": StandIn(
        "eki", ("controller_is", "status_ms", "full_acceleration_deg_s2", "jerk_deg_s3")
    ),
    "drivers.ur:UrRobot": StandIn("ur"),
}
"""For the robot drivers that come with Coupole; all choose an address that is free."""
LEDBOX_STAND_INS = {
    "drivers.ledbox:LedBox": StandIn("scpi"),
    "drivers.ledbox.text_lines:TextLineBox": StandIn("text", ("baud", "led_count", "first_led")),
}
"""For the LED boxes' drivers that come with Coupole: `world.settings.ledbox.kind`."""
CAMERA_KINDS = {"drivers.camera.aravis:AravisCamera": "gige"}
"""For camera drivers whose stand-in is not the camera in shared memory: `world.settings.camera.kind`."""
_MOTION_SETTINGS = {
    "speed_fraction": "speed_fraction",
    "acceleration_deg_s2": "acceleration_deg_s2",
    "jerk_deg_s3": "jerk_deg_s3",
    "settle_dwell_s": "dwell_s",
}
"""Figures of the rig's `motion:` and the settings of a robot's driver that they become."""


def load_class(name: DriverName) -> type[Any]:
    """The class behind `package.module:Class`. Raises ImportError or AttributeError."""
    module, _, attribute = name.partition(":")
    found: type[Any] = getattr(importlib.import_module(module), attribute)
    return found


def settings_class(name: DriverName) -> type[BaseModel]:
    """The `Settings` model that stands beside a driver's class."""
    found: type[BaseModel] = load_class(name.partition(":")[0] + ":Settings")
    return found


def planning_arm(rig: Rig) -> Arm | None:
    """The arm that the robot's driver moves, at the speeds that the rig gives it; None where the driver knows no
    model of it, so that neither postures nor collisions can be reckoned."""
    driver, settings = device_for(rig, "robot", dry_run=False)
    model = settings_class(driver)
    described = model(**_known(NOWHERE["robot"], model) | settings)
    arm: Arm | None = described.arm() if hasattr(described, "arm") else None
    return arm


def runs_tables(rig: Rig) -> bool:
    """True if the rig's LED box runs tables and triggers the camera (`coupole.devices.LedBox.runs_tables`)."""
    return bool(load_class(rig.ledbox.driver).runs_tables)


def upload_s(rig: Rig, steps: int) -> float:
    """Time to bring a table of so many steps into the rig's LED box, as its driver says; 0 if it does not."""
    model = settings_class(rig.ledbox.driver)
    described = model(**_known(NOWHERE["ledbox"], model) | rig.ledbox.settings)
    return float(described.upload_s(steps)) if hasattr(described, "upload_s") else 0.0


def in_world(rig: Rig, *, dry_run: bool) -> bool:
    """True if the rig's devices are stand-ins in a world."""
    return dry_run or (rig.world is not None and rig.world.serves == "always")


def device_for(rig: Rig, kind: str, *, dry_run: bool) -> tuple[DriverName, dict[str, Any]]:
    """Driver and settings to open for a device: its twin in a dry run, itself otherwise."""
    device: Device = getattr(rig, kind)
    settings = dict(device.settings)
    driver = device.driver
    if dry_run and device.twin is not None:
        driver, settings = device.twin.driver, dict(device.twin.settings)
    elif dry_run and not (rig.world is not None and rig.world.serves == "always"):
        known = driver in STAND_INS or driver in LEDBOX_STAND_INS
        driver = driver if known else DEFAULT_TWINS[kind]
        settings = _known(settings, settings_class(driver))
    if kind == "robot":
        settings = _known(_motion_settings(rig), settings_class(driver)) | settings
    return driver, settings


def stand_in_for(rig: Rig, *, dry_run: bool) -> StandIn:
    """What this rig's world has at the other end of the robot's wire: of its driver, or of its driver's twin where
    the world takes no part but in dry runs. Of a driver that did not come with Coupole the rig must say it."""
    driver, _ = device_for(rig, "robot", dry_run=dry_run or not in_world(rig, dry_run=False))
    told = rig.world.settings.get("robot") if rig.world else None
    return STAND_INS.get(driver) or StandIn(told.get("kind", "rsi") if isinstance(told, dict) else "rsi")


def ledbox_stand_in(rig: Rig, *, dry_run: bool) -> StandIn:
    """What this rig's world has at the other end of the LED box's wire."""
    driver, _ = device_for(rig, "ledbox", dry_run=dry_run or not in_world(rig, dry_run=False))
    return LEDBOX_STAND_INS.get(driver) or StandIn("scpi")


def camera_kind(rig: Rig, *, dry_run: bool) -> str:
    """Which camera this rig's world has at the other end of the driver's wire."""
    driver, _ = device_for(rig, "camera", dry_run=dry_run or not in_world(rig, dry_run=False))
    return CAMERA_KINDS.get(driver, "memory")


def driver_problems(document: Document, rig: Rig) -> list[Problem]:
    """Drivers that cannot be found and settings that their drivers do not take."""
    problems = []
    for kind in DEVICES:
        device: Device = getattr(rig, kind)
        for at, part, has_endpoint in (
            ((kind,), device, in_world(rig, dry_run=False)),
            ((kind, "twin"), device.twin, True),
        ):
            if part is not None:
                given = NOWHERE[kind] if has_endpoint else {}
                if kind == "robot":
                    given = given | _motion_settings(rig)
                problems += _settings_problems(document, at, part.driver, given)
    if not problems and not hasattr(load_class(rig.ledbox.driver), "runs_tables"):
        message = "expected a class that declares `runs_tables`, as `coupole.devices.LedBox` asks"
        problems.append(document.problem(("ledbox", "driver"), message))
    if rig.world is not None:
        problems += world_problems(document, rig, rig.world.settings)
        kinds = {"camera": camera_kind(rig, dry_run=False), "ledbox": ledbox_stand_in(rig, dry_run=False).kind}
        for name, other_end in kinds.items():
            told = rig.world.settings.get(name)
            if isinstance(told, dict) and told.get("kind", other_end) != other_end:
                message = f"expected {other_end}, which is at the other end of the {name}'s driver"
                problems.append(document.problem(("world", "settings", name, "kind"), message))
    return problems


def world_problems(document: Document, rig: Rig, settings: Mapping[str, Any]) -> list[Problem]:
    """What is wrong with the settings of the rig's world, with what follows from the rig filled in."""
    stand_in, robot = stand_in_for(rig, dry_run=False), settings.get("robot", {})
    if isinstance(robot, dict):
        if robot.get("kind", stand_in.kind) != stand_in.kind:
            message = f"expected {stand_in.kind}, which is at the other end of the robot's driver"
            return [document.problem(("world", "settings", "robot", "kind"), message)]
        robot = {"kind": stand_in.kind, **robot}
    camera = settings.get("camera", {})
    if isinstance(camera, dict):
        camera = {"kind": camera_kind(rig, dry_run=False), **camera}
    ledbox = settings.get("ledbox", {})
    if isinstance(ledbox, dict):
        ledbox = {"kind": ledbox_stand_in(rig, dry_run=False).kind, **ledbox}
    completed_settings = {**settings, "robot": robot, "camera": camera, "ledbox": ledbox}
    completed = replace(document, data={**document.data, "world": {"settings": completed_settings}})
    return _settings_problems(completed, ("world",), rig.world.driver if rig.world else DEFAULT_WORLD, {})


def _settings_problems(
    document: Document, at: tuple[str, ...], driver: DriverName, given: dict[str, Any]
) -> list[Problem]:
    try:
        load_class(driver)
        model = settings_class(driver)
    except (ImportError, AttributeError) as error:
        return [document.problem((*at, "driver"), f"cannot find `{driver}`: {error}")]
    return document.problems(model, (*at, "settings"), given=_known(given, model))[1]


def _motion_settings(rig: Rig) -> dict[str, Any]:
    """What the rig's `motion:` says to a robot's driver."""
    return {setting: getattr(rig.motion, figure) for figure, setting in _MOTION_SETTINGS.items()}


def _known(settings: Mapping[str, Any], model: type[BaseModel]) -> dict[str, Any]:
    """Of these settings those that the model has."""
    return {name: value for name, value in settings.items() if name in model.model_fields}
