"""What can be made to go wrong in the world, and when: the rig's `faults:`.

A fault happens at once, `at_s` seconds of world time after power-on, or when the box sends edge number
`at_edge` (counted from 0 at power-on; an edge that is dropped counts).
"""

from __future__ import annotations

from typing import Annotated, Literal

from pydantic import BaseModel, ConfigDict, Field, model_validator


class _Model(BaseModel):
    model_config = ConfigDict(frozen=True, extra="forbid")


Count = Annotated[int, Field(ge=0)]


class When(BaseModel):
    """Moment of a fault; none of the two: from power-on."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    at_edge: Count | None = None
    at_s: Annotated[float, Field(ge=0)] | None = None

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
    delay_us: Annotated[int, Field(ge=1)] = 9_500


class LostTransfer(_Model):
    """Frame number `frame` (counted from 0 at power-on) is exposed but never reaches the host."""

    kind: Literal["lost_transfer"]
    frame: Count


class MuteBox(When):
    """The box runs on but neither answers nor listens."""

    kind: Literal["mute_box"]


class CutWire(When):
    """The box's serial line is pulled."""

    kind: Literal["cut_wire"]


class UnplugCamera(When):
    """The camera's link is pulled."""

    kind: Literal["unplug_camera"]


class CameraControlLoss(When):
    """The camera forgets who controls it, as after a brown-out, and stops."""

    kind: Literal["camera_control_loss"]


class OverTemperature(When):
    """An LED board reports more than its limit."""

    kind: Literal["over_temperature"]
    board: Count


class DeadLed(_Model):
    """An LED that draws no current and gives no light."""

    kind: Literal["dead_led"]
    led: Count


class StuckLed(When):
    """An LED that does not go out any more, once it is lit."""

    kind: Literal["stuck_led"]
    led: Count


class FlickeringLed(_Model):
    """An LED whose flux varies from flash to flash by `rms`."""

    kind: Literal["flickering_led"]
    led: Count
    rms: Annotated[float, Field(gt=0, le=1)] = 0.1


class EmergencyStop(When):
    """Somebody hits the robot's red button."""

    kind: Literal["emergency_stop"]


class LateRsi(When):
    """`cycles` answers in a row come too late for the robot's controller."""

    kind: Literal["late_rsi"]
    cycles: Annotated[int, Field(ge=1)] = 200


class RsiLinkLoss(When):
    """The robot's controller sends no packets for `seconds`, then starts its program again."""

    kind: Literal["rsi_link_loss"]
    seconds: Annotated[float, Field(gt=0)] = 10.0


class NudgeArm(When):
    """Something pushes the arm by `deg` on every axis; after `seconds` it springs back (none: it stays there)."""

    kind: Literal["nudge_arm"]
    deg: float = 0.05
    seconds: Annotated[float, Field(gt=0)] | None = None


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
    | EmergencyStop
    | LateRsi
    | RsiLinkLoss
    | NudgeArm,
    Field(discriminator="kind"),
]
