"""The stand-in for a KUKA controller that runs an RSI program: UDP packets out, corrections of the axes in.

Every cycle of world time it applies the client's last answer and sends where the axes are. It stops for what
the real one stops for: axis limits, too fast corrections, late answers, a silent client, an emergency stop.
In lock-step the world waits for an outstanding answer, so a client on a busy machine is never late; lateness
is then something that the world's script asks for (`late`).
"""

from __future__ import annotations

import math
import re
import socket
import time
from collections.abc import Sequence
from enum import Enum
from typing import Literal

from pydantic import BaseModel, ConfigDict, Field

from coupole.geometry import Transform, abc_from_rotation
from sim.kuka_kinematics import AXIS_LIMITS_DEG, AXIS_SPEEDS_DEG_S, PoseErrors, flange_pose
from sim.reactor import Reactor

Six = tuple[float, float, float, float, float, float]

_FIRST_IPOC = 4208163634
_SEND_AGAIN_S = 0.05
"""Lock-step: an unanswered packet is sent again after this machine time."""
_SPEED_TOLERANCE_DEG = 2e-6
"""Corrections come with six decimals."""


class Settings(BaseModel):
    """Settings of the stand-in in the rig's world."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    sends_to: str = Field(default="127.0.0.1:49152", pattern=r"^[^:]+:\d+$")
    cycle_ms: Literal[4, 12] = 4
    lock_step: bool = True
    answer_limit_s: float = Field(default=2.0, gt=0)
    """Lock-step: machine time that the world waits for an answer before the client counts as gone."""
    start_joints_deg: Six = (0.0, -90.0, 90.0, 0.0, 90.0, 0.0)
    sends_pose: bool = False
    """Packets also carry RIst, the flange's pose."""
    delay_limit: int = Field(default=100, ge=1)
    """Late answers at which RSI stops with KSS29002."""
    delay_counts: Literal["cumulative", "consecutive"] = "cumulative"
    """Which of the two real controllers do is not known."""
    brake_deg_s2: float = Field(default=1000.0, gt=0)
    """Deceleration of the axes when the controller itself stops them."""
    packets_after_estop_s: float = Field(default=0.5, ge=0)
    restart_s: float = Field(default=1.0, gt=0)
    """World time from a lost link until the RSI program runs, and sends, again."""
    seed: int = 0
    repeatability_um: float = Field(default=10.0, ge=0)
    repeatability_deg: float = Field(default=0.001, ge=0)
    """Standard deviation in each coordinate of what differs from stop to stop."""
    absolute_mm: float = Field(default=0.0, ge=0)
    absolute_deg: float = Field(default=0.0, ge=0)
    """Standard deviation, over arms, of what stays the same: see `PoseErrors`."""


class _Does(Enum):
    WAIT = "send packets until a client answers"
    FOLLOW = "apply a client's corrections"
    BRAKE = "stop the axes, answers are ignored"
    REST = "send nothing"


