"""An answer starts from the arm: RSI that is started anew, counters that fall, cycles that change in a session.

The controller at the other end is a model of its own. Corrections count from where *it* last started RSI, whatever
the driver believes; what each answer moves is measured from the axes that it reports.
"""

from __future__ import annotations

import re
from dataclasses import dataclass, field, replace

import numpy as np
import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st
from test_kuka_rsi import CONFIG, HOME_DEG, packet

from drivers.kuka.rsi import shared_state
from drivers.kuka.rsi.bounds import StepBounds, follow_bounds
from drivers.kuka.rsi.corrections import Corrections
from drivers.kuka.rsi.rsi_session import Config, RsiSession
from drivers.kuka.rsi.wire import Packet
from drivers.kuka.rsi.witness import ArmWitness, LagBounds
from sim.devices.kuka_controller import Settings as ControllerSettings
from sim.devices.kuka_corrections import Corrections as TheirCorrections

STEP_DEG = 100.0 * CONFIG.cycle_s + 2e-5
THERE_DEG = tuple(np.add(HOME_DEG, 20.0))


@dataclass
class Controller:
    """A controller that can start RSI anew, and tells so only as real ones might."""

    session: RsiSession
    mode: str = "absolute"
    corrects: str = "axes"
    counts: str = "cumulative"
    steps_ipoc: bool = True
    """Whether the IPOC counts ms; else it counts packets."""
    real: bool = False
    """Whether it does not call itself simulated, so that the machine's clock counts."""
    cycle_ms: int = 4
    ipoc: int = 100_000
    now_ns: int = 10**9
    delay: int = 0
    axes_deg: tuple[float, ...] = HOME_DEG
    largest_deg: float = 0.0
    """Longest step that an answer has led from the axes that its packet reported."""
    packets: list[bytes] = field(default_factory=list)

    def __post_init__(self) -> None:
        self.begin()

    def begin(self) -> None:
        self.delay = 0
        self.applied = TheirCorrections(ControllerSettings(mode=self.mode, corrects=self.corrects))
        self.applied.begin(self.axes_deg)

    def pass_time(self, cycles: int) -> None:
        """Cycles in which nothing is sent."""
        self.now_ns += cycles * self.cycle_ms * 1_000_000
        self.ipoc += cycles * self.cycle_ms if self.steps_ipoc else 0

    def cycle(self, *, reaches: bool = True, returns: bool = True) -> bool:
        """One cycle; whether it was answered."""
        self.now_ns += self.cycle_ms * 1_000_000
        self.ipoc += self.cycle_ms if self.steps_ipoc else 1
        data = packet(self.ipoc, self.axes_deg, self.delay)
        self.packets.append(data)
        values = self.tell(data) if reaches else None
        in_time = values is not None and returns
        self.delay = self.delay + 1 if not in_time else 0 if self.counts == "consecutive" else self.delay
        before_deg = self.axes_deg
        self.axes_deg, fault = self.applied.take(values if in_time else None)
        assert fault == ""
        self.largest_deg = max(self.largest_deg, float(np.abs(np.subtract(self.axes_deg, before_deg)).max()))
        return in_time

    def tell(self, data: bytes) -> tuple[float, ...] | None:
        data = data.replace(b" simulated", b"") if self.real else data
        answer = self.session.answer(data, self.now_ns)
        self.session.check_link(self.now_ns)
        if answer is None:
            return None
        return tuple(float(value) for value in re.findall(rb' (?:[ABCXYZ]|A\d)="([^"]+)"', answer))

    def go_on(self, cycles: int) -> None:
        for _ in range(cycles):
            self.cycle()


def under_way(cycles: int = 100, config: Config = CONFIG, **controller: object) -> Controller:
    """A controller whose arm has moved away from where RSI was started."""
    theirs = Controller(RsiSession(config), mode=config.mode, corrects=config.corrects, **controller)  # type: ignore[arg-type]
    theirs.go_on(30)
    theirs.session.obey(shared_state.Command(1, shared_state.MOVE, THERE_DEG))
    theirs.go_on(cycles)
    assert np.abs(np.subtract(theirs.axes_deg, HOME_DEG)).max() > 3.0
    return theirs


