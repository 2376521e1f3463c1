"""A KUKA arm over RobotSensorInterface (RSI): `coupole.devices.Robot`.

The controller sends a packet every 4 or 12 ms and must be answered within that cycle. A separate process
(`drivers.kuka.rsi.loop`) answers; this class writes commands to shared memory and reads the arm's state there.
In the cell: open this driver first, then start the controller's RSI program.
"""

from __future__ import annotations

import contextlib
import json
import os
import socket
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Mapping
from dataclasses import fields
from typing import Any

import numpy as np
from numpy.typing import NDArray

from coupole.clock import Clock, Deadline
from coupole.devices import ArmState, Identity
from coupole.errors import ArmUnattended, DeviceError, DeviceFault, DeviceLost, DeviceRefused, DeviceTimeout
from coupole.kinematics import Arm, forward, move_duration_s
from coupole.supervision import ASKS_FROM_S, LOOK_S, Attention, Silence
from drivers.arm_motion import (
    MessageTime,
    StateReader,
    checked_speed,
    checked_target,
    longest_stop_s,
    overtaken,
    refusal,
    wait_for,
)
from drivers.kuka.rsi import shared_state
from drivers.kuka.rsi.limits import correction_violations
from drivers.kuka.rsi.realtime import how_to_give_the_right, may_be_realtime
from drivers.kuka.rsi.rsi_session import Config
from drivers.kuka.rsi.settings import Settings
from drivers.opening import closed_on_failure
from drivers.senders import only_here

__all__ = ["KukaRsi", "Settings"]

_SESSION_ANSWERS = 10
"""Number of answers after which a session counts as established."""
_POLL_S = 0.004
_LOST = (shared_state.LINK_LOST, shared_state.RESTARTED)
"""Faults after which the controller no longer has a session with this driver."""
_LEAVE_S = 2.0
"""Longest time that the loop needs to end once the arm is at rest."""


