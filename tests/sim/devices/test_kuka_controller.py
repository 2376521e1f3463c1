"""The stand-in for a KUKA controller without a driver: what it makes of corrections, and what it stops for."""

from __future__ import annotations

import re
import select
import socket
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from cells import wait_until

from drivers.kuka.rsi.wire import packet_parser
from sim.devices.kuka_axes import Axes
from sim.devices.kuka_controller import KukaController, Settings
from sim.devices.kuka_corrections import Corrections
from sim.devices.kuka_kinematics import PoseErrors, flange_pose
from sim.world.clock import ClockWriter, SharedClock
from sim.world.reactor import Reactor

HOME_DEG = (0.0, -90.0, 90.0, 0.0, 90.0, 0.0)
CYCLE_NS = 4_000_000
parse = packet_parser("AIPos", "Delay")


class Client(socket.socket):
    """Has to answer the stand-in."""

    answered = b""
    """The IPOC of the packet that was answered last."""

    def newest(self) -> tuple[bytes, Any]:
        """IPOC of the newest packet that was not answered, and where it came from. While the stand-in waits for a
        busy machine it sends a packet again."""
        while True:
            data, address = self.recvfrom(4096)
            while select.select([self], [], [], 0.0)[0]:
                data = self.recv(4096)
            read = parse(data)
            assert read is not None
            if read.ipoc != self.answered:
                self.answered = read.ipoc
                return read.ipoc, address


@contextmanager
def controller_and_client(
    folder: Path, told: list[str] | None = None, **settings: object
) -> Iterator[tuple[KukaController, Client]]:
    """A running stand-in, and the socket of a client that has to answer it; `told` gets its messages."""
    with Client(socket.AF_INET, socket.SOCK_DGRAM) as client:
        client.bind(("127.0.0.1", 0))
        client.settimeout(10.0)
        reactor = Reactor(ClockWriter(folder / "clock", speed=20.0))
        settings |= {"sends_to": f"127.0.0.1:{client.getsockname()[1]}"}
        tell = (told if told is not None else []).append
        controller = KukaController(reactor, Settings.model_validate(settings), tell)
        world = threading.Thread(target=reactor.run)
        world.start()
        try:
            yield controller, client
        finally:
            reactor.stop()
            world.join()
            controller.close()


def in_world(controller: KukaController, action: Callable[[], object]) -> None:
    """Do something on the world's thread, whose timers no other may touch, and wait until it is done."""
    done = threading.Event()

    def act() -> None:
        action()
        done.set()

    controller._reactor.call_threadsafe(act)
    assert done.wait(30.0)


def answer_with(client: Client, correction_a1_deg: float) -> None:
    """Answer the newest packet."""
    ipoc, address = client.newest()
    axes = f'A2="0.0" A1="{correction_a1_deg}" A3="0" A4="0" A5="0" A6="0"'
    client.sendto(b'<Sen Type="ImFree"><AKorr %b/><IPOC>%b</IPOC></Sen>' % (axes.encode(), ipoc), address)


def client_of(client: socket.socket) -> tuple[str, int]:
    """Where the controller's last packet came from."""
    _, address = client.recvfrom(4096, socket.MSG_PEEK)
    found: tuple[str, int] = address
    return found


def answer_until_silent(client: Client, correction_a1_deg: float) -> None:
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


@pytest.mark.parametrize(
    ("answer", "message"),
    [
        ("<AKorr @0@/>", "an answer without IPOC is ignored: <Sen Type"),
        (
            "<AKorr @0@/><IPOC>7</IPOC>",
            "an answer whose IPOC differs from the IPOC of the last packet is ignored: 7",
        ),
        ('<AKorr A1="a"/><IPOC>@</IPOC>', "an answer with a correction that is not a number is ignored"),
        ('<RKorr X="1"/><IPOC>@</IPOC>', "corrections without A1 A2 A3 A4 A5 A6 in AKorr are taken as 0"),
        ("<AKorr @9@/><IPOC>@</IPOC>", "RSI stops: command velocity of A1 exceeded: 9.000 deg"),
        ("<AKorr @999@/><IPOC>@</IPOC>", "a correction is clamped: to [341.0, 0.0"),
        ("another SENTYPE", "an answer whose SENTYPE is not ImFree is ignored"),
    ],
    ids=["ipoc", "old", "number", "element", "speed", "clamp", "sentype"],
)
def test_what_is_refused_is_told_with_its_reason(tmp_path: Path, answer: str, message: str) -> None:
    told: list[str] = []
    patience_s = 2.0  # with a busy machine
    with controller_and_client(tmp_path, told, restart_s=1e6, answer_limit_s=patience_s) as (_, client):
        answer_with(client, 0.0)
        answer_with(client, 0.0)
        ipoc, address = client.newest()
        assert told == []
        sen_type = "Other" if answer == "another SENTYPE" else "ImFree"
        inner = re.sub("@([0-9]+)@", r'A1="\1" A2="0" A3="0" A4="0" A5="0" A6="0"', answer)
        if sen_type == "Other":
            inner = "<IPOC>@</IPOC>"
        sent = f'<Sen Type="{sen_type}">{inner}</Sen>'.encode()
        client.sendto(sent.replace(b"@", ipoc), address)
        wait_until(lambda: told, "a message")
    assert told[0].startswith(f"robot: {message}")


