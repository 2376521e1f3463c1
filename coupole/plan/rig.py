"""The rig as its YAML file describes it: devices, geometry and limits.

Lengths are in mm, angles in degrees; poses are in the robot's base frame unless their names say otherwise.
"""

from __future__ import annotations

from typing import Annotated, Any, Literal

from pydantic import AfterValidator, Field, model_validator

from coupole.plan.arm_description import ArmDescription
from coupole.plan.base_model import Degrees, FilePath, Length, Model, Name, Pose, Vector, Words
from coupole.plan.registry import WORLD, current_name
from coupole.plan.watch import WatchLimits

DriverName = Annotated[str, Field(pattern=r"^[A-Za-z_][\w.]*:[A-Za-z_]\w*$"), AfterValidator(current_name)]
"""`package.module:Class`. Names of version 0.1 are understood."""


Posture = tuple[Degrees, Degrees, Degrees, Degrees, Degrees, Degrees]
OnTimeUs = Annotated[int, Field(ge=1, le=60_000_000)]


class Twin(Model):
    """The simulated counterpart that `--dry-run` opens in a device's place."""

    driver: DriverName
    """Class of the counterpart's driver."""
    settings: dict[str, Any] = Field(default_factory=dict)
    """Settings that the driver needs."""


class Device(Model):
    """A driver and its settings. On a simulated rig the world's endpoint fills in the address."""

    driver: DriverName
    """Class of the driver."""
    settings: dict[str, Any] = Field(default_factory=dict)
    """Settings that the driver needs: address, limits."""
    twin: Twin | None = None
    """Driver that `--dry-run` opens in the device's place. Without it, a stand-in of the same kind is opened."""


class Sensor(Model):
    """Format of the camera's frames. It is compared with the camera's report when the camera is opened."""

    width_px: Annotated[int, Field(ge=8, le=65536)]
    """Width of a frame."""
    height_px: Annotated[int, Field(ge=8, le=65536)]
    """Height of a frame."""
    pixel_pitch_um: Annotated[float, Field(gt=0, le=1000)]
    """Distance from pixel to pixel on the sensor."""
    bit_depth: Annotated[int, Field(ge=8, le=16)] = 12
    """Bits of a pixel."""
    bayer_pattern: Literal["GBRG", "GRBG", "RGGB", "BGGR", "MONO"] = "GBRG"
    """Colours of the 2 x 2 pixels from the top left; MONO without colours."""
    black_dn: Annotated[int, Field(ge=0, le=65535)] = 64
    """Value of a pixel without light."""
    max_frames_per_s: Annotated[float, Field(ge=0.001, le=100_000)] = 100.0
    """Frame rate that the camera and its link can sustain."""
    exposure_gap_us: Annotated[int, Field(ge=0, le=10_000_000)] = 100
    """Least time between the end of one exposure and the start of the next."""

    @model_validator(mode="after")
    def _black_below_white(self) -> Sensor:
        if self.black_dn >= self.white_dn:
            raise ValueError(f"a black level below the highest value of {self.bit_depth} bits, {self.white_dn}")
        return self

    @property
    def white_dn(self) -> int:
        return (1 << self.bit_depth) - 1


class Lens(Model):
    focal_length_mm: Annotated[float, Field(gt=0, le=5000)]
    """Focal length from the maker's data."""
    f_number: Annotated[float, Field(gt=0, le=1000)]
    """F-number to which the lens's aperture is set."""
    focus_distance_mm: Length
    """Distance from the projection centre to the plane of best focus."""

    @model_validator(mode="after")
    def _makes_an_image(self) -> Lens:
        if self.focus_distance_mm <= self.focal_length_mm:
            raise ValueError("a focus distance longer than the focal length, because otherwise there is no image")
        return self


class WhiteResponse(Model):
    """Response of the camera's pictures to a white diffuser that faces the light, measured with a lux meter."""

    dn_per_lux_s: Annotated[float, Field(gt=0, le=1e9)]
    """Value above black, per lux and second of exposure, in the most sensitive channel, at gain 0 dB."""
    f_number: Annotated[float, Field(gt=0, le=1000)]
    """F-number with which the response was measured. The response is not valid at another f-number."""


class Dome(Model):
    """The LEDs: a CSV with columns id, board, x_mm, y_mm, z_mm, nx, ny, nz (base frame), flux_lm."""

    leds: FilePath
    """The table of LEDs, relative to the rig."""
    emission: Literal["lambertian", "paper"] = "lambertian"
    """Fall-off of an LED's light with the angle: a cosine (`lambertian`), or the cosine twice (`paper`)."""
    panel_lux: Annotated[float, Field(ge=0, le=1e6)] = 0.0
    """Illuminance at the support's centre with one flat panel on. It is used for the light dose."""
    spectrum: FilePath | None = None
    """Relative spectral power of the LEDs (CSV: nm, power). It is used for the radiant exposure weighted by
    damage."""
    panel_spectrum: FilePath | None = None
    """Relative spectral power of the panels, in the form of `spectrum`."""