@pytest.mark.parametrize("cycles", [100, 400], ids=["in-motion", "at-rest"])
@pytest.mark.parametrize("silent", [1, 5, 24])
def test_rsi_that_was_restarted_within_a_tenth_of_a_second_gets_no_answer(silent: int, cycles: int) -> None:
    arm = under_way(cycles)
    arm.pass_time(silent)
    arm.begin()
    assert not arm.cycle()
    assert arm.session.fault == shared_state.RESTARTED
    assert b"%d cycles passed without an answer" % silent in arm.session.fault_text
    arm.go_on(30)
    assert arm.largest_deg <= STEP_DEG


def test_a_delay_counter_that_falls_is_a_restart_and_told_at_once() -> None:
    arm = under_way()
    arm.cycle(returns=False)
    arm.go_on(20)
    assert arm.session.fault == shared_state.NO_FAULT
    arm.begin()
    assert not arm.cycle()
    assert arm.session.fault == shared_state.RESTARTED
    assert b"its counter of late answers fell from 1 to 0" in arm.session.fault_text
    assert arm.largest_deg <= STEP_DEG


def test_a_counter_of_late_answers_in_a_row_may_fall_to_zero_where_the_rig_says_so() -> None:
    arm = under_way(config=replace(CONFIG, delay_counts="consecutive"), counts="consecutive")
    for late in (1, 3):
        for _ in range(late):
            arm.cycle(returns=False)
        arm.go_on(5)
    assert arm.session.fault == shared_state.NO_FAULT
    arm.pass_time(3)
    arm.begin()
    assert not arm.cycle()
    assert arm.session.fault == shared_state.RESTARTED


def test_lost_packets_that_the_controller_counts_do_not_end_the_session() -> None:
    arm = under_way()
    for _ in range(7):
        arm.cycle(reaches=False)
    assert arm.cycle()
    arm.go_on(500)
    assert arm.session.fault == shared_state.NO_FAULT
    assert np.allclose(arm.axes_deg, THERE_DEG, atol=1e-4)


def test_without_a_counter_a_lost_packet_ends_the_session() -> None:
    session = RsiSession(CONFIG)
    for ipoc in (*range(1000, 1200, 4), 1204):
        session.answer(packet(ipoc, delay=None), 10**9 + ipoc)
    assert session.fault == shared_state.RESTARTED
    assert b"no counter tells" in session.fault_text


@pytest.mark.parametrize(("before_ms", "after_ms"), [(4, 12), (12, 4)])
def test_a_cycle_that_changes_within_a_session_is_told_by_the_second_packet(before_ms: int, after_ms: int) -> None:
    cycle_s = before_ms / 1e3
    config = replace(CONFIG, cycle_s=cycle_s, declared_cycle_s=cycle_s)
    arm = under_way(config=config, cycle_ms=before_ms)
    answered_deg = arm.axes_deg
    arm.cycle_ms = after_ms
    assert [arm.cycle(), arm.cycle()] == [False, False]
    assert arm.session.fault == shared_state.RESTARTED
    assert b"cycle has changed" in arm.session.fault_text
    assert arm.axes_deg == answered_deg


@pytest.mark.parametrize("to", [500, 60_000, 100_000])
def test_an_ipoc_that_steps_back_is_a_restart_by_its_second_packet(to: int) -> None:
    arm = under_way()
    arm.begin()
    arm.ipoc = to
    assert [arm.cycle(), arm.cycle()] == [False, False]
    assert arm.session.fault == shared_state.RESTARTED
    assert arm.largest_deg <= STEP_DEG


def test_packets_that_the_network_brings_again_are_known_and_only_counted() -> None:
    arm = under_way()
    for data in arm.packets[-40:]:
        arm.tell(data)
    assert arm.session.astray == 39  # the newest gets its answer again
    assert arm.session.fault == shared_state.NO_FAULT


def test_another_packet_with_the_number_of_the_last_is_not_given_its_answer() -> None:
    arm = under_way()
    arm.begin()
    assert arm.tell(packet(arm.ipoc, HOME_DEG, 0)) is None
    assert arm.session.astray == 1