def test_the_same_refusal_is_not_told_in_every_cycle(tmp_path: Path) -> None:
    told: list[str] = []
    with controller_and_client(tmp_path, told, answer_limit_s=0.3) as (_, client):
        for _ in range(50):
            answer_with(client, 0.0)
            client.sendto(b"<Sen/>", client_of(client))
        answer_with(client, 0.0)
    assert sum("without IPOC" in message for message in told) == 1


def test_a_stop_element_ends_the_program_without_a_fault(tmp_path: Path) -> None:
    told: list[str] = []
    patience_s = 2.0  # with a busy machine
    with controller_and_client(tmp_path, told, restart_s=1e6, answer_limit_s=patience_s) as (controller, client):
        for correction_deg in (0.0, 0.0, 0.01):
            answer_with(client, correction_deg)
        ipoc, address = client.newest()
        answer = b'<Sen Type="ImFree"><AKorr A1="0.01" A2="0" A3="0" A4="0" A5="0" A6="0"/><Stop>1</Stop>'
        client.sendto(answer + b"<IPOC>%b</IPOC></Sen>" % ipoc, address)
        client.settimeout(0.3)
        with pytest.raises(TimeoutError):
            client.recv(4096)
        assert controller.ended_programs == 1
        assert controller.fault == ""
        assert told == []


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


# -- axes, without a wire -------------------------------------------------------------------------------------


def axes_at(joints_deg: tuple[float, ...] = HOME_DEG, **settings: object) -> Axes:
    return Axes(Settings.model_validate({"start_joints_deg": joints_deg, **settings}), 0)


def turn_a1(axes: Axes, steps_deg: list[float]) -> str:
    """Turn axis 1 by one step after the other; the first fault."""
    for number, step_deg in enumerate(steps_deg):
        a1_deg = axes.commanded_deg[0] + step_deg
        if fault := axes.follow((a1_deg, *axes.commanded_deg[1:]), number * CYCLE_NS):
            return fault
    return ""


def test_a_path_through_the_wrists_singularity_asks_for_too_much_speed() -> None:
    start_deg = (0.0, -90.0, 90.0, 10.0, 8.0, 0.0)
    axes = axes_at(start_deg)
    corrections = Corrections(Settings(corrects="pose"))
    corrections.begin(start_deg)
    fault = ""
    for number in range(200):
        target_deg, fault = corrections.take((0.0, 0.0, 0.0, 0.0, -0.1 * number, 0.0))
        if fault := fault or axes.follow(target_deg, number * CYCLE_NS):
            break
    assert "velocity of A4" in fault or "velocity of A6" in fault


@pytest.mark.parametrize(
    ("limit", "steps_deg"),
    [("acceleration_limit_deg_s2", [0.004, 0.02]), ("jerk_limit_deg_s3", [0.0001, 0.0101])],
)
def test_beyond_a_limit_of_acceleration_or_jerk_rsi_stops_or_the_axis_falls_behind(
    limit: str, steps_deg: list[float]
) -> None:
    assert turn_a1(axes_at(), steps_deg) == ""
    assert limit.split("_", maxsplit=1)[0] in turn_a1(axes_at(**{limit: 300.0}), steps_deg)
    slow = axes_at(**{limit: 300.0, "on_excess": "clamp"})
    assert turn_a1(slow, steps_deg) == ""
    assert 0.0 < slow.commanded_deg[0] < sum(steps_deg)


