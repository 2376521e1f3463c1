"""What every Robot must do, run on the EthernetKRL driver; and what this one must do besides."""

from __future__ import annotations

import socket
import subprocess
import sys
import threading
from collections.abc import Iterator
from contextlib import ExitStack, closing
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from pydantic import ValidationError
from robot_conformance import AWAY_DEG, HOME_DEG, KukaCell, RobotConformance

from coupole.errors import DeviceError, DeviceFault, DeviceLost, DeviceRefused, DeviceTimeout
from drivers.kuka_eki import KukaEki, Settings
from sim.clock import ClockWriter, SharedClock
from sim.kuka_eki_controller import KukaEkiController
from sim.kuka_eki_controller import Settings as ControllerSettings
from sim.reactor import Reactor

SAMPLE_MS = 4


class EkiCell:
    """A KUKA controller with EthernetKRL in a world of its own, and drivers that talk to it."""

    cycle_ms = SAMPLE_MS
    in_world = KukaCell.in_world
    joints_deg = KukaCell.joints_deg
    wait_until = KukaCell.wait_until
    wait_until_under_way = KukaCell.wait_until_under_way
    assert_smooth = KukaCell.assert_smooth
    assert_stands = KukaCell.assert_stands
    _sample = KukaCell._sample

    def __init__(self, folder: Path, *, speed: float = 10.0, **controller: Any) -> None:
        self.clock_path = folder / "clock"
        self.reactor = Reactor(ClockWriter(self.clock_path, speed=speed))
        self.controller = KukaEkiController(
            self.reactor, ControllerSettings.model_validate({"address": "127.0.0.1:0", **controller})
        )
        self.settings = Settings.model_validate(
            {
                "address": self.controller.address,
                "controller_is": controller.get("controller_is", "server"),
                "link_timeout_s": 1.0,
            }
        )
        self.trace_deg: list[tuple[float, ...]] = []
        self.reactor.after(0.5 * SAMPLE_MS / 1e3, self._sample)
        self._thread = threading.Thread(target=self.reactor.run)
        self._thread.start()
        self.clock = SharedClock(self.clock_path)
        self._drivers = ExitStack()

    def open(self, **settings: object) -> KukaEki:
        return self._drivers.enter_context(closing(KukaEki(self.settings.model_copy(update=settings), self.clock)))

    def close(self) -> None:
        self._drivers.close()
        self.reactor.stop()
        self._thread.join()
        self.controller.close()


class TestKukaEki(RobotConformance):
    @pytest.fixture(params=["server", "client"])
    def cell(self, request: pytest.FixtureRequest, tmp_path: Path) -> Iterator[EkiCell]:
        settings = {}
        if request.param == "client":
            with socket.create_server(("127.0.0.1", 0)) as probe:
                settings["address"] = f"127.0.0.1:{probe.getsockname()[1]}"
        with closing(EkiCell(tmp_path, controller_is=request.param, **settings)) as cell:
            yield cell


@pytest.fixture
def cell(tmp_path: Path) -> Iterator[EkiCell]:
    with closing(EkiCell(tmp_path)) as cell:
        yield cell


@pytest.fixture
def robot(cell: EkiCell) -> KukaEki:
    return cell.open()


def test_an_emergency_stop_is_named_and_the_arm_stands_when_it_is_told(cell: EkiCell, robot: KukaEki) -> None:
    robot.move_to(AWAY_DEG)
    cell.wait_until_under_way()
    cell.in_world(cell.controller.estop)
    with pytest.raises(DeviceFault, match="emergency stop"):
        robot.wait_settled()
    assert not robot.measured().moving
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


def test_a_silent_link_is_a_fault_though_the_connection_stays_open(cell: EkiCell, robot: KukaEki) -> None:
    cell.in_world(lambda: cell.controller.lose_link(1e6))
    with pytest.raises(DeviceLost, match="no status for"):
        robot.wait_settled()
    with pytest.raises(DeviceLost, match="no status for"):
        robot.measured()


def test_a_link_lost_in_mid_motion_brakes_the_arm(cell: EkiCell) -> None:
    robot = cell.open(speed_fraction=0.1)
    robot.move_to(AWAY_DEG)
    cell.wait_until_under_way()
    cell.in_world(lambda: cell.controller.lose_link(1e6))
    cell.clock.sleep(1.5)
    cell.assert_stands()
    assert np.max(np.abs(cell.joints_deg() - AWAY_DEG)) > 1.0
    cell.assert_smooth()


