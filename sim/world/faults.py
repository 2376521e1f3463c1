"""Faults that can be caused in the world, and their moments: the rig's `faults:`.

A fault happens at power-on, `at_s` seconds of world time later, or when the box sends edge number `at_edge`
(counted from 0 at power-on; a dropped edge counts).
"""

from __future__ import annotations

from typing import Annotated, Literal

from pydantic import BaseModel, ConfigDict, Field, model_validator


class _Model(BaseModel):
    model_config = ConfigDict(frozen=True, extra="forbid")


Count = Annotated[int, Field(ge=0, lt=2**31)]
Seconds = Annotated[float, Field(ge=0, le=1e6)]
Offset = Annotated[float, Field(ge=-1000, le=1000)]
Place = Annotated[float, Field(ge=-1, le=2)]


class When(BaseModel):
    """Moment of a fault. Without a field it is power-on."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    at_edge: Count | None = None
    at_s: Seconds | None = None

    @model_validator(mode="after")
    def _one_moment(self) -> When:
        if self.at_edge is not None and self.at_s is not None:
            raise ValueError("at_edge or at_s, not both")
        return self


class DropTrigger(_Model):
    """The cable loses edge number `edge`."""

    kind: Literal["drop_trigger"]
    edge: Count


class DoubleTrigger(_Model):
    """Edge number `edge` bounces: a second pulse follows `delay_us` later."""

    kind: Literal["double_trigger"]
    edge: Count
    delay_us: Annotated[int, Field(ge=1, lt=2**31)] = 9_500


class LostTransfer(_Model):
    """Frame number `frame` (counted from 0 at power-on) is exposed but never reaches the host."""

    kind: Literal["lost_transfer"]
    frame: Count


class MuteBox(When):
    """The box continues its burst but neither answers nor receives, for `seconds` (None: for ever)."""

    kind: Literal["mute_box"]
    seconds: Annotated[float, Field(gt=0)] | None = None


class CutWire(When):
    """The box's serial line is unplugged."""

    kind: Literal["cut_wire"]


class UnplugCamera(When):
    """The camera's link is unplugged."""

    kind: Literal["unplug_camera"]


class CameraControlLoss(When):
    """The camera drops its controlling client, as after a brown-out, and stops."""

    kind: Literal["camera_control_loss"]


class OverTemperature(When):
    """An LED board reports a temperature above its limit."""

    kind: Literal["over_temperature"]
    board: Count


class DeadLed(When):
    """An LED that draws no current and gives no light, for `seconds` (None: for ever), as at a loose contact."""

    kind: Literal["dead_led"]
    led: Count
    seconds: Annotated[float, Field(gt=0)] | None = None


class StuckLed(When):
    """An LED that cannot be switched off once it is lit."""

    kind: Literal["stuck_led"]
    led: Count


class FlickeringLed(_Model):
    """An LED whose flux varies from flash to flash by `rms`."""

    kind: Literal["flickering_led"]
    led: Count
    rms: Annotated[float, Field(gt=0, le=1)] = 0.1


class DimLed(When):
    """An LED that has aged, or whose contact has become worse. It loses `loss` of its flux permanently."""

    kind: Literal["dim_led"]
    led: Count
    loss: Annotated[float, Field(gt=0, lt=1)] = 0.3


class Warming(When):
    """All LEDs change together, by `per_s` of their flux each second, as on boards that warm up."""

    kind: Literal["warming"]
    per_s: Annotated[float, Field(ge=-1, le=1)] = -0.01


class RoomLamp(When):
    """A lamp in the room is switched on (0: off): `lux` on everything that the camera sees."""

    kind: Literal["room_lamp"]
    lux: Annotated[float, Field(ge=0, le=1e6)] = 20.0


class Bump(When):
    """The plan's object (in the support frame), or the camera (in the base frame), is displaced by `mm`."""

    kind: Literal["bump"]
    what: Literal["object", "camera"] = "object"
    mm: tuple[Offset, Offset, Offset] = (0.2, 0.0, 0.0)


class Smudge(When):
    """A fingerprint or dust on the lens. Place and radius are shares of the picture's width, from its top left."""

    kind: Literal["smudge"]
    at: tuple[Place, Place] = (0.5, 0.4)
    radius: Annotated[float, Field(gt=0, le=1)] = 0.15
    transmission: Annotated[float, Field(ge=0, lt=1)] = 0.93


class ExposureStep(When):
    """The camera's gain or exposure changes by itself: all values above black by `factor`."""

    kind: Literal["exposure_step"]
    factor: Annotated[float, Field(gt=0, le=100)] = 1.1


class Hand(When):
    """A hand or a cloth between camera and object, for `seconds`; it sways by `sway` of the picture's width."""

    kind: Literal["hand"]
    seconds: Annotated[float, Field(gt=0, le=1e6)] = 0.3
    at: tuple[Place, Place] = (0.3, 0.4)
    radius: Annotated[float, Field(gt=0, le=1)] = 0.15
    brightness: Annotated[float, Field(ge=0, le=100)] = 0.8
    """Its brightness relative to the mean of the picture behind it."""
    sway: Annotated[float, Field(ge=0, le=1)] = 0.03


class EmergencyStop(When):
    """The robot's emergency stop is pressed."""

    kind: Literal["emergency_stop"]


class EnablingSwitch(When):
    """The enabling switch at the LED box's input is held, or released."""

    kind: Literal["enabling_switch"]
    held: bool


class LateRsi(When):
    """`cycles` answers in a row come too late for the robot's controller."""

    kind: Literal["late_rsi"]
    cycles: Annotated[int, Field(ge=1, lt=2**31)] = 200


class RsiLinkLoss(When):
    """The robot's controller sends no packets for `seconds`, then restarts its program."""

    kind: Literal["rsi_link_loss"]
    seconds: Annotated[float, Field(gt=0, le=1e6)] = 10.0


class NudgeArm(When):
    """A displacement of the arm by `deg` on every axis; after `seconds` it springs back (None: it stays)."""

    kind: Literal["nudge_arm"]
    deg: Annotated[float, Field(ge=-360, le=360)] = 0.05
    seconds: Annotated[float, Field(gt=0, le=1e6)] | None = None


Fault = Annotated[
    DropTrigger
    | DoubleTrigger
    | LostTransfer
    | MuteBox
    | CutWire
    | UnplugCamera
    | CameraControlLoss
    | OverTemperature
    | DeadLed
    | StuckLed
    | FlickeringLed
    | DimLed
    | Warming
    | RoomLamp
    | Bump
    | Smudge
    | ExposureStep
    | Hand
    | EmergencyStop
    | EnablingSwitch
    | LateRsi
    | RsiLinkLoss
    | NudgeArm,
    Field(discriminator="kind"),
]