class KukaRsi:
    """See `coupole.devices.Robot`. After a fault it refuses to move: close it and open it again."""

    def __init__(self, settings: Settings, clock: Clock) -> None:
        """Wait for the controller's packets. They are answered with zero correction until `move_to`.

        Raises DeviceRefused if the right to real-time priority is missing, DeviceLost if the port cannot be bound,
        DeviceTimeout if no session begins in time.
        """
        _refuse_normal_priority(settings)
        self.settings = settings
        self.arm = settings.arm()
        self._clock = clock
        self._command = shared_state.Command()
        self._sending = threading.Lock()
        """Held while a command is numbered and written, because any thread may call `stop`."""
        self._stops = 0
        self._motion_s = 0.0
        self._target_deg: shared_state.Six = (0.0,) * 6
        """Target of the last motion."""
        self._message_time = MessageTime(clock)
        self._attention, self._silence = Attention(), Silence()
        self._hung = ""
        self._lapses = 0
        """Number of lapses that the loop had counted when the last motion began."""
        self._process, self._block = _spawn(settings, self.arm)
        with closed_on_failure(self.close):
            self._wait_for_session()

    def identify(self) -> Identity:
        controller = self._state().controller.decode(errors="replace")
        return Identity(
            vendor="KUKA",
            model=self.arm.name,
            serial="",
            firmware=f"RSI, controller type {controller!r}",
            simulated="simulated" in controller,
        )

    def self_test(self) -> Mapping[str, str]:
        state = self._state()
        self._raise_fault(state)
        axes = ", ".join(f"{angle:.3f}" for angle in state.measured_deg)
        strangers = f"{state.foreign} packets ignored, the last of {state.other_sender.decode()}"
        return {
            "axes": f"{axes} deg",
            "delay counter": f"{state.delay}",
            "cycle": f"{state.cycle_ns / 1e6:.2f} ms",
            "scheduling": "SCHED_FIFO" if state.realtime else "normal: answers may be late on a busy machine",
            **({"other senders": strangers} if state.foreign else {}),
        }

    def move_to(self, joints_deg: NDArray[np.float64], speed: float = 1.0) -> None:
        stops, speed = self._stops, checked_speed(speed)
        target_deg = checked_target(joints_deg, self.arm.limits_deg)
        state = self._state()
        self._raise_fault(state)
        # A new target during a motion: the arm may start from anywhere on the rest of the present line.
        on_the_way_deg = [state.commanded_deg] if self._stands(state) else [state.commanded_deg, self._target_deg]
        if violations := correction_violations(
            self.settings, self.arm, state.start_deg, on_the_way_deg, target_deg
        ):
            raise refusal("a motion within the limits of corrections", violations)
        # If the arm is moving it brakes first, which lengthens the motion by up to twice the braking time.
        motion_s = move_duration_s(self.arm, state.measured_deg, target_deg) / speed + self._stop_s()
        with self._sending:
            if self._stops != stops:  # another thread has called `stop` since this call began
                raise overtaken()
            self._target_deg, self._motion_s = target_deg, motion_s
            self._lapses = state.lapses
            self._block.write_looked(self._attention.begin())
            self._send(shared_state.MOVE, target_deg, speed)

    def wait_settled(self) -> ArmState:
        command = self._command
        settings = self.settings
        settle_s = settings.settle_cycles * settings.cycle_ms / 1e3
        deadline = Deadline(self._clock, 1.5 * self._motion_s + settle_s + settings.dwell_s + 1.0)
        self._wait(lambda state: self._is_settled(state, command), deadline, "the arm at its target and still")
        self._clock.sleep(settings.dwell_s)
        self._wait(lambda state: self._is_settled(state, command), deadline, "the arm still after the dwell")
        return self.measured()

    def measured(self) -> ArmState:
        state = self._state()
        joints = state.measured_deg
        return ArmState(
            joints_deg=(joints[0], joints[1], joints[2], joints[3], joints[4], joints[5]),
            base_from_flange=forward(self.arm, joints),
            t_ns=self._message_time.since_ns(state.packets),
            moving=self._moves(state),
            fault=state.fault_text.decode(errors="replace"),
            unattended_s=self._attention.longest_gap_s() if state.lapses != self._lapses else 0.0,
        )

    def stop(self) -> None:
        """Brake and wait until the arm is at rest; raises DeviceTimeout if it does not come to rest.

        If the link is lost, it returns at once, because the controller has then stopped the arm itself.
        """
        if self._process.poll() is not None:
            return
        with self._sending:
            self._stops += 1
            self._send(shared_state.STOP)
            number = self._command.number
        deadline = Deadline(self._clock, 2.0 * self._stop_s() + 1.0)

        def stands(state: shared_state.State) -> bool:
            has_ended = state.fault != shared_state.NO_FAULT and state.phase == shared_state.STANDING
            has_obeyed = state.command >= number and not self._moves(state)
            return state.fault == shared_state.LINK_LOST or has_ended or has_obeyed

        self._wait(stands, deadline, "the arm at rest", faults=False)

    def stopping_deg(self) -> NDArray[np.float64]:
        return self.settings.stopping_deg()

    def statistics(self) -> Mapping[str, float]:
        state = self._block.read_state()
        return {
            "packets": state.packets,
            "answers": state.answers,
            "late_answers": state.late,
            "malformed_packets": state.malformed,
            "foreign_packets": state.foreign,
            "astray_packets": state.astray,
            "cycle_ms": state.cycle_ns / 1e6,
            "program_ended": state.program_ended,
            "max_gap_ms": state.max_gap_ns / 1e6,
            "delay_counter": state.delay,
            "realtime": state.realtime,
        }

    def close(self) -> None:
        """Bring the arm to rest, then end the answering process. Safe to call again."""
        if self._process.poll() is None:
            with contextlib.suppress(DeviceError):
                self.stop()
            with self._sending:
                self._stops += 1
                self._send(shared_state.LEAVE)
            with contextlib.suppress(subprocess.TimeoutExpired):
                self._process.wait(timeout=_LEAVE_S)
            self._process.kill()
        self._process.wait()

    def _wait_for_session(self) -> None:
        give_up = time.monotonic() + self.settings.connect_timeout_s
        while (state := self._state()).answers < _SESSION_ANSWERS or not state.cycle_ns:
            self._raise_fault(state)
            if time.monotonic() > give_up:
                raise DeviceTimeout(
                    "robot",
                    expected=f"RSI packets at {self.settings.listen}"
                    + (f" from {self.settings.controller}" if self.settings.controller else ""),
                    happened=_no_session_reason(state),
                    remedy="Restart the RSI program on the controller, and check its IP_NUMBER and PORT"
                    + ("; set `controller` to the controller's address" if state.foreign else ""),
                )
            time.sleep(_POLL_S)
        self._raise_fault(state)

    def _send(self, verb: int, target_deg: tuple[float, ...] = (0.0,) * 6, speed: float = 1.0) -> None:
        self._command = shared_state.Command(self._command.number + 1, verb, target_deg, speed)
        self._block.write_command(self._command)

    def _state(self) -> shared_state.State:
        """Return the loop's latest state. Raises DeviceLost if the loop has ended or does not run; the controller
        then ends the motion by itself."""
        if looked_ns := self._attention.look():
            self._block.write_looked(looked_ns)
        try:
            if self._process.poll() is None:
                if self._silence.after(self._block.ran_ns()) < ASKS_FROM_S:
                    return self._block.read_state()
                self._hung = f"the process stood still for {ASKS_FROM_S:g} s, and was ended"
                self._end()
        except TimeoutError:
            self._end()
        raise DeviceLost(
            "robot",
            expected="a process that answers the controller",
            happened=self._hung or f"it ended with exit code {self._process.returncode}",
            remedy="Open the robot again",
        )

    def _end(self) -> None:
        """End the process, even if it is frozen. It must not answer a session of which it has lost count."""
        self._process.kill()
        self._process.wait()

    def _wait(
        self,
        is_done: Callable[[shared_state.State], bool],
        deadline: Deadline,
        expectation: str,
        *,
        faults: bool = True,
    ) -> None:
        reader = StateReader(
            self._state,
            pause=lambda: self._clock.sleep(_POLL_S, LOOK_S),
            describe=lambda state: (
                f"axes measured at {np.round(state.measured_deg, 3).tolist()} deg, "
                f"commanded to {np.round(state.commanded_deg, 3).tolist()} deg"
            ),
            remedy="See the controller's messages; its override must be at 100 %",
        )
        wait_for(reader, is_done, deadline, expectation, check=self._raise_fault if faults else None)

    def _is_settled(self, state: shared_state.State, command: shared_state.Command) -> bool:
        if self._command is not command:
            raise overtaken()
        if state.lapses != self._lapses:
            raise ArmUnattended(self._attention.longest_gap_s())
        return state.command == command.number and state.settled_cycles >= self.settings.settle_cycles

    def _moves(self, state: shared_state.State) -> bool:
        speed_deg_s = max(map(abs, state.velocity_deg_s))
        # A command that the loop has not taken yet counts as motion.
        return not self._stands(state) or speed_deg_s > self.settings.settle_deg_s

    def _stands(self, state: shared_state.State) -> bool:
        return state.phase == shared_state.STANDING and state.command == self._command.number

    def _stop_s(self) -> float:
        settings = self.settings
        return longest_stop_s(self.arm.velocity_deg_s, settings.acceleration_deg_s2, settings.jerk_deg_s3)

    def _raise_fault(self, state: shared_state.State) -> None:
        if state.fault == shared_state.NO_FAULT:
            return
        if state.fault == shared_state.WRONG_CYCLE:
            raise DeviceFault(
                "robot",
                expected=f"a controller with a cycle of {self.settings.cycle_ms} ms",
                happened=state.fault_text.decode(errors="replace"),
                remedy="Set `cycle_ms` to the controller's cycle, or start RSI with the other one "
                "(#IPO_FAST: 4 ms, #IPO: 12 ms); before that, nothing is moved",
            )
        kind = DeviceLost if state.fault in _LOST else DeviceFault
        raise kind(
            "robot",
            expected="an arm that follows its RSI corrections",
            happened=state.fault_text.decode(errors="replace"),
            remedy="Check the cell, acknowledge at the controller, restart its program, reopen the robot",
        )


