"""The contract of robots as one class, which tests each driver against a simulated controller at the other end of
its wire."""

from __future__ import annotations

import re
import threading
import time
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from typing import ClassVar, Protocol

import numpy as np
import pytest
from numpy.typing import NDArray

from coupole.clock import Clock
from coupole.devices import Robot
from coupole.errors import ArmUnattended, DeviceFault, DeviceLost, DeviceRefused
from coupole.kinematics import Arm, forward
from coupole.plan.arm_description import shipped_arm

HOME_DEG = np.array([0.0, -90.0, 90.0, 0.0, 90.0, 0.0])
AWAY_DEG = np.array([50.0, -50.0, 40.0, 30.0, 60.0, -70.0])
UNHURRIED_S = 0.5
"""A motion ends if nobody looks at the arm for this time, s. It is long because a test's thread may have to wait
on a busy machine."""


class RobotCell(Protocol):
    """An arm as it is seen from outside: the other end of the driver's wire, and the true angles of the axes.

    `sim.world.robot_alone.RobotAlone` implements this for a stand-in on the event loop of the simulated cell.
    """

    @property
    def clock(self) -> Clock:
        """The clock of both driver and controller."""

    @property
    def cycle_ms(self) -> float:
        """Time between the samples of `trace_deg`, ms of `clock`."""

    @property
    def trace_deg(self) -> list[tuple[float, ...]]:
        """Angles of the axes, sampled since the cell began or since the list was cleared."""

    @property
    def velocity_deg_s(self) -> NDArray[np.float64]:
        """[6] greatest speeds of motions by the driver."""

    @property
    def is_moving(self) -> bool:
        """True while the arm moves."""

    @property
    def repeatability_mm(self) -> float:
        """Standard deviation of the arm's position at rest, mm."""

    def open(self) -> Robot:
        """Open a driver; it is closed with the cell."""

    def in_world(self, action: Callable[[], object]) -> None:
        """Perform an action while the controller waits; return when it is done."""

    def joints_deg(self) -> NDArray[np.float64]:
        """[6] true angles of the axes."""

    def true_base_from_flange(self) -> NDArray[np.float64]:
        """[4, 4] true pose of the flange, mm."""

    def emergency_stop(self) -> None:
        """Press the emergency stop."""

    def reset(self) -> None:
        """Release the emergency stop, and switch the drives on."""

    def lose_link(self, seconds: float) -> None:
        """Lose all packets for this time."""

    def push_aside(self, turns_deg: tuple[float, ...]) -> None:
        """Turn the axes by these angles without a command."""

    def wait_until(self, condition: Callable[[], bool]) -> None:
        """Wait for a condition of the world, and look at the arm meanwhile, as every caller that moves the arm
        must."""

    def wait_until_under_way(self) -> None:
        """Wait until a motion from home is well under way."""

    def stop_under_way(self, robot: Robot) -> None:
        """Stop a motion from home while it is under way."""

    def assert_smooth(self) -> None:
        """Assert that speed, acceleration and jerk of all samples are within the driver's limits."""

    def assert_stands(self) -> None:
        """Assert that the arm does not move for half a second."""


