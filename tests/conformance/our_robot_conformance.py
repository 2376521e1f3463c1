"""The contract of robots in the words of our own drivers, and what can be seen of them alone."""

from __future__ import annotations

import sys
import threading
from concurrent.futures import ThreadPoolExecutor
from typing import Any

import numpy as np
import pytest

from coupole.devices import Robot
from coupole.errors import DeviceRefused
from coupole.testing import RobotConformance
from sim.world.robot_alone import RobotAlone


@pytest.mark.timeout(1800)  # two hundred poses with --full
class OurRobotConformance(RobotConformance):
    """The contract, for drivers that check a target by `drivers.arm_motion`."""

    words_of_a_fault = "does not follow"
    words_of_another_command = "another command"
    words_of_an_axis = "A5 would be 121"
    model = "KR10 R1100 sixx"

    def test_it_tells_its_model(self, robot: Robot) -> None:
        assert robot.identify().model == self.model

    def test_a_speed_of_nothing_is_refused_by_name(self, robot: Robot) -> None:
        with pytest.raises(DeviceRefused, match="a speed above 0"):
            robot.move_to(self.home_deg, 0.0)

    def test_a_motion_that_another_thread_stops_before_it_begins_does_not_begin(
        self, cell: RobotAlone, robot: Robot, monkeypatch: pytest.MonkeyPatch
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
            motion = other.submit(robot.move_to, self.away_deg)
            assert entered.wait(30.0)
            robot.stop()
            stopped.set()
            with pytest.raises(DeviceRefused, match="another command"):
                motion.result(30.0)
        cell.assert_stands()
        assert np.abs(cell.joints_deg() - self.home_deg).max() < 1e-3