def _refuse_normal_priority(settings: Settings) -> None:
    """Raises DeviceRefused if a controller on the network would be answered at normal priority, and nobody has
    taken responsibility for this."""
    if only_here(settings.listen) or settings.without_realtime_by or may_be_realtime():
        return
    raise DeviceRefused(
        "robot",
        expected="the right to real-time priority (SCHED_FIFO) for the process that answers the controller "
        f"in every {settings.cycle_ms} ms",
        happened="this user does not have this right; without it, 16 % of the answers were late beside other work",
        remedy=f"{how_to_give_the_right()}. Or a person writes `without_realtime_by: NAME` among the robot's "
        "`settings:` in the rig's file; `coupole doctor` measures whether this machine answers in time",
    )


def _no_session_reason(state: shared_state.State) -> str:
    if state.foreign:
        other_sender, own_sender = state.other_sender.decode(), state.sender.decode()
        own_packets = (
            f"the driver listens to {own_sender}; {state.packets} packets came from there"
            if own_sender
            else "no others came"
        )
        return f"{state.foreign} packets of other senders were ignored, the last of {other_sender}; {own_packets}"
    if state.astray:
        return (
            f"{state.astray} packets came that do not continue the session, and {state.packets} that continue it"
        )
    if state.refused:
        return f"{state.refused} packets belong to a running RSI session that another program may have begun"
    if state.malformed:
        return (
            f"{state.malformed} packets came, but none with an IPOC and six axes (and, for relative corrections, "
            "the delay counter)"
        )
    return f"{state.packets} came"