class KukaController:
    """See the module. All methods must be called on the reactor's thread."""

    def __init__(self, reactor: Reactor, settings: Settings) -> None:
        self.fault = ""
        """Why RSI stopped; empty while it runs or waits for a client."""
        self.settled_since_ns: int | None = reactor.now_ns
        """World time since when the axes stand; None while they move."""
        self.errors = PoseErrors(
            seed=settings.seed,
            repeatability_um=settings.repeatability_um,
            repeatability_deg=settings.repeatability_deg,
            absolute_mm=settings.absolute_mm,
            absolute_deg=settings.absolute_deg,
        )
        self._reactor, self._settings = reactor, settings
        self._cycle_ns = settings.cycle_ms * 1_000_000
        self._step_limit_deg = [v * settings.cycle_ms / 1e3 + _SPEED_TOLERANCE_DEG for v in AXIS_SPEEDS_DEG_S]
        self._does = _Does.WAIT
        self._axes_deg: tuple[float, ...] = settings.start_joints_deg
        self._step_deg: tuple[float, ...] = (0.0,) * 6
        """What the axes moved in the last cycle."""
        self._start_deg: tuple[float, ...] = self._axes_deg
        """Where corrections count from."""
        self._pushed_deg: tuple[float, ...] = (0.0,) * 6
        self._stops = 0
        self._ipoc = self._ended_ipoc = _FIRST_IPOC
        """IPOC of the last packet, and of the last packet of the RSI program's last run."""
        self._delay = self._late_cycles = 0
        self._changes_ns = 0
        self._after_braking = _Does.WAIT
        self._packet = b""
        self._sent_s = 0.0
        """Machine time of the last packet."""
        self._sent_axes: tuple[float, ...] = ()
        self._axes_xml = b""
        self._socket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        host, port = settings.sends_to.rsplit(":", 1)
        self._socket.connect((host, int(port)))  # connected, so that a closed port there is told at once
        self._socket.setblocking(False)
        self._timer = reactor.after(0.0, self._cycle)

    @property
    def joints_deg(self) -> tuple[float, ...]:
        """The axes now, as the controller measures and reports them."""
        return self._axes_deg

    @property
    def moving(self) -> bool:
        return self.settled_since_ns is None

    @property
    def delay(self) -> int:
        """The counter of late answers."""
        return self._delay

    def true_base_from_flange(self) -> Transform:
        """Where the flange truly is: what the controller believes, with the arm's fixed error and the last
        stop's own."""
        return self.errors.true_flange_pose(self._axes_deg, self._stops)

    def estop(self) -> None:
        """Emergency stop: the axes brake, packets go on for a while, then RSI ends until `reset`."""
        self._stop_axes("emergency stop", _Does.REST, self._settings.packets_after_estop_s)

    def reset(self) -> None:
        """Acknowledge all faults and start the RSI program again, from the axes where they stand."""
        self.fault = ""
        self._does, self._changes_ns, self._ended_ipoc = _Does.WAIT, 0, self._ipoc
        self._step_deg = (0.0,) * 6
        self._delay = self._late_cycles = 0

    def late(self, cycles: int) -> None:
        """Take the next answers, one a cycle, for late ones."""
        self._late_cycles += cycles

    def lose_link(self, seconds: float) -> None:
        """No packet leaves for `seconds`; the axes brake, and then the RSI program starts again."""
        self._stop_axes("link lost", _Does.WAIT, seconds)

    def nudge(self, joints_deg: Sequence[float]) -> None:
        """Push the arm off the commanded axes by six angles, for good."""
        self._pushed_deg = tuple(a + b for a, b in zip(self._pushed_deg, joints_deg, strict=True))
        self._put_axes(tuple(a + b for a, b in zip(self._axes_deg, joints_deg, strict=True)))
        self._step_deg = (0.0,) * 6  # pushed, not driven: there is nothing to brake

    def close(self) -> None:
        self._timer.cancel()
        self._socket.close()

    def _cycle(self) -> None:
        """What happens once per interpolation cycle."""
        self._ipoc += self._settings.cycle_ms
        if self._does is _Does.FOLLOW:
            self._follow()
        elif self._does is not _Does.BRAKE:
            self._put_axes(self._axes_deg)
        if self._does is _Does.BRAKE:
            self._brake()
        if self._sends():
            if self._does is _Does.WAIT:
                self._look_for_client()
            self._send()
        self._timer = self._reactor.at(self._reactor.now_ns + self._cycle_ns, self._cycle)

    def _sends(self) -> bool:
        """Whether packets leave: after a lost link only from `_changes_ns` on, after an E-stop until then."""
        ending = self._does is _Does.REST or (self._does is _Does.BRAKE and self._after_braking is _Does.REST)
        return ending == (self._reactor.now_ns < self._changes_ns)

    def _follow(self) -> None:
        answer = self._take_answer()
        if self._does is not _Does.FOLLOW:
            return
        if answer is None or self._late_cycles > 0:
            self._late_cycles = max(0, self._late_cycles - 1)
            self._delay += 1
            if self._delay >= self._settings.delay_limit:
                self._stop_axes(f"KSS29002: {self._delay} late answers", _Does.WAIT, self._settings.restart_s)
            else:
                self._put_axes(self._axes_deg)  # HOLDON=1: the last correction stays in force
            return
        if self._settings.delay_counts == "consecutive":
            self._delay = 0
        axes_deg = tuple(map(float.__add__, map(float.__add__, self._start_deg, self._pushed_deg), answer))
        for i, (axis_deg, (low, high)) in enumerate(zip(axes_deg, AXIS_LIMITS_DEG, strict=True)):
            if not low <= axis_deg <= high:
                self._stop_axes(f"software limit switch of A{i + 1}: {axis_deg:.3f} deg", _Does.REST, 0.0)
                return
            if not abs(axis_deg - self._axes_deg[i]) <= self._step_limit_deg[i]:
                step_deg = axis_deg - self._axes_deg[i]
                fault = f"command velocity of A{i + 1} exceeded: {step_deg:.3f} deg a cycle"
                self._stop_axes(fault, _Does.REST, 0.0)
                return
        self._put_axes(axes_deg)

    def _take_answer(self) -> tuple[float, ...] | None:
        """The corrections that answer the last packet; None if they are late or the client left."""
        awaited = self._ipoc - self._settings.cycle_ms
        while True:
            try:
                data = self._socket.recv(4096)
            except BlockingIOError:
                patience_s = self._patience_s()
                if self._reactor.hold_for(self._socket, min(patience_s, _SEND_AGAIN_S)):
                    continue
                if patience_s > _SEND_AGAIN_S:
                    self._send_packet()  # a client that left with the packet unread is found out by the next
                    continue
                if self._settings.lock_step:
                    self._stop_axes("link lost: no answer", _Does.WAIT, self._settings.restart_s)
                return None
            except ConnectionRefusedError:
                self._stop_axes("link lost: nobody listens", _Does.WAIT, self._settings.restart_s)
                return None
            answer = _parse_answer(data)
            if answer is not None and answer[0] == awaited:
                return answer[1]

    def _patience_s(self) -> float:
        """Machine time that an answer may still take. In real time that is one cycle from its packet on, also
        where the world itself is late and works cycles off in a row."""
        settings = self._settings
        cycle_s = settings.cycle_ms / 1e3 / self._reactor.clock.speed
        allowed_s = settings.answer_limit_s if settings.lock_step else cycle_s
        return max(0.0, self._sent_s + allowed_s - time.monotonic())

    def _look_for_client(self) -> None:
        """Any answer to a packet of this run of the RSI program begins a session."""
        try:
            answer = _parse_answer(self._socket.recv(4096))
            while answer is not None and answer[0] <= self._ended_ipoc:
                answer = _parse_answer(self._socket.recv(4096))
        except (BlockingIOError, ConnectionRefusedError):
            return
        if answer is not None:
            self.fault = ""
            self._does = _Does.FOLLOW
            self._start_deg, self._pushed_deg = self._axes_deg, (0.0,) * 6

    def _stop_axes(self, fault: str, then: _Does, seconds: float) -> None:
        """End the session: brake, and let packets end (REST) or begin again (WAIT) `seconds` from now."""
        self.fault = self.fault or fault
        self._does, self._after_braking = _Does.BRAKE, then
        self._changes_ns = self._reactor.now_ns + round(seconds * 1e9)
        self._ended_ipoc = self._ipoc
        self._delay = self._late_cycles = 0

    def _brake(self) -> None:
        change_deg = self._settings.brake_deg_s2 * (self._settings.cycle_ms / 1e3) ** 2
        step_deg = tuple(math.copysign(max(0.0, abs(s) - change_deg), s) for s in self._step_deg)
        if not any(step_deg):
            self._does = self._after_braking
        self._put_axes(tuple(map(float.__add__, self._axes_deg, step_deg)))

    def _put_axes(self, axes_deg: tuple[float, ...]) -> None:
        if axes_deg == self._axes_deg:
            if self.settled_since_ns is None:
                self.settled_since_ns = self._reactor.now_ns
                self._step_deg = (0.0,) * 6
                self._stops += 1
            return
        self.settled_since_ns = None
        self._step_deg = tuple(map(float.__sub__, axes_deg, self._axes_deg))
        self._axes_deg = axes_deg

    def _send(self) -> None:
        if self._axes_deg != self._sent_axes:
            self._sent_axes = self._axes_deg
            self._axes_xml = _AXES_XML % self._axes_deg
            if self._settings.sends_pose:
                pose = flange_pose(self._axes_deg)
                self._axes_xml = _POSE_XML % (*pose[:3, 3], *abc_from_rotation(pose[:3, :3])) + self._axes_xml
        self._packet = _PACKET_XML % (self._axes_xml, self._delay, self._ipoc)
        self._sent_s = time.monotonic()
        self._send_packet()

    def _send_packet(self) -> None:
        try:
            self._socket.send(self._packet)
        except (ConnectionRefusedError, BlockingIOError):
            return  # nobody there: the missing answer tells


