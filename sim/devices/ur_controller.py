"""The stand-in for a UR arm and its controller, at the other end of ur-rtde: RTDE, dashboard, script upload.

It does the work of ur-rtde's uploaded program (`ur_script`), and moves its arm with trapezoidal speed profiles. It
stops like the real one on an emergency stop, a protective stop, or a silent watchdog. The ports are UR's own,
30003, 30004 and 29999, because ur-rtde cannot use others. So each stand-in needs its own address in 127.0.0.0/8.
ur-rtde works only in real time. So with a world speed other than 1, this stand-in raises InputError.
"""

from __future__ import annotations

import math
import random
import re
import socket
from collections.abc import Sequence
from enum import IntEnum
from typing import Literal

import numpy as np
from pydantic import BaseModel, ConfigDict, Field

from coupole.errors import InputError
from coupole.geometry import Transform
from sim.devices.kuka_kinematics import turn
from sim.devices.ur_arm import Motion, Six, UrModel, brake, flange_pose, movej, movel, rotation_vector
from sim.devices.ur_rtde_session import RtdeSession
from sim.devices.ur_rtde_wire import Value
from sim.devices.ur_script import ControlScript
from sim.devices.ur_tcp import Connection, TcpPort
from sim.world.pushes import Pushes
from sim.world.reactor import Reactor

_ANY = "127.0.0.0"
_DASHBOARD, _SCRIPT, _RTDE = 29999, 30003, 30004
_CYCLE_NS = 2_000_000
_END_OF_PROGRAM = re.compile(rb"^end\r?\n", re.MULTILINE)
_ROBOT_MODE_RUNNING, _ROBOT_MODE_POWER_OFF = 7, 3
_SAFETY_NORMAL, _SAFETY_PROTECTIVE, _SAFETY_SAFEGUARD = 0x001, 0x404, 0x410
_SAFETY_EMERGENCY, _SAFETY_FAULT = 0x4C0, 0x600
"""safety_status_bits: 0 normal, 2 protective stop, 4 safeguard stop, 6 robot and 7 any emergency stop, 9 fault,
10 stopped for safety."""


class _Runtime(IntEnum):
    """RTDE's runtime_state."""

    STOPPED = 1
    PLAYING = 2
    PAUSED = 4


