"""Configuration of a world: the rig's `world.settings`, and the scene from rig and plan."""

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
from sim.optics.glare import Glare
from sim.optics.led_light import STEADY, LedModel
from sim.optics.panels import Panel
from sim.optics.sensor_model import SensorModel
from sim.scene.surface import Layer
from sim.scene.things import Stickers, Thing
from sim.strangers import Strangers
from sim.strangers.arm_stranger import NO_STRANGER
from sim.world import faults as script

WHITE_SHARE = 0.6
"""Share of full scale that a white target at the support's centre reaches at the plan's exposure."""


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
"""Settings in the rig's `world.settings.camera` that concern the picture."""
Share = Annotated[float, Field(ge=0, le=1)]


class _Model(BaseModel):
    model_config = ConfigDict(frozen=True, extra="forbid")


class MaterialConfig(_Model):
    """Material as in `sim.scene.surface.Material`: Lambert and GGX per channel."""

    diffuse: tuple[Share, Share, Share]
    f0: tuple[Share, Share, Share] = (0.0, 0.0, 0.0)
    roughness: Share = 0.0


class SpecimenConfig(_Model):
    """A material that is not a sum of Lambert and GGX (`sim.objects.specimens`)."""

    specimen: Literal["tabulated", "layered", "makie", "four-flux", "fabric"]


class MeasuredConfig(_Model):
    """A measured material (`sim.objects.measured_files`), given by one of these files."""

    merl: Path | None = None
    bsdf: Path | None = None
    alta: Path | tuple[Path, Path, Path] | None = None
    """One file, or one file each for red, green and blue."""

    @property
    def alta_files(self) -> tuple[Path, ...]:
        return (self.alta,) if isinstance(self.alta, Path) else self.alta or ()

    @model_validator(mode="after")
    def _one_of_them(self) -> MeasuredConfig:
        paths = [path for path in (self.merl, self.bsdf, *self.alta_files) if path is not None]
        if sum(kind is not None for kind in (self.merl, self.bsdf, self.alta)) != 1:
            raise ValueError("expected one of `merl`, `bsdf` and `alta`")
        if not all(path.is_absolute() for path in paths):
            raise ValueError("expected an absolute path, as the world does not know from where the rig was read")
        return self


class MeshConfig(_Model):
    """One object: its mesh and its pose on the support (row-major 4x4)."""

    path: Path
    pictures_beside: Path | None = None
    """File beside which the textures of the mesh are; None: beside `path`."""
    unit: Literal["mm", "m", "um"]
    support_from_object: list[list[float]]
    material: MaterialConfig | SpecimenConfig | MeasuredConfig | None = None
    """Material that is multiplied by the mesh's own colours. None: only the mesh's own colours, or warm stone for
    a mesh without colours."""


class SceneConfig(_Model):
    """Geometry of the simulated cell; transforms are row-major 4x4."""

    leds: Path
    emission: Literal["lambertian", "paper"]
    base_from_support: list[list[float]]
    support_diameter_mm: float
    objects: list[MeshConfig]
    tool: list[ToolBody] = []
    """Bodies on the flange, which block light."""


class InterreflectionConfig(_Model):
    """Light from surface to surface, as in `sim.render.interreflection`."""

    bounces: Annotated[int, Field(ge=2, le=16)] = 4
    """Greatest number of surfaces that light meets."""
    rays: Annotated[int, Field(ge=4, le=4096)] = 128
    """Number of rays from each side of a patch."""


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
    """k1, k2, p1, p2, k3 of the Brown-Conrady model, in OpenCV's order and sign."""
    f_number: Annotated[float, Field(gt=0)] = 8.0
    samples_per_side: Annotated[int, Field(ge=1, le=8)] = 1
    """Rays through each pixel, k x k. Use several for targets whose corners are located to a fraction of a
    pixel."""
    blur: bool = False
    rim_radius: float = 3.0
    rim_shift: float = 4.0
    lateral_colour: tuple[float, float, float] = (0.0, 0.0, 0.0)
    sensor: SensorModel = SensorModel()
    sensor_temperature_c: float = 25.0
    """Temperature of the sensor. The settings from `blur` on are as in `sim.devices.camera_body.Settings`."""
    flange_from_camera: list[list[float]]
    nominal_exposure_us: int
    """The exposure at which white reaches `white_share` of full scale."""
    white_share: Annotated[float, Field(gt=0)] = WHITE_SHARE

    def true_sensor(self, seed: int) -> SensorModel:
        """The sensor with the rig's pattern, bit depth and black level; its seed depends on the world's."""
        return dataclasses.replace(
            self.sensor,
            bayer_pattern=self.bayer_pattern,
            bit_depth=self.bit_depth,
            black_dn=self.black_dn,
            seed=self.sensor.seed + seed - 1,
        )