def test_a_nudge_after_the_arm_settled_is_told_by_the_next_wait(cell: EkiCell, robot: KukaEki) -> None:
    robot.move_to(AWAY_DEG)
    robot.wait_settled()
    cell.in_world(lambda: cell.controller.nudge((0.0, 0.0, 0.0, 0.0, 0.0, 3.0)))
    with pytest.raises(DeviceFault, match=r"does not follow: it stands 3.00 deg"):
        robot.wait_settled()


def test_waiting_again_for_an_arm_that_settled_long_ago_works(cell: EkiCell, robot: KukaEki) -> None:
    robot.move_to(AWAY_DEG)
    robot.wait_settled()
    cell.clock.sleep(20.0)
    assert np.allclose(robot.wait_settled().joints_deg, AWAY_DEG, atol=1e-3)


def test_a_target_that_the_controller_refuses_is_a_fault(
    cell: EkiCell, robot: KukaEki, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("drivers.kuka_eki.limit_violations", lambda *_: "")
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


def test_a_second_driver_is_turned_away_and_the_first_goes_on(cell: EkiCell, robot: KukaEki) -> None:
    with pytest.raises(DeviceLost):
        cell.open()
    robot.move_to(AWAY_DEG)
    assert np.allclose(robot.wait_settled().joints_deg, AWAY_DEG, atol=1e-3)


def test_without_a_controller_opening_fails(cell: EkiCell) -> None:
    with socket.create_server(("127.0.0.1", 0)) as probe:
        nobody = f"127.0.0.1:{probe.getsockname()[1]}"
    with pytest.raises(DeviceLost, match="refused"):
        cell.open(address=nobody, connect_timeout_s=0.2)


def test_a_controller_that_never_connects_is_told(cell: EkiCell) -> None:
    with pytest.raises(DeviceLost, match="EthernetKRL"):
        cell.open(address="127.0.0.1:0", controller_is="client", connect_timeout_s=0.2)


def test_a_server_that_says_nothing_is_no_controller(cell: EkiCell) -> None:
    with socket.create_server(("127.0.0.1", 0)) as silent:
        address = f"127.0.0.1:{silent.getsockname()[1]}"
        with pytest.raises(DeviceTimeout, match="0 statuses answered"):
            cell.open(address=address, connect_timeout_s=0.2)


def test_a_killed_driver_leaves_the_arm_at_rest_and_another_may_come(cell: EkiCell) -> None:
    script = (
        "import sys, time, numpy; from pathlib import Path\n"
        "from sim.clock import SharedClock; from drivers.kuka_eki import KukaEki, Settings\n"
        "robot = KukaEki(Settings.model_validate_json(sys.argv[1]), SharedClock(Path(sys.argv[2])))\n"
        f"robot.move_to(numpy.array({AWAY_DEG.tolist()}))\n"
        "time.sleep(60)\n"
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


@pytest.mark.parametrize("speed", [1.0, 10.0])
def test_the_world_may_run_faster_than_life(tmp_path: Path, speed: float) -> None:
    with closing(EkiCell(tmp_path, speed=speed)) as cell:
        robot = cell.open(dwell_s=0.3)
        for target_deg in (HOME_DEG + 5.0, HOME_DEG):
            robot.move_to(target_deg)
            assert np.allclose(robot.wait_settled().joints_deg, target_deg, atol=1e-3)


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
    monkeypatch.setattr("drivers.kuka_eki.forward", lambda *_: off)
    with pytest.raises(DeviceError, match="NULLFRAME"):
        robot.self_test()


def test_a_link_lost_after_an_emergency_stop_is_noticed_too(cell: EkiCell, robot: KukaEki) -> None:
    cell.in_world(cell.controller.estop)
    with pytest.raises(DeviceFault, match="emergency stop"):
        robot.wait_settled()
    cell.in_world(lambda: cell.controller.lose_link(1.0))
    cell.wait_until(lambda: robot._watch.link_lost)
    with pytest.raises(DeviceFault, match="emergency stop"):
        robot.measured()
    robot.stop()


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
        Settings.model_validate(settings)


def test_the_arm_moves_at_the_whole_percents_that_the_controller_is_given() -> None:
    settings = Settings(speed_fraction=0.299, acceleration_deg_s2=305.0)
    assert settings.arm().velocity_deg_s[0] == pytest.approx(0.29 * 300.0)
    assert settings.arm().acceleration_deg_s2[0] == pytest.approx(300.0)