class BoardThermal(Model):
    """First-order thermal model of an LED board. Each joule heats the board; it cools with one time constant."""

    led_power_w: Annotated[float, Field(gt=0, le=10_000)] = 15.0
    """Heat of a lit LED."""
    rise_c_per_j: Annotated[float, Field(gt=0, le=1000)] = 0.02
    """Temperature rise of the board for each joule."""
    time_constant_s: Annotated[float, Field(ge=0.001, le=1e6)] = 240.0
    """Time constant of the board's cooling."""
    ambient_c: Annotated[float, Field(ge=-50, le=100)] = 22.0
    """Temperature of a board that was dark for a long time."""
    limit_c: Annotated[float, Field(ge=-50, le=1000)] = 70.0
    """Highest temperature of a board that preflight allows."""


class LedLimits(Model):
    """Limits of LEDs and boards. The box also enforces its own limits."""

    on_us: tuple[OnTimeUs, OnTimeUs] = (1_000, 2_000_000)
    """Shortest and longest time for which an LED may be lit."""
    rise_us: Annotated[int, Field(ge=0, le=10_000_000)] = 1_000
    """Time from switching on to full current. The trigger waits for this time."""
    cooldown_ratio: Annotated[float, Field(ge=0, le=100_000)] = 2.0
    """Ratio for the dark time: an LED that was lit for t stays dark for at least `cooldown_ratio` * t."""
    board: BoardThermal = BoardThermal()
    """Thermal model of the boards."""

    @model_validator(mode="after")
    def _shortest_first(self) -> LedLimits:
        if self.on_us[0] > self.on_us[1]:
            raise ValueError("the shortest on-time first")
        return self


class Motion(Model):
    """Motion between views: share of the joint speeds, acceleration, jerk, and settling."""

    speed_fraction: Annotated[float, Field(ge=0.001, le=1)] = 0.3
    """Share of the joints' greatest speeds."""
    acceleration_deg_s2: Annotated[float, Field(ge=0.01, le=100_000)] = 300.0
    """Greatest acceleration of each joint."""
    jerk_deg_s3: Annotated[float, Field(ge=0.01, le=10_000_000)] = 3000.0
    """Greatest jerk of each joint."""
    settle_dwell_s: Annotated[float, Field(ge=0, le=3600)] = 0.3
    """Time waited after the arm has come to rest."""
    still_deg: Annotated[float, Field(gt=0, le=10)] = 0.01
    """Largest change of an axis during a burst. If the change is larger, the shots that are not proven yet are
    taken again."""
    home_joints_deg: Posture = (
        0.0,
        -170.0,
        150.0,
        0.0,
        -70.0,
        0.0,
    )
    """Assumed start posture if a plan is checked without the arm."""
    park_joints_deg: Posture | None = None
    """Posture in which the arm is left when nobody works with it. Without it, the arm cannot be sent to park."""


class Support(Model):
    """The disk that carries the object, and the origin of the support frame."""

    base_from_support: Pose
    """Pose of the support frame (the disk's centre, z up) in the robot's base frame."""
    diameter_mm: Length = 1480.0
    """Diameter of the disk."""


class KeepOutSphere(Model):
    """A volume of the support frame that the flange must not enter."""

    kind: Literal["sphere"]
    """A ball."""
    name: Name
    """Name of the volume in messages."""
    center_mm: Vector
    """Centre of the ball in the support frame."""
    radius_mm: Length
    """Radius of the ball."""


class KeepOutBox(Model):
    kind: Literal["box"]
    """A box along the support frame's axes."""
    name: Name
    """Name of the volume in messages."""
    min_mm: Vector
    """Lowest corner, in the support frame."""
    max_mm: Vector
    """Highest corner, in the support frame."""

    @model_validator(mode="after")
    def _has_a_volume(self) -> KeepOutBox:
        if not all(low < high for low, high in zip(self.min_mm, self.max_mm, strict=True)):
            raise ValueError("`min_mm` below `max_mm` on each axis")
        return self


KeepOut = Annotated[KeepOutSphere | KeepOutBox, Field(discriminator="kind")]


class ToolBody(Model):
    """A body on the flange: a capsule in the flange's frame."""

    name: Name
    """Name of the body in messages and pictures."""
    from_mm: Vector
    """One end of the capsule's axis."""
    to_mm: Vector
    """Its other end."""
    radius_mm: Length
    """Radius of the capsule."""


