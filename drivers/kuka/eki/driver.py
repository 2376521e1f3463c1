"""A KUKA arm over EthernetKRL (EKI): `coupole.devices.Robot` without real-time demands on the host.

The controller plans and runs every motion itself (PTP); this driver sends targets and reads the status messages
that arrive at a steady rate. No message has to be answered within a cycle. The programs for the controller are
in `configs/kuka/eki/`; in the cell, start them before this driver is opened.
"""

from __future__ import annotations

import secrets
import threading
import time
from collections.abc import Callable, Mapping

import numpy as np
from numpy.typing import NDArray

from coupole.clock import Clock
from coupole.devices import ArmCondition, ArmState, Identity
from coupole.errors import ArmUnattended, DeviceError, DeviceLost, DeviceTimeout
from coupole.geometry import transform
from coupole.kinematics import forward, move_duration_s
from coupole.supervision import ATTENTION_S, Attention
from drivers.arm_motion import (
    MessageTime,
    checked_speed,
    checked_target,
    farthest_stop_deg,
    longest_stop_s,
    overtaken,
    refusal,
)
from drivers.kuka.eki import wire
from drivers.kuka.eki.link import Link, connect
from drivers.kuka.eki.settings import Settings
from drivers.kuka.eki.watch import Tolerances, Watch
from drivers.kuka.eki.wire import Command, Six, Status
from drivers.opening import closed_on_failure

_SAME_POSE_MM, _SAME_ROTATION = 1.0, 0.005
"""Largest allowed difference between the controller's flange pose and the pose computed from its axes."""
_BEAT_EVERY_S = ATTENTION_S / 4.0
_T1_SLOWER = 10.0
"""Largest factor by which motions take longer in T1 (for time-outs)."""