@pytest.mark.parametrize(
    "workspace",
    [
        {"kind": "box", "min_mm": (-2000, 20, -2000), "max_mm": (2000, 2000, 2000), "stops": "inside"},
        {"kind": "box", "min_mm": (-2000, -2000, -2000), "max_mm": (2000, 20, 2000), "stops": "outside"},
        {"kind": "sphere", "centre_mm": (540, 0, 915), "radius_mm": 20, "stops": "outside"},
        {"kind": "sphere", "centre_mm": (540, 120, 915), "radius_mm": 100, "stops": "inside"},
    ],
)
def test_a_workspace_stops_the_arm_where_the_flange_comes_in_or_out(workspace: dict[str, object]) -> None:
    axes = axes_at(workspaces=(workspace,))
    assert "workspace 1 violated" in turn_a1(axes, [-0.5] * 10)
    assert abs(abs(flange_pose(axes.commanded_deg)[1, 3]) - 20.0) < 6.0
    assert turn_a1(axes_at(workspaces=(workspace,)), [-0.5] * 3) == ""


def test_after_a_stop_the_arm_swings_and_then_stands() -> None:
    axes = axes_at(vibration_deg=0.1, vibration_hz=10.0, vibration_decay_s=0.1)
    turn_a1(axes, [0.5, 0.5, 0.0])
    stopped_ns = 2 * CYCLE_NS
    assert axes.settled_since_ns(stopped_ns) is None
    quarter_period_ns = stopped_ns + 25_000_000
    away_deg = np.subtract(axes.measured_deg(quarter_period_ns), axes.commanded_deg)
    assert away_deg[0] == pytest.approx(0.1 * np.exp(-0.25))
    assert np.all(away_deg[1:] == 0.0)
    later_ns = stopped_ns + 2_000_000_000
    assert axes.measured_deg(later_ns) == axes.commanded_deg
    assert axes.settled_since_ns(later_ns) is not None
    assert axes.stops == 1


# -- the rest of its life -------------------------------------------------------------------------------------


def test_after_an_emergency_stop_the_brakes_hold_the_arm_whatever_corrections_come(tmp_path: Path) -> None:
    with controller_and_client(tmp_path, packets_after_estop_s=0.2) as (controller, client):
        for correction_deg in (0.0, 0.05, 0.1):
            answer_with(client, correction_deg)
        assert not controller.brakes_closed
        controller.estop()
        answer_until_silent(client, 5.0)
        assert controller.brakes_closed
        held_deg = controller.joints_deg
        assert held_deg[0] < 0.3
        controller.reset()
        assert not controller.brakes_closed
        assert controller.joints_deg == held_deg


def test_a_nudge_for_a_while_springs_back(tmp_path: Path) -> None:
    with controller_and_client(tmp_path, answer_limit_s=0.2) as (controller, client):
        answer_with(client, 0.0)
        answer_with(client, 0.0)
        pushed, true_mm = [], []

        def push() -> None:
            controller.nudge([0.5] * 6, 0.02)
            pushed.append(round(controller.joints_deg[0], 6))
            true_mm.append(controller.true_base_from_flange()[:3, 3])

        in_world(controller, push)
        assert np.linalg.norm(true_mm[0] - flange_pose(HOME_DEG)[:3, 3]) > 1.0
        for _ in range(10):
            answer_with(client, 0.0)
            pushed.append(round(controller.joints_deg[0], 6))
        assert sorted(set(pushed)) == [0.0, 0.5]
        assert pushed[-1] == 0.0


def test_an_answer_of_another_sentype_is_none(tmp_path: Path) -> None:
    with controller_and_client(tmp_path, sen_type="Dome", restart_s=1e6, answer_limit_s=0.1) as (
        controller,
        client,
    ):
        answer_with(client, 0.0)
        answer_with(client, 5.0)
        assert controller.joints_deg == HOME_DEG


def test_consecutive_counting_forgets_late_answers_after_one_in_time(tmp_path: Path) -> None:
    settings = {"delay_limit": 5, "delay_counts": "consecutive", "answer_limit_s": 0.2}
    with controller_and_client(tmp_path, **settings) as (controller, client):
        answer_with(client, 0.0)
        for _ in range(3):
            controller.late(4)
            for _ in range(6):
                answer_with(client, 0.0)
        assert controller.fault == ""
        assert controller.delay == 0
