"""The stand-in for a KUKA controller with an RSI program: sends UDP packets, receives corrections.

In every cycle of world time it applies the client's last answer and sends the axes. It stops as the real one does
on: limits of axes and corrections, corrections that are too fast, poses without solution, workspaces, late
answers, a silent client, an emergency stop. Then the brakes close, and the arm stays where it is until the RSI
program is restarted. An answer with the stop element ends the program without a fault. `tell` receives each
refusal with its reason, because the client only sees that packets stop.

In lock-step the world waits for each answer, so a client on a busy machine is never late. Then only the fault
script (`late`) causes late answers.
"""

from __future__ import annotations

import contextlib
import socket
import time
from collections.abc import Callable, Sequence
from enum import Enum

from coupole.geometry import Transform
from sim.devices.host_port import HostPort
from sim.devices.kuka_axes import Axes
from sim.devices.kuka_corrections import Corrections
from sim.devices.kuka_kinematics import PoseErrors
from sim.devices.kuka_rsi_wire import Answer, PacketWriter, answer_reader
from sim.devices.kuka_settings import Settings
from sim.devices.refusals import Refusals, untold
from sim.strangers.arm_stranger import NO_STRANGER, ArmStranger
from sim.world.reactor import Reactor, Timer

__all__ = ["ALIKE", "KukaController", "Settings"]

ALIKE = ("corrects", "mode", "sen_type", "measured_tag", "correction_tag", "stop_tag", "delay_counts")
"""Settings that must be equal at both ends of the wire; the driver's settings have the same names."""
_FIRST_IPOC = 4208163634
_SEND_AGAIN_S = 0.05
"""An unanswered packet is sent again after this machine time, if the world runs in lock-step."""


class _Does(Enum):
    WAIT = "send packets until a client answers"
    FOLLOW = "apply a client's corrections"
    BRAKE = "stop the axes, answers are ignored"
    REST = "send nothing"


