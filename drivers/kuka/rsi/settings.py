"""Settings of the RSI driver: some must match the controller's configuration, others belong to the motion."""

from __future__ import annotations

import socket
from ipaddress import IPv4Address
from typing import Literal, Self

import numpy as np
from numpy.typing import NDArray
from pydantic import BaseModel, ConfigDict, Field, PositiveFloat, model_validator

from coupole.devices import HostNeed
from coupole.kinematics import Arm, SphericalWrist, slowed_arm, structure_of
from coupole.supervision import ATTENTION_S
from drivers.arm_motion import farthest_stop_deg
from drivers.host_checks import own_address
from drivers.kuka.rsi.corrections import TAGS
from drivers.kuka.rsi.realtime import how_to_give_the_right, may_be_realtime
from drivers.senders import only_here, refuse_anybody

_TAG = r"^[A-Za-z_]\w*$"


class Settings(BaseModel):
    """Settings of the driver in the rig file."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    arm_model: Arm
    """The arm that the controller moves. The rig provides it."""
    listen: str = Field(default="0.0.0.0:49152", pattern=r"^[^:]+:\d+$")
    """host:port to bind. The controller's RSI configuration names it (IP_NUMBER, PORT)."""
    controller: Literal[""] | IPv4Address = ""
    """The controller's address in the RSI network. Packets from any other address are ignored and counted. It may
    be left out only if no other machine can send (`listen` on loopback), or if `any_controller_by` names a person.
    The first sender of an answerable packet then counts as the controller, until the driver is closed."""
    any_controller_by: str = Field(default="", max_length=60)
    """Person who has decided that the first sender counts as the controller."""
    without_realtime_by: str = Field(default="", max_length=60)
    """Person who has decided that this machine may answer at normal priority. Without this entry, and without the
    right to real-time priority, a controller on the network is not answered."""
    cycle_ms: Literal[4, 12] = 4
    """Cycle: 4 for #IPO_FAST, 12 for #IPO. It is compared with the arrival of the packets before the first
    motion."""
    declared_cycle_ms: float | None = Field(default=None, gt=0)
    """Cycle of a simulated controller whose world waits for answers, or runs at another speed than the machine's
    clock. This cycle is compared instead of the arrival of packets. The world provides it. A controller that does
    not call itself simulated is measured."""
    sen_type: str = Field(default="ImFree", pattern=r"^[\w.-]+$")
    """SENTYPE of the controller's RSI configuration."""
    measured_tag: str = Field(default="AIPos", pattern=_TAG)
    delay_tag: str = Field(default="Delay", pattern=_TAG)
    correction_tag: str = Field(default="", pattern=_TAG + "|^$")
    """Element of the corrections. Empty means AKorr for axes, RKorr for the pose."""
    stop_tag: str = Field(default="Stop", pattern=_TAG + "|^$")
    """The element that ends the controller's program when the driver is closed. Empty means none; the controller
    then ends the program with an error when no more answers come."""
    corrects: Literal["axes", "pose"] = "axes"
    """Quantity that the controller corrects: axes (AXISCORR) or the flange's pose (POSCORR). In both cases motions
    are straight in joint space. Motions on which the pose does not determine the axes are refused."""
    mode: Literal["absolute", "relative"] = "absolute"
    """Mode as in RSI_ON: corrections count from where RSI was started, or are summed from cycle to cycle."""
    axis_correction_deg: tuple[PositiveFloat, ...] | None = Field(default=None, min_length=6, max_length=6)
    """Largest distance of each axis from the start of RSI: MaxA1 to MaxA6 of the context's AXISCORRMON. The
    controller stops RSI beyond it, so a target there is refused. Without it, each axis has its whole range."""
    pose_correction_mm: float = Field(default=2300.0, gt=0)
    pose_correction_deg: float = Field(default=180.0, gt=0, le=180)
    """The same for corrections of the pose: MaxTrans and MaxRotAngle of POSCORRMON. The defaults allow the arm's
    whole reach, and any rotation."""
    singularity_margin_deg: float = Field(default=5.0, gt=0, lt=45)
    """Least angle of wrist, elbow and shoulder from their singularities, for corrections of the pose."""
    link_timeout_s: float = Field(default=2.0, gt=0)
    """The link counts as lost after this silence (machine time). It must be longer than any pause of the simulated
    world."""
    connect_timeout_s: float = Field(default=10.0, gt=0)
    """Time-out for the first packets, in machine time."""
    delay_limit: int = Field(default=50, ge=1)
    """Value of the delay counter at which the motion ends in a fault. It must be below the controller's own limit
    (100 as shipped)."""
    delay_counts: Literal["cumulative", "consecutive"] = "cumulative"
    """Way in which the controller counts late answers. `cumulative`: all of a session, so that a decrease means
    that RSI was restarted. `consecutive`: late answers in a row; an answer in time sets the counter to 0."""
    unaccounted_s: float = Field(default=0.1, ge=0)
    """The session ends if the controller is silent for this time and its IPOC does not count the silence. 0: no
    silence ends it."""
    speed_fraction: float = Field(default=0.5, gt=0, le=1)
    """Fraction of the axes' highest speeds."""
    acceleration_deg_s2: float = Field(default=300.0, gt=0)
    jerk_deg_s3: float = Field(default=3000.0, gt=0)
    settle_deg: float = Field(default=0.003, gt=0)
    settle_deg_s: float = Field(default=0.1, gt=0)
    settle_cycles: int = Field(default=10, ge=1)
    """The arm is settled if it is within both tolerances for this many cycles, and again after the dwell."""
    attention_s: float = Field(default=ATTENTION_S, gt=0, le=0.5)
    """A motion ends if nobody has looked at it for this time, machine time (`coupole.supervision`). Use a longer
    time only for a simulated cell on a machine that is busy with other work."""
    dwell_s: float = Field(default=0.1, ge=0)
    follow_deg: float = Field(default=1.0, gt=0)
    follow_lag_s: float = Field(default=0.06, ge=0)
    follow_cycles: int = Field(default=10, ge=1)
    """The arm does not follow if it is farther from the commanded axes than `follow_deg` plus `follow_lag_s` times
    the commanded speed, for this many cycles."""

    @model_validator(mode="after")
    def _controller_is_named(self) -> Self:
        refuse_anybody(self.listen, self.controller, self.any_controller_by)
        return self

    @model_validator(mode="after")
    def _pose_is_known(self) -> Self:
        """Check that the pose is known: the answering process computes poses with the formula of a spherical wrist
        and KUKA's flange."""
        standard = np.allclose(self.wrist.opw_from_flange, np.eye(4), rtol=0.0, atol=1e-9)
        if self.corrects == "pose" and not standard:
            raise ValueError(
                f"corrections of the pose need a flange like KUKA's, with its z axis along "
                f"axis 6, not the flange of "
                f"{self.arm_model.name}; set `corrects: axes`"
            )
        return self

    def host_needs(self) -> list[HostNeed]:
        """Needs of this machine, for `coupole doctor`."""
        needs = own_address(self.listen, kind=socket.SOCK_DGRAM)
        if not only_here(self.listen):
            has_right = may_be_realtime()
            needs.append(
                HostNeed(
                    "real-time priority",
                    has_right,
                    "this user has the right" if has_right else "this user lacks the right (SCHED_FIFO)",
                    how_to_give_the_right(),
                    is_vital=not self.without_realtime_by,
                )
            )
        return needs

    @property
    def wrist(self) -> SphericalWrist:
        """The arm's lengths. Raises ValueError for an arm without a spherical wrist."""
        structure = structure_of(self.arm_model)
        if not isinstance(structure, SphericalWrist):
            raise ValueError(  # noqa: TRY004  pydantic adds the field's name to a ValueError only
                f"expected an arm with a spherical wrist, as KUKA's have; {self.arm_model.name} has none"
            )
        return structure

    def arm(self) -> Arm:
        """The arm with the speeds of this driver. Preflight computes durations with it."""
        return slowed_arm(
            self.arm_model,
            speed_fraction=self.speed_fraction,
            acceleration_deg_s2=self.acceleration_deg_s2,
            jerk_deg_s3=self.jerk_deg_s3,
        )

    @property
    def most_correction_deg(self) -> tuple[float, ...]:
        """`axis_correction_deg`, or each axis' whole range."""
        return self.axis_correction_deg or tuple(high - low for low, high in self.arm_model.limits_deg)

    @property
    def tag(self) -> str:
        """The element that carries the corrections."""
        return self.correction_tag or TAGS[self.corrects]

    def stopping_deg(self) -> NDArray[np.float64]:
        """Largest further turn of each axis after a stop (`farthest_stop_deg`). The delay is two cycles until the
        command is taken, one until its answer is applied, and the lag of the arm behind its command."""
        delay_s = 3.0 * self.cycle_ms / 1e3 + self.follow_lag_s
        return farthest_stop_deg(self.arm().velocity_deg_s, self.acceleration_deg_s2, self.jerk_deg_s3, delay_s)
