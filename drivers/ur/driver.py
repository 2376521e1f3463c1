"""A Universal Robots arm over ur-rtde: `coupole.devices.Robot`.

A separate process (`drivers.ur.worker`) runs the library and talks to the controller. This class queries it, and
takes the age of its answers from the controller's timestamp. In the cell: power the arm, release its brakes,
switch to remote control, then open this driver. The controller shapes the motion (movej: a trapezoidal speed
profile of the leading joint), so no jerk can be set.

Poses are the controller's own `actual_TCP_pose`, without the tool offset that was read at opening. The controller
knows the arm's factory calibration; nominal DH parameters differ from it by millimetres.
"""

from __future__ import annotations

import contextlib
import math
from collections.abc import Callable, Mapping
from dataclasses import fields, replace
from typing import Literal

import numpy as np
from numpy.typing import NDArray
from pydantic import BaseModel, ConfigDict, Field

from coupole import geometry
from coupole.clock import Clock, Deadline
from coupole.devices import ArmCondition, ArmState, HostNeed, Identity
from coupole.errors import ArmUnattended, DeviceLost, DeviceRefused
from coupole.kinematics import Arm
from coupole.supervision import ATTENTION_S, LOOK_S, Attention
from drivers.arm_motion import (
    MessageTime,
    StateReader,
    checked_speed,
    checked_target,
    overtaken,
    refusal,
    wait_for,
)
from drivers.fair_lock import FairLock
from drivers.host_checks import package
from drivers.opening import closed_on_failure
from drivers.ur.messages import (
    BACKDRIVE,
    EMERGENCY_STOP_BITS,
    PROTECTIVE_STOP_BIT,
    ROBOT_MODES,
    RUNNING,
    SAFEGUARD_STOP_BIT,
    Ask,
    Config,
    Six,
    State,
)
from drivers.ur.process import UrProcess, raise_fault

_POLL_S = 0.008


class Settings(BaseModel):
    """Settings of the driver in the rig file. Angles are joint angles. Speeds are those of the leading joint."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    host: str = Field(min_length=1)
    """Address of the controller; the ports are fixed by UR (29999, 30003, 30004)."""
    model: str = Field(default="ur10e", pattern=r"^ur\d+e?$")
    """Model of the arm; the controller must report the same, with or without the e."""
    arm_model: Arm | None = None
    """The arm as described in the rig. It is used for planning; this driver does not use it to move."""
    limits_deg: tuple[tuple[float, float], ...] = Field(default=((-360.0, 360.0),) * 6, min_length=6, max_length=6)
    """Lowest and highest angle of each joint; narrower than the arm's own limits if the cell requires it."""
    joint_speed_deg_s: float = Field(default=120.0, gt=0, le=179.9)
    """Highest speed of every joint: 120 for the UR10e, 179.9 for the UR3e and UR5e."""
    speed_fraction: float = Field(default=0.5, gt=0, le=1)
    acceleration_deg_s2: float = Field(default=80.0, gt=0, le=2000)
    stop_deg_s2: float = Field(default=300.0, gt=0, le=2000)
    """Deceleration of `stop`."""
    frequency_hz: float = Field(default=125.0, ge=10, le=500)
    """Rate of the controller's samples."""
    watchdog_s: float = Field(default=0.1, ge=0.05, le=0.5)
    """The controller ends all motion after this time without a message from the host's process."""
    attention_s: float = Field(default=ATTENTION_S, gt=0, le=0.5)
    """A motion ends if nobody has looked at it for this time, machine time (`coupole.supervision`). Use a longer
    time only for a simulated cell on a machine that is busy with other work."""
    link_timeout_s: float = Field(default=1.0, gt=0)
    """The link counts as lost after this time without a sample from the controller."""
    connect_timeout_s: float = Field(default=20.0, gt=0)
    """Time-out for opening, in machine time."""
    settle_deg: float = Field(default=0.02, gt=0)
    settle_deg_s: float = Field(default=0.1, gt=0)
    settle_samples: int = Field(default=10, ge=1)
    """The arm is settled if it is within both tolerances for this many samples, and again after the dwell."""
    dwell_s: float = Field(default=0.1, ge=0)
    follow_deg: float = Field(default=1.0, gt=0)
    follow_samples: int = Field(default=10, ge=1)
    """The arm does not follow if it is farther than `follow_deg` from the controller's target joints for this many
    samples."""

    def host_needs(self) -> list[HostNeed]:
        """Needs of this machine, for `coupole doctor`."""
        return [package("rtde_control", "ur")]

    def arm(self) -> Arm | None:
        """The arm with the limits and speeds of this driver. Preflight computes durations with it. Speed profiles
        are trapezoids of the leading joint, so the jerk is unlimited."""
        if self.arm_model is None:
            return None
        limits_deg = zip(self.limits_deg, self.arm_model.limits_deg, strict=True)
        return replace(
            self.arm_model,
            limits_deg=tuple((max(a[0], b[0]), min(a[1], b[1])) for a, b in limits_deg),
            velocity_deg_s=(self.speed_deg_s,) * 6,
            acceleration_deg_s2=(self.acceleration_deg_s2,) * 6,
            jerk_deg_s3=(math.inf,) * 6,
        )

    @property
    def speed_deg_s(self) -> float:
        return self.joint_speed_deg_s * self.speed_fraction

    @property
    def stop_s(self) -> float:
        """Longest time from full speed to rest."""
        return self.speed_deg_s / self.stop_deg_s2


