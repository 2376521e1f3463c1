"""The stand-in for a KUKA controller with the EthernetKRL programs of `configs/kuka/eki`: XML over TCP.

Like these programs it has two parts. One takes commands and sends statuses at a steady rate, even while the robot
program is in a fault. The other runs point-to-point motions, and brakes when a new command comes. The axes are
computed from world time, not in steps, so they are exact at any world speed.
"""

from __future__ import annotations

import math
import select
import socket
import time
from collections.abc import Sequence
from typing import Literal
from xml.etree import ElementTree

from pydantic import BaseModel, ConfigDict, Field

from coupole.geometry import Transform, abc_from_rotation
from sim.devices.kuka_eki_wire import ASK, BEAT, MOVE, Command, Messages
from sim.devices.kuka_kinematics import AXIS_LIMITS_DEG, AXIS_SPEEDS_DEG_S, PoseErrors, flange_pose
from sim.devices.kuka_ptp import Motion, braking_motion, point_to_point, standing
from sim.strangers.arm_stranger import NO_STRANGER, ArmStranger
from sim.world.pushes import Pushes
from sim.world.reactor import Reactor, Timer

Six = tuple[float, float, float, float, float, float]

_NO_FAULT, _EMERGENCY_STOP, _TARGET_REFUSED = 0, 1, 5
_TRY_AGAIN_S = 0.1
_UNSENT_BYTES = 4096
"""Size of the send buffer. When it is full, the world pauses, so that it does not run ahead of its client."""
_HARD = 100.0
"""Factor on the jerk in an emergency stop, which is practically not jerk-limited."""


