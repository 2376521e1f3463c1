"""Whatever comes in, no answer of the RSI session steps by more than the limits allow.

The arm at the other end is a model of its own: it adds up what is answered to its own packets, and knows nothing
of the packets that others, or the network, put between them.
"""

from __future__ import annotations

import re
from collections.abc import Iterator
from dataclasses import dataclass, field, replace

import numpy as np
import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st
from test_kuka_rsi import CONFIG, HOME_DEG, packet

from drivers.kuka.rsi import shared_state
from drivers.kuka.rsi.bounds import StepBounds
from drivers.kuka.rsi.cycle import WINDOW, CycleMeter
from drivers.kuka.rsi.rsi_session import RsiSession

SPEED_DEG_S, ACCELERATION_DEG_S2, JERK_DEG_S3 = 100.0, 300.0, 3000.0
STEP_DEG = SPEED_DEG_S * CONFIG.cycle_s
CHANGE_DEG = ACCELERATION_DEG_S2 * CONFIG.cycle_s**2
ROUNDING_DEG = 1e-5


@dataclass
class Arm:
    """An arm that follows what it is answered, and what was answered to everybody."""

    session: RsiSession
    relative: bool
    ipoc: int = 100_000
    axes_deg: np.ndarray = field(default_factory=lambda: np.array(HOME_DEG))
    pushed_deg: float = 0.0
    delay: int = 0
    now_ns: int = 0
    packets: list[bytes] = field(default_factory=list)
    answers_deg: list[np.ndarray] = field(default_factory=list)
    steps_deg: list[np.ndarray] = field(default_factory=list)
    interrupted: list[bool] = field(default_factory=list)
    """For each step of the arm, whether its answer was missing, or the driver held it because one was."""

    def cycle(self, *, reaches: bool = True, returns: bool = True) -> None:
        """One cycle: a packet that reaches the driver, an answer that returns in time."""
        self.ipoc += 4
        self.now_ns += 4_000_000
        measured_deg = tuple(self.axes_deg + self.pushed_deg)
        data = packet(self.ipoc, measured_deg, self.delay)
        self.packets.append(data)
        answer = self.tell(data) if reaches else None
        step_deg = np.zeros(6)
        if answer is None or not returns:
            self.delay += 1
        else:
            step_deg = answer if self.relative else np.array(HOME_DEG) + answer - self.axes_deg
        self.interrupted.append(answer is None or not returns)
        self.steps_deg.append(step_deg)
        self.axes_deg = self.axes_deg + step_deg

    def tell(self, data: bytes) -> np.ndarray | None:
        """The corrections [6] that answer these bytes, if any do."""
        answer = self.session.answer(data, self.now_ns)
        self.session.check_link(self.now_ns)
        self.session.state(0)
        if answer is None:
            return None
        values = np.array([float(value) for value in re.findall(rb'A\d="([^"]+)"', answer)])
        assert values.shape == (6,)
        self.answers_deg.append(values)
        return values


def numbered(low: int, high: int) -> st.SearchStrategy[int]:
    return st.integers(low, high)


angles = st.tuples(*[st.floats(-20.0, 20.0)] * 6)
IN_TIME = (
    st.tuples(st.just("go on"), numbered(1, 60)),
    st.tuples(st.just("go on"), numbered(1, 60)),
    st.tuples(st.just("again"), numbered(1, 400)),
    st.tuples(st.just("ipoc"), st.one_of(numbered(-400, 400), numbered(-200_000, 2**62))),
    st.tuples(st.just("move"), angles),
    st.tuples(st.just("move"), angles),
    st.tuples(st.just("stop"), st.none()),
)
"""Events with which every answer to the arm's own packets comes in time."""
EVENTS = st.one_of(
    *IN_TIME,
    st.tuples(st.just("late"), numbered(1, 12)),
    st.tuples(st.just("lost"), numbered(1, 30)),
    st.tuples(st.just("delay"), st.one_of(numbered(-1, 300), numbered(0, 2**70))),
    st.tuples(st.just("ahead"), st.tuples(numbered(1, 30), numbered(0, 300))),
    st.tuples(st.just("pushed"), st.floats(-5.0, 5.0)),
    st.tuples(st.just("elsewhere"), st.floats(-1e6, 1e6)),
    st.tuples(st.just("bytes"), st.binary(max_size=60)),
)


UNDER_WAY: list[tuple[str, object]] = [("move", (20.0,) * 6), ("go on", 60)]
"""At 60 deg/s."""