class Settings(_Model):
    """The rig's `world.settings`: properties of the stand-ins, and faults."""

    speed: Annotated[float, Field(gt=0, le=1000)] = 1.0
    hurry_only_when_told: bool = False
    """True: the world runs at `speed` only while the controller announces that it only waits (dry runs), otherwise
    in real time."""
    seed: int = 1
    white_at_us: Annotated[int, Field(gt=0)] | None = None
    """The exposure at which white reaches a fixed share of full scale. None: the plan's exposure, so that every
    plan is exposed well. A camera that is calibrated must have this value; otherwise each plan has a camera of its
    own."""
    ledbox: LedBoxSettings = ledbox_firmware.Settings()
    robot: RobotSettings = kuka_controller.Settings()
    camera: CameraSettings = camera_server.Settings()
    faults: tuple[script.Fault, ...] = ()
    things: tuple[Thing, ...] = ()
    """Things on the support in addition to the plan's object."""
    shading: Literal["pixel", "flat"] = "pixel"
    """`pixel`: light and shadow on each pixel, with interreflection and blur. `flat`: one radiance for each
    triangle, without interreflection and blur. Both can be set separately."""
    interreflection: InterreflectionConfig | bool | None = None
    """Light from surface to surface. None: as `shading` determines."""
    arm_shadows: bool = True
    """True if arm and tool block light."""
    cables: tuple[ToolBody, ...] = ()
    """Capsules in the support frame that hang in the cell and block light. No plan and no rig knows of them."""
    material: MaterialConfig | SpecimenConfig | MeasuredConfig | None = None
    """Material of the plan's object, multiplied by its mesh's own colours. None: only the mesh's own colours, or
    warm stone."""
    detail: tuple[Layer, ...] = ()
    """Detail of the plan's object: texture, bumps and turned normals that its mesh does not have."""
    true_surface: Literal["plaque"] | None = None
    """The surface that was scanned for the plan's mesh: `sim.objects.plaque`, in the scan's frame, with its own
    materials. None: the mesh itself."""
    stickers: Stickers | None = None
    """Stickers on the plan's object."""
    leds: LedModel = STEADY
    """`{}`: realistic LEDs. Each has its own flux and colour, and depends on temperature and flickers."""
    dome: DomeErrors = DomeErrors()
    """Deviations of the dome from its table."""
    glare: Glare | None = None
    """Veiling glare of the camera. `{}` means 1 % of white; None means no glare."""
    strangers: Strangers = Strangers()
    """Causes for which no calibration has a term."""
    exposures_remembered: Annotated[int, Field(ge=0)] = 0
    """Number of newest exposures for which the world reports the true light on its control connection."""
    panels: tuple[Panel, ...] = ()
    """The flat white panels 1 to 4, which the camera may see. Without them a panel is uniform ambient light."""

    @property
    def light_between_surfaces(self) -> InterreflectionConfig | None:
        """Interreflection, or None if it is off."""
        if isinstance(self.interreflection, InterreflectionConfig):
            return self.interreflection
        is_enabled = self.shading == "pixel" if self.interreflection is None else self.interreflection
        return InterreflectionConfig() if is_enabled else None

    @model_validator(mode="after")
    def _possible(self) -> Settings:
        if self.detail and self.shading == "flat":
            raise ValueError("`detail` is finer than triangles: it needs `shading: pixel`")
        if self.true_surface is not None and (self.detail or self.material is not None):
            raise ValueError("`true_surface` has its own materials and detail: leave out `material` and `detail`")
        for fault in self.faults:
            if why := (
                impossible(fault, self.robot)
                or impossible_for_camera(fault, self.camera)
                or impossible_for_box(fault, self.ledbox)
            ):
                raise ValueError(why)
        if self.robot.kind == "ur" and self.strangers.arm != NO_STRANGER:
            raise ValueError("`strangers.arm` is for a KUKA: the world has no weights and gears of a UR")
        if self.robot.kind == "ur" and self.speed != 1.0:
            raise ValueError("a world with a robot of kind `ur` has speed 1: ur-rtde works in real time only")
        return self


class Config(_Model):
    """The complete configuration of a world."""

    settings: Settings
    scene: SceneConfig
    camera: CameraConfig
    tells_refusals: bool = False
    """True: stand-ins report their refusals on standard error, for clients that are not Coupole."""

    @property
    def rendered_camera(self) -> CameraConfig:
        """The camera as the renderer needs it: with the true lens, and the rays per pixel set in the rig."""
        true = {name: getattr(self.settings.camera, name) for name in _OF_THE_TRUE_CAMERA}
        if true["blur"] is None:
            true["blur"] = self.settings.shading == "pixel"
        return self.camera.model_copy(update=true)