_PACKET_XML = b'<Rob Type="KUKA simulated">%b<Delay D="%d"/><IPOC>%d</IPOC></Rob>'
_AXES_XML = b'<AIPos A1="%.4f" A2="%.4f" A3="%.4f" A4="%.4f" A5="%.4f" A6="%.4f"/>'
_POSE_XML = b'<RIst X="%.4f" Y="%.4f" Z="%.4f" A="%.4f" B="%.4f" C="%.4f"/>'
_KORR = re.compile(rb"<AKorr\s([^>]*)/>")
_PAIR = re.compile(rb'(\w+)="([^"]*)"')
_IN_ORDER = re.compile(rb"<AKorr " + rb" ".join(rb'A%d="([^"]+)"' % a for a in range(1, 7)) + rb"\s*/>")
_IPOC = re.compile(rb"<IPOC>(\d+)</IPOC>")


def _parse_answer(data: bytes) -> tuple[int, tuple[float, ...]] | None:
    """IPOC and corrections in degrees; a missing axis has none. None for what is no answer at all."""
    ipoc = _IPOC.search(data)
    if ipoc is None:
        return None
    try:
        if in_order := _IN_ORDER.search(data):
            return int(ipoc[1]), tuple(map(float, in_order.groups()))
        korr = _KORR.search(data)
        pairs = dict(_PAIR.findall(korr[1])) if korr else {}
        return int(ipoc[1]), tuple(float(pairs.get(b"A%d" % axis, b"0")) for axis in range(1, 7))
    except ValueError:
        return None