class KukaController:
    """One controller. All methods must be called on the reactor's thread."""

    def __init__(
        self,
        reactor: Reactor,
        settings: Settings,
        tell: Callable[[str], None] = untold,
        stranger: ArmStranger = NO_STRANGER,
    ) -> None:
        """`tell` gets a line for every refusal."""
        self.fault = ""
        """Reason why RSI stopped; empty while it runs or waits for a client."""
        self.ended_programs = 0
        """Programs that a client has ended with the stop element."""
        self._refusals = Refusals("robot", tell)
        self.errors = PoseErrors.of(settings, stranger)
        self._reactor, self._settings = reactor, settings
        self._cycle_ns = settings.cycle_ms * 1_000_000
        self._axes = Axes(settings, reactor.now_ns)
        self._corrections = Corrections(settings)
        self._read_answer, self._writer = answer_reader(settings), PacketWriter(settings)
        self._does = _Does.WAIT
        self._springs_back: list[Timer] = []
        self._ipoc_step = settings.ipoc_step or settings.cycle_ms
        self._ipoc = self._ended_ipoc = _FIRST_IPOC
        """IPOC of the last packet, and of the last packet of the RSI program's previous run."""
        self._delay = self._late_cycles = 0
        self._changes_ns = 0
        self._after_braking = _Does.WAIT
        self._end_requested = False
        self._packet = b""
        self._sent_s = 0.0
        """Machine time of the last packet."""
        self._socket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self._host_port = HostPort(settings.sends_to)
        host, port = self.sends_to.rsplit(":", 1)
        # the socket is connected, so that a closed port is reported at once
        self._socket.connect((host, int(port)))
        self._socket.setblocking(False)
        self._timer = reactor.after(0.0, self._cycle)

    @property
    def sends_to(self) -> str:
        """`host:port` of the client: the settings' own, with port 0 replaced by a free one."""
        return self._host_port.address

    @property
    def joints_deg(self) -> tuple[float, ...]:
        """The present axes, as measured and reported by the controller."""
        return self._axes.measured_deg(self._reactor.now_ns)

    @property
    def settled_since_ns(self) -> int | None:
        """World time since which the arm is still; None while it moves or vibrates."""
        return self._axes.settled_since_ns(self._reactor.now_ns)

    @property
    def moving(self) -> bool:
        return self.settled_since_ns is None

    @property
    def brakes_closed(self) -> bool:
        """True from the end of a stop by the controller until its RSI program is restarted."""
        return self._axes.brakes_closed

    @property
    def delay(self) -> int:
        """The counter of late answers."""
        return self._delay

    def true_base_from_flange(self) -> Transform:
        """True pose of the flange: the controller's, with the arm's constant error and the error of the last
        stop."""
        return self.errors.true_flange_pose(self.joints_deg, self._axes.stops, self._axes.came_from_deg)

    def estop(self) -> None:
        """Emergency stop: the axes brake, packets continue for a while, then RSI ends until `reset`."""
        self._stop_axes("emergency stop", _Does.REST, self._settings.packets_after_estop_s)

    def reset(self) -> None:
        """Acknowledge all faults and restart the RSI program, from the present axes."""
        self.fault = ""
        self._does, self._changes_ns, self._ended_ipoc = _Does.WAIT, 0, self._ipoc
        self._release_axes()
        self._delay = self._late_cycles = 0

    def late(self, cycles: int) -> None:
        """Treat the next answers as late, one answer in each cycle."""
        self._late_cycles += cycles

    def lose_link(self, seconds: float) -> None:
        """Send no packet for `seconds`; the axes brake, then the RSI program is restarted."""
        self._stop_axes("link lost", _Does.WAIT, seconds)

    def nudge(self, joints_deg: Sequence[float], seconds: float | None = None) -> None:
        """Displace the arm by six angles; after `seconds`, if given, it springs back."""
        self._axes.push(joints_deg, self._reactor.now_ns)
        if seconds is not None:
            back_deg = [-angle for angle in joints_deg]
            spring = self._reactor.after(seconds, lambda: self._axes.push(back_deg, self._reactor.now_ns))
            self._springs_back.append(spring)

    def close(self) -> None:
        self._timer.cancel()
        self._socket.close()
        self._host_port.close()

    def _cycle(self) -> None:
        """One interpolation cycle."""
        self._ipoc += self._ipoc_step
        if self._does is _Does.FOLLOW:
            self._follow()
        elif self._does is not _Does.BRAKE:
            self._axes.stay(self._reactor.now_ns)
        if self._does is _Does.BRAKE and self._axes.brake(self._reactor.now_ns):
            self._does = self._after_braking
        if self._sends():
            if self._does is _Does.WAIT:
                self._look_for_client()
            self._send()
        self._timer = self._reactor.at(self._reactor.now_ns + self._cycle_ns, self._cycle)

    def _sends(self) -> bool:
        """True if packets are sent. After a lost link they are sent only from `_changes_ns` on, after an E-stop
        until then."""
        ending = self._does is _Does.REST or (self._does is _Does.BRAKE and self._after_braking is _Does.REST)
        return ending == (self._reactor.now_ns < self._changes_ns)

    def _follow(self) -> None:
        values = self._take_answer()
        if self._does is not _Does.FOLLOW:
            return
        if self._late_cycles > 0:
            self._late_cycles -= 1
            values = None
        if values is None:
            self._delay += 1
            self._refusals.note_refusal("a cycle without an answer in time", f"delay counter {self._delay}")
            if self._delay >= self._settings.delay_limit:
                self._stop_axes(f"KSS29002: {self._delay} late answers", _Does.WAIT, self._settings.restart_s)
                return
        elif self._settings.delay_counts == "consecutive":
            self._delay = 0
        target_deg, fault = self._corrections.take(values)
        if self._corrections.clamp_text:
            self._refusals.note_refusal("a correction is clamped", self._corrections.clamp_text)
        if fault := fault or self._axes.follow(target_deg, self._reactor.now_ns):
            self._stop_axes(fault, _Does.REST, 0.0)
        elif self._end_requested and values is not None:
            self._end_program()

    def _take_answer(self) -> tuple[float, ...] | None:
        """Return the corrections that answer the last packet; None if they are late or the client has left."""
        expected_ipoc = self._ipoc - self._ipoc_step
        while True:
            try:
                data = self._socket.recv(4096)
            except BlockingIOError:
                patience_s = self._patience_s()
                if self._reactor.hold_for(self._socket, min(patience_s, _SEND_AGAIN_S)):
                    continue
                if patience_s > _SEND_AGAIN_S:
                    self._send_packet()  # if the client left with the packet unread, this send reports it
                    continue
                if self._settings.lock_step:
                    self._stop_axes("link lost: no answer", _Does.WAIT, self._settings.restart_s)
                return None
            except ConnectionRefusedError:
                self._stop_axes("link lost: the client's port is closed", _Does.WAIT, self._settings.restart_s)
                return None
            answer = self._read_answer(data)
            if not isinstance(answer, Answer):
                self._refusals.note_refusal(*answer)
            elif answer.ipoc != expected_ipoc:
                self._refusals.note_refusal(
                    "an answer whose IPOC differs from the IPOC of the last packet is ignored",
                    f"{answer.ipoc}, expected {expected_ipoc}",
                )
            else:
                self._end_requested = answer.stops
                if answer.remark:
                    self._refusals.note_refusal(answer.remark)
                return answer.values

    def _patience_s(self) -> float:
        """Machine time left for an answer. In real time it is one cycle from the answer's packet on, even if the
        world is late and runs several cycles in a row."""
        settings = self._settings
        cycle_s = settings.cycle_ms / 1e3 / self._reactor.clock.speed
        allowed_s = settings.answer_limit_s if settings.lock_step else cycle_s
        return max(0.0, self._sent_s + allowed_s - time.monotonic())

    def _look_for_client(self) -> None:
        """Begin a session with the first answer to a packet of the present run of the RSI program."""
        if self._axes.brakes_closed:
            self._release_axes()  # the program was restarted
        answer = None
        with contextlib.suppress(BlockingIOError, ConnectionRefusedError):
            while not isinstance(answer, Answer) or answer.ipoc <= self._ended_ipoc:
                answer = self._read_answer(self._socket.recv(4096))
                if not isinstance(answer, Answer):
                    self._refusals.note_refusal(*answer)
        if isinstance(answer, Answer) and answer.ipoc > self._ended_ipoc:
            self.fault = ""
            self._does = _Does.FOLLOW
            self._release_axes()
            self._corrections.begin(self._axes.commanded_deg)

    def _release_axes(self) -> None:
        """Open the brakes; the present axes, displaced or not, become the commanded ones."""
        for spring in self._springs_back:
            spring.cancel()
        self._springs_back.clear()
        self._axes.release()

    def _stop_axes(self, fault: str, then: _Does, seconds: float) -> None:
        """End the session: brake, then stop sending (REST) or resume sending (WAIT) `seconds` from now."""
        self._refusals.note_refusal("RSI stops", fault)
        self.fault = self.fault or fault
        self._brake(then, seconds)

    def _end_program(self) -> None:
        """End the program without a fault, as the client asked. The stand-in then restarts it, in place of a
        person."""
        self.ended_programs += 1
        self._brake(_Does.WAIT, self._settings.restart_s)

    def _brake(self, then: _Does, seconds: float) -> None:
        self._does, self._after_braking = _Does.BRAKE, then
        self._changes_ns = self._reactor.now_ns + round(seconds * 1e9)
        self._ended_ipoc = self._ipoc
        self._delay = self._late_cycles = 0

    def _send(self) -> None:
        self._packet = self._writer.packet(self.joints_deg, self._delay, self._ipoc)
        self._sent_s = time.monotonic()
        self._send_packet()

    def _send_packet(self) -> None:
        try:
            self._socket.send(self._packet)
        except (ConnectionRefusedError, BlockingIOError):
            return  # no client: the missing answer is detected
