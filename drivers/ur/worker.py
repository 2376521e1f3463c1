"""The process that talks to a UR controller through ur-rtde, for `drivers.ur.driver`.

    python -m drivers.ur.worker SOCKET_FD CONFIG_JSON

The library runs in a separate process for four reasons, observed with ur-rtde 1.6: it prints on standard output;
its constructor and moveJ can hang for minutes; after a lost link its getters keep returning stale data; and it
reconnects and restarts its program by itself. A process can be ended, and this one ends itself when the link is
lost.

The controller monitors this process (RTDE watchdog). Silence ends the program, and so all motion.
"""

from __future__ import annotations

import contextlib
import json
import math
import os
import select
import signal
import socket
import sys
import time
from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import Any

from drivers.ur.dashboard import CannotBegin, end_program, ready_controller, why_ended
from drivers.ur.messages import (
    EMERGENCY_STOP_BITS,
    PROTECTIVE_STOP_BIT,
    RUNNING,
    SAFEGUARD_STOP_BIT,
    Ask,
    Config,
    Six,
    State,
    receive,
    send,
)

_VARIABLES = [
    "timestamp",
    "target_q",
    "actual_q",
    "actual_qd",
    "actual_TCP_pose",
    "robot_mode",
    "safety_status_bits",
    "runtime_state",
    "target_speed_fraction",
]
_RUNTIME_PLAYING = 2
_SAFETY_FAULTS = (
    (EMERGENCY_STOP_BITS, "emergency stop"),
    (PROTECTIVE_STOP_BIT, "protective stop"),
    (SAFEGUARD_STOP_BIT, "safeguard stop"),
    (0x300, "safety fault"),
)
"""Bits of RTDE's safety_status_bits, most serious first."""
_NAMING_SAMPLES = 10
"""Number of samples between the end of a program and its fault. The safety bits with the cause come after the
end."""
_CANNOT_BEGIN, _LOST = 1, 2
"""Exit codes."""
_LEAVE_S = 3
"""Longest time for which the process continues after `leave`, or after the driver's death."""