class KukaEki:
    """See `coupole.devices.Robot`. After a fault it refuses to move: close it and open it again."""

    def __init__(self, settings: Settings, clock: Clock) -> None:
        """Connect, and let the controller begin a session. The arm does not move.

        Raises DeviceLost without a connection, DeviceTimeout without an answer, DeviceFault if the controller
        reports a fault.
        """
        self.settings = settings
        self.arm = settings.arm()
        self._clock = clock
        self._message_time = MessageTime(clock)
        self._number = 0
        self._sending = threading.Lock()
        """Held while a command is numbered and sent, because any thread may call `stop`."""
        self._stops = 0
        self._motion_s = 0.0
        self._attention = Attention()
        self._sent_s = 0.0
        """Machine time of the last command."""
        self._watch = Watch(
            1 + secrets.randbelow(2**31 - 2),
            Tolerances(settings.settle_deg, settings.settle_deg_s, settings.follow_deg, settings.follow_cycles),
        )
        try:
            link, self._strangers = connect(
                settings.address, settings.controller_is, str(settings.controller), settings.connect_timeout_s
            )
        except OSError as error:
            raise DeviceLost(
                "robot",
                expected=f"an EthernetKRL connection at {settings.address}",
                happened=str(error) or "no connection came",
                remedy="Start the controller's programs (configs/kuka/eki), and check its IP and PORT",
            ) from error
        self._link = Link(link, self._watch, settings.link_timeout_s)
        with closed_on_failure(self.close):
            self._begin_session()

    def identify(self) -> Identity:
        status = self._status()
        return Identity(
            vendor="KUKA",
            model=self.arm.name,
            serial=str(status.serial),
            firmware=f"EthernetKRL, controller reports {status.model!r}",
            simulated="simulated" in status.model,
        )

    def self_test(self) -> Mapping[str, str]:
        self._raise_fault()
        status = self._status()
        axes = ", ".join(f"{angle:.3f}" for angle in status.joints_deg)
        return {
            "axes": f"{axes} deg",
            "pose": self._compare_pose(status),
            "override": f"{status.override_percent} %",
            "mode": "T1: slow, for tests" if status.t1 else "automatic or T2",
        }

    def move_to(self, joints_deg: NDArray[np.float64], speed: float = 1.0) -> None:
        stops, percent = self._stops, self._percent(checked_speed(speed))
        target_deg = checked_target(joints_deg, self.arm.limits_deg)
        self._raise_fault()
        status = self._status()
        if status.override_percent <= 0:
            raise refusal("an override above 0 %", "the controller's program override is at 0 %")
        # If the arm is moving it brakes first, which lengthens the motion by up to twice the braking time.
        slower = self.settings.velocity_percent() / percent
        move_s = move_duration_s(self.arm, status.joints_deg, target_deg) * slower + self._stop_s()
        with self._sending:
            if self._stops != stops:  # another thread has called `stop` since this call began
                raise overtaken()
            self._motion_s = move_s * _slower(status)
            self._attention.begin()
            self._order(wire.MOVE, target_deg, percent)

    def wait_settled(self) -> ArmState:
        settings, watch = self.settings, self._watch
        order = watch.order
        with self._sending:
            # statuses count only if they were sent after the controller took the command ASK
            with self._link.changed:
                watch.note_command(self._number + 1)
            self._send(wire.ASK)
        self._wait_taken()
        settle_s = settings.settle_cycles * settings.status_ms / 1e3
        limit_s = 1.5 * self._motion_s + settle_s + settings.dwell_s + 1.0

        def is_settled() -> bool:
            if watch.order != order:
                raise overtaken()
            self._look()
            if watch.has_lapsed and not watch.moving:
                raise ArmUnattended(self._attention.longest_gap_s())
            return watch.taken_ms is not None and watch.settled_cycles >= settings.settle_cycles

        self._wait(is_settled, limit_s, "the arm at its target and still")
        dwell_ends_ms = self._status().time_ms + 1e3 * settings.dwell_s
        self._wait(
            lambda: self._status().time_ms >= dwell_ends_ms and is_settled(),
            limit_s,
            "the arm still after the dwell",
        )
        return self.measured()

    def measured(self) -> ArmState:
        """Return the state in the last status. Raises DeviceLost if the link is lost."""
        self._look()
        with self._link.changed:
            if self._watch.link_lost:
                self._raise_fault()
            status, fault = self._status(), self._watch.fault
            return ArmState(
                joints_deg=status.joints_deg,
                base_from_flange=forward(self.arm, status.joints_deg),
                t_ns=self._message_time.since_ns(self._watch.statuses),
                moving=self._watch.moving,
                fault=fault.text if fault else "",
                condition=_condition(status),
                unattended_s=self._attention.longest_gap_s() if self._watch.has_lapsed else 0.0,
            )

    def stop(self) -> None:
        """Brake and wait until the arm is at rest; raises DeviceTimeout if it does not come to rest.

        If the link is lost, it returns at once, because the controller has then stopped the arm itself.
        """
        watch = self._watch
        if watch.link_lost:
            return
        with self._sending:
            self._stops += 1
            self._order(wire.STOP, None)
        self._wait_taken()
        self._wait(lambda: not watch.moving, 2.0 * self._stop_s() + 1.0, "the arm at rest", faults=False)

    def stopping_deg(self) -> NDArray[np.float64]:
        """Largest further turn of each axis after a stop (`farthest_stop_deg`). The controller's program reads
        commands at least once per status period. A second period allows for the network and for the interruption
        of the robot program."""
        settings, arm = self.settings, self.arm
        delay_s = 2.0 * settings.status_ms / 1e3
        return farthest_stop_deg(arm.velocity_deg_s, arm.acceleration_deg_s2[0], settings.jerk_deg_s3, delay_s)

    def statistics(self) -> Mapping[str, float]:
        watch = self._watch
        return {
            "statuses": watch.statuses,
            "foreign_statuses": watch.foreign,
            "strangers": self._strangers,
            "malformed_statuses": self._link.reader.malformed,
            "max_gap_ms": watch.max_gap_ms,
        }

    def close(self) -> None:
        """Bring the arm to rest, then end the connection. Safe to call again."""
        try:
            if self._watch.status is not None:
                self.stop()
        except DeviceError:
            pass  # the controller's program stops the arm when it loses the connection
        finally:
            self._link.close()

    def _begin_session(self) -> None:
        """Send a first STOP. Its answers have this session's number, so that older statuses are recognised."""
        with self._sending:
            self._order(wire.STOP, None)
        watch = self._watch
        self._link.wait_for(
            lambda: watch.fault or (watch.status and not watch.moving), self.settings.connect_timeout_s
        )
        self._raise_fault()
        if watch.status is None or watch.moving:
            raise DeviceTimeout(
                "robot",
                expected=f"an answer from the program at {self.settings.address}",
                happened=f"{watch.statuses} statuses answered, {watch.foreign} belonged to another session, "
                f"{self._link.reader.malformed} were malformed",
                remedy="Restart the controller's programs, and check that they are the "
                "programs of configs/kuka/eki",
            )

    def _percent(self, speed: float) -> int:
        """Return a speed in percent of the controller's own speeds. Raises DeviceRefused below its slowest."""
        percent = int(round(speed * self.settings.velocity_percent(), 6))
        if percent < 1:
            raise refusal(
                "at least 1 % of the controller's speeds, its slowest",
                f"{speed:.3g} of the {self.settings.velocity_percent()} % of the rig is less",
            )
        return percent

    def _order(self, verb: int, target_deg: Six | None, percent: int | None = None) -> None:
        """Send a STOP or a MOVE; `_sending` must be held."""
        with self._link.changed:
            self._watch.note_order(self._number + 1, target_deg)
        self._send(verb, target_deg, percent)

    def _look(self) -> None:
        """Tell the controller, often enough, that the motion was checked."""
        due = time.monotonic() - self._sent_s > _BEAT_EVERY_S
        if self._attention.look() is None or not due or not self._watch.moving:
            return
        # otherwise another thread is sending a command, which serves as well
        if self._sending.acquire(blocking=False):
            try:
                self._link.beat(self._command(wire.BEAT))
            finally:
                self._sending.release()

    def _send(self, verb: int, target_deg: Six | None = None, percent: int | None = None) -> None:
        self._link.send(self._command(verb, target_deg, percent))

    def _command(self, verb: int, target_deg: Six | None = None, percent: int | None = None) -> Command:
        """Return the next command; `_sending` must be held."""
        self._number += 1
        self._sent_s = time.monotonic()
        settings, status = self.settings, self._watch.status
        here_deg = status.joints_deg if status else (0.0,) * 6
        return Command(
            session=self._watch.session,
            number=self._number,
            verb=verb,
            velocity_percent=percent or settings.velocity_percent(),
            acceleration_percent=settings.acceleration_percent(),
            joints_deg=target_deg or here_deg,
        )

    def _status(self) -> Status:
        status = self._watch.status
        if status is None:
            raise DeviceLost("robot", expected="a status", happened="none has come", remedy="Open the robot again")
        return status

    def _wait_taken(self) -> None:
        watch, patience_s = self._watch, 2.0 * self.settings.link_timeout_s  # a lost link is noticed before this

        def is_taken() -> bool:
            self._look()
            return watch.link_lost or watch.taken_ms is not None

        self._link.wait_for(is_taken, patience_s)
        if watch.taken_ms is None and not watch.link_lost:
            raise DeviceTimeout(
                "robot",
                expected=f"command {self._number} to be taken within {patience_s:.1f} s",
                happened="statuses arrive, but none acknowledges it",
                remedy="See the controller's messages: its submit interpreter must run",
            )

    def _wait(self, is_done: Callable[[], bool], limit_s: float, expectation: str, *, faults: bool = True) -> None:
        """Wait until `is_done`. Raises a fault once the arm is at rest. Raises DeviceTimeout when more than
        `limit_s` of the controller's time have passed since it took the last command."""
        watch = self._watch

        def outcome() -> str:
            if watch.link_lost or (watch.fault and not watch.moving):
                return "fault"
            if watch.fault is None and is_done():
                return "done"
            return "overdue" if watch.overdue(limit_s) else ""

        how = self._link.wait_for(outcome)
        if faults:
            self._raise_fault()
        if how == "overdue":
            raise DeviceTimeout(
                "robot",
                expected=f"{expectation} within {limit_s:.1f} s",
                happened=f"axes measured at {np.round(self._status().joints_deg, 3).tolist()} deg",
                remedy="See the controller's messages; a motion may wait for an enabling switch or a condition",
            )

    def _compare_pose(self, status: Status) -> str:
        """Return text for the self-test. Raises DeviceError if the controller has another arm model or another
        tool."""
        if status.pose is None:
            return "the controller reports none"
        x, y, z, *abc_deg = status.pose
        reported_pose = transform((x, y, z), (abc_deg[0], abc_deg[1], abc_deg[2]))
        apart = np.abs(reported_pose - forward(self.arm, status.joints_deg))
        if apart[:3, 3].max() > _SAME_POSE_MM or apart[:3, :3].max() > _SAME_ROTATION:
            raise DeviceError(
                "robot",
                expected=f"the flange of a {self.arm.name} at the pose computed from its axes",
                happened=f"the controller reports {np.round(status.pose, 3).tolist()} (mm, deg)",
                remedy="Check that the program sets $TOOL and $BASE to $NULLFRAME, and the arm's model",
            )
        return f"flange at {x:.2f}, {y:.2f}, {z:.2f} mm, as computed from the axes"

    def _stop_s(self) -> float:
        arm = self.arm
        return longest_stop_s(arm.velocity_deg_s, arm.acceleration_deg_s2[0], self.settings.jerk_deg_s3)

    def _raise_fault(self) -> None:
        fault = self._watch.fault
        if fault is None:
            return
        raise fault.kind(
            "robot",
            expected="an arm that follows its program",
            happened=fault.text,
            remedy="Check the cell, acknowledge at the controller, restart its program, reopen the robot",
        )


def _slower(status: Status) -> float:
    """Return the factor by which the controller slows motions down (override, T1)."""
    return 100.0 / status.override_percent * (_T1_SLOWER if status.t1 else 1.0)


def _condition(status: Status) -> ArmCondition:
    """Return the arm's condition, from the most serious fault; the controller's program reports only this one."""
    mode = "T1" if status.t1 else "automatic or T2"
    brakes_released = status.fault not in (wire.EMERGENCY_STOP, wire.DRIVES_OFF)
    return ArmCondition(mode, emergency_stop=status.fault == wire.EMERGENCY_STOP, brakes_released=brakes_released)
