"""Settings of the EKI driver: some must match the controller's configuration, others belong to the motion."""

from __future__ import annotations

import socket
from ipaddress import IPv4Address
from typing import Literal, Self

from pydantic import BaseModel, ConfigDict, Field, model_validator

from coupole.devices import HostNeed
from coupole.kinematics import Arm, slowed_arm
from drivers.host_checks import own_address
from drivers.senders import refuse_anybody


class Settings(BaseModel):
    """Settings of the driver in the rig file."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    arm_model: Arm
    """The arm that the controller moves. The rig provides it."""
    address: str = Field(default="172.31.1.147:54600", pattern=r"^[^:]+:\d+$")
    """host:port of the controller, or of this machine if the controller is the client."""
    controller_is: Literal["server", "client"] = "server"
    """Side of the controller. The server listens for the connection. EKI's own configuration (EXTERNAL/TYPE) names
    the opposite side."""
    controller: Literal[""] | IPv4Address = ""
    """The controller's address, if it is the client. Connections from any other address are refused and counted.
    (A controller that is the server is reached at `address`.) It may be left out only if no other machine can
    connect, or if `any_controller_by` names a person."""
    any_controller_by: str = Field(default="", max_length=60)
    """Person who has decided that the first client that connects counts as the controller."""
    status_ms: int = Field(default=20, ge=4)
    """Period of the controller's status messages, in controller time."""
    link_timeout_s: float = Field(default=2.0, gt=0)
    """The link counts as lost after this silence (machine time). It must be longer than any pause of the simulated
    world."""
    connect_timeout_s: float = Field(default=10.0, gt=0)
    """Time-out for the connection and for its first answer, in machine time."""
    speed_fraction: float = Field(default=0.5, gt=0, le=1)
    """Share of the axes' highest speeds. The controller takes whole percents, rounded down."""
    acceleration_deg_s2: float = Field(default=300.0, gt=0)
    full_acceleration_deg_s2: float = Field(default=600.0, gt=0)
    """Acceleration at $ACC_AXIS = 100 %. KUKA publishes no figure, so measure it. The controller takes whole
    percents, rounded down."""
    jerk_deg_s3: float = Field(default=3000.0, gt=0)
    """Assumed jerk of the controller's profile. It is used to compute durations; EKI cannot set it."""
    settle_deg: float = Field(default=0.003, gt=0)
    settle_deg_s: float = Field(default=0.1, gt=0)
    settle_cycles: int = Field(default=3, ge=1)
    """The arm is settled if it is within both tolerances for this many statuses, and again after the dwell."""
    dwell_s: float = Field(default=0.1, ge=0)
    follow_deg: float = Field(default=1.0, gt=0)
    follow_cycles: int = Field(default=3, ge=1)
    """The arm does not follow if the motion is done, but the arm is farther than `follow_deg` from the target for
    this many statuses."""

    @model_validator(mode="after")
    def _controller_can_be_checked(self) -> Self:
        if self.controller and self.controller_is == "server":
            raise ValueError("`controller` is for `controller_is: client`; a server is reached at `address`")
        if self.controller_is == "client":
            refuse_anybody(self.address, self.controller, self.any_controller_by)
        return self

    @model_validator(mode="after")
    def _percents_exist(self) -> Self:
        if not (self.velocity_percent() >= 1 and 1 <= self.acceleration_percent() <= 100):
            raise ValueError(
                f"speed is {self.velocity_percent()} % and acceleration {self.acceleration_percent()} % "
                f"of the controller's own highest values: both must be from 1 to 100 %"
            )
        return self

    def host_needs(self) -> list[HostNeed]:
        """Needs of this machine, for `coupole doctor`."""
        return own_address(self.address, kind=socket.SOCK_STREAM) if self.controller_is == "client" else []

    def velocity_percent(self) -> int:
        return int(round(100.0 * self.speed_fraction, 6))

    def acceleration_percent(self) -> int:
        return int(round(100.0 * self.acceleration_deg_s2 / self.full_acceleration_deg_s2, 6))

    def arm(self) -> Arm:
        """The arm with the speeds of this driver. Preflight computes durations with it."""
        return slowed_arm(
            self.arm_model,
            speed_fraction=self.velocity_percent() / 100.0,
            acceleration_deg_s2=self.acceleration_percent() / 100.0 * self.full_acceleration_deg_s2,
            jerk_deg_s3=self.jerk_deg_s3,
        )