class Link:
    """The library's two interfaces, and the state derived from them."""

    def __init__(self, config: Config) -> None:
        self.config = config
        model, serial, firmware = ready_controller(config)
        try:
            from rtde_control import RTDEControlInterface  # type: ignore[import-not-found]
            from rtde_receive import RTDEReceiveInterface  # type: ignore[import-not-found]
        except ImportError as error:
            raise CannotBegin("refused", "the package ur-rtde", str(error), "Install the extra `ur`") from error
        try:
            self._receive: Any = RTDEReceiveInterface(config.host, config.frequency_hz, _VARIABLES)
            self._control: Any = RTDEControlInterface(config.host, config.frequency_hz)
            has_watchdog = self._control.setWatchdog(1.0 / config.watchdog_s)
            tcp_offset = self._control.getTCPOffset()
        except (RuntimeError, ValueError) as error:
            raise CannotBegin("lost", "a session of ur-rtde", str(error), "See the controller's log") from error
        if not has_watchdog:
            raise CannotBegin("fault", "a watched program", "it took no watchdog", "See the controller's log")
        self._goal_deg: Six | None = None
        self._pending_deg: Six | None = None
        self._pending_speed = 1.0
        """A target that waits until the arm is at rest, because the effect of movej on a moving arm is not
        documented."""
        self._quiet_samples = self._astray_samples = self._ended_samples = 0
        self._timestamp_s = -1.0
        self._changed_s = self._kicked_s = self._looked_s = time.monotonic()
        zeros = (0.0,) * 6
        self.state = State(
            command=0,
            joints_deg=zeros,
            wanted_deg=zeros,
            tcp_pose_m_rad=zeros,
            tcp_offset_m_rad=_six(tcp_offset),
            speed_fraction=0.0,
            still_samples=0,
            samples=0,
            max_gap_s=0.0,
            max_call_s=0.0,
            model=model,
            serial=serial,
            firmware=firmware,
        )

    def tick(self) -> None:
        """Read the controller's state, kick its watchdog, and start a pending motion. End a motion that nobody
        watches."""
        self._look()
        if self.state.fault:
            return
        self._attend()
        now_s = time.monotonic()
        if now_s - self._kicked_s > self.config.watchdog_s / 5.0:
            self._kicked_s = now_s
            self._call(self._control.kickWatchdog)
        if self._pending_deg is not None and self._quiet_samples >= self.config.settle_samples:
            self._start(self._pending_deg, self._pending_speed)

    def obey(self, ask: Ask) -> None:
        """Begin a command. After a fault, do nothing. The answer is `state`."""
        if ask.looks or ask.verb == "move":
            self._looked_s = time.monotonic()
        if ask.verb == "state" or self.state.fault:
            return
        stands = self._is_settled()
        self.state = replace(self.state, command=ask.number, still_samples=0)
        self._quiet_samples, self._goal_deg = 0, None
        if ask.verb == "move" and ask.target_deg is not None and stands:
            self._start(ask.target_deg, ask.speed)
            return
        self._call(lambda: self._control.stopJ(math.radians(self.config.stop_deg_s2), True))
        self._pending_deg, self._pending_speed = ask.target_deg, ask.speed

    def _attend(self) -> None:
        """Brake if nobody has looked at a motion for too long (`coupole.supervision`)."""
        pursues = self._pending_deg is not None or (self._goal_deg is not None and not self._is_settled())
        if pursues and time.monotonic() - self._looked_s > self.config.attention_s:
            self.state = replace(self.state, lapses=self.state.lapses + 1, still_samples=0)
            self._quiet_samples, self._goal_deg, self._pending_deg = 0, None, None
            self._call(lambda: self._control.stopJ(math.radians(self.config.stop_deg_s2), True))

    def leave(self) -> None:
        """Bring the arm to rest and end the program. A hang here ends the process by SIGALRM."""
        signal.alarm(_LEAVE_S)
        self.obey(Ask("stop", self.state.command))
        while not self.state.fault and not self._is_settled():
            time.sleep(1.0 / self.config.frequency_hz)
            self.tick()
        if not self.state.lost:
            end_program(self.config.host)

    def _is_settled(self) -> bool:
        return self.state.still_samples >= self.config.settle_samples

    def _start(self, target_deg: Six, share: float) -> None:
        config = self.config
        self._goal_deg, self._pending_deg = target_deg, None
        self.state = replace(self.state, still_samples=0)
        target = [math.radians(angle) for angle in target_deg]
        speed = math.radians(share * config.speed_deg_s)
        acceleration = math.radians(config.acceleration_deg_s2)
        if not self._call(lambda: self._control.moveJ(target, speed, acceleration, True)):
            time.sleep(_NAMING_SAMPLES / config.frequency_hz)
            self._look()  # so that a safety stop is reported as such
            if not self.state.fault:
                self._latch("program stopped: it did not take moveJ")

    def _call(self, call: Callable[[], Any]) -> Any:
        began_s = time.monotonic()
        result = call()
        took_s = time.monotonic() - began_s
        self.state = replace(self.state, max_call_s=max(self.state.max_call_s, took_s))
        return result

    def _look(self) -> None:
        """Read the controller's sample and, if it is new, evaluate it."""
        timestamp_s, now_s = self._receive.getTimestamp(), time.monotonic()
        age_s = now_s - self._changed_s
        if not (self._receive.isConnected() and self._control.isConnected()):
            end_program(self.config.host)
            self._latch("link lost: the controller closed it", is_lost=True)
            return
        if timestamp_s == self._timestamp_s:
            if age_s > self.config.link_timeout_s:
                self._latch(f"link lost: no sample for {age_s:.2f} s", is_lost=True)
            return
        self._timestamp_s, self._changed_s = timestamp_s, now_s
        joints_deg, wanted_deg = _degrees(self._receive.getActualQ()), _degrees(self._receive.getTargetQ())
        speed_deg_s = max(map(abs, _degrees(self._receive.getActualQd())))
        self._quiet_samples = self._quiet_samples + 1 if speed_deg_s < self.config.settle_deg_s else 0
        at_target = _apart(joints_deg, self._goal_deg or wanted_deg) < self.config.settle_deg
        still = self._quiet_samples > 0 and at_target and self._pending_deg is None
        self.state = replace(
            self.state,
            joints_deg=joints_deg,
            wanted_deg=wanted_deg,
            tcp_pose_m_rad=_six(self._receive.getActualTCPPose()),
            speed_fraction=self._receive.getTargetSpeedFraction(),
            still_samples=self.state.still_samples + 1 if still else 0,
            samples=self.state.samples + 1,
            max_gap_s=max(self.state.max_gap_s, age_s),
            robot_mode=self._receive.getRobotMode(),
            safety_bits=self._receive.getSafetyStatusBits(),
        )
        if not self.state.fault:
            self._evaluate(_apart(joints_deg, wanted_deg))

    def _evaluate(self, astray_deg: float) -> None:
        """Latch the fault that the last sample shows, if any."""
        config = self.config
        self._astray_samples = self._astray_samples + 1 if astray_deg > config.follow_deg else 0
        plays = self._receive.getRuntimeState() == _RUNTIME_PLAYING
        self._ended_samples = 0 if plays else self._ended_samples + 1
        bits, mode = self.state.safety_bits, self.state.robot_mode
        for mask, name in _SAFETY_FAULTS:
            if bits & mask:
                self._latch(f"{name} (safety status {bits:#x})")
                return
        if mode != RUNNING:
            self._latch(f"arm not running (robot mode {mode})")
        elif self._astray_samples >= config.follow_samples:
            self._latch(f"the arm does not follow: it is {astray_deg:.2f} deg off")
        elif self._ended_samples >= _NAMING_SAMPLES:
            self._latch(why_ended(config.host))

    def _latch(self, fault: str, *, is_lost: bool = False) -> None:
        """Latch a fault: no more commands are taken. The program is ended, so that no acknowledgement resumes a
        motion."""
        self._goal_deg = self._pending_deg = None
        self.state = replace(self.state, fault=fault, lost=is_lost)
        if not is_lost:
            end_program(self.config.host)