class UrRobot:
    """See `coupole.devices.Robot`. After a fault it refuses to move: close it and open it again."""

    def __init__(self, settings: Settings, clock: Clock) -> None:
        """Start ur-rtde's program on the controller; the arm does not move.

        Raises DeviceFault if the controller is in a fault or in local control, DeviceRefused if a program runs
        there, DeviceLost if it cannot be reached, DeviceTimeout if the library hangs.
        """
        self.settings = settings
        self._clock = clock
        self._message_time = MessageTime(clock)
        self._number = 0
        self._asking = FairLock()
        """Held while the process is asked and answers, because any thread may call `stop`."""
        self._stops = 0
        self._motion_s = 0.0
        self._attention = Attention()
        self._lapses = 0
        """Number of lapses that the process had counted when the last motion began."""
        config = {field.name: getattr(settings, field.name) for field in fields(Config)}
        self._process = UrProcess(Config(**config))
        with closed_on_failure(self.close):
            self._last = self._process.first_state(settings.connect_timeout_s)
            raise_fault(self._last)
            self._check_model(self._last.model)

    def _check_model(self, reported_model: str) -> None:
        """Check the arm model, because plans are computed for one model. The dashboard calls a UR10e `UR10`."""
        if reported_model.lower().removesuffix("e") != self.settings.model.removesuffix("e"):
            raise DeviceRefused(
                "robot",
                expected=f"a {self.settings.model.upper().replace('E', 'e')}, as the rig has it",
                happened=f"the controller says that it moves a {reported_model}",
                remedy="Correct `model` in the robot's settings, and `arm`, if the rig names one",
            )

    def identify(self) -> Identity:
        last = self._last
        return Identity(
            vendor="Universal Robots",
            model=last.model,
            serial=last.serial,
            firmware=last.firmware,
            simulated="simulated" in last.firmware,
        )

    def self_test(self) -> Mapping[str, str]:
        state = self._state()
        raise_fault(state)
        joints = ", ".join(f"{angle:.3f}" for angle in state.joints_deg)
        x_mm, y_mm, z_mm = (1e3 * v for v in state.tcp_offset_m_rad[:3])
        return {
            "joints": f"{joints} deg",
            "tool offset": f"{x_mm:.2f}, {y_mm:.2f}, {z_mm:.2f} mm",
            "speed slider": f"{100 * state.speed_fraction:.0f} %",
        }

    def move_to(self, joints_deg: NDArray[np.float64], speed: float = 1.0) -> None:
        """Start movej; a moving arm is first brought to rest. Raises DeviceRefused for a target out of limits."""
        stops, speed = self._stops, checked_speed(speed)
        target_deg = checked_target(joints_deg, self.settings.limits_deg)
        state = self._command("move", target_deg, stops, speed)
        self._lapses = state.lapses
        raise_fault(state)
        if state.speed_fraction <= 0.0:
            raise refusal("a speed slider above 0 %", "it is at 0 %: the arm will not move")
        turn_deg = float(np.max(np.abs(np.subtract(target_deg, state.joints_deg))))
        # A moving arm brakes first, and may turn away from the target while it does.
        turn_deg += self.settings.speed_deg_s * self.settings.stop_s
        self._motion_s = _movej_s(self.settings, turn_deg) / speed / state.speed_fraction + self._rest_s()

    def wait_settled(self) -> ArmState:
        settings, number = self.settings, self._number
        settle_s = settings.settle_samples / settings.frequency_hz
        deadline = Deadline(self._clock, 1.5 * self._motion_s + settle_s + settings.dwell_s + 1.0)
        self._wait(lambda state: self._is_settled(state, number), deadline, "the arm at its target and still")
        self._clock.sleep(settings.dwell_s)
        self._wait(lambda state: self._is_settled(state, number), deadline, "the arm still after the dwell")
        return self.measured()

    def measured(self) -> ArmState:
        """Raises DeviceLost if the last sample is older than `link_timeout_s`."""
        state = self._state()
        return ArmState(
            joints_deg=state.joints_deg,
            base_from_flange=_transform(state.tcp_pose_m_rad)
            @ geometry.inverse(_transform(state.tcp_offset_m_rad)),
            t_ns=self._message_time.since_ns(state.samples),
            moving=state.still_samples < self.settings.settle_samples,
            fault=state.fault,
            condition=_condition(state),
            unattended_s=self._attention.longest_gap_s() if state.lapses != self._lapses else 0.0,
        )

    def stop(self) -> None:
        """Brake and wait until the arm is at rest; raises DeviceTimeout if it does not come to rest.

        If the link is lost, it sends nothing, because the controller's watchdog has then stopped the arm.
        """
        with contextlib.suppress(DeviceLost):
            self._command("stop")
            deadline = Deadline(self._clock, 2.0 * self._rest_s() + 1.0)
            self._wait(self._is_still, deadline, "the arm at rest", faults=False)

    def stopping_deg(self) -> NDArray[np.float64]:
        """Largest angle that each joint [6] can turn after a stop command. It is the leading joint's speed, which
        no joint exceeds, times the sum of the delay before stopj and half the braking time. The delay is six
        samples: three for a library call in progress, three for the answer to stopj.
        """
        settings = self.settings
        delay_s = 6.0 / settings.frequency_hz
        return np.full(6, settings.speed_deg_s * (delay_s + 0.5 * settings.stop_s))

    def statistics(self) -> Mapping[str, float]:
        """Return figures of the process's latest answer, even if the process is lost."""
        with contextlib.suppress(DeviceLost):
            self._state()
        state = self._last
        return {
            "samples": state.samples,
            "max_gap_ms": 1e3 * state.max_gap_s,
            "max_call_ms": 1e3 * state.max_call_s,
            "speed_slider": state.speed_fraction,
        }

    def close(self) -> None:
        """Bring the arm to rest, end the controller's program and the process. Safe to call again."""
        with self._asking:
            self._stops += 1
            self._process.close()

    def _command(
        self, verb: Literal["move", "stop"], target_deg: Six | None = None, stops: int = 0, speed: float = 1.0
    ) -> State:
        """Send a command and return the state. `stops` is the number of stop commands that had been given when the
        call of a motion began."""
        with self._asking:
            if verb == "stop":
                self._stops += 1
            elif self._stops != stops:  # another thread has stopped the arm since that call began
                raise overtaken()
            self._number += 1
            if verb == "move":
                self._attention.begin()
            return self._process.ask(Ask(verb, self._number, target_deg, speed))

    def _state(self) -> State:
        with self._asking:
            self._last = self._process.ask(Ask("state", looks=self._attention.look() is not None))
            return self._last

    def _wait(
        self, is_done: Callable[[State], bool], deadline: Deadline, expectation: str, *, faults: bool = True
    ) -> None:
        reader = StateReader(
            self._state,
            pause=lambda: self._clock.sleep(_POLL_S, LOOK_S),
            describe=lambda state: (
                f"joints measured at {np.round(state.joints_deg, 3).tolist()} deg, "
                f"wanted at {np.round(state.wanted_deg, 3).tolist()} deg"
            ),
            remedy="See the controller's messages; its speed slider must not be moved during a motion",
        )
        wait_for(reader, is_done, deadline, expectation, check=raise_fault if faults else None)

    def _is_settled(self, state: State, number: int) -> bool:
        if self._number != number:
            raise overtaken()
        if state.lapses != self._lapses:
            raise ArmUnattended(self._attention.longest_gap_s())
        return state.command == number and self._is_still(state)

    def _is_still(self, state: State) -> bool:
        return state.still_samples >= self.settings.settle_samples

    def _rest_s(self) -> float:
        """Longest time from a stop command until the arm counts as at rest."""
        return self.settings.stop_s + self.settings.settle_samples / self.settings.frequency_hz


