"""The RSI packets, the responder without its process, and the stand-in without a driver."""

from __future__ import annotations

import select
import socket
import threading
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from random import Random

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from drivers import kuka_rsi_block as block
from drivers.kuka_rsi_responder import Config, Responder
from drivers.kuka_rsi_wire import controller_type, packet_parser
from sim.clock import ClockWriter, SharedClock
from sim.kuka_controller import KukaController, Settings
from sim.kuka_kinematics import PoseErrors, flange_pose
from sim.reactor import Reactor

HOME_DEG = (0.0, -90.0, 90.0, 0.0, 90.0, 0.0)
CONFIG = Config(
    cycle_s=0.004,
    sen_type="ImFree",
    measured_tag="AIPos",
    delay_tag="Delay",
    correction_tag="AKorr",
    velocity_deg_s=(100.0,) * 6,
    acceleration_deg_s2=(300.0,) * 6,
    jerk_deg_s3=(3000.0,) * 6,
    link_timeout_s=0.5,
    delay_limit=50,
    settle_deg=0.003,
    settle_deg_s=0.1,
    follow_deg=1.0,
    follow_lag_s=0.06,
    follow_cycles=10,
)
parse = packet_parser("AIPos", "Delay")


def packet(ipoc: int, joints_deg: tuple[float, ...] = HOME_DEG, delay: int = 0) -> bytes:
    axes = " ".join(f'A{i}="{angle:.4f}"' for i, angle in enumerate(joints_deg, start=1))
    return f'<Rob Type="KUKA"><AIPos {axes}/><Delay D="{delay}"/><IPOC>{ipoc}</IPOC></Rob>'.encode()


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
    assert read.delay == (delay or 0)
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
    ],
)
def test_a_packet_without_ipoc_or_axes_is_not_answered(data: bytes) -> None:
    responder = Responder(CONFIG)
    assert responder.answer(data, 0) is None
    assert responder.malformed == 1


@given(st.binary(max_size=200))
def test_no_bytes_upset_the_parser(data: bytes) -> None:
    parse(b"<Rob><AIPos " + data)


def test_the_first_answer_corrects_nothing_and_echoes_the_ipoc() -> None:
    answer = Responder(CONFIG).answer(packet(4208163634), 0)
    zeros = " ".join(f'A{i}="0.000000"' for i in range(1, 7))
    expected = f'<Sen Type="ImFree"><EStr></EStr><AKorr {zeros}/><IPOC>4208163634</IPOC></Sen>'
    assert answer == expected.encode()


def test_a_session_that_another_program_began_is_not_answered() -> None:
    responder = Responder(CONFIG)
    assert responder.answer(packet(100, delay=3), 0) is None
    assert responder.refused == 1
    assert responder.answer(packet(104), 0) is not None


def test_a_packet_that_comes_twice_gets_the_same_answer_twice() -> None:
    responder = Responder(CONFIG)
    responder.answer(packet(100), 0)
    responder.obey(block.Command(1, block.MOVE, (20.0, -90.0, 90.0, 0.0, 90.0, 0.0)))
    assert responder.answer(packet(104), 1) == responder.answer(packet(104), 2)


def test_a_session_begun_anew_is_rebased_on_the_measured_axes() -> None:
    responder = Responder(CONFIG)
    for ipoc in (10_000, 10_004):
        responder.answer(packet(ipoc), 0)
    elsewhere = (30.0, -80.0, 90.0, 0.0, 90.0, 0.0)
    answer = responder.answer(packet(200, elsewhere), 0)
    assert answer is not None
    assert b'A1="0.000000" A2="0.000000"' in answer
    assert responder.fault == block.NO_FAULT


def test_a_session_begun_anew_in_mid_motion_is_a_fault() -> None:
    responder = Responder(CONFIG)
    for ipoc in (10_000, 10_004):
        responder.answer(packet(ipoc), 0)
    responder.obey(block.Command(1, block.MOVE, (20.0, -90.0, 90.0, 0.0, 90.0, 0.0)))
    responder.answer(packet(10_008), 0)
    answers = [responder.answer(packet(ipoc), 0) for ipoc in range(200, 240, 4)]
    assert responder.fault == block.RESTARTED
    assert answers[0] is not None
    assert b'A1="0.000000" A2="0.000000"' in answers[0]
    assert answers[-1] is None


def test_after_a_gap_nothing_is_answered_any_more() -> None:
    responder = Responder(CONFIG)
    for ipoc in (100, 104, 108):
        responder.answer(packet(ipoc), 0)
    assert responder.answer(packet(1108), 0) is None
    assert responder.fault == block.LINK_LOST
    assert responder.answer(packet(1112), 0) is None


def test_a_fault_is_latched_against_new_targets() -> None:
    responder = Responder(CONFIG)
    responder.answer(packet(100), 0)
    responder.check_link(int(1e9))
    responder.obey(block.Command(1, block.MOVE, (20.0, -90.0, 90.0, 0.0, 90.0, 0.0)))
    assert responder.motion.phase == block.STANDING
    assert b"no packet for 1.00 s" in responder.fault_text