def _six(values: Sequence[float]) -> Six:
    x, y, z, u, v, w = values
    return x, y, z, u, v, w


def _degrees(values: Sequence[float]) -> Six:
    return _six([math.degrees(v) for v in values])


def _apart(a_deg: Six, b_deg: Six) -> float:
    return max(abs(a - b) for a, b in zip(a_deg, b_deg, strict=True))


def serve(driver: socket.socket, link: Link) -> None:
    """Answer the driver until it sends `leave` or ends, or until the link is lost."""
    config = link.config
    period_s = 1.0 / config.frequency_hz
    is_open, next_s = False, time.monotonic()
    while not link.state.lost:
        if select.select([driver], [], [], max(0.0, next_s - time.monotonic()))[0]:
            ask = receive(driver)
            if not isinstance(ask, Ask) or ask.verb == "leave":
                link.leave()
                return
            link.obey(ask)
            send(driver, link.state)
        if time.monotonic() >= next_s:
            next_s = time.monotonic() + period_s
            link.tick()
            if not is_open and (link.state.samples >= config.settle_samples or link.state.fault):
                send(driver, link.state)
                is_open = True
    send(driver, link.state)


def main() -> None:
    """Serve, then end by os._exit with `link` alive. The reason is that on a lost link the library's destructors
    hang, and meanwhile the library reconnects and restarts its program."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    driver = socket.socket(fileno=int(sys.argv[1]))
    try:
        link = Link(Config(**json.loads(sys.argv[2])))
    except CannotBegin as error:
        send(driver, error.failure)
        os._exit(_CANNOT_BEGIN)
    with contextlib.suppress(ConnectionError):  # the driver has ended
        serve(driver, link)
    os._exit(_LOST if link.state.lost else 0)


if __name__ == "__main__":
    main()
