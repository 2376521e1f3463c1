"""What every Robot must do: one class, run on each driver against the other end of its wire."""

from __future__ import annotations

import sys
import threading
import time
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from typing import Any

import numpy as np
import pytest
from arms import KR10_R1100_SIXX
from numpy.typing import NDArray
from robot_cells import AWAY_DEG, HOME_DEG, UNHURRIED_S, RobotCell

from coupole.devices import Robot
from coupole.errors import ArmUnattended, DeviceFault, DeviceLost, DeviceRefused
from coupole.kinematics import forward


class RobotConformance:
    """Any driver passes that satisfies `coupole.devices.Robot`; `cell` is the arm it talks to."""

    def range_deg(self, cell: RobotCell) -> NDArray[np.float64]:
        """Lowest and highest angles [6, 2] that tests draw targets from."""
        return 0.6 * np.array(KR10_R1100_SIXX.limits_deg)

    def targets_deg(self, cell: RobotCell, count: int, seed: int) -> NDArray[np.float64]:
        """Random joint angles [count, 6]."""
        low, high = self.range_deg(cell).T
        return np.random.default_rng(seed).uniform(low, high, (count, 6))

    @pytest.fixture
    def robot(self, cell: RobotCell) -> Robot:
        return cell.open()

    def test_opening_moves_nothing(self, cell: RobotCell, robot: Robot) -> None:
        cell.clock.sleep(0.2)
        assert robot.measured().fault == ""
        assert not robot.measured().moving
        assert set(cell.trace_deg) == {tuple(HOME_DEG)}

    def test_it_says_who_it_is_and_that_it_is_simulated(self, cell: RobotCell, robot: Robot) -> None:
        assert robot.identify().model == "KR10 R1100 sixx"
        assert robot.identify().simulated
        assert robot.self_test()

    @pytest.mark.timeout(1800)
    def test_it_reaches_poses_and_measures_them_right(
        self, cell: RobotCell, robot: Robot, scale: Callable[[int, int], int]
    ) -> None:
        errors = cell.controller.errors
        for target_deg in self.targets_deg(cell, scale(8, 200), seed=5):
            wanted = forward(KR10_R1100_SIXX, target_deg)
            robot.move_to(target_deg)
            state = robot.wait_settled()
            assert not state.moving
            assert np.allclose(state.joints_deg, target_deg, atol=5e-3)
            assert np.allclose(state.base_from_flange, wanted, atol=0.2)
            settled_mm = np.abs(state.base_from_flange[:3, 3] - wanted[:3, 3])
            off_mm = np.abs(cell.controller.true_base_from_flange()[:3, 3] - wanted[:3, 3])
            # what is measured is rounded to 1e-4 deg, some 2 um at the flange
            assert np.all(off_mm <= 5.0 * errors.repeatability_um / 1e3 + settled_mm + 0.01)

    def test_motion_is_jerk_limited(self, cell: RobotCell, robot: Robot) -> None:
        robot.move_to(AWAY_DEG)
        robot.wait_settled()
        cell.assert_smooth()

    def test_at_a_share_of_its_speeds_no_axis_is_faster(self, cell: RobotCell, robot: Robot) -> None:
        robot.move_to(AWAY_DEG, 0.25)
        assert np.allclose(robot.wait_settled().joints_deg, AWAY_DEG, atol=1e-3)
        speeds_deg_s = np.abs(np.diff(cell.trace_deg, axis=0)).max(axis=0) / (cell.cycle_ms / 1e3)
        assert 0.15 < (speeds_deg_s / cell.velocity_deg_s).max() < 0.26
        for share in (0.0, 1.1, float("nan")):
            with pytest.raises(DeviceRefused, match="a speed above 0"):
                robot.move_to(HOME_DEG, share)
        cell.assert_stands()

    def test_a_new_target_in_mid_motion_is_reached_smoothly(self, cell: RobotCell, robot: Robot) -> None:
        robot.move_to(AWAY_DEG)
        cell.wait_until_under_way()
        robot.move_to(HOME_DEG)
        assert np.allclose(robot.wait_settled().joints_deg, HOME_DEG, atol=1e-3)
        cell.assert_smooth()

    def test_stop_in_mid_motion_brings_it_to_rest_smoothly(self, cell: RobotCell, robot: Robot) -> None:
        robot.move_to(AWAY_DEG)
        cell.stop_under_way(robot)
        assert not robot.measured().moving
        cell.assert_stands()
        assert np.max(np.abs(cell.joints_deg() - AWAY_DEG)) > 1.0
        cell.assert_smooth()

    @pytest.mark.timeout(600)
    def test_after_stop_no_axis_turns_farther_than_it_says(
        self, cell: RobotCell, robot: Robot, scale: Callable[[int, int], int]
    ) -> None:
        random = np.random.default_rng(11)
        allowed_deg = robot.stopping_deg()
        assert allowed_deg.shape == (6,)
        for target_deg in self.targets_deg(cell, scale(4, 40), seed=11):
            robot.move_to(target_deg)
            cell.clock.sleep(random.uniform(0.05, 0.9))
            called_deg = _stop_while_the_world_waits(cell, robot)
            assert np.all(np.abs(cell.joints_deg() - called_deg) <= allowed_deg + 1e-3)

    def test_a_stop_forgets_the_next_target_too(self, cell: RobotCell, robot: Robot) -> None:
        """A target given in motion waits until the arm is at rest; a stop must not bring it to rest for that."""
        robot.move_to(AWAY_DEG)
        cell.wait_until_under_way()
        robot.move_to(HOME_DEG - 20.0)
        cell.clock.sleep(0.05)  # so that this target is waiting when the stop comes
        robot.stop()
        stood_deg = cell.joints_deg()
        cell.assert_stands()
        cell.clock.sleep(1.0)
        assert np.abs(cell.joints_deg() - stood_deg).max() < 1e-3
        assert np.abs(stood_deg - (HOME_DEG - 20.0)).max() > 5.0
        cell.assert_smooth()

    def test_a_motion_that_another_thread_stops_before_it_begins_does_not_begin(
        self, cell: RobotCell, robot: Robot, monkeypatch: pytest.MonkeyPatch
    ) -> None:
        driver = sys.modules[type(robot).__module__]
        entered, stopped = threading.Event(), threading.Event()
        checked_target = driver.checked_target

        def checked_slowly(*arguments: Any) -> Any:
            entered.set()
            assert stopped.wait(30.0)
            return checked_target(*arguments)

        monkeypatch.setattr(driver, "checked_target", checked_slowly)
        with ThreadPoolExecutor(1) as other:
            motion = other.submit(robot.move_to, AWAY_DEG)
            assert entered.wait(30.0)
            robot.stop()
            stopped.set()
            with pytest.raises(DeviceRefused, match="another command"):
                motion.result(30.0)
        cell.assert_stands()
        assert np.abs(cell.joints_deg() - HOME_DEG).max() < 1e-3

    def test_stops_of_other_threads_end_a_wait_in_progress(self, cell: RobotCell, robot: Robot) -> None:
        robot.move_to(AWAY_DEG)
        with ThreadPoolExecutor(4) as others:
            wait = others.submit(robot.wait_settled)
            cell.wait_until_under_way()
            for stop in [others.submit(robot.stop) for _ in range(3)]:
                stop.result(30.0)
            with pytest.raises(DeviceRefused, match="another command"):
                wait.result(30.0)
        assert not robot.measured().moving
        cell.assert_stands()
        assert np.max(np.abs(cell.joints_deg() - AWAY_DEG)) > 1.0
        cell.assert_smooth()

    def test_it_moves_again_after_a_stop(self, cell: RobotCell, robot: Robot) -> None:
        robot.move_to(AWAY_DEG)
        cell.wait_until_under_way()
        robot.stop()
        robot.move_to(HOME_DEG)
        assert np.allclose(robot.wait_settled().joints_deg, HOME_DEG, atol=1e-3)

    def test_a_motion_that_nobody_watches_brakes_on_its_path_and_another_may_follow(
        self, cell: RobotCell, robot: Robot
    ) -> None:
        """Another thread that looks at the arm is not the one that watches it."""
        robot.move_to(AWAY_DEG, 0.05)
        cell.wait_until_under_way()
        with ThreadPoolExecutor(1) as other:
            give_up = time.monotonic() + 30.0
            while cell.controller.moving:
                other.submit(robot.measured).result()
                assert time.monotonic() < give_up, "it moves on although nobody watches it"
                time.sleep(0.02)
        stood_deg = cell.joints_deg()
        assert np.abs(stood_deg - AWAY_DEG).max() > 1.0, "it was there before it could be stopped"
        way = (stood_deg - HOME_DEG) / (AWAY_DEG - HOME_DEG)
        assert np.ptp(way) < 0.01, "it left its line"
        with pytest.raises(ArmUnattended):
            robot.wait_settled()
        # A look just after a beat passes none on, so the arm may have waited longer than the looks were apart.
        assert robot.measured().unattended_s > 0.8 * UNHURRIED_S
        assert not robot.measured().fault
        cell.assert_smooth()
        robot.move_to(HOME_DEG)
        assert np.allclose(robot.wait_settled().joints_deg, HOME_DEG, atol=1e-3)
        assert robot.measured().unattended_s == 0.0

    def test_closing_in_mid_motion_brings_it_to_rest_smoothly(self, cell: RobotCell, robot: Robot) -> None:
        robot.move_to(AWAY_DEG)
        cell.wait_until_under_way()
        robot.close()
        cell.assert_stands()
        cell.assert_smooth()

    def test_a_target_out_of_limits_is_refused_by_the_name_of_its_axis(
        self, cell: RobotCell, robot: Robot
    ) -> None:
        with pytest.raises(DeviceRefused, match="A5 would be 121"):
            robot.move_to(np.array([0.0, -90.0, 90.0, 0.0, 121.0, 0.0]))
        cell.assert_stands()

    def test_an_emergency_stop_is_a_fault_that_only_a_new_driver_leaves_behind(
        self, cell: RobotCell, robot: Robot
    ) -> None:
        robot.move_to(AWAY_DEG)
        cell.wait_until_under_way()
        cell.in_world(cell.controller.estop)
        with pytest.raises(DeviceFault, match="does not follow"):
            robot.wait_settled()
        cell.assert_stands()
        cell.in_world(cell.controller.reset)
        with pytest.raises(DeviceFault, match="does not follow"):
            robot.move_to(HOME_DEG)
        assert "does not follow" in robot.measured().fault
        cell.assert_stands()
        robot.close()
        again = cell.open()
        again.move_to(HOME_DEG)
        assert np.allclose(again.wait_settled().joints_deg, HOME_DEG, atol=1e-3)

    def test_a_lost_link_ends_all_motion(self, cell: RobotCell, robot: Robot) -> None:
        robot.move_to(AWAY_DEG)
        cell.wait_until_under_way()
        cell.in_world(lambda: cell.controller.lose_link(1.0))
        with pytest.raises(DeviceLost):
            robot.wait_settled()
        with pytest.raises(DeviceLost):
            robot.move_to(HOME_DEG)
        robot.stop()
        cell.assert_stands()

    def test_a_driver_opened_after_a_lost_link_starts_where_the_arm_stands(
        self, cell: RobotCell, robot: Robot
    ) -> None:
        robot.move_to(AWAY_DEG)
        cell.wait_until_under_way()
        cell.in_world(lambda: cell.controller.lose_link(1.0))
        with pytest.raises(DeviceLost):
            robot.wait_settled()
        cell.wait_until(lambda: not cell.controller.moving)
        robot.close()
        cell.trace_deg.clear()
        again = cell.open()
        again.move_to(AWAY_DEG)
        assert np.allclose(again.wait_settled().joints_deg, AWAY_DEG, atol=1e-3)
        cell.assert_smooth()

    def test_an_arm_pushed_aside_is_a_fault(self, cell: RobotCell, robot: Robot) -> None:
        cell.in_world(lambda: cell.controller.nudge((0.0, 2.0, 0.0, 0.0, 0.0, 0.0)))
        with pytest.raises(DeviceFault, match="does not follow"):
            robot.wait_settled()


def _stop_while_the_world_waits(cell: RobotCell, robot: Robot) -> NDArray[np.float64]:
    """Where the axes [6] are when `stop` is called: the world stands still until the command has left."""
    called_deg: list[NDArray[np.float64]] = []
    stopper = threading.Thread(target=robot.stop)

    def call() -> None:
        called_deg.append(cell.joints_deg())
        stopper.start()
        time.sleep(0.1)

    cell.in_world(call)
    stopper.join()
    return called_deg[0]
