"""Our RSI driver against a controller that knows nothing of ours: settings of its own, packets that nobody sent.

The controller waits for each answer (`lock_step`), so that a busy machine makes no answer late, but its cycle is
never shorter than it says.
"""

from __future__ import annotations

import itertools
import socket
import subprocess
import sys
import threading
from collections.abc import Callable, Iterator
from contextlib import closing, contextmanager
from functools import partial
from typing import Any

import numpy as np
import pytest
from arms import KR10_R1100_SIXX
from bare_rsi_controller import BareRsiController, packet_of
from beside import beside
from cells import wait_until

from coupole.clock import SystemClock
from coupole.errors import DeviceFault, DeviceLost, DeviceTimeout
from drivers.kuka.rsi.driver import KukaRsi, Settings

HOME_DEG = np.array([0.0, -90.0, 90.0, 0.0, 90.0, 0.0])
THERE_DEG = HOME_DEG + np.array([8.0, 4.0, -6.0, 5.0, -7.0, 9.0])
ABSURD_DELAYS = (str(2**64), str(2**63), str(2**31), "9" * 400, "-1", "1e9", "nan", "")


@pytest.fixture
def port() -> int:
    """A port that is free now."""
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe:
        probe.bind(("127.0.0.1", 0))
        found: int = probe.getsockname()[1]
        return found


def settings_for(port: int, **settings: Any) -> Settings:
    ours = {"arm_model": KR10_R1100_SIXX, "listen": f"127.0.0.1:{port}", "speed_fraction": 0.3, "dwell_s": 0.0}
    ours["attention_s"] = 0.5  # a test's own thread may wait for its turn
    ours["unaccounted_s"] = 0.0  # this controller's time stands still while it waits for an answer
    return Settings.model_validate(ours | settings)


@contextmanager
def opened(port: int, settings: dict[str, Any], **controller: Any) -> Iterator[tuple[KukaRsi, BareRsiController]]:
    """A driver, and the controller that was started before it was ready."""
    with (
        BareRsiController(("127.0.0.1", port), **controller) as arm,
        closing(KukaRsi(settings_for(port, **settings), SystemClock())) as robot,
    ):
        yield robot, arm


def assert_within_limits_of_speed(robot: KukaRsi, arm: BareRsiController) -> None:
    """What the controller commanded to its axes, by its own clock."""
    assert np.all(arm.peak_speed_deg_s <= 1.001 * np.array(robot.arm.velocity_deg_s) + 2e-6 / arm.cycle_s)


def assert_within_limits(robot: KukaRsi, arm: BareRsiController) -> None:
    """The same, and its acceleration; four cycles of rounding to six decimals."""
    cycle_s = arm.cycle_s
    assert_within_limits_of_speed(robot, arm)
    assert np.all(
        arm.peak_acceleration_deg_s2 <= 1.001 * np.array(robot.arm.acceleration_deg_s2) + 4e-6 / cycle_s**2
    )


@pytest.mark.parametrize(
    ("ours", "theirs"),
    [
        ({"cycle_ms": 12}, {"cycle_s": 0.004, "ipoc_step": 4}),
        ({"cycle_ms": 12}, {"cycle_s": 0.004, "ipoc_step": 12}),
        ({"cycle_ms": 12}, {"cycle_s": 0.004, "ipoc_step": 1}),
        ({"cycle_ms": 4}, {"cycle_s": 0.012, "ipoc_step": 1}),
        ({"cycle_ms": 4}, {"cycle_s": 0.004, "ipoc_step": 12}),
        ({"cycle_ms": 12, "declared_cycle_ms": 12}, {"cycle_s": 0.004, "ipoc_step": 1}),
    ],
    ids=["faster", "its-ipoc-lies", "its-ipoc-says-nothing", "slower", "ipoc-alone", "not-simulated"],
)
def test_a_controller_with_another_cycle_is_refused_before_anything_moves(
    port: int, ours: dict[str, Any], theirs: dict[str, Any]
) -> None:
    with BareRsiController(("127.0.0.1", port), **theirs) as arm:
        with pytest.raises(DeviceFault, match="its packets come every") as raised:
            KukaRsi(settings_for(port, **ours), SystemClock())
        assert f"`cycle_ms` is {ours['cycle_ms']}" in raised.value.happened
        assert f"its IPOC counts {theirs['ipoc_step']} a packet" in raised.value.happened
        assert "Set `cycle_ms`" in raised.value.remedy
        assert arm.answers > 100
        assert not arm.peak_speed_deg_s.any()