@contextmanager
def controller_and_client(folder: Path, **settings: object) -> Iterator[tuple[KukaController, socket.socket]]:
    """A running stand-in, and the socket of a client that has to answer it."""
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as client:
        client.bind(("127.0.0.1", 0))
        client.settimeout(10.0)
        reactor = Reactor(ClockWriter(folder / "clock", speed=20.0))
        settings |= {"sends_to": f"127.0.0.1:{client.getsockname()[1]}"}
        controller = KukaController(reactor, Settings.model_validate(settings))
        world = threading.Thread(target=reactor.run)
        world.start()
        try:
            yield controller, client
        finally:
            reactor.stop()
            world.join()
            controller.close()


def answer_with(client: socket.socket, correction_a1_deg: float) -> None:
    """Answer the newest packet."""
    data, address = client.recvfrom(4096)
    while select.select([client], [], [], 0.0)[0]:
        data = client.recv(4096)
    read = parse(data)
    assert read is not None
    axes = f'A2="0.0" A1="{correction_a1_deg}" A3="0" A4="0" A5="0" A6="0"'
    client.sendto(b"<Sen><AKorr %b/><IPOC>%b</IPOC></Sen>" % (axes.encode(), read.ipoc), address)


def answer_until_silent(client: socket.socket, correction_a1_deg: float) -> None:
    client.settimeout(0.3)
    with suppress(TimeoutError):
        for _ in range(100):
            answer_with(client, correction_a1_deg)
        pytest.fail("the controller goes on sending")


def test_a_correction_faster_than_an_axis_can_turn_stops_rsi(tmp_path: Path) -> None:
    with controller_and_client(tmp_path) as (controller, client):
        for correction_deg in (0.0, 0.0, 0.0):
            answer_with(client, correction_deg)
        answer_until_silent(client, 2.0)
        assert "velocity of A1" in controller.fault
        assert controller.joints_deg == HOME_DEG


def test_a_correction_past_a_software_limit_stops_rsi(tmp_path: Path) -> None:
    with controller_and_client(tmp_path, start_joints_deg=(169.9, *HOME_DEG[1:])) as (controller, client):
        for correction_deg in (0.0, 0.0, 0.0, 0.05):
            answer_with(client, correction_deg)
        answer_until_silent(client, 0.2)
        assert "limit switch of A1" in controller.fault


def test_late_answers_end_in_the_controllers_own_fault(tmp_path: Path) -> None:
    settings = {"delay_limit": 5, "restart_s": 1e6}
    with controller_and_client(tmp_path, **settings) as (controller, client):
        answer_with(client, 0.0)
        controller.late(5)
        answer_until_silent(client, 0.0)
        assert controller.fault == "KSS29002: 5 late answers"


def test_the_world_waits_for_an_outstanding_answer(tmp_path: Path) -> None:
    with controller_and_client(tmp_path, answer_limit_s=5.0) as (controller, client):
        for _ in range(5):
            answer_with(client, 0.0)
        clock = SharedClock(tmp_path / "clock")
        held = [client.recv(4096) for _ in range(2)]
        now_ns = clock.now_ns()
        held.append(client.recv(4096))
        assert held[0] == held[1] == held[2]  # sent again, in case it was lost
        assert clock.now_ns() == now_ns
        assert controller.delay == 0
        client.close()


def test_the_true_pose_differs_from_stop_to_stop_and_repeats_with_the_seed() -> None:
    errors = PoseErrors(seed=3, repeatability_um=10.0, repeatability_deg=0.001, absolute_mm=0.0, absolute_deg=0.0)
    reported = flange_pose(HOME_DEG)
    first, second = (errors.true_flange_pose(HOME_DEG, stop) for stop in (0, 1))
    assert np.array_equal(first, errors.true_flange_pose(HOME_DEG, 0))
    assert 0.0 < np.linalg.norm(first[:3, 3] - second[:3, 3]) < 0.1
    assert np.linalg.norm(first[:3, 3] - reported[:3, 3]) < 0.1


def test_the_absolute_error_varies_over_the_cell_and_is_known() -> None:
    errors = PoseErrors(seed=3, repeatability_um=0.0, repeatability_deg=0.0, absolute_mm=0.2, absolute_deg=0.02)
    believed = np.array(HOME_DEG) + errors.axis_zero_error_deg()
    true_mm = errors.true_flange_pose(HOME_DEG, 7)[:3, 3]
    assert np.allclose(true_mm, flange_pose(believed.tolist())[:3, 3] + errors.base_error_mm())
    elsewhere = (60.0, -60.0, 60.0, 0.0, 60.0, 0.0)
    here, there = (errors.true_flange_pose(q, 0)[:3, 3] - flange_pose(q)[:3, 3] for q in (HOME_DEG, elsewhere))
    assert np.linalg.norm(here - there) > 1e-3