class Settings(BaseModel):
    """Settings of the stand-in in the rig's world."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    kind: Literal["ur"] = "ur"
    model: UrModel = "ur10e"
    address: str = Field(default=_ANY, pattern=r"^127\.\d+\.\d+\.\d+$")
    """Loopback address to listen at; the default chooses a free one, see `UrController.address`."""
    start_joints_deg: tuple[float, float, float, float, float, float] = (0.0, -90.0, 90.0, 0.0, 90.0, 0.0)
    tcp_offset_m_rad: tuple[float, float, float, float, float, float] = (0.0, 0.0, 0.1, 0.0, 0.0, 0.5)
    """Flange to tool centre point: x, y, z in m and a rotation vector in rad."""
    brake_deg_s2: float = Field(default=600.0, gt=0)
    """Deceleration of the leading axis when the controller itself stops the arm."""
    start_program_s: float = Field(default=0.05, gt=0)
    """Time from the upload of a program until it runs."""


class UrController:
    """One controller. All methods must be called on the reactor's thread."""

    def __init__(self, reactor: Reactor, settings: Settings) -> None:
        """Raises InputError in a world that does not run in real time."""
        if reactor.clock.speed != 1.0:
            raise InputError(
                f"a UR stand-in works in real time only: the world's speed is {reactor.clock.speed:g}, not 1"
            )
        self.fault = ""
        """Reason why the controller ended the last program; empty if it did not."""
        self.settled_since_ns: int | None = reactor.now_ns
        """World time since which the axes are at rest; None while they move."""
        self.remote_control = True
        """False: the pendant has control, programs from the network are refused."""
        self._reactor, self._settings = reactor, settings
        self._motion: Motion | None = None
        self._commanded_deg: Six = settings.start_joints_deg
        self._velocity_deg_s: Six = (0.0,) * 6
        self._pushes = Pushes(reactor)
        self._script: ControlScript | None = None
        self._runtime = _Runtime.STOPPED
        self._safety_bits, self._robot_mode = _SAFETY_NORMAL, _ROBOT_MODE_RUNNING
        self._inputs: dict[str, Value] = {}
        self._heard_ns = 0
        """World time at which a client last wrote registers, for the watchdog."""
        self._sessions: dict[Connection, RtdeSession] = {}
        self._values: dict[str, Value] | None = None
        self.address = host = _free_address() if settings.address == _ANY else settings.address
        self._ports = (
            TcpPort(reactor, (host, _RTDE), self._open_session, lambda c: self._sessions[c].take()),
            TcpPort(reactor, (host, _DASHBOARD), self._greet, self._answer_dashboard),
            TcpPort(reactor, (host, _SCRIPT), lambda _: None, self._take_program),
        )
        self._timer = reactor.after(0.0, self._cycle)

    @property
    def joints_deg(self) -> Six:
        """The present axes, as measured and reported by the controller."""
        return tuple(map(float.__add__, self._commanded_deg, self._pushes.deg))

    @property
    def moving(self) -> bool:
        return self.settled_since_ns is None

    @property
    def program_state(self) -> str:
        """STOPPED, PLAYING or PAUSED, as reported by the dashboard."""
        return self._runtime.name

    def true_base_from_flange(self) -> Transform:
        """True pose of the flange."""
        return flange_pose(self._settings.model, self.joints_deg)

    def estop(self) -> None:
        """Emergency stop: the arm brakes and loses power, the program ends."""
        self._safety_bits, self._robot_mode = _SAFETY_EMERGENCY, _ROBOT_MODE_POWER_OFF
        self._end_program("emergency stop", _Runtime.STOPPED)

    def protective_stop(self) -> None:
        """Collision detected: the arm brakes, the program pauses until it is ended."""
        self._safety_bits = _SAFETY_PROTECTIVE
        self._end_program("protective stop", _Runtime.PAUSED if self._script else _Runtime.STOPPED)

    def safeguard_stop(self) -> None:
        """The cell's door is opened: the arm brakes, the program pauses."""
        self._safety_bits = _SAFETY_SAFEGUARD
        self._end_program("safeguard stop", _Runtime.PAUSED if self._script else _Runtime.STOPPED)

    def safety_fault(self) -> None:
        """The controller's safety system fails: the arm loses power, the program ends."""
        self._safety_bits, self._robot_mode = _SAFETY_FAULT, _ROBOT_MODE_POWER_OFF
        self._end_program("safety fault", _Runtime.STOPPED)

    def reset(self) -> None:
        """The operator acknowledges all faults, powers the arm and releases its brakes."""
        self.fault = ""
        self._safety_bits, self._robot_mode = _SAFETY_NORMAL, _ROBOT_MODE_RUNNING
        self._commanded_deg = self.joints_deg
        self._pushes.forget()

    def stop_program(self) -> None:
        """The operator presses stop at the pendant."""
        self._end_program("stopped at the pendant", _Runtime.STOPPED)

    def lose_link(self, seconds: float) -> None:
        """Cut the network for `seconds`; existing connections do not recover."""
        for port in self._ports:
            port.mute()
        self._reactor.after(seconds, self._restore_link)

    def drop_link(self) -> None:
        """All connections end, as when the controller's network restarts."""
        for port in self._ports:
            port.drop()

    def nudge(self, joints_deg: Sequence[float], seconds: float | None = None) -> None:
        """Displace the arm by six angles; after `seconds`, if given, it springs back."""
        self._pushes.push(joints_deg, seconds)

    def close(self) -> None:
        self._timer.cancel()
        for port in self._ports:
            port.close()

    def start_movej(self, target_deg: Six, speed_deg_s: float, acceleration_deg_s2: float) -> None:
        """Start movej. The program calls this, and the next two methods."""
        now_ns = self._reactor.now_ns
        self._start(movej(self._commanded_deg, target_deg, speed_deg_s, acceleration_deg_s2, now_ns))

    def start_movel(self, tool_pose_m_rad: Six, speed_m_s: float, acceleration_m_s2: float) -> None:
        tool = _transform(tool_pose_m_rad), _transform(self._settings.tcp_offset_m_rad)
        now_ns = self._reactor.now_ns
        self._start(movel(self._settings.model, self._commanded_deg, *tool, speed_m_s, acceleration_m_s2, now_ns))

    def start_stopj(self, deceleration_deg_s2: float) -> None:
        if self.moving:
            now_ns = self._reactor.now_ns
            self._motion = brake(self._commanded_deg, self._velocity_deg_s, deceleration_deg_s2, now_ns)

    def _start(self, motion: Motion | None) -> None:
        """Start a motion. If the arm moves, the program ends in a fault: a real arm's reaction is undocumented."""
        if self.moving:
            self._end_program("another motion while the arm moved", _Runtime.STOPPED)
        elif motion is None:
            self._end_program("no path along that line", _Runtime.STOPPED)
        else:
            self._motion, self.settled_since_ns = motion, None

    def _cycle(self) -> None:
        """One controller cycle, every 2 ms."""
        now_ns = self._reactor.now_ns
        if self._motion is not None:
            self._commanded_deg, self._velocity_deg_s, goes_on = self._motion.at(now_ns)
            if not goes_on:
                self._motion = None
                self.settled_since_ns = now_ns
        if self._script is not None and self._runtime is _Runtime.PLAYING:
            self._run_program(self._script, now_ns)
        self._values = None
        for connection, session in list(self._sessions.items()):
            session.cycle(self._variables)
            if connection.gone:
                del self._sessions[connection]
        self._timer = self._reactor.at(now_ns + _CYCLE_NS, self._cycle)

    def _run_program(self, script: ControlScript, now_ns: int) -> None:
        script.cycle(self._inputs)
        silent_s = (now_ns - self._heard_ns) / 1e9
        if script.ended:
            self._end_program(script.ended, _Runtime.STOPPED)
        elif script.watchdog_s is not None and silent_s > script.watchdog_s:
            self._end_program(f"RTDE watchdog: {silent_s:.2f} s of silence", _Runtime.STOPPED)

    def _end_program(self, why: str, runtime: _Runtime) -> None:
        self.fault = self.fault or why
        self._runtime = runtime
        if runtime is _Runtime.STOPPED:
            self._script = None
        self.start_stopj(self._settings.brake_deg_s2)

    def _start_program(self) -> None:
        if self._runtime is _Runtime.STOPPED and self._safety_bits == _SAFETY_NORMAL and self.remote_control:
            self.fault = ""
            self._script = ControlScript(self, self._settings.tcp_offset_m_rad)
            self._runtime = _Runtime.PLAYING
            self._heard_ns = self._reactor.now_ns

    def _restore_link(self) -> None:
        for port in self._ports:
            port.unmute()

    def _open_session(self, connection: Connection) -> None:
        self._sessions[connection] = RtdeSession(connection, self._take_inputs)

    def _take_inputs(self, values: dict[str, Value]) -> None:
        self._inputs.update(values)
        self._heard_ns = self._reactor.now_ns

    def _take_program(self, connection: Connection) -> None:
        """Take a program, which is complete with its last line, an unindented `end`."""
        if _END_OF_PROGRAM.search(connection.inbox):
            connection.inbox.clear()
            if self._runtime is not _Runtime.STOPPED:
                self._end_program("replaced by another program", _Runtime.STOPPED)
            self._reactor.after(self._settings.start_program_s, self._start_program)

    def _greet(self, connection: Connection) -> None:
        connection.send(b"Connected: Universal Robots Dashboard Server\n")

    def _answer_dashboard(self, connection: Connection) -> None:
        while b"\n" in connection.inbox:
            line, _, rest = bytes(connection.inbox).partition(b"\n")
            connection.inbox[:] = rest
            connection.send(self._dashboard_answer(line.decode(errors="replace").strip()).encode() + b"\n")

    def _dashboard_answer(self, question: str) -> str:
        """Answer as in Universal Robots, "Dashboard Server e-Series"."""
        if question == "stop":
            self._end_program("stopped over the dashboard", _Runtime.STOPPED)
            return "Stopped"
        safety = {
            _SAFETY_NORMAL: "NORMAL",
            _SAFETY_PROTECTIVE: "PROTECTIVE_STOP",
            _SAFETY_SAFEGUARD: "SAFEGUARD_STOP",
            _SAFETY_EMERGENCY: "ROBOT_EMERGENCY_STOP",
            _SAFETY_FAULT: "FAULT",
        }
        answers = {
            "PolyscopeVersion": "URSoftware 5.15.0.126600 (simulated)",
            "get serial number": "20245500001",
            "get robot model": self._settings.model.upper().removesuffix("E"),
            "is in remote control": str(self.remote_control).lower(),
            "robotmode": f"Robotmode: {'RUNNING' if self._robot_mode == _ROBOT_MODE_RUNNING else 'POWER_OFF'}",
            "safetystatus": f"Safetystatus: {safety[self._safety_bits]}",
            "programState": f"{self.program_state} rtde_control.urp",
        }
        return answers.get(question, f"could not understand: '{question}'")

    def _variables(self) -> dict[str, Value]:
        """All RTDE variables, computed once per cycle."""
        if self._values is None:
            pose = self.true_base_from_flange() @ _transform(self._settings.tcp_offset_m_rad)
            self._values = {
                "timestamp": self._reactor.now_ns / 1e9,
                "target_q": _radians(self._commanded_deg),
                "target_qd": _radians(self._velocity_deg_s),
                "actual_q": _radians(self.joints_deg),
                "actual_qd": _radians(self._velocity_deg_s),
                "actual_TCP_pose": (*(pose[:3, 3] / 1e3).tolist(), *rotation_vector(pose[:3, :3])),
                "robot_mode": self._robot_mode,
                "safety_status_bits": self._safety_bits,
                "robot_status_bits": 1 + 2 * (self._runtime is _Runtime.PLAYING),
                "runtime_state": int(self._runtime),
                "speed_scaling": 1.0,
                "target_speed_fraction": 1.0,
                **(self._script.outputs if self._script else {}),
            }
        return self._values


def _free_address() -> str:
    """A loopback address at which UR's ports are free."""
    while True:
        host = f"127.{random.randint(1, 254)}.{random.randint(0, 254)}.{random.randint(1, 254)}"
        try:
            for port in (_DASHBOARD, _SCRIPT, _RTDE):
                socket.create_server((host, port)).close()
        except OSError:
            continue
        return host


def _radians(angles_deg: Six) -> Six:
    return tuple(map(math.radians, angles_deg))


def _transform(pose_m_rad: Six) -> Transform:
    """A UR pose (x, y, z in m, rotation vector in rad) as 4x4 in mm."""
    result = np.eye(4)
    result[:3, 3] = np.array(pose_m_rad[:3]) * 1e3
    angle = math.hypot(*pose_m_rad[3:])
    if angle > 0.0:
        result[:3, :3] = turn([v / angle for v in pose_m_rad[3:]], math.degrees(angle))
    return result
