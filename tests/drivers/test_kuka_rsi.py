"""The RSI packets, and the session without its process."""

from __future__ import annotations

import re
from dataclasses import replace
from random import Random

import numpy as np
import pytest
from arms import KR10_R1100_SIXX
from hypothesis import given, settings
from hypothesis import strategies as st

from coupole.kinematics import structure_of
from drivers.kuka.rsi import shared_state
from drivers.kuka.rsi.rsi_session import Config, RsiSession
from drivers.kuka.rsi.wire import controller_type, packet_parser
from sim.devices.kuka_controller import Settings as ControllerSettings
from sim.devices.kuka_corrections import Corrections

HOME_DEG = (0.0, -90.0, 90.0, 0.0, 90.0, 0.0)
CONFIG = Config(
    cycle_s=0.004,
    declared_cycle_s=0.004,
    controller="",
    sen_type="ImFree",
    measured_tag="AIPos",
    delay_tag="Delay",
    correction_tag="AKorr",
    stop_tag="",
    corrects="axes",
    mode="absolute",
    geometry=structure_of(KR10_R1100_SIXX).lengths,
    velocity_deg_s=(100.0,) * 6,
    acceleration_deg_s2=(300.0,) * 6,
    jerk_deg_s3=(3000.0,) * 6,
    link_timeout_s=0.5,
    delay_limit=50,
    attention_s=0.1,
    delay_counts="cumulative",
    unaccounted_s=0.1,
    settle_deg=0.003,
    settle_deg_s=0.1,
    follow_deg=1.0,
    follow_lag_s=0.06,
    follow_cycles=10,
)
parse = packet_parser("AIPos", "Delay")


def packet(ipoc: int, joints_deg: tuple[float, ...] = HOME_DEG, delay: int | None = 0) -> bytes:
    axes = " ".join(f'A{i}="{angle:.4f}"' for i, angle in enumerate(joints_deg, start=1))
    late = "" if delay is None else f'<Delay D="{delay}"/>'
    return f'<Rob Type="KUKA simulated"><AIPos {axes}/>{late}<IPOC>{ipoc}</IPOC></Rob>'.encode()


def values_of(answer: bytes | None) -> tuple[float, ...]:
    """The six corrections of an answer."""
    assert answer is not None
    values = re.findall(rb' (?:[ABCXYZ]|A\d)="([^"]+)"', answer)
    assert len(values) == 6
    return tuple(map(float, values))


def turn_a1(by_deg: float, number: int = 1) -> shared_state.Command:
    return shared_state.Command(number, shared_state.MOVE, (by_deg, *HOME_DEG[1:]))


@given(
    joints_deg=st.tuples(*[st.floats(-350.0, 350.0)] * 6),
    ipoc=st.integers(0, 2**40),
    delay=st.none() | st.integers(0, 100),
    quote=st.sampled_from("'\""),
    type_name=st.sampled_from(["Type", "TYPE"]),
    order=st.randoms(use_true_random=False),
)
def test_a_packet_is_read_in_any_order(
    joints_deg: tuple[float, ...], ipoc: int, delay: int | None, quote: str, type_name: str, order: Random
) -> None:
    axes = [f"A{i}={quote}{angle:.6f}{quote}" for i, angle in enumerate(joints_deg, start=1)]
    order.shuffle(axes)
    elements = [f"<AIPos {' '.join(axes)} />", f"<IPOC>{ipoc}</IPOC>", '<ASPos A1="1" A2="2"/>', "<Other/>"]
    if delay is not None:
        elements.append(f"<Delay D={quote}{delay}{quote}/>")
    order.shuffle(elements)
    data = f"<Rob {type_name}={quote}KUKA{quote}>{''.join(elements)}</Rob>".encode()
    read = parse(data)
    assert read is not None
    assert read.ipoc == str(ipoc).encode()
    assert np.allclose(read.joints_deg, joints_deg, atol=1e-6)
    assert read.delay == delay
    assert controller_type(data) == b"KUKA"