class Settings(BaseModel):
    """Settings of the stand-in in the rig's world."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    kind: Literal["eki"] = "eki"
    address: str = Field(default="127.0.0.1:0", pattern=r"^[^:]+:\d+$")
    """host:port to listen at, or to connect to. Port 0 means any free port; see `KukaEkiController.address`."""
    controller_is: Literal["server", "client"] = "server"
    status_ms: int = Field(default=20, ge=4)
    beat_s: float = Field(default=0.1, gt=0)
    """A motion ends if no command comes for this time. It is counted on the machine's clock, because the
    supervisor uses that clock, and a world may run faster."""
    ping_s: float = Field(default=0.2, gt=0)
    """World time after which the controller detects a dead link, and brakes."""
    write_limit_s: float = Field(default=2.0, gt=0)
    """Longest pause of the world, in machine time, for a client that does not read its statuses."""
    full_acceleration_deg_s2: float = Field(default=600.0, gt=0)
    """Acceleration at 100 %."""
    jerk_deg_s3: float = Field(default=3000.0, gt=0)
    start_joints_deg: Six = (0.0, -90.0, 90.0, 0.0, 90.0, 0.0)
    brake_deg_s2: float = Field(default=1000.0, gt=0)
    """Deceleration of the fastest axis in an emergency stop."""
    override_percent: int = Field(default=100, ge=1, le=100)
    seed: int = 0
    repeatability_um: float = Field(default=10.0, ge=0)
    repeatability_deg: float = Field(default=0.001, ge=0)
    """Standard deviation, per coordinate, of the error that varies from stop to stop."""
    absolute_mm: float = Field(default=0.0, ge=0)
    absolute_deg: float = Field(default=0.0, ge=0)
    """Standard deviation, over arms, of the constant error: see `PoseErrors`."""


class KukaEkiController:
    """One controller. All methods must be called on the reactor's thread."""

    def __init__(self, reactor: Reactor, settings: Settings, stranger: ArmStranger = NO_STRANGER) -> None:
        self.fault = ""
        """Reason why the robot program does not run; empty while it does."""
        self.settled_since_ns: int | None = reactor.now_ns
        """World time since which the axes are at rest; None while they move."""
        self.errors = PoseErrors.of(settings, stranger)
        self._reactor, self._settings = reactor, settings
        self._motion: Motion = standing(settings.start_joints_deg)
        self._begun_ns = reactor.now_ns
        self._acceleration_deg_s2 = settings.full_acceleration_deg_s2
        self._pushes = Pushes(reactor)
        self._stops = 0
        self._came_from_deg = self._stood_at_deg = tuple(settings.start_joints_deg)
        """The axes at the stop before the last, and at the last."""
        self._end: Timer | None = None
        self._session = self._taken = self._done = self._order = 0
        self._refused = False
        self._heard_s = 0.0
        """Machine time of the last command."""
        self._watched = self._lapsed = 0
        """Number of the present MOVE, and of the last one that ended because no command came."""
        self._target: tuple[tuple[float, ...], float] | None = None
        """Axes and speed (fraction of the highest) of the motion to begin once the axes are at rest."""
        self._client: socket.socket | None = None
        self._parser = Messages()
        self._unsent = b""
        """The rest of a status that did not fit into the send buffer."""
        self._left_behind = False
        """True if the client has not read for as long as the world waits for it."""
        self._cut = False
        """True while `lose_link` blocks all communication."""
        self._healing: Timer | None = None
        self._listener: socket.socket | None = None
        self.address = _with_free_port(settings.address)
        """host:port where it listens, or where it connects to."""
        if settings.controller_is == "server":
            host, port = self.address.rsplit(":", 1)
            self._listener = socket.create_server((host, int(port)))
            self._listener.setblocking(False)
        self._open()
        self._timer = reactor.after(settings.status_ms / 1e3, self._cycle)

    @property
    def joints_deg(self) -> tuple[float, ...]:
        """The present axes, as measured and reported by the controller."""
        path_deg = self._motion.joints_deg((self._reactor.now_ns - self._begun_ns) / 1e9)
        return tuple(map(float.__add__, path_deg, self._pushes.deg))

    @property
    def moving(self) -> bool:
        return self.settled_since_ns is None

    def true_base_from_flange(self) -> Transform:
        """True pose of the flange: the controller's, with the arm's constant error and the error of the last
        stop."""
        return self.errors.true_flange_pose(self.joints_deg, self._stops, self._came_from_deg)

    def estop(self) -> None:
        """Emergency stop: the axes brake hard, the robot program ends until `reset`; statuses continue."""
        self.fault = "emergency stop"
        self._target = None
        self._brake(self._settings.brake_deg_s2, _HARD * self._settings.jerk_deg_s3)

    def reset(self) -> None:
        """Acknowledge all faults and restart the robot program, from the present axes."""
        self.fault = ""

    def lose_link(self, seconds: float) -> None:
        """Block all communication for `seconds`. The axes brake, then the controller accepts a connection."""
        self._unlisten()
        self._reactor.after(self._settings.ping_s, self._abandon)
        if self._healing is not None:
            self._healing.cancel()
        self._healing = self._reactor.after(seconds, self._heal)

    def nudge(self, joints_deg: Sequence[float], seconds: float | None = None) -> None:
        """Displace the arm by six angles; after `seconds`, if given, it springs back."""
        self._pushes.push(joints_deg, seconds)
        self._stops += not self.moving

    def close(self) -> None:
        self._timer.cancel()
        self._unlisten()
        self._hang_up()
        if self._listener is not None:
            self._listener.close()

    # -- the submit interpreter: commands in, statuses out ------------------------------------------------

    def _open(self) -> None:
        """Listen for a connection, or try to connect."""
        if self._listener is not None:
            self._reactor.add_reader(self._listener, self._accept)
        else:
            self._reactor.after(_TRY_AGAIN_S, self._connect)

    def _unlisten(self) -> None:
        """Read nothing more, neither from the client nor from new ones."""
        for port in (self._listener, self._client):
            if port is not None and not self._cut:
                self._reactor.remove_reader(port)
        self._cut = True

    def _accept(self) -> None:
        assert self._listener is not None
        try:
            client, _ = self._listener.accept()
        except OSError:  # it has left already
            return
        if self._client is not None:
            self._receive()  # detects a client that has already left
        if self._client is not None:
            client.close()  # EKI serves one client
        else:
            self._welcome(client)

    def _connect(self) -> None:
        if self._cut:
            return
        host, port = self.address.rsplit(":", 1)
        try:
            self._welcome(socket.create_connection((host, int(port)), timeout=1.0))
        except OSError:
            self._reactor.after(_TRY_AGAIN_S, self._connect)

    def _welcome(self, client: socket.socket) -> None:
        client.setblocking(False)
        client.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        client.setsockopt(socket.SOL_SOCKET, socket.SO_SNDBUF, _UNSENT_BYTES)
        self._client, self._parser, self._unsent, self._left_behind = client, Messages(), b"", False
        self._reactor.add_reader(client, self._receive)

    def _receive(self) -> None:
        assert self._client is not None
        try:
            data = self._client.recv(65536)
        except BlockingIOError:
            return
        except OSError:
            data = b""
        if not data:
            self._drop()
            return
        try:
            for message in self._parser.messages(data):
                self._take(Command.of(message))
        except (ElementTree.ParseError, KeyError, ValueError):
            self._drop()

    def _drop(self) -> None:
        """Drop the client: it has left, or sends data that are not commands."""
        self._hang_up()
        self._abandon()
        if self._listener is None:
            self._open()

    def _hang_up(self) -> None:
        if self._client is not None:
            if not self._cut:
                self._reactor.remove_reader(self._client)
            self._client.close()
            self._client = None

    def _abandon(self) -> None:
        """The link is lost: cancel the target and brake."""
        self._target = None
        self._brake(self._acceleration_deg_s2, self._settings.jerk_deg_s3)

    def _heal(self) -> None:
        self._hang_up()
        self._cut = False
        self._open()

    def _take(self, command: Command) -> None:
        if command.session != self._session:
            self._session, self._done, self._refused, self._lapsed = command.session, 0, False, 0
            if not self.moving:  # the present axes become the target of the new session
                self._motion = standing(self.joints_deg)
                self._pushes.forget()
        self._taken = command.number
        self._heard_s = time.monotonic()
        if command.verb in (ASK, BEAT):
            return
        self._watched = command.number if command.verb == MOVE else 0
        self._order, self._target = command.number, None
        if self.fault:
            return
        if command.verb == MOVE:
            self._refused = not _within_limits(command.axes_deg)
            if not self._refused:
                self._target = command.axes_deg, command.velocity_percent / 100.0
        self._brake(self._acceleration_deg_s2, self._settings.jerk_deg_s3)
        share = command.acceleration_percent / 100.0
        self._acceleration_deg_s2 = share * self._settings.full_acceleration_deg_s2

    def _watch(self) -> None:
        """End a motion that nobody watches any more."""
        if not self._watched or time.monotonic() - self._heard_s <= self._settings.beat_s:
            return
        self._lapsed, self._watched, self._target = self._watched, 0, None
        self._brake(self._acceleration_deg_s2, self._settings.jerk_deg_s3)

    def _cycle(self) -> None:
        self._watch()
        if self._client is not None and not self._cut:
            self._send(self._status())
        self._timer = self._reactor.after(self._settings.status_ms / 1e3, self._cycle)

    def _send(self, status: bytes) -> None:
        """Send a status. A client that has not read for `write_limit_s` no longer delays the world. Until it
        reads, it misses statuses; each status that it gets is complete.
        """
        assert self._client is not None
        self._unsent = self._unsent or status
        while self._unsent:
            limit_s = 0.0 if self._left_behind else self._settings.write_limit_s
            try:
                if not select.select([], [self._client], [], limit_s)[1]:
                    self._left_behind = True
                    return
                self._unsent = self._unsent[self._client.send(self._unsent) :]
            except OSError:
                return  # the client is gone; `_receive` detects it
        self._left_behind = False

    def _status(self) -> bytes:
        axes = " ".join(f'A{axis}="{angle:.4f}"' for axis, angle in enumerate(self.joints_deg, start=1))
        base_from_flange = flange_pose(self.joints_deg)
        pose = (*base_from_flange[:3, 3], *abc_from_rotation(base_from_flange[:3, :3]))
        fault = _EMERGENCY_STOP if self.fault else _TARGET_REFUSED if self._refused else _NO_FAULT
        return (
            f'<Coupole><Status Session="{self._session}" Taken="{self._taken}" Done="{self._done}" '
            f'Moving="{int(self.moving)}" Fault="{fault}" Time="{self._reactor.now_ns // 1_000_000}" '
            f'Override="{self._settings.override_percent}" T1="0" '
            f'Lapsed="{self._lapsed}"/>'
            f'<Arm Model="KR10R1100SIXX simulated" Serial="{self._settings.seed}"/><Axes {axes}/><Pose Valid="1" '
            + " ".join(f'{name}="{value:.4f}"' for name, value in zip("XYZABC", pose, strict=True))
            + "/></Coupole>"
        ).encode()

    # -- the robot interpreter: motions -------------------------------------------------------------------

    def _brake(self, acceleration_deg_s2: float, jerk_deg_s3: float) -> None:
        """Brake along the path; then the pending motion begins."""
        t_s = (self._reactor.now_ns - self._begun_ns) / 1e9
        self._begin(braking_motion(self._motion, t_s, acceleration_deg_s2, jerk_deg_s3))

    def _begin(self, motion: Motion) -> None:
        self._motion, self._begun_ns = motion, self._reactor.now_ns
        if self._end is not None:
            self._end.cancel()
        if motion.phases:
            self.settled_since_ns = None
            self._end = self._reactor.at(self._begun_ns + math.ceil(motion.duration_s * 1e9), self._stand)
        else:
            self._stand()

    def _stand(self) -> None:
        """Note that the axes have come to rest."""
        self._end = None
        self._motion = standing(self._motion.joints_deg(self._motion.duration_s))
        if self.settled_since_ns is None:
            self.settled_since_ns = self._reactor.now_ns
            self._stops += 1
            self._came_from_deg, self._stood_at_deg = self._stood_at_deg, tuple(self._motion.joints_deg(0.0))
        if self.fault:
            return
        if self._target is None:
            self._done, self._watched = self._order, 0
            return
        target_deg, speed_share = self._target
        self._target = None
        share = speed_share * self._settings.override_percent / 100.0
        speeds_deg_s = [speed * share for speed in AXIS_SPEEDS_DEG_S]
        self._begin(
            point_to_point(
                self._motion.start_deg,
                target_deg,
                speeds_deg_s,
                self._acceleration_deg_s2,
                self._settings.jerk_deg_s3,
            )
        )


def _within_limits(joints_deg: Sequence[float]) -> bool:
    return all(low <= angle <= high for angle, (low, high) in zip(joints_deg, AXIS_LIMITS_DEG, strict=True))


def _with_free_port(address: str) -> str:
    """The address, with port 0 replaced by a free port."""
    host, port = address.rsplit(":", 1)
    if port != "0":
        return address
    with socket.create_server((host, 0)) as probe:
        return f"{host}:{probe.getsockname()[1]}"