def _spawn(settings: Settings, arm: Arm) -> tuple[subprocess.Popen[bytes], shared_state.Block]:
    """Bind the port and start the loop; raises DeviceLost if the port cannot be bound."""
    host, port = settings.listen.rsplit(":", 1)
    derived_fields: dict[str, Any] = {
        "cycle_s": settings.cycle_ms / 1e3,
        "declared_cycle_s": settings.declared_cycle_ms and settings.declared_cycle_ms / 1e3,
        "controller": str(settings.controller),
        "correction_tag": settings.tag,
        "geometry": settings.wrist.lengths,
        "velocity_deg_s": arm.velocity_deg_s,
        "acceleration_deg_s2": arm.acceleration_deg_s2,
        "jerk_deg_s3": arm.jerk_deg_s3,
    }
    passed_on = {f.name: getattr(settings, f.name) for f in fields(Config) if f.name not in derived_fields}
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as link:
        try:
            link.bind((host, int(port)))
        except OSError as error:
            raise DeviceLost(
                "robot",
                expected=f"to listen for the controller at {settings.listen}",
                happened=str(error),
                remedy="End the other program that uses this port, or change `listen`",
            ) from error
        memory_fd = os.memfd_create("coupole-rsi")
        try:
            os.truncate(memory_fd, shared_state.BLOCK_BYTES)
            block = shared_state.Block(memory_fd)
            process = subprocess.Popen(
                [
                    sys.executable,
                    *("-m", "drivers.kuka.rsi.loop"),
                    *map(str, (link.fileno(), memory_fd, os.getpid())),
                    json.dumps(derived_fields | passed_on),
                ],
                pass_fds=(link.fileno(), memory_fd),
                stdin=subprocess.DEVNULL,
                start_new_session=True,
            )
        finally:
            os.close(memory_fd)
    return process, block
