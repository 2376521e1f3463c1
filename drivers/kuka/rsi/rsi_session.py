"""State of one RSI session: the commanded axes, and the answer to every packet.

Each packet advances the commanded axes by one cycle of a jerk-limited trajectory, and is answered with their
corrections. So the motion follows the controller's cycles, even in a simulated world that pauses or runs fast.

Corrections count from where RSI was started (`drivers.kuka.rsi.corrections`). Therefore only a program that saw
the session begin may answer. In a session in progress, a first answer of zero would be a jump back to its start.
For the same reason a session keeps its start for as long as this program runs. A packet that does not continue the
session is not answered, and after a restart of RSI the driver must be opened again. `drivers.kuka.rsi.bounds` and
`witness` state the invariants of every answer; both are checked when an answer is formed.
"""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass

from coupole.wrist_lengths import WristLengths
from drivers.kuka.rsi import shared_state
from drivers.kuka.rsi.bounds import StepBounds, follow_bounds
from drivers.kuka.rsi.corrections import NAMES, Corrections
from drivers.kuka.rsi.cycle import CycleMeter
from drivers.kuka.rsi.trajectory import Motion
from drivers.kuka.rsi.wire import Packet, answer_template, controller_type, packet_parser, stop_element
from drivers.kuka.rsi.witness import ArmWitness, LagBounds

_GAP_STEPS = 25
"""A jump of the IPOC by more than this many steps does not continue the session. Such a packet is old, belongs to
a new session, or comes after an outage that was long enough for a new session."""
_LONGEST_STEP = 12
"""Largest step of the IPOC that is accepted before the step is known: the longest cycle in ms."""
_ANOTHER_RUN = 2
"""The session is over after this many consecutive packets that continue one another, but not the session."""
_REMEMBERED = 250
"""Number of packets that are recognised if the network delivers them a second time. It is more than come in a
second."""
_LAST_WORDS = 5
"""Number of packets that are still answered after a fault, once the commanded axes are at rest."""
_HALTED_PACKETS = 5
"""The arm has halted after this many consecutive cycles without an advance. Answers were late, or the arm is not
where it was led."""
_QUIET_NS = 500_000_000
"""Silence after which a packet without a delay counter counts as the first of a session."""

_SESSION_ENDS = (shared_state.LINK_LOST, shared_state.RESTARTED, shared_state.OUT_OF_BOUNDS)
"""Faults after which nothing is answered, because the controller may have begun a new session, or because no
answer is right."""


@dataclass(frozen=True)
class Config:
    """Settings that the driver passes to the loop. `drivers.kuka.rsi.settings.Settings` describes the fields."""

    cycle_s: float
    declared_cycle_s: float | None
    controller: str
    sen_type: str
    measured_tag: str
    delay_tag: str
    correction_tag: str
    stop_tag: str
    corrects: str
    mode: str
    geometry: WristLengths
    velocity_deg_s: tuple[float, ...]
    acceleration_deg_s2: tuple[float, ...]
    jerk_deg_s3: tuple[float, ...]
    link_timeout_s: float
    delay_limit: int
    attention_s: float
    delay_counts: str
    unaccounted_s: float
    settle_deg: float
    settle_deg_s: float
    follow_deg: float
    follow_lag_s: float
    follow_cycles: int


