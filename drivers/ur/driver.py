"""A Universal Robots arm through ur-rtde: `coupole.devices.Robot`.

A process of its own (`ur_link`) owns the library and speaks to the controller; this class asks it and judges
its answers by the age of the controller's timestamp. Order of work in the cell: power the arm, release its
brakes, switch to remote control, then open this driver. The controller shapes the motion (movej: a trapezoid
of the leading joint's speed), so there is no jerk to set.

Poses are the controller's own `actual_TCP_pose`, with the tool's offset, as read at opening, taken off: the
controller knows the arm's factory calibration, which nominal DH parameters miss by millimetres.
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
from coupole.devices import ArmState, Clock, Deadline, Identity
from coupole.errors import DeviceLost, DeviceRefused
from coupole.kinematics import Arm
from drivers.arm_motion import News, checked_target, overtaken, refused, wait_for
from drivers.ur.messages import Ask, Config, Six, State
from drivers.ur.process import UrProcess, raise_fault

_POLL_S = 0.008


class Settings(BaseModel):
    """Settings of the driver in the rig file. Angles are of the joints; speeds are of the leading joint."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    host: str = Field(min_length=1)
    """Address of the controller; the ports are UR's own (29999, 30003, 30004)."""
    model: str = Field(default="ur10e", pattern=r"^ur\d+e?$")
    """Which arm it is; the controller must say the same, without the e."""
    arm_model: Arm | None = None
    """The arm as a rig describes it; plans are made with it, this driver does without."""
    limits_deg: tuple[tuple[float, float], ...] = Field(default=((-360.0, 360.0),) * 6, min_length=6, max_length=6)
    """Lowest and highest angle of each joint; narrower than the arm's own where the cell asks for it."""
    joint_speed_deg_s: float = Field(default=120.0, gt=0, le=179.9)
    """What every joint can do: 120 for the UR10e, 179.9 for the UR3e and UR5e."""
    speed_fraction: float = Field(default=0.5, gt=0, le=1)
    acceleration_deg_s2: float = Field(default=80.0, gt=0, le=2000)
    stop_deg_s2: float = Field(default=300.0, gt=0, le=2000)
    """Deceleration of `stop`."""
    frequency_hz: float = Field(default=125.0, ge=10, le=500)
    """Samples that the controller sends."""
    watchdog_s: float = Field(default=0.5, ge=0.05)
    """Silence of this computer after which the controller ends all motion by itself."""
    link_timeout_s: float = Field(default=1.0, gt=0)
    """Silence of the controller after which the link counts as lost."""
    connect_timeout_s: float = Field(default=20.0, gt=0)
    """How long opening may take, in machine time."""
    settle_deg: float = Field(default=0.02, gt=0)
    settle_deg_s: float = Field(default=0.1, gt=0)
    settle_samples: int = Field(default=10, ge=1)
    """Settled: within both tolerances for so many samples, and again after the dwell."""
    dwell_s: float = Field(default=0.1, ge=0)
    follow_deg: float = Field(default=1.0, gt=0)
    follow_samples: int = Field(default=10, ge=1)
    """The arm does not follow: farther than that from where its controller wants it for so many samples."""

    def arm(self) -> Arm | None:
        """The arm with the limits and speeds that this driver moves it at; preflight computes durations with it.
        Motions are trapezoids of the leading joint's speed: there is no limit to the jerk."""
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
    """See `coupole.devices.Robot`. After a fault it moves no more: close it and open another."""

    def __init__(self, settings: Settings, clock: Clock) -> None:
        """Start the controller's program that obeys ur-rtde; nothing moves.

        Raises DeviceFault if the controller is in a fault or in local control, DeviceRefused if a program runs
        there, DeviceLost if it cannot be reached, DeviceTimeout if the library hangs.
        """
        self.settings = settings
        self._clock = clock
        self._news = News(clock)
        self._number = 0
        self._motion_s = 0.0
        config = {field.name: getattr(settings, field.name) for field in fields(Config)}
        self._process = UrProcess(Config(**config))
        try:
            self._last = self._process.first_word(settings.connect_timeout_s)
            raise_fault(self._last)
            self._check_model(self._last.model)
        except BaseException:
            self.close()
            raise

    def _check_model(self, told: str) -> None:
        """Plans are reckoned for one arm: another must not run them. The dashboard calls a UR10e `UR10`."""
        if told.lower().removesuffix("e") != self.settings.model.removesuffix("e"):
            raise DeviceRefused(
                "robot",
                expected=f"a {self.settings.model.upper().replace('E', 'e')}, as the rig has it",
                happened=f"the controller says that it moves a {told}",
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

    def move_to(self, joints_deg: NDArray[np.float64]) -> None:
        """Start movej; an arm in motion is first brought to rest. Raises DeviceRefused out of limits."""
        target_deg = checked_target(joints_deg, self.settings.limits_deg)
        state = self._command("move", target_deg)
        raise_fault(state)
        if state.speed_fraction <= 0.0:
            raise refused("a speed slider above 0 %", "it stands at 0 %: the arm will not move")
        way_deg = float(np.max(np.abs(np.subtract(target_deg, state.joints_deg))))
        # Asked in motion, the arm first brakes, and may have gone on away from the target meanwhile.
        way_deg += self.settings.speed_deg_s * self.settings.stop_s
        self._motion_s = _movej_s(self.settings, way_deg) / state.speed_fraction + self._rest_s()

    def wait_settled(self) -> ArmState:
        settings, number = self.settings, self._number
        settle_s = settings.settle_samples / settings.frequency_hz
        deadline = Deadline(self._clock, 1.5 * self._motion_s + settle_s + settings.dwell_s + 1.0)
        self._wait(lambda state: self._settled(state, number), deadline, "the arm at its target and still")
        self._clock.sleep(settings.dwell_s)
        self._wait(lambda state: self._settled(state, number), deadline, "the arm still after the dwell")
        return self.measured()

    def measured(self) -> ArmState:
        """Raises DeviceLost rather than tell what is older than `link_timeout_s`."""
        state = self._state()
        return ArmState(
            joints_deg=state.joints_deg,
            base_from_flange=_transform(state.tcp_pose_m_rad)
            @ geometry.inverse(_transform(state.tcp_offset_m_rad)),
            t_ns=self._news.since_ns(state.samples),
            moving=state.still_samples < self.settings.settle_samples,
            fault=state.fault,
        )

    def stop(self) -> None:
        """Brake and wait until the arm stands; raises DeviceTimeout if it does not come to rest.

        With a lost link it commands nothing: the controller's watchdog has stopped the arm.
        """
        with contextlib.suppress(DeviceLost):
            self._command("stop")
            deadline = Deadline(self._clock, 2.0 * self._rest_s() + 1.0)
            self._wait(self._is_still, deadline, "the arm at rest", faults=False)

    def stopping_deg(self) -> NDArray[np.float64]:
        """Farthest that each joint [6] turns after a stop: the leading joint's speed, which no joint exceeds, for
        the time until stopj begins, and half of the time that it takes. A call of the library that is under way
        comes before, and its commands wait for an answer: three samples each.
        """
        settings = self.settings
        delay_s = 6.0 / settings.frequency_hz
        return np.full(6, settings.speed_deg_s * (delay_s + 0.5 * settings.stop_s))

    def statistics(self) -> Mapping[str, float]:
        """Figures of the process's last word."""
        with contextlib.suppress(DeviceLost):
            self._last = self._state()
        state = self._last
        return {
            "samples": state.samples,
            "max_gap_ms": 1e3 * state.max_gap_s,
            "max_call_ms": 1e3 * state.max_call_s,
            "speed_slider": state.speed_fraction,
        }

    def close(self) -> None:
        """Bring the arm to rest and end the controller's program and our process. Safe to call again."""
        self._process.close()

    def _command(self, verb: Literal["move", "stop"], target_deg: Six | None = None) -> State:
        self._number += 1
        return self._process.ask(Ask(verb, self._number, target_deg))

    def _state(self) -> State:
        return self._process.ask(Ask("state"))

    def _wait(
        self, done: Callable[[State], bool], deadline: Deadline, expected: str, *, faults: bool = True
    ) -> None:
        wait_for(
            self._state,
            done,
            deadline,
            expected,
            check=raise_fault if faults else None,
            pause=lambda: self._clock.sleep(_POLL_S),
            describe=lambda state: (
                f"joints measured at {np.round(state.joints_deg, 3).tolist()} deg, "
                f"wanted at {np.round(state.wanted_deg, 3).tolist()} deg"
            ),
            remedy="See the controller's messages; its speed slider must not be moved during a motion",
        )

    def _settled(self, state: State, number: int) -> bool:
        if self._number != number:
            raise overtaken()
        return state.command == number and self._is_still(state)

    def _is_still(self, state: State) -> bool:
        return state.still_samples >= self.settings.settle_samples

    def _rest_s(self) -> float:
        """Time until an arm told to stop counts as standing."""
        return self.settings.stop_s + self.settings.settle_samples / self.settings.frequency_hz


def _movej_s(settings: Settings, way_deg: float) -> float:
    """Duration of a trapezoid of speed: d/v + v/a, or 2 sqrt(d/a) where full speed is not reached."""
    speed, acceleration = settings.speed_deg_s, settings.acceleration_deg_s2
    if way_deg < speed**2 / acceleration:
        return 2.0 * math.sqrt(way_deg / acceleration)
    return way_deg / speed + speed / acceleration


def _transform(pose_m_rad: Six) -> geometry.Transform:
    """A UR pose (x, y, z in m and a rotation vector in rad) as 4x4 in mm."""
    from scipy.spatial.transform import Rotation

    result = np.eye(4)
    result[:3, :3] = Rotation.from_rotvec(pose_m_rad[3:]).as_matrix()
    result[:3, 3] = np.array(pose_m_rad[:3]) * 1e3
    return result