@pytest.mark.parametrize(
    "data",
    [
        b"",
        b"<Rob/>",
        packet(1).replace(b"IPOC", b"IPOX"),
        packet(1).replace(b"A4", b"B4"),
        packet(1).replace(b"90.0000", b"ninety"),
        packet(1).replace(b"90.0000", b"nan"),
        packet(1).replace(b"90.0000", b"1e300"),
        packet(1, delay=2**64),
        packet(1, delay=2**31),
        packet(1, delay=-1),
        packet(1).replace(b'D="0"', b'D="none"'),
        packet(2**63),
    ],
)
def test_a_packet_without_ipoc_or_axes_is_not_answered(data: bytes) -> None:
    session = RsiSession(CONFIG)
    assert session.answer(data, 0) is None
    assert session.malformed == 1


@given(st.binary(max_size=200))
def test_no_bytes_upset_the_parser(data: bytes) -> None:
    parse(b"<Rob><AIPos " + data)


def test_the_first_answer_corrects_nothing_and_echoes_the_ipoc() -> None:
    answer = RsiSession(CONFIG).answer(packet(4208163634), 0)
    zeros = " ".join(f'A{i}="0.000000"' for i in range(1, 7))
    expected = f'<Sen Type="ImFree"><EStr></EStr><AKorr {zeros}/><IPOC>4208163634</IPOC></Sen>'
    assert answer == expected.encode()


def test_a_session_that_another_program_began_is_not_answered() -> None:
    session = RsiSession(CONFIG)
    assert session.answer(packet(100, delay=3), 0) is None
    assert session.refused == 1
    assert session.answer(packet(104), 0) is not None


def test_a_packet_that_comes_twice_gets_the_same_answer_twice() -> None:
    session = RsiSession(CONFIG)
    session.answer(packet(100), 0)
    session.obey(shared_state.Command(1, shared_state.MOVE, (20.0, -90.0, 90.0, 0.0, 90.0, 0.0)))
    assert session.answer(packet(104), 1) == session.answer(packet(104), 2)


@pytest.mark.parametrize("moves", [False, True])
def test_a_session_begun_anew_is_a_fault_and_gets_no_answer(moves: bool) -> None:
    session = RsiSession(CONFIG)
    for ipoc in (10_000, 10_004):
        session.answer(packet(ipoc), 0)
    if moves:
        session.obey(turn_a1(20.0))
        session.answer(packet(10_008), 0)
    elsewhere = (30.0, -80.0, 90.0, 0.0, 90.0, 0.0)
    assert [session.answer(packet(ipoc, elsewhere), 0) for ipoc in range(200, 240, 4)] == [None] * 10
    assert session.fault == shared_state.RESTARTED
    assert session.answer(packet(10_012), 0) is None


@pytest.mark.parametrize("stray", [400, 9_000, 2**40, 10_007])
def test_one_packet_that_does_not_continue_the_session_changes_nothing(stray: int) -> None:
    """At rest a re-based session would let the next correction jump by as much as the arm has moved."""
    session = RsiSession(CONFIG)
    for ipoc in range(8_000, 10_000, 4):
        session.answer(packet(ipoc, delay=0), 0)
    before = session.answer(packet(10_000), 0)
    assert session.answer(packet(stray, (5.0, *HOME_DEG[1:])), 0) is None
    assert values_of(session.answer(packet(10_004), 0)) == values_of(before)
    assert session.astray == 1
    assert session.fault == shared_state.NO_FAULT


def test_after_a_gap_nothing_is_answered_any_more() -> None:
    session = RsiSession(CONFIG)
    for ipoc in (100, 104, 108):
        session.answer(packet(ipoc), 0)
    assert [session.answer(packet(ipoc), 0) for ipoc in range(1108, 1140, 4)] == [None] * 8
    assert session.fault == shared_state.LINK_LOST
    assert session.fault_text == b"249 packets are missing"


def test_a_fault_is_latched_against_new_targets() -> None:
    session = RsiSession(CONFIG)
    session.answer(packet(100), 0)
    session.check_link(int(1e9))
    session.obey(shared_state.Command(1, shared_state.MOVE, (20.0, -90.0, 90.0, 0.0, 90.0, 0.0)))
    assert session.motion.phase == shared_state.STANDING
    assert b"no packet for 1.00 s" in session.fault_text


def test_without_a_delay_counter_only_a_session_after_silence_is_begun() -> None:
    session = RsiSession(CONFIG, opened_ns=0)
    assert session.answer(packet(100, delay=None), 4_000_000) is None
    assert session.answer(packet(104, delay=None), 8_000_000) is None
    assert session.refused == 2
    assert session.answer(packet(5000, delay=None), 1_000_000_000) is not None