@pytest.mark.parametrize(
    ("ours", "theirs"),
    [
        ({"cycle_ms": 4}, {"cycle_s": 0.004, "ipoc_step": 1}),
        ({"cycle_ms": 12, "mode": "relative"}, {"cycle_s": 0.012, "ipoc_step": 12, "absolute": False}),
    ],
    ids=["absolute", "relative"],
)
def test_it_moves_within_its_limits_though_packets_come_late_twice_and_from_the_past(
    port: int, ours: dict[str, Any], theirs: dict[str, Any]
) -> None:
    with opened(port, ours, **theirs) as (robot, arm):
        for target_deg in (THERE_DEG, HOME_DEG):
            robot.move_to(target_deg)
            begun = arm.cycles
            wait_until(lambda begun=begun: arm.cycles > begun + 20, "an arm under way")
            arm.double_next(3)
            arm.hold_back_next(0.03)
            for age in (1, 2, 30, 90):
                arm.repeat_old(age)
            assert np.allclose(robot.wait_settled().joints_deg, target_deg, atol=1e-3)
            for age in (1, 30, 90):
                arm.repeat_old(age)
        assert robot.statistics()["cycle_ms"] > 0.85 * 1e3 * arm.cycle_s
        assert robot.statistics()["astray_packets"] >= 4
        assert np.allclose(arm.commanded_deg, HOME_DEG, atol=1e-4)
        assert_within_limits(robot, arm)


def test_one_old_packet_at_rest_does_not_give_the_session_another_start(port: int) -> None:
    with opened(port, {}) as (robot, arm):
        robot.move_to(THERE_DEG)
        robot.wait_settled()
        arm.send_once(packet_of(HOME_DEG, 0, arm.first_ipoc + 4))
        wait_until(lambda: robot.statistics()["astray_packets"] == 1, "the old packet")
        robot.move_to(THERE_DEG + 3.0)
        assert np.allclose(robot.wait_settled().joints_deg, THERE_DEG + 3.0, atol=1e-3)
        assert_within_limits(robot, arm)


def test_absurd_delay_counters_are_no_packets_and_end_no_process(port: int) -> None:
    with opened(port, {"link_timeout_s": 5.0}) as (robot, arm):
        robot.move_to(THERE_DEG)
        for delay in ABSURD_DELAYS:
            arm.send_once(packet_of(HOME_DEG, delay, arm.first_ipoc + 10**6))
        assert np.allclose(robot.wait_settled().joints_deg, THERE_DEG, atol=1e-3)
        assert robot.statistics()["malformed_packets"] == len(ABSURD_DELAYS)
        assert_within_limits(robot, arm)


@contextmanager
def stranger(
    port: int, on_answer: Callable[[], None], on_many: Callable[[], None] = lambda: None
) -> Iterator[None]:
    """Somebody at another address whose packets look right; `on_answer` is called once one is answered, `on_many`
    when many have been sent without an answer."""

    def speak(link: socket.socket, over: threading.Event) -> None:
        unanswered = 0
        for ipoc in itertools.count(5000, 4):
            try:
                link.send(packet_of(HOME_DEG, 0, ipoc))
                link.recv(4096)
            except ConnectionRefusedError:  # the port is not bound yet
                pass
            except TimeoutError:
                unanswered += 1
            else:
                on_answer()
                return
            if unanswered == 40:
                on_many()
            if over.wait(0.01):
                return

    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as link:
        link.bind(("127.0.0.3", 0))
        link.connect(("127.0.0.1", port))
        link.settimeout(0.02)
        with beside(partial(speak, link)):
            yield


def test_one_packet_of_a_stranger_that_came_first_is_named_when_opening_fails(port: int) -> None:
    with BareRsiController(("127.0.0.1", port), host="127.0.0.2") as arm:
        arm.fall_silent()
        with stranger(port, arm.speak_again), pytest.raises(DeviceTimeout) as raised:
            KukaRsi(settings_for(port, connect_timeout_s=2.0, link_timeout_s=20.0), SystemClock())
        assert f"the last of {':'.join(map(str, arm.address))}" in raised.value.happened
        assert "the driver listens to 127.0.0.3:" in raised.value.happened
        assert "set `controller`" in raised.value.remedy


def test_a_controller_named_in_the_rig_is_the_only_one_that_is_answered(port: int) -> None:
    answered: list[bool] = []
    with BareRsiController(("127.0.0.1", port), host="127.0.0.2") as arm:
        arm.fall_silent()
        with (
            stranger(port, lambda: answered.append(True), arm.speak_again),
            closing(KukaRsi(settings_for(port, controller="127.0.0.2"), SystemClock())) as robot,
        ):
            robot.move_to(THERE_DEG)
            assert np.allclose(robot.wait_settled().joints_deg, THERE_DEG, atol=1e-3)
            assert robot.statistics()["foreign_packets"] > 10
        assert answered == []
        assert_within_limits(robot, arm)