def happen(arm: Arm, events: list[tuple[str, object]]) -> Iterator[None]:
    """Carry out the events; some are packets that the arm did not send."""
    for number, (what, value) in enumerate(events, start=1):
        latest = arm.packets[-1]
        match what:
            case "go on" | "late" | "lost":
                assert isinstance(value, int)
                for _ in range(value):
                    arm.cycle(reaches=what != "lost", returns=what != "late")
            case "again":
                assert isinstance(value, int)
                arm.tell(arm.packets[-min(value, len(arm.packets))])
            case "ipoc":
                assert isinstance(value, int)
                arm.tell(re.sub(rb"<IPOC>\d+", b"<IPOC>%d" % (arm.ipoc + value), latest))
            case "delay":
                arm.tell(re.sub(rb'D="\d+"', f'D="{value}"'.encode(), latest))
            case "ahead":
                steps, delay = value  # type: ignore[misc]
                arm.tell(packet(arm.ipoc + 4 * steps, tuple(arm.axes_deg), delay))
            case "pushed":
                assert isinstance(value, float)
                arm.pushed_deg = value
            case "elsewhere":
                arm.tell(packet(arm.ipoc + 4, (value, *HOME_DEG[1:]), arm.delay))  # type: ignore[arg-type]
            case "bytes":
                assert isinstance(value, bytes)
                arm.tell(latest[: len(value)] + value + latest[len(value) :])
            case "move":
                target_deg = tuple(np.add(HOME_DEG, value))
                arm.session.obey(shared_state.Command(number, shared_state.MOVE, target_deg))
            case "stop":
                arm.session.obey(shared_state.Command(number, shared_state.STOP))
        yield


@settings(max_examples=150, deadline=None)
@given(mode=st.sampled_from(["absolute", "relative"]), events=st.lists(EVENTS, max_size=25))
@example("absolute", [*UNDER_WAY, ("ipoc", -90_000), ("go on", 60)])
@example("absolute", [*UNDER_WAY, ("go on", 400), ("ipoc", -90_000), ("move", (0.0,) * 6), ("go on", 9)])
@example("absolute", [*UNDER_WAY, ("late", 9), ("go on", 60), ("late", 3), ("stop", None), ("go on", 60)])
@example("absolute", [("move", (1e-77,) * 6), ("go on", 3)])
@example("relative", [*UNDER_WAY, ("late", 9), ("pushed", 5.0), ("go on", 60)])
def test_no_answer_steps_by_more_than_the_limits_whatever_comes_in(
    mode: str, events: list[tuple[str, object]]
) -> None:
    session = RsiSession(replace(CONFIG, mode=mode, delay_limit=200))
    arm = Arm(session, mode == "relative")
    for _ in range(15):  # the cycle is declared, and witnessed after ten
        arm.cycle()
    for _ in happen(arm, events):
        assert session.fault != shared_state.OUT_OF_BOUNDS, session.fault_text
    answers_deg = np.array(arm.answers_deg)
    answered_deg = answers_deg if mode == "relative" else np.diff(answers_deg, axis=0)
    assert np.abs(answered_deg).max() <= STEP_DEG + ROUNDING_DEG
    if not any(what == "ahead" for what, _ in events):  # a packet of the future takes an answer from the arm
        assert np.abs(arm.steps_deg).max() <= STEP_DEG + ROUNDING_DEG


@settings(max_examples=60, deadline=None)
@given(
    mode=st.sampled_from(["absolute", "relative"]),
    events=st.lists(st.one_of(*IN_TIME), max_size=25),
)
@example("absolute", [*UNDER_WAY, ("stop", None), ("go on", 60)])
@example("relative", [*UNDER_WAY, ("again", 3), ("move", (-20.0,) * 6), ("go on", 400)])
def test_an_arm_whose_answers_come_in_time_is_never_accelerated_beyond_its_limit(
    mode: str, events: list[tuple[str, object]]
) -> None:
    """Old, doubled and wrong packets of the controller's own address may come between its own."""
    session = RsiSession(replace(CONFIG, mode=mode))
    arm = Arm(session, mode == "relative")
    for _ in range(15):
        arm.cycle()
    # an IPOC near the arm's own takes an answer from it, and too many in a row end the session
    events = [event for event in events if event[0] != "ipoc" or abs(int(event[1])) > 4 * 25]  # type: ignore[call-overload]
    for _ in happen(arm, events):
        arm.cycle()
    assert session.fault == shared_state.NO_FAULT, session.fault_text
    assert np.abs(np.diff(arm.steps_deg, axis=0)).max() <= CHANGE_DEG + 2 * ROUNDING_DEG


@pytest.mark.parametrize("corrects", ["axes", "pose"])
def test_an_answer_that_would_break_the_bounds_is_withheld(corrects: str) -> None:
    """The last gate, tested by a trajectory that jumps."""
    session = RsiSession(replace(CONFIG, corrects=corrects))
    for ipoc in range(100, 200, 4):
        assert session.answer(packet(ipoc), 0) is not None
    session.motion.stand_at((HOME_DEG[0] + 3.0, *HOME_DEG[1:]))
    assert [session.answer(packet(ipoc), 0) for ipoc in range(200, 300, 4)] == [None] * 25
    assert session.fault == shared_state.OUT_OF_BOUNDS
    assert b"an answer was withheld" in session.fault_text