def test_relative_corrections_need_the_delay_counter() -> None:
    session = RsiSession(replace(CONFIG, mode="relative"))
    assert session.answer(packet(100, delay=None), 10**10) is None
    assert session.malformed == 1


def test_a_packet_out_of_order_does_not_disturb_the_count_of_late_answers() -> None:
    session = RsiSession(CONFIG)
    for ipoc, delay in ((100, 0), (104, 1), (108, 2), (104, 1), (112, 2)):
        session.answer(packet(ipoc, delay=delay), 0)
    assert session.late == 2


@pytest.mark.parametrize(("every", "told"), [(1000, False), (12, True)])
def test_late_answers_are_told_of_an_arm_that_does_not_follow(every: int, told: bool) -> None:
    session, delay = RsiSession(CONFIG), 0
    session.answer(packet(100), 0)
    session.obey(turn_a1(20.0))
    for ipoc in range(104, 900, 4):
        delay += ipoc % every == 0
        session.answer(packet(ipoc, delay=delay), 0)
        if session.fault != shared_state.NO_FAULT:
            break
    assert session.fault == shared_state.NOT_FOLLOWING
    assert (b"late answers meanwhile" in session.fault_text) == told


@pytest.mark.parametrize("mode", ["absolute", "relative"])
def test_the_answers_after_a_fault_move_nothing(mode: str) -> None:
    session = RsiSession(replace(CONFIG, mode=mode))
    session.answer(packet(100), 0)
    session.obey(turn_a1(20.0))
    told_deg, last = 0.0, 0.0
    answers: list[bytes | None] = []
    for ipoc in range(104, 900, 4):  # the arm stands: brakes, though answers are taken
        answers.append(session.answer(packet(ipoc), 0))
        if session.fault == shared_state.NOT_FOLLOWING:
            break
        last = values_of(answers[-1])[0]
        told_deg = last if mode == "absolute" else told_deg + last
    assert told_deg > 0.5
    words = [answers[-1], *(session.answer(packet(ipoc), 0) for ipoc in range(ipoc + 4, ipoc + 40, 4))]
    expected = 0.0 if mode == "relative" else last
    assert [values_of(word)[0] for word in words if word is not None] == [expected] * 5
    assert words[-1] is None


@settings(max_examples=30, deadline=None)
@given(
    mode=st.sampled_from(["absolute", "relative"]),
    corrects=st.sampled_from(["axes", "pose"]),
    counts=st.sampled_from(["cumulative", "consecutive"]),
    seed=st.integers(0, 2**32),
    late_share=st.sampled_from([0.0, 0.02, 0.2]),
    lost_share=st.sampled_from([0.0, 0.02, 0.1]),
)
def test_late_answers_and_lost_packets_change_neither_the_way_nor_its_end(
    mode: str, corrects: str, counts: str, seed: int, late_share: float, lost_share: float
) -> None:
    chance = Random(seed)
    session = RsiSession(replace(CONFIG, mode=mode, corrects=corrects, delay_counts=counts, delay_limit=10**6))
    controller = Corrections(ControllerSettings(mode=mode, corrects=corrects))
    controller.begin(HOME_DEG)
    target_deg = (6.0, -88.0, 91.0, -4.0, 85.0, 3.0)
    arm_deg, delay, answer = HOME_DEG, 0, None
    share_before = 0.0
    for number in range(400):
        if number:
            in_time = answer is not None and chance.random() >= late_share
            delay = delay + 1 if not in_time else 0 if counts == "consecutive" else delay
            arm_deg, fault = controller.take(values_of(answer) if in_time else None)
            assert fault == ""
        lost = 1 < number < 300 and chance.random() < lost_share
        answer = None if lost else session.answer(packet(1000 + 4 * number, arm_deg, delay), 0)
        if number == 1:
            session.obey(shared_state.Command(1, shared_state.MOVE, target_deg))
        shares = np.subtract(arm_deg, HOME_DEG) / np.subtract(target_deg, HOME_DEG)
        assert np.ptp(shares) < 1e-4, "off the line"
        assert shares[0] >= share_before - 1e-6, "backwards"
        share_before = float(shares[0])
    assert session.fault == shared_state.NO_FAULT
    assert np.allclose(arm_deg, target_deg, atol=1e-5 if corrects == "axes" else 1e-3)