def _movej_s(settings: Settings, turn_deg: float) -> float:
    """Return the duration of a trapezoidal speed profile: d/v + v/a, or 2 sqrt(d/a) if full speed is not
    reached."""
    speed, acceleration = settings.speed_deg_s, settings.acceleration_deg_s2
    if turn_deg < speed**2 / acceleration:
        return 2.0 * math.sqrt(turn_deg / acceleration)
    return turn_deg / speed + speed / acceleration


def _condition(state: State) -> ArmCondition:
    bits = state.safety_bits
    return ArmCondition(
        mode=ROBOT_MODES.get(state.robot_mode, f"robot mode {state.robot_mode}"),
        emergency_stop=bool(bits & EMERGENCY_STOP_BITS),
        protective_stop=bool(bits & (PROTECTIVE_STOP_BIT | SAFEGUARD_STOP_BIT)),
        brakes_released=state.robot_mode in (BACKDRIVE, RUNNING),
    )


def _transform(pose_m_rad: Six) -> geometry.Transform:
    """Return the 4x4 transform in mm for a UR pose (x, y, z in m and a rotation vector in rad)."""
    from scipy.spatial.transform import Rotation

    result = np.eye(4)
    result[:3, :3] = Rotation.from_rotvec(pose_m_rad[3:]).as_matrix()
    result[:3, 3] = np.array(pose_m_rad[:3]) * 1e3
    return result