def test_a_silence_that_an_ipoc_of_packets_does_not_count_ends_the_session() -> None:
    config = replace(CONFIG, declared_cycle_s=None)
    arm = Controller(RsiSession(config), steps_ipoc=False, real=True)
    arm.go_on(150)
    arm.session.obey(shared_state.Command(1, shared_state.MOVE, THERE_DEG))
    arm.go_on(100)
    arm.pass_time(30)
    arm.begin()
    arm.go_on(8)
    assert arm.session.fault == shared_state.RESTARTED
    assert b"silent for 0.1" in arm.session.fault_text
    assert arm.largest_deg <= STEP_DEG


def test_a_silence_of_this_machine_is_no_restart() -> None:
    """Its first packet is read late, those behind it are dropped, and the next accounts for all."""
    config = replace(CONFIG, cycle_s=0.012, declared_cycle_s=None, unaccounted_s=0.05)
    arm = Controller(RsiSession(config), cycle_ms=12, real=True)
    arm.go_on(150)
    begun_ns, arm.now_ns = arm.now_ns, arm.now_ns + 120_000_000
    assert arm.tell(packet(arm.ipoc + 12, arm.axes_deg, 0)) is None
    assert arm.session.behind
    arm.now_ns = begun_ns
    for _ in range(9):
        arm.cycle(reaches=False)
    assert arm.cycle()
    assert not arm.session.behind
    assert arm.session.fault == shared_state.NO_FAULT


def test_an_arm_that_is_not_where_it_was_led_is_not_led_on_while_that_is_judged() -> None:
    session = RsiSession(replace(CONFIG, follow_cycles=50))
    arm = Controller(session)
    arm.go_on(30)
    session.obey(shared_state.Command(1, shared_state.MOVE, THERE_DEG))
    told = []
    for _ in range(150):  # brakes: the corrections are taken, the arm stands
        arm.ipoc += 4
        told.append((arm.tell(packet(arm.ipoc, HOME_DEG, 0)) or (0.0,))[0])
    # a degree, what an arm lags behind in 60 ms at the speed reached until then, and a step; the axes go on to 20
    assert 1.0 < max(told) < 4.5
    assert session.fault == shared_state.NOT_FOLLOWING


EVENTS = st.one_of(
    st.tuples(st.just("go on"), st.integers(1, 80)),
    st.tuples(st.just("go on"), st.integers(1, 80)),
    st.tuples(st.just("move"), st.floats(-20.0, 20.0)),
    st.tuples(st.just("late"), st.integers(1, 12)),
    st.tuples(st.just("lost"), st.integers(1, 30)),
    st.tuples(st.just("restarted"), st.integers(1, 40)),
    st.tuples(st.just("counts anew"), st.integers(0, 99_000)),
    st.tuples(st.just("counter falls"), st.none()),
    st.tuples(st.just("another cycle"), st.sampled_from([4, 12])),
    st.tuples(st.just("again"), st.integers(1, 300)),
    st.tuples(st.just("stray"), st.integers(-400, 400)),
)


def happen(arm: Controller, what: str, value: object) -> None:
    number = value if isinstance(value, int) else 0
    match what:
        case "go on" | "late" | "lost":
            for _ in range(number):
                arm.cycle(reaches=what != "lost", returns=what != "late")
        case "move":
            target_deg = tuple(angle + float(value) for angle in HOME_DEG)  # type: ignore[arg-type]
            arm.session.obey(shared_state.Command(1, shared_state.MOVE, target_deg))
        case "restarted":
            arm.pass_time(number)
            arm.begin()
        case "counts anew":
            arm.ipoc = number
            arm.begin()
        case "counter falls":
            # With a counter that was told as 0 there would be nothing to see: RSI does not restart in no time.
            if b'D="0"' not in arm.packets[-1]:
                arm.begin()
        case "another cycle":
            arm.cycle_ms = number
        case "again":
            arm.tell(arm.packets[-min(number, len(arm.packets))])
        case "stray":
            arm.tell(re.sub(rb"<IPOC>\d+", b"<IPOC>%d" % (arm.ipoc + number), arm.packets[-1]))


