"""What every Robot must do, run on the EthernetKRL driver; and what this one must do besides."""

from __future__ import annotations

import subprocess
import sys
import threading
from collections.abc import Callable, Iterator
from contextlib import closing
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from arms import KR10_R1100_SIXX
from eki_cell import SAMPLE_MS, EkiCell
from our_robot_conformance import OurRobotConformance
from pydantic import ValidationError

from coupole.devices import ArmCondition
from coupole.errors import DeviceError, DeviceFault, DeviceLost, DeviceRefused
from coupole.kinematics import move_duration_s
from coupole.testing.robot_conformance import AWAY_DEG, HOME_DEG
from drivers.kuka.eki.driver import KukaEki, Settings

KINDS: dict[str, dict[str, Any]] = {
    "fast": {},
    "client": {"controller_is": "client"},
    "real-time": {"speed": 1.0},
    "fastest": {"speed": 200.0},
}
"""Worlds and controllers. The whole class is run on the first of them, and with --full on all."""
_REACHES = "test_it_reaches_poses_and_measures_them_right"
_STOPS = "test_after_stop_no_axis_turns_farther_than_it_says"
_STOPS_SMOOTHLY = "test_stop_in_mid_motion_brings_it_to_rest_smoothly"
_REOPENS = "test_a_driver_opened_after_a_lost_link_starts_where_the_arm_stands"
_ESTOP = "test_an_emergency_stop_is_a_fault_that_only_a_new_driver_leaves_behind"
ALSO_ON: dict[str, tuple[str, ...]] = {
    "client": (_REOPENS, _ESTOP),
    "real-time": (_STOPS_SMOOTHLY, _ESTOP),
    "fastest": (_REACHES, _STOPS, _ESTOP),
}


def pytest_generate_tests(metafunc: pytest.Metafunc) -> None:
    if "kind" in metafunc.fixturenames:
        full, name = metafunc.config.getoption("full"), metafunc.function.__name__
        metafunc.parametrize("kind", [kind for kind in KINDS if full or name in ALSO_ON.get(kind, (name,))])


class TestKukaEki(OurRobotConformance):
    @pytest.fixture
    def cell(self, kind: str, tmp_path: Path) -> Iterator[EkiCell]:
        with closing(EkiCell(tmp_path, **KINDS[kind])) as cell:
            yield cell

    @pytest.mark.timeout(600)
    def test_after_stop_no_axis_turns_farther_than_it_says(
        self, cell: EkiCell, robot: KukaEki, scale: Callable[[int, int], int]
    ) -> None:
        """From the call on the world stands still until the command has come, however busy the machine is."""
        random = np.random.default_rng(11)
        for target_deg in self.targets_deg(cell, scale(4, 40), seed=11):
            robot.move_to(target_deg)
            cell.clock.sleep(random.uniform(0.05, 0.9))
            stopper = threading.Thread(target=robot.stop)
            called_deg = cell.hold_until_commanded(stopper.start)
            stopper.join()
            assert np.all(np.abs(cell.joints_deg() - called_deg) <= robot.stopping_deg() + 1e-3)


@pytest.fixture
def cell(tmp_path: Path) -> Iterator[EkiCell]:
    with closing(EkiCell(tmp_path)) as cell:
        yield cell


@pytest.fixture
def robot(cell: EkiCell) -> KukaEki:
    return cell.open()


def test_an_emergency_stop_is_named_and_the_arm_stands_when_it_is_told(cell: EkiCell, robot: KukaEki) -> None:
    assert robot.measured().condition == ArmCondition("automatic or T2", False, None, True)
    robot.move_to(AWAY_DEG)
    cell.wait_until_under_way()
    cell.in_world(cell.controller.estop)
    with pytest.raises(DeviceFault, match="emergency stop"):
        robot.wait_settled()
    assert not robot.measured().moving
    assert robot.measured().condition == ArmCondition("automatic or T2", True, None, False)
    cell.assert_stands()


def test_during_an_emergency_stop_no_driver_opens(cell: EkiCell) -> None:
    cell.in_world(cell.controller.estop)
    with pytest.raises(DeviceFault, match="emergency stop"):
        cell.open()


def test_after_an_emergency_stop_the_old_target_is_not_gone_for(cell: EkiCell, robot: KukaEki) -> None:
    robot.move_to(AWAY_DEG)
    cell.wait_until_under_way()
    cell.in_world(cell.controller.estop)
    with pytest.raises(DeviceFault):
        robot.wait_settled()
    cell.in_world(cell.controller.reset)
    cell.assert_stands()
    robot.close()
    cell.open()
    cell.assert_stands()


def test_a_nudge_after_the_arm_settled_is_told_by_the_next_wait(cell: EkiCell, robot: KukaEki) -> None:
    robot.move_to(AWAY_DEG)
    robot.wait_settled()
    cell.in_world(lambda: cell.controller.nudge((0.0, 0.0, 0.0, 0.0, 0.0, 3.0)))
    with pytest.raises(DeviceFault, match=r"does not follow: it is 3.00 deg"):
        robot.wait_settled()


def test_a_push_for_a_while_springs_back_unless_a_new_driver_takes_the_arm_where_it_stands(
    cell: EkiCell, robot: KukaEki
) -> None:
    push_deg = (0.5, 0.0, 0.0, 0.0, 0.0, 0.0)
    cell.in_world(lambda: cell.controller.nudge(push_deg, 2.0))
    assert cell.joints_deg() == pytest.approx(HOME_DEG + push_deg)
    cell.clock.sleep(3.0)
    assert cell.joints_deg() == pytest.approx(HOME_DEG)
    cell.in_world(lambda: cell.controller.nudge(push_deg, 10.0))
    robot.close()
    cell.open()
    cell.clock.sleep(11.0)
    assert cell.joints_deg() == pytest.approx(HOME_DEG + push_deg)