class RobotConformance:
    """The contract `coupole.devices.Robot`.

    A subclass gives the fixture `cell`, a `RobotCell`: the controller that the driver talks to. All angles below
    are for a KR 10 R1100 sixx; for another arm, a subclass overrides them.
    """

    home_deg: ClassVar[NDArray[np.float64]] = HOME_DEG
    """[6] angles at the beginning of each test."""
    away_deg: ClassVar[NDArray[np.float64]] = AWAY_DEG
    """[6] angles far from `home_deg`: each axis differs by at least 20 degrees."""
    beyond_deg: ClassVar[NDArray[np.float64]] = np.array([0.0, -90.0, 90.0, 0.0, 121.0, 0.0])
    """[6] angles with one axis out of its range."""
    attention_s: ClassVar[float] = UNHURRIED_S
    """A motion of this cell's driver ends if nobody looks at the arm for this time, s."""
    is_simulated: ClassVar[bool] = True
    """Expected value of `Identity.simulated`."""
    poses: ClassVar[int] = 8
    """Number of poses that the arm is sent to."""
    stops: ClassVar[int] = 4
    """Number of motions that are stopped at random times."""
    words_of_a_fault: ClassVar[str] = "."
    """Pattern of the message when the arm does not follow its command."""
    words_of_another_command: ClassVar[str] = "expected"
    """Pattern of the refusal of a call after another thread's call has ended its motion."""
    words_of_an_axis: ClassVar[str] = "121"
    """Pattern of the refusal of `beyond_deg`; it names the angle."""

    def arm(self) -> Arm:
        """Return the arm that moves, with its limits."""
        return shipped_arm("kr10_r1100_sixx").arm

    def range_deg(self, cell: RobotCell) -> NDArray[np.float64]:
        """Return the lowest and highest angles [6, 2] from which tests draw targets."""
        return 0.6 * np.array(self.arm().limits_deg)

    def targets_deg(self, cell: RobotCell, count: int, seed: int) -> NDArray[np.float64]:
        """Return random joint angles [count, 6]."""
        low, high = self.range_deg(cell).T
        return np.random.default_rng(seed).uniform(low, high, (count, 6))

    @pytest.fixture
    def robot(self, cell: RobotCell) -> Robot:
        """An opened driver of the cell's arm."""
        return cell.open()

    def test_opening_moves_nothing(self, cell: RobotCell, robot: Robot) -> None:
        cell.clock.sleep(0.2)
        assert robot.measured().fault == ""
        assert not robot.measured().moving
        assert set(cell.trace_deg) == {tuple(self.home_deg)}

    def test_it_says_who_it_is_and_whether_it_is_simulated(self, cell: RobotCell, robot: Robot) -> None:
        identity = robot.identify()
        assert identity.vendor
        assert identity.model
        assert identity.simulated is self.is_simulated
        assert robot.self_test()

    def test_it_reaches_poses_and_measures_them_right(self, cell: RobotCell, robot: Robot) -> None:
        for target_deg in self.targets_deg(cell, self.poses, seed=5):
            wanted_base_from_flange = forward(self.arm(), target_deg)
            robot.move_to(target_deg)
            state = robot.wait_settled()
            assert not state.moving
            assert np.allclose(state.joints_deg, target_deg, atol=5e-3)
            assert np.allclose(state.base_from_flange, wanted_base_from_flange, atol=0.2)
            settled_mm = np.abs(state.base_from_flange[:3, 3] - wanted_base_from_flange[:3, 3])
            off_mm = np.abs(cell.true_base_from_flange()[:3, 3] - wanted_base_from_flange[:3, 3])
            # measured angles are rounded to 1e-4 deg, about 2 um at the flange
            assert np.all(off_mm <= 5.0 * cell.repeatability_mm + settled_mm + 0.01)

    def test_motion_is_jerk_limited(self, cell: RobotCell, robot: Robot) -> None:
        robot.move_to(self.away_deg)
        robot.wait_settled()
        cell.assert_smooth()

    def test_at_a_share_of_its_speeds_no_axis_is_faster(self, cell: RobotCell, robot: Robot) -> None:
        robot.move_to(self.away_deg, 0.25)
        assert np.allclose(robot.wait_settled().joints_deg, self.away_deg, atol=1e-3)
        speeds_deg_s = np.abs(np.diff(cell.trace_deg, axis=0)).max(axis=0) / (cell.cycle_ms / 1e3)
        assert 0.15 < (speeds_deg_s / cell.velocity_deg_s).max() < 0.26
        for share in (0.0, 1.1, float("nan")):
            with pytest.raises(DeviceRefused, match="expected"):
                robot.move_to(self.home_deg, share)
        cell.assert_stands()

    def test_a_new_target_in_mid_motion_is_reached_smoothly(self, cell: RobotCell, robot: Robot) -> None:
        robot.move_to(self.away_deg)
        cell.wait_until_under_way()
        robot.move_to(self.home_deg)
        assert np.allclose(robot.wait_settled().joints_deg, self.home_deg, atol=1e-3)
        cell.assert_smooth()

    def test_stop_in_mid_motion_brings_it_to_rest_smoothly(self, cell: RobotCell, robot: Robot) -> None:
        robot.move_to(self.away_deg)
        cell.stop_under_way(robot)
        assert not robot.measured().moving
        cell.assert_stands()
        assert np.max(np.abs(cell.joints_deg() - self.away_deg)) > 1.0
        cell.assert_smooth()

    def test_after_stop_no_axis_turns_farther_than_it_says(self, cell: RobotCell, robot: Robot) -> None:
        random = np.random.default_rng(11)
        allowed_deg = robot.stopping_deg()
        assert allowed_deg.shape == (6,)
        for target_deg in self.targets_deg(cell, self.stops, seed=11):
            robot.move_to(target_deg)
            cell.clock.sleep(random.uniform(0.05, 0.9))
            called_deg = _stop_while_the_world_waits(cell, robot)
            assert np.all(np.abs(cell.joints_deg() - called_deg) <= allowed_deg + 1e-3)

    def test_a_stop_forgets_the_next_target_too(self, cell: RobotCell, robot: Robot) -> None:
        """A target given in motion is begun when the arm is at rest. The rest after a stop must not begin it."""
        robot.move_to(self.away_deg)
        cell.wait_until_under_way()
        robot.move_to(self.home_deg - 20.0)
        cell.clock.sleep(0.05)  # now the target is waiting when the stop comes
        robot.stop()
        stood_deg = cell.joints_deg()
        cell.assert_stands()
        cell.clock.sleep(1.0)
        assert np.abs(cell.joints_deg() - stood_deg).max() < 1e-3
        assert np.abs(stood_deg - (self.home_deg - 20.0)).max() > 5.0
        cell.assert_smooth()

    def test_stops_of_other_threads_end_a_wait_in_progress(self, cell: RobotCell, robot: Robot) -> None:
        robot.move_to(self.away_deg)
        with ThreadPoolExecutor(4) as threads:
            wait = threads.submit(robot.wait_settled)
            cell.wait_until_under_way()
            for stop in [threads.submit(robot.stop) for _ in range(3)]:
                stop.result(30.0)
            with pytest.raises(DeviceRefused, match=self.words_of_another_command):
                wait.result(30.0)
        assert not robot.measured().moving
        cell.assert_stands()
        assert np.max(np.abs(cell.joints_deg() - self.away_deg)) > 1.0
        cell.assert_smooth()

    def test_it_moves_again_after_a_stop(self, cell: RobotCell, robot: Robot) -> None:
        robot.move_to(self.away_deg)
        cell.wait_until_under_way()
        robot.stop()
        robot.move_to(self.home_deg)
        assert np.allclose(robot.wait_settled().joints_deg, self.home_deg, atol=1e-3)

    def test_a_motion_that_nobody_watches_brakes_on_its_path_and_another_may_follow(
        self, cell: RobotCell, robot: Robot
    ) -> None:
        """Looks at the arm from another thread do not count as watching the motion."""
        robot.move_to(self.away_deg, 0.05)
        cell.wait_until_under_way()
        with ThreadPoolExecutor(1) as thread:
            give_up = time.monotonic() + 30.0
            while cell.is_moving:
                thread.submit(robot.measured).result()
                assert time.monotonic() < give_up, "the arm moves on although nobody watches it"
                time.sleep(0.02)
        stood_deg = cell.joints_deg()
        assert np.abs(stood_deg - self.away_deg).max() > 1.0, "the arm arrived before it was stopped"
        way = (stood_deg - self.home_deg) / (self.away_deg - self.home_deg)
        assert np.ptp(way) < 0.01, "it left its line"
        with pytest.raises(ArmUnattended):
            robot.wait_settled()
        # A look directly after a beat passes no beat on, so the time without attention may exceed the time between
        # looks.
        assert robot.measured().unattended_s > 0.8 * self.attention_s
        assert not robot.measured().fault
        cell.assert_smooth()
        robot.move_to(self.home_deg)
        assert np.allclose(robot.wait_settled().joints_deg, self.home_deg, atol=1e-3)
        assert robot.measured().unattended_s == 0.0

    def test_closing_in_mid_motion_brings_it_to_rest_smoothly(self, cell: RobotCell, robot: Robot) -> None:
        robot.move_to(self.away_deg)
        cell.wait_until_under_way()
        robot.close()
        cell.assert_stands()
        cell.assert_smooth()

    def test_a_target_out_of_limits_is_refused_by_the_name_of_its_axis(
        self, cell: RobotCell, robot: Robot
    ) -> None:
        with pytest.raises(DeviceRefused, match=self.words_of_an_axis):
            robot.move_to(self.beyond_deg)
        cell.assert_stands()

    def test_an_emergency_stop_is_a_fault_that_only_a_new_driver_leaves_behind(
        self, cell: RobotCell, robot: Robot
    ) -> None:
        robot.move_to(self.away_deg)
        cell.wait_until_under_way()
        cell.emergency_stop()
        with pytest.raises(DeviceFault, match=self.words_of_a_fault):
            robot.wait_settled()
        cell.assert_stands()
        cell.reset()
        with pytest.raises(DeviceFault, match=self.words_of_a_fault):
            robot.move_to(self.home_deg)
        assert re.search(self.words_of_a_fault, robot.measured().fault)
        cell.assert_stands()
        robot.close()
        again = cell.open()
        again.move_to(self.home_deg)
        assert np.allclose(again.wait_settled().joints_deg, self.home_deg, atol=1e-3)

    def test_a_lost_link_ends_all_motion(self, cell: RobotCell, robot: Robot) -> None:
        robot.move_to(self.away_deg)
        cell.wait_until_under_way()
        cell.lose_link(1.0)
        with pytest.raises(DeviceLost):
            robot.wait_settled()
        with pytest.raises(DeviceLost):
            robot.move_to(self.home_deg)
        robot.stop()
        cell.assert_stands()

    def test_a_driver_opened_after_a_lost_link_starts_where_the_arm_stands(
        self, cell: RobotCell, robot: Robot
    ) -> None:
        robot.move_to(self.away_deg)
        cell.wait_until_under_way()
        cell.lose_link(1.0)
        with pytest.raises(DeviceLost):
            robot.wait_settled()
        cell.wait_until(lambda: not cell.is_moving)
        robot.close()
        cell.trace_deg.clear()
        again = cell.open()
        again.move_to(self.away_deg)
        assert np.allclose(again.wait_settled().joints_deg, self.away_deg, atol=1e-3)
        cell.assert_smooth()

    def test_an_arm_pushed_aside_is_a_fault(self, cell: RobotCell, robot: Robot) -> None:
        cell.push_aside((0.0, 2.0, 0.0, 0.0, 0.0, 0.0))
        with pytest.raises(DeviceFault, match=self.words_of_a_fault):
            robot.wait_settled()


def _stop_while_the_world_waits(cell: RobotCell, robot: Robot) -> NDArray[np.float64]:
    """Call `stop`; return the axes [6] at that moment. The world stands still until the command has been sent."""
    called_deg: list[NDArray[np.float64]] = []
    stopper = threading.Thread(target=robot.stop)

    def call() -> None:
        called_deg.append(cell.joints_deg())
        stopper.start()
        time.sleep(0.1)

    cell.in_world(call)
    stopper.join()
    return called_deg[0]