def test_the_bounds_are_those_of_speed_and_acceleration() -> None:
    bounds = StepBounds("axes", CONFIG.cycle_s, (SPEED_DEG_S,) * 6, (ACCELERATION_DEG_S2,) * 6, CONFIG.geometry)
    rest = (0.0,) * 5
    assert bounds.violation((0.0048, *rest), advances=True) == ""
    assert bounds.violation((0.0096, *rest), advances=True) == ""
    assert "would change by 0.0052" in bounds.violation((0.0148, *rest), advances=True)
    assert bounds.violation((0.3999, *rest), advances=False) == ""
    assert "step by 0.4010" in bounds.violation((0.401, *rest), advances=False)
    assert "nan" in bounds.violation((float("nan"), *rest), advances=False)
    bounds.at_rest()
    assert bounds.violation((0.0048, *rest), advances=True) == ""


def beat(meter: CycleMeter, cycle_s: float, count: int, start_s: float = 0.0, step: int = 4) -> tuple[float, str]:
    """Feed `count` packets; returns the time of the last one, and the first reason to end the session."""
    for _ in range(count):
        start_s += cycle_s
        if reason := meter.packet(round(start_s * 1e9), step, 1):
            return start_s, reason
    return start_s, ""


def test_a_cycle_is_known_after_a_hundred_packets() -> None:
    meter = CycleMeter(0.004, None)
    beat(meter, 0.0041, WINDOW)
    assert meter.measured_ns == 0
    beat(meter, 0.0041, 1, start_s=0.0041 * WINDOW)
    assert meter.measured_ns == pytest.approx(4_100_000, abs=1)
    assert meter.ipoc_step == 4


def test_a_cycle_that_becomes_shorter_in_a_session_is_noticed_within_two_hundred_packets() -> None:
    meter = CycleMeter(0.012, None)
    now_s, reason = beat(meter, 0.012, WINDOW + 1, step=12)
    assert reason == ""
    _, reason = beat(meter, 0.004, 2 * WINDOW, now_s, step=12)
    assert "its packets come every 4.00 ms" in reason


def test_stalls_of_the_machine_are_no_longer_cycle() -> None:
    meter = CycleMeter(0.004, None)
    now_s = 0.0
    for _ in range(12):
        now_s, reason = beat(meter, 0.004, 20, now_s + 0.2)
        assert reason == ""
    assert meter.measured_ns > 10_000_000


def test_a_stall_before_the_first_packet_is_no_shorter_cycle() -> None:
    """It was read late, and those behind it at once; the next window is right."""
    meter = CycleMeter(0.004, None)
    now_s, reason = beat(meter, 0.0, 25, 0.1)
    now_s, more = beat(meter, 0.004, WINDOW - 24, now_s)
    assert reason + more == ""
    assert meter.measured_ns == 0
    assert beat(meter, 0.004, WINDOW, now_s)[1] == ""
    assert meter.measured_ns == pytest.approx(4_000_000, abs=1)


def test_a_longer_cycle_is_told_after_two_hundred_packets() -> None:
    meter = CycleMeter(0.004, None)
    now_s, reason = beat(meter, 0.012, 2 * WINDOW, step=1)
    assert reason == ""
    assert "its packets come every 12.00 ms" in beat(meter, 0.012, 1, now_s, step=1)[1]


def test_an_ipoc_that_counts_in_ms_must_agree_with_the_arrival() -> None:
    assert beat(CycleMeter(0.004, None), 0.004, WINDOW + 1, step=1)[1] == ""
    assert "its IPOC counts 12 a packet" in beat(CycleMeter(0.004, None), 0.004, WINDOW + 1, step=12)[1]


def test_a_declared_cycle_is_compared_and_still_witnessed_by_the_ipoc() -> None:
    assert beat(CycleMeter(0.004, 0.004), 0.0, 20)[1] == ""
    assert "declares 12.00 ms" in beat(CycleMeter(0.004, 0.012), 0.0, 20)[1]
    assert "its IPOC counts 12 a packet" in beat(CycleMeter(0.004, 0.004), 0.0, 20, step=12)[1]


def test_a_trajectory_that_cannot_be_computed_ends_in_a_fault_and_not_in_an_exception() -> None:
    endless = {"velocity_deg_s": (1e79,) * 6, "acceleration_deg_s2": (3e79,) * 6, "jerk_deg_s3": (3e80,) * 6}
    session = RsiSession(replace(CONFIG, **endless))
    for ipoc in range(100, 140, 4):
        session.answer(packet(ipoc), 0)
    session.obey(shared_state.Command(1, shared_state.MOVE, (1.0, *HOME_DEG[1:])))
    assert session.answer(packet(140), 0) is not None
    assert session.fault == shared_state.NO_TRAJECTORY