class Clearances(Model):
    """Clearances of the arm, mm."""

    object_mm: Annotated[float, Field(ge=0, le=5000)] = 50.0
    """Least distance to the object."""
    support_mm: Annotated[float, Field(ge=0, le=5000)] = 10.0
    """Least distance to the disk."""
    dome_mm: Annotated[float, Field(ge=0, le=5000)] = 20.0
    """Least distance to the dome."""
    self_mm: Annotated[float, Field(ge=0, le=5000)] = 0.0
    """Least distance between parts of the arm."""
    keep_out_mm: Annotated[float, Field(ge=0, le=5000)] = 0.0
    """Least distance to the `keep_out` volumes."""


class Storage(Model):
    folder: FilePath
    """Folder for the runs, relative to the rig."""
    reserve_bytes: Annotated[int, Field(ge=0, le=2**60)] = 256 * 1024**2
    """Free space that a run leaves on the disk."""
    pixels: Literal["uint16", "packed12"] = "uint16"
    """Storage of pixels: two bytes each, or two pixels of at most 12 bits in three bytes."""
    state: FilePath | None = None
    """Folder for facts about the cell that do not depend on the acquisition, such as faults of the arm. It must be
    the same for all who use the cell. Default: `state` in `folder`."""


class Consoles(Model):
    """The consoles from which people work with the cell."""

    at_the_cell: Annotated[tuple[Words, ...], Field(max_length=100)] = ()
    """Addresses of consoles whose user sees the arm and can reach its emergency stop. The arm is moved by hand
    only from these addresses."""
    enabling_switch: bool = False
    """True if the LED box has an input for an enabling switch. Without the switch, the arm is then not moved from
    a console."""


class WorldSection(Model):
    """The stand-ins. Stand-ins are started with the rig (or only for dry runs); stand-ins that already run are
    used.
    """

    serves: Literal["always", "dry_run"] = "always"
    """Sessions that use the stand-ins: all, or only dry runs."""
    join: FilePath | None = None
    """File with the JSON line of a running `coupole sim`."""
    driver: DriverName = WORLD
    """Class of the stand-ins."""
    settings: dict[str, Any] = Field(default_factory=dict)
    """Settings that say which things the stand-ins simulate, and how."""


class Rig(Model):
    """One cell: devices, geometry, limits, storage."""

    schema_version: Literal[1]
    """Version of the format of rigs."""
    name: Name
    """Name of the rig in runs and reports."""
    ledbox: Device
    """The box that switches the LEDs."""
    camera: Device
    """The camera."""
    robot: Device
    """The arm's controller."""
    arm: FilePath | ArmDescription | None = None
    """The file that describes the arm, or the description itself. Default: the arm of the robot's driver."""
    sensor: Sensor
    """Format of the frames."""
    lens: Lens
    """The lens and its settings."""
    white_response: WhiteResponse | None = None
    """Response to white. Exposures cannot be judged without the camera if both this response and a record of the
    LEDs' power are missing."""
    flange_from_camera: Pose
    """Pose of the camera frame in the flange frame, from the drawing. A hand-eye record replaces it."""
    dome: Dome
    """The LEDs and panels."""
    support: Support
    """The disk under the object."""
    tool: Annotated[tuple[ToolBody, ...], Field(max_length=100)]
    """Camera, lens and cables: the bodies besides the arm that can collide."""
    link_meshes: FilePath | None = None
    """Folder of meshes (`base_link.stl`, `link_1.stl` to `link_6.stl`) that replace the capsules of the arm's
    links."""
    clearances: Clearances = Clearances()
    """Least distances of the arm."""
    keep_out: Annotated[tuple[KeepOut, ...], Field(max_length=1000)] = ()
    """Volumes that the arm must not enter."""
    led_limits: LedLimits = LedLimits()
    """Limits of LEDs and boards, such as the time for which an LED may be lit."""
    watch: WatchLimits = WatchLimits()
    """Figures of camera and LEDs from which the limits of a watched run follow."""
    motion: Motion = Motion()
    """Motion of the arm between views."""
    storage: Storage
    """Storage of the runs."""
    ledger: FilePath | None = None
    """Folder of the objects' dose ledgers. It must be the same for all rigs on which the objects are measured.
    Default: `coupole/ledger` in the user's data folder (XDG)."""
    controllers: FilePath | None = None
    """Folder of facts about controllers of arms, such as standing faults and commissioning. These facts do not
    depend on the rig that names the controller. Default: `coupole/controllers` in the user's data folder (XDG).
    """
    calibrations: Literal["none"] | tuple[FilePath, ...] = "none"
    """Records that must be in force for plans that list no records."""
    console: Consoles = Consoles()
    """The consoles at the cell."""
    world: WorldSection | None = None
    """The stand-ins of a simulated rig. A real rig has none."""
    licence: Words | None = None
    """Terms under which the data of its runs may be used, if the plan has none."""
    contact: Words | None = None
    """Person to ask about the data, if the plan names none."""

    @property
    def frame_bytes(self) -> int:
        """Size of a frame on the disk."""
        pixels = self.sensor.width_px * self.sensor.height_px
        return pixels * 3 // 2 if self.storage.pixels == "packed12" else pixels * 2