@settings(max_examples=120, deadline=None)
@given(
    mode=st.sampled_from(["absolute", "relative"]),
    corrects=st.sampled_from(["axes", "axes", "pose"]),
    counts=st.sampled_from(["cumulative", "consecutive"]),
    events=st.lists(EVENTS, max_size=20),
)
@example("absolute", "axes", "cumulative", [("restarted", 24), ("go on", 20)])
@example("absolute", "axes", "cumulative", [("late", 1), ("go on", 20), ("counter falls", None), ("go on", 20)])
@example("absolute", "pose", "cumulative", [("go on", 80), ("restarted", 3), ("go on", 20)])
@example("absolute", "axes", "cumulative", [("another cycle", 12), ("go on", 5)])
def test_whatever_a_controller_does_no_answer_leads_its_axes_farther_than_one_cycles_step(
    mode: str, corrects: str, counts: str, events: list[tuple[str, object]]
) -> None:
    config = replace(CONFIG, mode=mode, corrects=corrects, delay_counts=counts, delay_limit=10**6)
    arm = Controller(RsiSession(config), mode=mode, corrects=corrects, counts=counts)
    arm.go_on(30)
    arm.session.obey(shared_state.Command(1, shared_state.MOVE, THERE_DEG))
    arm.go_on(60)
    if counts == "consecutive":  # its falling counter says nothing
        events = [event for event in events if event[0] != "counter falls"]
    for what, value in events:
        happen(arm, what, value)
    assert arm.session.fault != shared_state.OUT_OF_BOUNDS, arm.session.fault_text
    # near the wrist's singularity the axes of a pose turn faster than the flange
    assert arm.largest_deg <= STEP_DEG * (1.0 if corrects == "axes" else 1.2)


# -- the witness alone: what it holds without any counting of the session --------------------------------------


def witness() -> ArmWitness:
    corrections = Corrections("axes", "absolute", CONFIG.geometry)
    limits = CONFIG.velocity_deg_s, CONFIG.acceleration_deg_s2
    step = StepBounds("axes", 0.004, *limits, CONFIG.geometry).farthest
    return ArmWitness(
        corrections.place,
        corrections.between,
        LagBounds(follow_bounds("axes", 1.0, CONFIG.geometry), step, lag_s=0.02),
        cycle_s=0.004,
        counts_in_a_row=False,
        unaccounted_s=0.0,
    )


def at(ipoc: int, a1_deg: float = 0.0, delay: int | None = 0) -> Packet:
    return Packet(b"%d" % ipoc, (a1_deg, *HOME_DEG[1:]), delay)


@pytest.mark.parametrize(
    ("packets", "place_deg", "expected"),
    [
        ([at(4), at(8), at(12)], 0.4, ""),
        ([at(4), at(8), at(12)], 1.39, ""),
        ([at(4), at(8), at(12)], 1.41, "lead axis or coordinate 1 to 1.410"),
        ([at(4), at(8), at(12)], -1.41, "lead axis or coordinate 1 to 1.410"),
        ([at(4), at(8), at(16)], 0.0, "1 cycles passed without an answer"),
        ([at(4), at(8), at(16, delay=1)], 0.0, ""),
        ([at(4), at(8, delay=1), at(12)], 0.0, "fell from 1 to 0"),
        ([at(4), at(8), at(4)], 0.0, "went back from 8 to 4"),
        ([at(4), at(8), at(8)], 0.0, "went back from 8 to 8"),
        ([*map(at, range(4, 60, 4)), at(58)], 0.0, "advanced by 2"),
        ([at(4, delay=None), at(8, delay=None), at(16, delay=None)], 0.0, "no counter tells"),
    ],
)
def test_the_witness_lets_no_answer_pass_that_does_not_start_from_the_arm(
    packets: list[Packet], place_deg: float, expected: str
) -> None:
    watching = witness()
    for given_packet in packets[:-1]:
        assert watching.violation(given_packet, given_packet.joints_deg, 0) == ""
    said = watching.violation(packets[-1], (place_deg, *HOME_DEG[1:]), 0)
    assert expected in said
    assert bool(said) == bool(expected)


def test_an_arm_may_lag_behind_within_the_time_that_the_rig_allows() -> None:
    watching = witness()
    for cycle in range(1, 20):
        lagging_deg = max(0.0, 0.4 * (cycle - 5))
        assert watching.violation(at(4 * cycle, lagging_deg), (0.4 * cycle, *HOME_DEG[1:]), 0) == ""
    assert not watching.strays((0.4 * 15, *HOME_DEG[1:]))
    assert watching.strays((0.4 * 8, *HOME_DEG[1:]))