def test_waiting_again_for_an_arm_that_settled_long_ago_works(cell: EkiCell, robot: KukaEki) -> None:
    robot.move_to(AWAY_DEG)
    robot.wait_settled()
    cell.clock.sleep(6.0)
    assert np.allclose(robot.wait_settled().joints_deg, AWAY_DEG, atol=1e-3)


def test_a_target_that_the_controller_refuses_is_a_fault(cell: EkiCell, robot: KukaEki) -> None:
    robot.arm = replace(robot.arm, limits_deg=((-360.0, 360.0),) * 6)
    robot.move_to(np.array([0.0, -90.0, 90.0, 0.0, 121.0, 0.0]))
    with pytest.raises(DeviceRefused, match="software limits"):
        robot.wait_settled()
    with pytest.raises(DeviceRefused, match="software limits"):
        robot.move_to(HOME_DEG)
    cell.assert_stands()


def test_another_command_ends_the_wait_for_the_first(cell: EkiCell, robot: KukaEki) -> None:
    robot.move_to(AWAY_DEG)
    cell.wait_until_under_way()
    stopper = threading.Timer(0.02, robot.stop)
    stopper.start()
    with pytest.raises(DeviceRefused, match="another command"):
        robot.wait_settled()
    stopper.join()
    cell.assert_stands()


def test_a_killed_driver_leaves_the_arm_at_rest_and_another_may_come(cell: EkiCell) -> None:
    script = (
        "import sys, time, numpy; from pathlib import Path\n"
        "from sim.world.clock import SharedClock; from drivers.kuka.eki.driver import KukaEki, Settings\n"
        "robot = KukaEki(Settings.model_validate_json(sys.argv[1]), SharedClock(Path(sys.argv[2])))\n"
        f"robot.move_to(numpy.array({AWAY_DEG.tolist()}))\n"
        "for _ in range(3000): robot.measured(); time.sleep(0.02)\n"
    )
    arguments = [cell.settings.model_dump_json(), str(cell.clock_path)]
    with subprocess.Popen([sys.executable, "-c", script, *arguments]) as driver:
        cell.wait_until_under_way()
        driver.kill()
    cell.wait_until(lambda: not cell.controller.moving)
    cell.assert_stands()
    cell.assert_smooth()
    again = cell.open()
    again.move_to(HOME_DEG)
    assert np.allclose(again.wait_settled().joints_deg, HOME_DEG, atol=1e-3)


def test_motions_last_as_long_as_preflight_says(cell: EkiCell) -> None:
    robot = cell.open(speed_fraction=0.295, acceleration_deg_s2=250.0)
    start_deg = HOME_DEG
    for target_deg in (HOME_DEG + 0.5, AWAY_DEG, HOME_DEG):
        before = len(cell.trace_deg)
        robot.move_to(target_deg)
        robot.wait_settled()
        on_the_way = np.any(np.diff(np.array(cell.trace_deg[before - 1 :]), axis=0) != 0.0, axis=1)
        says_s = move_duration_s(robot.arm, start_deg, target_deg)
        assert on_the_way.sum() * SAMPLE_MS / 1e3 == pytest.approx(says_s, rel=0.01, abs=2 * SAMPLE_MS / 1e3)
        start_deg = target_deg


def test_an_override_below_100_percent_lengthens_the_time_allowed(tmp_path: Path) -> None:
    with closing(EkiCell(tmp_path, speed=50.0, override_percent=5)) as cell:
        robot = cell.open()
        assert robot.self_test()["override"] == "5 %"
        robot.move_to(AWAY_DEG)
        assert np.allclose(robot.wait_settled().joints_deg, AWAY_DEG, atol=1e-3)


def test_the_self_test_compares_the_poses_of_both_sides(
    cell: EkiCell, robot: KukaEki, monkeypatch: pytest.MonkeyPatch
) -> None:
    robot.move_to(AWAY_DEG)
    robot.wait_settled()
    assert "as computed from the axes" in robot.self_test()["pose"]
    off = np.eye(4)
    off[0, 3] = 5.0
    monkeypatch.setattr("drivers.kuka.eki.driver.forward", lambda *_: off)
    with pytest.raises(DeviceError, match="NULLFRAME"):
        robot.self_test()


def test_closing_twice_raises_nothing_and_a_closed_driver_moves_nothing(cell: EkiCell, robot: KukaEki) -> None:
    robot.close()
    robot.close()
    with pytest.raises(DeviceLost, match="closed") as raised:
        robot.move_to(HOME_DEG)
    assert raised.value.remedy


@pytest.mark.parametrize(
    "settings", [{"acceleration_deg_s2": 700.0}, {"acceleration_deg_s2": 1.0}, {"speed_fraction": 0.004}]
)
def test_speeds_that_the_controller_cannot_be_given_are_refused(settings: dict[str, float]) -> None:
    with pytest.raises(ValidationError, match="from 1 to 100 %"):
        Settings.model_validate({"arm_model": KR10_R1100_SIXX, **settings})


def test_the_arm_moves_at_the_whole_percents_that_the_controller_is_given() -> None:
    settings = Settings(arm_model=KR10_R1100_SIXX, speed_fraction=0.299, acceleration_deg_s2=305.0)
    assert settings.arm().velocity_deg_s[0] == pytest.approx(0.29 * 300.0)
    assert settings.arm().acceleration_deg_s2[0] == pytest.approx(300.0)
