"""Settings of the stand-in for a KUKA controller that runs an RSI program."""

from __future__ import annotations

from typing import Annotated, Literal

from pydantic import BaseModel, ConfigDict, Field

Six = tuple[float, float, float, float, float, float]
Three = tuple[float, float, float]

_TAG = r"^[A-Za-z_]\w*$"


class _Model(BaseModel):
    model_config = ConfigDict(frozen=True, extra="forbid")


class Box(_Model):
    """A workspace ($WORKSPACE) with edges along the base's axes."""

    kind: Literal["box"] = "box"
    min_mm: Three
    max_mm: Three
    stops: Literal["inside", "outside"]
    """The region that the flange must not enter."""


class Sphere(_Model):
    """A spherical workspace."""

    kind: Literal["sphere"] = "sphere"
    centre_mm: Three
    radius_mm: float = Field(gt=0)
    stops: Literal["inside", "outside"]


Workspace = Annotated[Box | Sphere, Field(discriminator="kind")]


class Limits(_Model):
    """Objects of the RSI context that limit corrections, counted from where RSI was started. AXISCORR and POSCORR
    clamp without a message; the monitors stop RSI. The defaults are those of `configs/kuka/rsi/context.md`."""

    axis_clamp_deg: Six = (341.0, 236.0, 277.0, 371.0, 241.0, 701.0)
    axis_monitor_deg: Six = (340.0, 235.0, 276.0, 370.0, 240.0, 700.0)
    pose_clamp_mm: float = Field(default=2301.0, gt=0)
    """Clamp for each coordinate."""
    pose_clamp_deg: float = Field(default=180.0, gt=0)
    pose_monitor_mm: float = Field(default=2300.0, gt=0)
    """Limit for the distance."""
    pose_monitor_deg: float = Field(default=180.0, gt=0)


class Settings(_Model):
    """Settings of the stand-in in the rig's world."""

    kind: Literal["rsi"] = "rsi"
    sends_to: str = Field(default="127.0.0.1:49152", pattern=r"^[^:]+:\d+$")
    cycle_ms: Literal[4, 12] = 4
    ipoc_step: int = Field(default=0, ge=0)
    """Increment of the IPOC. 0 means the cycle in ms, as on real controllers."""
    sen_type: str = "ImFree"
    """SENTYPE: answers of another type are ignored."""
    measured_tag: str = Field(default="AIPos", pattern=_TAG)
    delay_tag: str = Field(default="Delay", pattern=_TAG + "|^$")
    """Name of the counter of late answers. If the name is empty, the counter is not sent."""
    correction_tag: str = Field(default="", pattern=_TAG + "|^$")
    """Element of the corrections. Empty means AKorr for axes, RKorr for the pose."""
    stop_tag: str = Field(default="Stop", pattern=_TAG + "|^$")
    """The element that ends the RSI program. If the name is empty, there is no such element."""
    sends_pose: bool = False
    """Packets also carry RIst, the flange's pose."""

    corrects: Literal["axes", "pose"] = "axes"
    mode: Literal["absolute", "relative"] = "absolute"
    hold_on: bool | None = None
    """HOLDON of the corrections: in a cycle without an answer, the last correction is kept, otherwise zero is
    applied. None selects the right value for the mode: on for absolute, off for relative.
    """
    limits: Limits = Limits()

    lock_step: bool = True
    answer_limit_s: float = Field(default=2.0, gt=0)
    """Longest pause of the world for an answer in lock-step, in machine time. After this pause the client counts
    as gone.
    """
    delay_limit: int = Field(default=100, ge=1)
    """Number of late answers at which RSI stops with KSS29002."""
    delay_counts: Literal["cumulative", "consecutive"] = "cumulative"
    """Way of counting late answers. It is not known which of the two ways real controllers use."""
    packets_after_estop_s: float = Field(default=0.5, ge=0)
    restart_s: float = Field(default=1.0, gt=0)
    """World time from a lost link until the RSI program runs and sends again."""

    start_joints_deg: Six = (0.0, -90.0, 90.0, 0.0, 90.0, 0.0)
    brake_deg_s2: float = Field(default=1000.0, gt=0)
    """Deceleration of the axes when the controller itself stops them."""
    acceleration_limit_deg_s2: float | None = Field(default=None, gt=0)
    jerk_limit_deg_s3: float | None = Field(default=None, gt=0)
    """Limits of the corrections' demands; None: no limit. The limits of real controllers are not published."""
    on_excess: Literal["fault", "clamp"] = "fault"
    """Reaction beyond those two limits: RSI stops, or the axes are limited and lag behind. Too high a speed always
    stops RSI."""
    workspaces: tuple[Workspace, ...] = ()
    vibration_deg: float = Field(default=0.0, ge=0)
    """Initial amplitude of the damped vibration of every moved axis after a stop."""
    vibration_hz: float = Field(default=12.0, gt=0)
    vibration_decay_s: float = Field(default=0.15, gt=0)

    seed: int = 0
    repeatability_um: float = Field(default=10.0, ge=0)
    repeatability_deg: float = Field(default=0.001, ge=0)
    """Standard deviation, per coordinate, of the error that varies from stop to stop."""
    absolute_mm: float = Field(default=0.0, ge=0)
    absolute_deg: float = Field(default=0.0, ge=0)
    """Standard deviation, over arms, of the constant error: see `PoseErrors`."""