@pytest.mark.parametrize("knows_the_element", [True, False])
def test_closing_ends_the_controllers_program_and_says_whether_it_did(port: int, knows_the_element: bool) -> None:
    with opened(port, {}, stop_tag="Stop" if knows_the_element else None) as (robot, arm):
        robot.move_to(THERE_DEG)
        begun = arm.cycles
        wait_until(lambda: arm.cycles > begun + 20, "an arm under way")
        robot.close()
        assert arm.ended_by_stop == knows_the_element
        assert robot.statistics()["program_ended"] == knows_the_element
        assert arm.history[-1].answered
        assert_within_limits(robot, arm)


def test_a_lost_link_is_no_ended_program(port: int) -> None:
    with opened(port, {"link_timeout_s": 0.3}, stop_tag="Stop") as (robot, arm):
        arm.fall_silent()
        wait_until(lambda: "no packet for" in robot.measured().fault, "the lost link")
        robot.close()
        assert not arm.ended_by_stop
        assert robot.statistics()["program_ended"] == 0


_PARENT = """
import sys, time, numpy
from coupole.clock import SystemClock
from drivers.kuka.rsi.driver import KukaRsi, Settings

robot = KukaRsi(Settings.model_validate_json(sys.argv[1]), SystemClock())
robot.move_to(numpy.array([0.0, -90.0, 90.0, 0.0, 90.0, 300.0]))
print(robot._process.pid, flush=True)
for _ in range(3000): robot.measured(); time.sleep(0.02)
"""


def test_an_orphaned_loop_brakes_for_as_long_as_the_limits_demand(port: int) -> None:
    """From 147 deg/s it takes 1.5 s, twice as long as a second's patience with an orphan would allow."""
    settings = settings_for(port, cycle_ms=12, acceleration_deg_s2=100.0, jerk_deg_s3=3000.0)
    arguments = [sys.executable, "-c", _PARENT, settings.model_dump_json()]
    with (
        BareRsiController(("127.0.0.1", port), cycle_s=0.012, ipoc_step=12, stop_tag="Stop") as arm,
        subprocess.Popen(arguments, stdout=subprocess.PIPE) as parent,
    ):
        assert parent.stdout is not None
        parent.stdout.readline()
        wait_until(lambda: arm.peak_speed_deg_s[5] > 145.0, "axis 6 at its full speed")
        parent.kill()
        wait_until(lambda: arm.ended_by_stop, "the end of the program")
        speeds_deg_s = np.abs(arm.speeds_deg_s[:, 5])
        assert speeds_deg_s[-1] == 0.0
        assert np.abs(np.diff(speeds_deg_s)).max() <= 1.001 * 100.0 * 0.012 + 4e-6 / 0.012
        assert arm.commanded_deg[5] < 290.0


@pytest.mark.parametrize("at_rest", [False, True])
def test_rsi_restarted_in_a_tenth_of_a_second_with_a_continuing_ipoc_is_not_led_on(
    port: int, at_rest: bool
) -> None:
    """The old corrections, counted from where the arm is now, would be a step of as much as it has moved."""
    with opened(port, {}, lock_step_patience_s=0.05) as (robot, arm):
        robot.move_to(THERE_DEG)
        if at_rest:
            robot.wait_settled()
        else:
            wait_until(lambda: robot.measured().joints_deg[0] > 2.0, "an arm under way")
        arm.restart_rsi(silent_cycles=20)
        wait_until(lambda: "RSI was started anew" in robot.measured().fault, "the fault")
        with pytest.raises(DeviceLost, match="20 cycles passed without an answer"):
            robot.move_to(HOME_DEG)
        assert_within_limits_of_speed(robot, arm)


def test_a_restarted_program_is_a_fault_that_only_a_new_driver_leaves_behind(port: int) -> None:
    with opened(port, {}, lock_step_patience_s=0.05) as (robot, arm):
        robot.move_to(THERE_DEG)
        begun = arm.cycles
        wait_until(lambda: arm.cycles > begun + 20, "an arm under way")
        arm.at_next_cycle(lambda: setattr(arm, "ipoc", 1000))
        with pytest.raises(DeviceLost, match="RSI was restarted"):
            robot.wait_settled()
        answers = arm.answers
        with pytest.raises(DeviceLost, match="RSI was restarted"):
            robot.move_to(HOME_DEG)
        assert arm.answers == answers