class RsiSession:
    """Computes the answer to every packet, and the state for the driver; uses neither socket nor memory."""

    def __init__(self, config: Config, opened_ns: int = 0) -> None:
        self.fault, self.fault_text = shared_state.NO_FAULT, b""
        self.packets = self.answers = self.malformed = self.refused = self.foreign = self.astray = 0
        self.late = self.delay = self.max_gap_ns = self.command = 0
        self.sender = self.other_sender = b""
        self.lapses = 0
        """Motions that ended because nobody watched them."""
        self.stop_answers = self.program_ended = 0
        """Number of answers that end the controller's program; 1 once the program has ended on one of them."""
        self.settled_cycles = self._astray_cycles = self._late_before = self._held_in_row = 0
        limits = config.velocity_deg_s, config.acceleration_deg_s2, config.jerk_deg_s3
        self.motion = Motion(config.cycle_s, limits)
        self._config = config
        self._parse = packet_parser(config.measured_tag, config.delay_tag)
        names = NAMES[config.corrects]
        self._template, self._stop_template = (
            answer_template(
                config.sen_type, config.correction_tag, names, stop_element(config.stop_tag, stops=stops)
            )
            for stops in (False, True)
        )
        self._corrections = Corrections(config.corrects, config.mode, config.geometry)
        self._bounds = StepBounds(
            config.corrects, config.cycle_s, config.velocity_deg_s, config.acceleration_deg_s2, config.geometry
        )
        self._witness = self._new_witness(is_simulated=False)
        self._cycle = CycleMeter(config.cycle_s, None)
        self._counts_delay = False
        """True if the session's first packet had a delay counter."""
        self._controller = b""
        self._start_deg: tuple[float, ...] | None = None
        """The measured axes at the start of the session, to which corrections refer; None before the session."""
        self._measured_deg: tuple[float, ...] = (0.0,) * 6
        self._velocity_deg_s: tuple[float, ...] = (0.0,) * 6
        self._ipoc = self._ipoc_step = self._astray_ipoc = self._astray_run = 0
        self._packet_ns = opened_ns
        """Time of the last packet, including the packets of a session that another program began."""
        self._session_over = self._leaves = False
        self._last_words = _LAST_WORDS
        self._last_answer: bytes | None = None
        self._last_data = b""
        self._remembered: deque[int] = deque(maxlen=_REMEMBERED)
        """Hashes of the last packets of the session."""
        self.behind = False
        """True if the last packet came after a silence that is not explained yet."""

    def obey(self, command: shared_state.Command) -> None:
        """Take a command. After a fault, motion commands are ignored."""
        self.command = command.number
        self.settled_cycles = 0
        if command.verb == shared_state.MOVE and self.fault == shared_state.NO_FAULT:
            self.motion.move_to(command.target_deg, command.speed)
        elif command.verb == shared_state.STOP:
            self.motion.stop()
        elif command.verb == shared_state.LEAVE:
            self.leave()

    def leave(self) -> None:
        """Bring the commanded axes to rest, then end the controller's program."""
        self._leaves = True
        self.motion.stop()

    def attend(self, silent_ns: int) -> None:
        """Brake on the path if nobody has looked at a motion for too long. `silent_ns` is the time since the last
        look."""
        if silent_ns > self._config.attention_s * 1e9 and self.motion.pursues:
            self.lapses += 1
            self.motion.stop()

    def answer(self, data: bytes, now_ns: int) -> bytes | None:
        """Return the answer to a packet, or None if the packet must not be answered."""
        packet = self._parse(data)
        if packet is None or (packet.delay is None and (self._config.mode == "relative" or self._counts_delay)):
            self.malformed += 1
            return None
        advance, cycles, rose = int(packet.ipoc) - self._ipoc, 1, 0
        if self._start_deg is None:
            if not self._may_begin(packet, now_ns):
                self.refused += 1
                return None
            self._begin_session(packet, controller_type(data))
        else:
            if data == self._last_data:  # sent again: its first answer may be lost
                return self._last_answer
            if not self._in_sequence(int(packet.ipoc), advance, hash(data)) or not self._proves(packet, now_ns):
                return None
            self.max_gap_ns = max(self.max_gap_ns, now_ns - self._packet_ns)
            rose = max(0, (packet.delay or 0) - self.delay)
            cycles = advance // self._ipoc_step
        self._last_data = data
        self._remembered.append(hash(data))
        self._ipoc, self._packet_ns, self.delay = int(packet.ipoc), now_ns, packet.delay or 0
        if mismatch := self._cycle.packet(now_ns, advance, cycles):
            # At rest and in motion, the arm moves by one cycle's step per answer. With another cycle, no answer is
            # right.
            self._session_over |= self._cycle.measured_ns > 0
            self.fail(shared_state.WRONG_CYCLE, mismatch)
        self._ipoc_step = self._cycle.ipoc_step or self._ipoc_step
        self.packets += 1
        self.late += rose
        # Packets lost on the network also raise the delay counter, but do not concern the answer before them.
        was_applied = rose == 0 or rose < cycles
        if was_applied:
            self._corrections.note_applied()
        strays = self._witness.strays(packet.joints_deg)
        self._watch(packet, strays=strays)
        self._held_in_row = self._held_in_row + 1 if rose or strays else 0
        was_standing = self.motion.phase == shared_state.STANDING
        advances = was_applied and not strays
        if not advances:  # repeat the last answer instead of advancing ahead of the arm
            if self._held_in_row >= _HALTED_PACKETS:
                self.motion.note_halt()
                self._bounds.at_rest()
        elif not self.motion.step():
            self._bounds.at_rest()
            self.fail(shared_state.NO_TRAJECTORY, "no trajectory within the limits leads to the target")
        self._last_answer = (
            None
            if self._silent()
            else self._answer_to(packet, now_ns, advances=advances, was_at_rest=was_standing)
        )
        self.answers += self._last_answer is not None
        return self._last_answer

    def _proves(self, packet: Packet, now_ns: int) -> bool:
        """Tell whether this packet's corrections still count from the session's start, as far as this can be seen.
        Otherwise nothing is answered."""
        self.behind = False
        if reason := self._witness.break_reason(packet, now_ns):
            self.fail(shared_state.RESTARTED, reason)
        else:
            self.behind = self._witness.waits(packet, now_ns)
        return not reason and not self.behind

    def _answer_to(self, packet: Packet, now_ns: int, *, advances: bool, was_at_rest: bool) -> bytes | None:
        """Return the answer, or None if it would break the bounds; the controller then ends the session by itself.
        Once the arm is at rest after a fault, its corrections cause no further motion. `was_at_rest` says that the
        axes were at rest in the previous answer."""
        holds = self.motion.phase == shared_state.STANDING and self.fault != shared_state.NO_FAULT
        values = self._corrections.hold() if holds else self._corrections.to(self.motion.commanded_deg)
        violation = self._bounds.violation(self._corrections.step(values), advances=advances and not holds)
        if violation := violation or self._witness.violation(packet, self._corrections.led_to, now_ns):
            self.fail(shared_state.OUT_OF_BOUNDS, f"an answer was withheld: {violation}")
            return None
        ends = self._leaves and was_at_rest and self.fault == shared_state.NO_FAULT and bool(self._config.stop_tag)
        self.stop_answers += ends
        return (self._stop_template if ends else self._template) % (*values, packet.ipoc)

    def _silent(self) -> bool:
        """Tell whether the driver has stopped answering. After a fault the driver ends the session in this way, so
        that no old correction reaches a new session. The driver is silent at once if a new session may have begun,
        otherwise when the commanded axes, and so the arm, are at rest."""
        if self.fault != shared_state.NO_FAULT and self.motion.phase == shared_state.STANDING:
            self._last_words -= 1
        return self._session_over or self._last_words < 0

    def check_link(self, now_ns: int) -> None:
        """Latch a fault if no packet has come for longer than the link's time-out."""
        silent_s = (now_ns - self._packet_ns) / 1e9
        if self._start_deg is not None and silent_s > self._config.link_timeout_s:
            self.fail(
                shared_state.LINK_LOST, f"no packet for {silent_s:.2f} s, the delay counter was {self.delay}"
            )

    def fail(self, fault: int, text: str) -> None:
        """Latch the first fault, and bring the commanded axes to rest. If the arm follows them, they brake along
        their path. Otherwise they stop at once, so that the arm is not pushed further."""
        if self.fault == shared_state.NO_FAULT:
            self.fault, self.fault_text = fault, text.encode()
        self._session_over |= fault in _SESSION_ENDS
        if fault in _SESSION_ENDS or fault == shared_state.NOT_FOLLOWING:
            self.motion.stand_at(self.motion.commanded_deg)
            self._bounds.at_rest()
        else:
            self.motion.stop()

    def state(self, realtime: int) -> shared_state.State:
        return shared_state.State(
            packets=self.packets,
            answers=self.answers,
            malformed=self.malformed,
            refused=self.refused,
            foreign=self.foreign,
            astray=self.astray,
            late=self.late,
            delay=self.delay,
            max_gap_ns=self.max_gap_ns,
            cycle_ns=self._cycle.measured_ns,
            program_ended=self.program_ended,
            realtime=realtime,
            command=self.command,
            phase=self.motion.phase,
            settled_cycles=self.settled_cycles,
            fault=self.fault,
            lapses=self.lapses,
            measured_deg=self._measured_deg,
            velocity_deg_s=self._velocity_deg_s,
            commanded_deg=self.motion.commanded_deg,
            start_deg=self._start_deg or (0.0,) * 6,
            controller=self._controller,
            sender=self.sender,
            other_sender=self.other_sender,
            fault_text=self.fault_text,
        )

    def _may_begin(self, packet: Packet, now_ns: int) -> bool:
        """False if another program may have begun this packet's session."""
        quiet_ns, self._packet_ns = now_ns - self._packet_ns, now_ns
        return packet.delay == 0 if packet.delay is not None else quiet_ns > _QUIET_NS

    def _begin_session(self, packet: Packet, controller: bytes) -> None:
        """Begin the session. This is called only once for each object."""
        config = self._config
        self._controller, self._counts_delay = controller, packet.delay is not None
        # Only a simulated controller may say how long its cycle is.
        declared_s = config.declared_cycle_s if b"simulated" in controller else None
        self._witness = self._new_witness(is_simulated=b"simulated" in controller)
        self._cycle = CycleMeter(config.cycle_s, declared_s)
        self._start_deg = self._measured_deg = packet.joints_deg
        self._corrections.begin(packet.joints_deg)
        self.motion.stand_at(packet.joints_deg)

    def _new_witness(self, *, is_simulated: bool) -> ArmWitness:
        """Return a new witness. `is_simulated` says that the simulated world waits for answers or for its
        machine. The clock then cannot show for how long the controller was silent.
        """
        config = self._config
        follow = follow_bounds(config.corrects, config.follow_deg, config.geometry)
        return ArmWitness(
            self._corrections.place,
            self._corrections.between,
            LagBounds(follow, self._bounds.farthest, config.follow_lag_s),
            cycle_s=config.cycle_s,
            counts_in_a_row=config.delay_counts == "consecutive",
            unaccounted_s=0.0 if is_simulated else config.unaccounted_s,
        )

    def _in_sequence(self, ipoc: int, advance: int, packet_hash: int) -> bool:
        """True for a packet that continues the session. Packets that come twice, are old or belong to another
        session change nothing; a series of such packets ends the session. `packet_hash` is the packet's hash."""
        step = self._cycle.ipoc_step
        if step:
            continues = 0 < advance <= _GAP_STEPS * step and advance % step == 0
        else:
            continues = 0 < advance <= _GAP_STEPS * _LONGEST_STEP
        if continues:
            if not 0 < self._ipoc_step <= advance:
                self._ipoc_step = advance  # the smallest so far: a packet may have been lost on the network
            self._astray_run = 0
        elif packet_hash in self._remembered:
            self.astray += 1
        else:
            self._astray(ipoc, advance, self._ipoc_step or 1)
        return continues

    def _astray(self, ipoc: int, advance: int, step: int) -> None:
        """Handle a packet whose IPOC is in the past or too far ahead. It may be one old packet, or a new
        session."""
        self.astray += 1
        apart = ipoc - self._astray_ipoc
        self._astray_run = self._astray_run + 1 if 0 < apart <= _GAP_STEPS * step else 1
        self._astray_ipoc = ipoc
        if self._astray_run < _ANOTHER_RUN:
            return
        if 0 < advance <= _GAP_STEPS * step:
            self.fail(
                shared_state.RESTARTED,
                f"its IPOC now steps by {apart}, before by {step}: the controller's cycle has changed",
            )
        elif advance > 0:
            self.fail(shared_state.LINK_LOST, f"{advance // step - self._astray_run} packets are missing")
        else:
            self.fail(shared_state.RESTARTED, "RSI was restarted: its packets have begun to count anew")

    def _watch(self, packet: Packet, *, strays: bool) -> None:
        """Compare the measured axes with the axes commanded in the last answer."""
        config, motion = self._config, self.motion
        if packet.joints_deg == self._measured_deg:
            self._velocity_deg_s = (0.0,) * 6
            speed_deg_s = 0.0
        else:
            rates = map(float.__sub__, packet.joints_deg, self._measured_deg)
            self._velocity_deg_s = tuple(rate / config.cycle_s for rate in rates)
            speed_deg_s = max(map(abs, self._velocity_deg_s))
            self._measured_deg = packet.joints_deg
        error_deg = max(map(abs, map(float.__sub__, packet.joints_deg, motion.commanded_deg)))
        is_settled = motion.phase == shared_state.STANDING and error_deg <= config.settle_deg
        self.settled_cycles = self.settled_cycles + 1 if is_settled and speed_deg_s <= config.settle_deg_s else 0

        allowed_deg = config.follow_deg + config.follow_lag_s * max(map(abs, motion.velocity_deg_s))
        self._astray_cycles = self._astray_cycles + 1 if strays or error_deg > allowed_deg else 0
        if self._astray_cycles <= 1:
            self._late_before = self.late
        if self._astray_cycles >= config.follow_cycles:
            late = self.late - self._late_before
            self.fail(
                shared_state.NOT_FOLLOWING,
                f"the arm does not follow: {error_deg:.2f} deg from the commanded axes for "
                f"{self._astray_cycles} cycles (emergency stop, brakes or collision)"
                + (f", with {late} late answers meanwhile" if late else ""),
            )
        if self.delay >= config.delay_limit:
            self.fail(shared_state.LATE, f"late answers: the controller's delay counter rose to {self.delay}")
