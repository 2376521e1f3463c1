"""What a world is told when it starts: the rig's `world.settings`, and the scene of rig and plan."""

from __future__ import annotations

import dataclasses
from pathlib import Path
from typing import Annotated, Literal

from pydantic import BaseModel, ConfigDict, Field, model_validator

from sim.devices import camera_server, kuka_controller, ledbox_firmware
from sim.devices.arm_bodies import ToolBody
from sim.devices.camera_stand_in import CameraSettings
from sim.devices.camera_stand_in import impossible as impossible_for_camera
from sim.devices.ledbox_stand_in import LedBoxSettings
from sim.devices.ledbox_stand_in import impossible as impossible_for_box
from sim.devices.robot import RobotSettings, impossible
from sim.optics.dome import DomeErrors
from sim.optics.led_light import STEADY, LedModel
from sim.optics.panels import Panel
from sim.optics.sensor_model import SensorModel
from sim.scene.things import Stickers, Thing
from sim.world import faults as script

WHITE_SHARE = 0.6
"""A white target at the support's centre reaches this share of full scale at the plan's exposure (design)."""


_OF_THE_TRUE_CAMERA = (
    "samples_per_side",
    "distortion",
    "blur",
    "rim_radius",
    "rim_shift",
    "lateral_colour",
    "sensor",
    "sensor_temperature_c",
)
"""What the rig's `world.settings.camera` says of the picture that it takes."""
Share = Annotated[float, Field(ge=0, le=1)]


class _Model(BaseModel):
    model_config = ConfigDict(frozen=True, extra="forbid")


class MaterialConfig(_Model):
    """As `sim.scene.surface.Material`: Lambert and GGX per channel."""

    diffuse: tuple[Share, Share, Share]
    f0: tuple[Share, Share, Share] = (0.0, 0.0, 0.0)
    roughness: Share = 0.0


class MeshConfig(_Model):
    """One object: its mesh and where it lies on the support (row-major 4x4)."""

    path: Path
    unit: Literal["mm", "m", "um"]
    support_from_object: list[list[float]]
    material: MaterialConfig | None = None
    """Times the mesh's own colours; without it these alone, or a warm stone where there are none."""


class SceneConfig(_Model):
    """Geometry of the simulated cell; transforms are row-major 4x4."""

    leds: Path
    emission: Literal["lambertian", "paper"]
    base_from_support: list[list[float]]
    support_diameter_mm: float
    objects: list[MeshConfig]
    tool: list[ToolBody] = []
    """What the flange carries, which stands in the light."""


class InterreflectionConfig(_Model):
    """Light that goes from surface to surface, by Mitsuba (the extra `mitsuba`): seconds for each LED and pose."""

    bounces: Annotated[int, Field(ge=2, le=16)] = 4
    samples: Annotated[int, Field(ge=1, le=4096)] = 64
    """Paths from each triangle that is seen."""


class CameraConfig(_Model):
    """Sensor and lens of the simulated camera."""

    width_px: int
    height_px: int
    pixel_pitch_um: float
    bit_depth: int
    bayer_pattern: str
    black_dn: int
    max_frames_per_s: float
    exposure_gap_us: int
    focal_length_mm: float
    focus_distance_mm: float
    distortion: tuple[float, float, float, float, float] = (0.0, 0.0, 0.0, 0.0, 0.0)
    """k1, k2, p1, p2, k3 of Brown and Conrady, as OpenCV orders and signs them."""
    f_number: Annotated[float, Field(gt=0)] = 8.0
    samples_per_side: Annotated[int, Field(ge=1, le=8)] = 1
    """Rays through each pixel, k x k: for targets whose corners are measured to a fraction of a pixel."""
    blur: bool = False
    rim_radius: float = 3.0
    rim_shift: float = 4.0
    lateral_colour: tuple[float, float, float] = (0.0, 0.0, 0.0)
    sensor: SensorModel = SensorModel()
    sensor_temperature_c: float = 25.0
    """These as in `sim.devices.camera_body.Settings`."""
    flange_from_camera: list[list[float]]
    nominal_exposure_us: int
    """The exposure at which white reaches `WHITE_SHARE` of full scale."""

    def true_sensor(self, seed: int) -> SensorModel:
        """The sensor with the rig's pattern, bits and black level; the world's seed makes it another one."""
        return dataclasses.replace(
            self.sensor,
            bayer_pattern=self.bayer_pattern,
            bit_depth=self.bit_depth,
            black_dn=self.black_dn,
            seed=self.sensor.seed + seed - 1,
        )


class Settings(_Model):
    """The rig's `world.settings`: the character of the stand-ins, and what goes wrong."""

    speed: Annotated[float, Field(gt=0, le=1000)] = 1.0
    hurry_only_when_told: bool = False
    """Real time, but `speed` while the controller says that it merely waits (dry runs)."""
    seed: int = 1
    ledbox: LedBoxSettings = ledbox_firmware.Settings()
    robot: RobotSettings = kuka_controller.Settings()
    camera: CameraSettings = camera_server.Settings()
    faults: tuple[script.Fault, ...] = ()
    things: tuple[Thing, ...] = ()
    """What stands on the support beside the plan's object."""
    interreflection: InterreflectionConfig | None = None
    """`{}` adds it; without it light meets one surface."""
    arm_shadows: bool = True
    """Whether arm and tool stand in the light."""
    material: MaterialConfig | None = None
    """Of the plan's object, times its mesh's own colours; without it these alone, or a warm stone."""
    stickers: Stickers | None = None
    """On the plan's object."""
    leds: LedModel = STEADY
    """`{}` is LEDs as they are made: each has its own flux and colour, warms up, flickers."""
    dome: DomeErrors = DomeErrors()
    """How the dome differs from its table."""
    panels: tuple[Panel, ...] = ()
    """The flat white panels 1 to 4, for the camera to see; without them a panel is light from all around."""

    @model_validator(mode="after")
    def _possible(self) -> Settings:
        for fault in self.faults:
            if why := (
                impossible(fault, self.robot)
                or impossible_for_camera(fault, self.camera)
                or impossible_for_box(fault, self.ledbox)
            ):
                raise ValueError(why)
        if self.robot.kind == "ur" and self.speed != 1.0:
            raise ValueError("a world with a robot of kind `ur` has speed 1: ur-rtde lives in real time")
        return self


class Config(_Model):
    """All that a world needs to know."""

    settings: Settings
    scene: SceneConfig
    camera: CameraConfig

    @property
    def photographed(self) -> CameraConfig:
        """The camera as the renderer needs it: with the true lens, and as many rays as are wanted."""
        true = {name: getattr(self.settings.camera, name) for name in _OF_THE_TRUE_CAMERA}
        return self.camera.model_copy(update=true)
