"""What every Robot must do, run on the UR driver against a stand-in for the controller; and the UR's own faults.

Real time: ur-rtde knows no other. Each cell has a loopback address of its own, since UR's ports are fixed.
"""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import closing
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray
from our_robot_conformance import OurRobotConformance
from pydantic import ValidationError
from ur import needs_ur_rtde

from coupole.devices import ArmCondition
from coupole.errors import DeviceFault, DeviceLost, DeviceRefused, DeviceTimeout, InputError
from coupole.testing.robot_conformance import AWAY_DEG, HOME_DEG, UNHURRIED_S
from drivers.ur.driver import Settings, UrRobot
from sim.devices.ur_arm import flange_pose, rotation_vector
from sim.devices.ur_controller import Settings as ControllerSettings
from sim.devices.ur_controller import UrController
from sim.world.clock import ClockWriter
from sim.world.reactor import Reactor
from sim.world.robot_alone import RobotAlone

pytestmark = needs_ur_rtde

_CYCLE_S = 0.002


class UrCell(RobotAlone):
    """A UR controller and its driver."""

    def __init__(self, folder: Path) -> None:
        reactor = Reactor(ClockWriter(folder / "clock", speed=1.0))
        arm = UrController(reactor, ControllerSettings())
        self.settings = Settings.model_validate(
            {
                "host": arm.address,
                "limits_deg": [(-170, 170), (-190, 45), (-120, 156), (-185, 185), (-120, 120), (-350, 350)],
                "speed_fraction": 0.75,
                "acceleration_deg_s2": 300.0,
                "stop_deg_s2": 600.0,
                "link_timeout_s": 1.5,
                "watchdog_s": UNHURRIED_S,
                "attention_s": UNHURRIED_S,
            }
        )
        super().__init__(folder / "clock", reactor, arm, 1e3 * _CYCLE_S)

    def open(self) -> UrRobot:
        opened: UrRobot = self.keep(UrRobot(self.settings, self.clock))
        return opened

    @property
    def velocity_deg_s(self) -> NDArray[np.float64]:
        return np.full(6, self.settings.speed_deg_s)

    def assert_smooth(self) -> None:
        """Speed and acceleration of all that was sampled are within the driver's limits."""
        axes_deg = np.array(self.trace_deg)
        for order, limit in enumerate((self.settings.speed_deg_s, self.settings.stop_deg_s2), start=1):
            rounding = 2.0**order * 1e-9 / _CYCLE_S**order
            assert np.all(np.abs(np.diff(axes_deg, order, axis=0)) / _CYCLE_S**order <= limit * 1.001 + rounding)

    def assert_stands(self) -> None:
        """The arm does not move for half a second."""
        before = self.joints_deg()
        self.clock.sleep(0.5)
        assert not self.controller.moving
        assert np.array_equal(self.joints_deg(), before)


@pytest.fixture
def cell(tmp_path: Path) -> Iterator[UrCell]:
    with closing(UrCell(tmp_path)) as cell:
        yield cell


@pytest.fixture
def robot(cell: UrCell) -> UrRobot:
    return cell.open()


class TestUrRobot(OurRobotConformance):
    model = "UR10"

    @pytest.fixture
    def cell(self, tmp_path: Path) -> Iterator[UrCell]:
        with closing(UrCell(tmp_path)) as cell:
            yield cell

    def test_it_says_who_it_is_and_whether_it_is_simulated(self, cell: UrCell, robot: UrRobot) -> None:
        assert robot.identify().simulated
        assert robot.self_test()["tool offset"] == "0.00, 0.00, 100.00 mm"
        assert robot.measured().condition == ArmCondition("running", False, False, True)

    def test_it_reaches_poses_and_measures_them_right(
        self, cell: UrCell, robot: UrRobot, scale: Callable[[int, int], int]
    ) -> None:
        for target_deg in self.targets_deg(cell, scale(2, 100), seed=5):
            robot.move_to(target_deg)
            state = robot.wait_settled()
            assert not state.moving
            assert np.allclose(state.joints_deg, target_deg, atol=1e-3)
            assert np.allclose(state.base_from_flange, flange_pose("ur10e", target_deg.tolist()), atol=1e-6)
            assert np.allclose(cell.controller.true_base_from_flange(), state.base_from_flange, atol=1e-6)

    def test_an_emergency_stop_is_a_fault_that_only_a_new_driver_leaves_behind(
        self, cell: UrCell, robot: UrRobot
    ) -> None:
        _assert_latched(cell, robot, cell.controller.estop, "emergency stop")

    def test_many_moves_leave_no_queue_behind(self, cell: UrCell, robot: UrRobot) -> None:
        for _ in range(5):
            robot.move_to(AWAY_DEG)
            robot.move_to(HOME_DEG)
        assert np.allclose(robot.wait_settled().joints_deg, HOME_DEG, atol=1e-3)
        cell.assert_smooth()


def _assert_latched(cell: UrCell, robot: UrRobot, happens: Callable[[], None], name: str) -> None:
    """What happens in mid-motion is a fault of that name; acknowledged, nothing moves until a new driver does."""
    robot.move_to(AWAY_DEG)
    cell.wait_until_under_way()
    cell.in_world(happens)
    with pytest.raises(DeviceFault, match=name):
        robot.wait_settled()
    cell.wait_until(lambda: not cell.controller.moving)
    told = robot.measured().condition
    assert (told.emergency_stop, told.protective_stop) == (
        name == "emergency stop",
        name in ("protective stop", "safeguard stop"),
    )
    assert told.brakes_released == (told.mode == "running")
    cell.in_world(cell.controller.reset)
    with pytest.raises(DeviceFault, match=name):
        robot.move_to(HOME_DEG)
    assert name in robot.measured().fault
    assert cell.controller.program_state == "STOPPED"
    cell.assert_stands()
    robot.close()
    again = cell.open()
    again.move_to(HOME_DEG)
    assert np.allclose(again.wait_settled().joints_deg, HOME_DEG, atol=1e-3)


@pytest.mark.parametrize(
    ("stop", "name"),
    [
        (UrController.protective_stop, "protective stop"),
        (UrController.safeguard_stop, "safeguard stop"),
        (UrController.safety_fault, "safety fault"),
    ],
    ids=["protective", "safeguard", "fault"],
)
def test_each_stop_for_safety_is_a_latched_fault_by_its_name_and_a_paused_program_is_ended(
    cell: UrCell, robot: UrRobot, stop: Callable[[UrController], None], name: str
) -> None:
    _assert_latched(cell, robot, lambda: stop(cell.controller), name)


def test_a_program_stopped_at_the_pendant_is_a_latched_fault(cell: UrCell, robot: UrRobot) -> None:
    _assert_latched(cell, robot, cell.controller.stop_program, "program stopped")


def test_an_operator_who_takes_local_control_is_named(cell: UrCell, robot: UrRobot) -> None:
    def take_control() -> None:
        cell.controller.remote_control = False
        cell.controller.stop_program()

    cell.in_world(take_control)
    cell.wait_until(lambda: bool(robot.measured().fault))
    with pytest.raises(DeviceFault, match="not in remote control"):
        robot.move_to(AWAY_DEG)
    robot.close()
    with pytest.raises(DeviceFault, match="not in remote control"):
        cell.open()


def test_opening_in_an_emergency_stop_names_it(cell: UrCell) -> None:
    cell.in_world(cell.controller.estop)
    with pytest.raises(DeviceFault, match="ROBOT_EMERGENCY_STOP"):
        cell.open()


def test_connections_that_end_are_a_lost_link(cell: UrCell, robot: UrRobot) -> None:
    robot.move_to(AWAY_DEG)
    cell.wait_until_under_way()
    cell.in_world(cell.controller.drop_link)
    with pytest.raises(DeviceLost, match="the controller closed it"):
        robot.wait_settled()
    assert cell.controller.program_state == "STOPPED"
    cell.assert_stands()
    robot.close()
    again = cell.open()
    again.move_to(HOME_DEG)
    assert np.allclose(again.wait_settled().joints_deg, HOME_DEG, atol=1e-3)


def test_news_of_the_arm_is_as_old_as_the_last_sample_until_the_link_counts_as_lost(
    cell: UrCell, robot: UrRobot
) -> None:
    before_ns = robot.measured().t_ns
    cell.wait_until(lambda: robot.measured().t_ns > before_ns)
    cell.in_world(lambda: cell.controller.lose_link(60.0))
    heard_ns = []

    def measure_on() -> None:
        while True:
            heard_ns.append(robot.measured().t_ns)
            time.sleep(0.01)

    with pytest.raises(DeviceLost, match="link lost: no sample for"):
        measure_on()
    assert heard_ns[-1] < cell.clock.now_ns() - 500_000_000
    assert heard_ns[len(heard_ns) // 2] == heard_ns[-1]
    robot.stop()
    robot.close()


def test_a_running_program_of_somebody_else_is_left_alone(cell: UrCell, robot: UrRobot) -> None:
    cell.settings = cell.settings.model_copy(update={"connect_timeout_s": 10.0})
    with pytest.raises(DeviceRefused, match="PLAYING"):
        cell.open()
    robot.move_to(AWAY_DEG)
    assert np.allclose(robot.wait_settled().joints_deg, AWAY_DEG, atol=1e-3)


def test_a_silent_controller_ends_opening_in_time_and_leaves_no_process(
    cell: UrCell, monkeypatch: pytest.MonkeyPatch
) -> None:
    cell.in_world(lambda: cell.controller.lose_link(60.0))
    cell.settings = cell.settings.model_copy(update={"connect_timeout_s": 1.0})
    started: list[subprocess.Popen[bytes]] = []
    popen = subprocess.Popen

    def watched(*args: object, **options: object) -> subprocess.Popen[bytes]:
        started.append(popen(*args, **options))  # type: ignore[call-overload]
        return started[-1]

    monkeypatch.setattr(subprocess, "Popen", watched)
    with pytest.raises(DeviceTimeout, match="hung for"):
        cell.open()
    assert [process.returncode is not None for process in started] == [True]


def test_nobody_at_the_address_is_told(cell: UrCell) -> None:
    cell.settings = cell.settings.model_copy(update={"host": "127.255.255.254"})
    with pytest.raises(DeviceLost, match="Connection refused"):
        cell.open()


def test_figures_of_a_dead_process_are_those_of_its_latest_answer(robot: UrRobot) -> None:
    opened_samples = robot.statistics()["samples"]
    time.sleep(0.2)
    robot.measured()
    os.kill(robot._process.pid, signal.SIGKILL)
    with pytest.raises(DeviceLost):
        robot.measured()
    assert robot.statistics()["samples"] > opened_samples


def test_closing_twice_or_with_a_dead_process_raises_nothing(cell: UrCell, robot: UrRobot) -> None:
    robot.move_to(AWAY_DEG)
    cell.wait_until_under_way()
    os.kill(robot._process.pid, signal.SIGKILL)
    with pytest.raises(DeviceLost) as raised:
        robot.wait_settled()
    assert raised.value.remedy
    robot.stop()
    robot.close()
    robot.close()
    with pytest.raises(DeviceLost, match="robot"):
        robot.move_to(HOME_DEG)
    assert cell.controller.fault.startswith("RTDE watchdog")
    cell.assert_stands()


def test_a_killed_parent_leaves_no_process_and_the_arm_at_rest(cell: UrCell) -> None:
    script = (
        "import sys, time, numpy; from pathlib import Path\n"
        "from sim.world.clock import SharedClock; from drivers.ur.driver import UrRobot, Settings\n"
        "robot = UrRobot(Settings.model_validate_json(sys.argv[1]), SharedClock(Path(sys.argv[2])))\n"
        f"robot.move_to(numpy.array({AWAY_DEG.tolist()}))\n"
        "print(robot._process.pid, flush=True)\n"
        "for _ in range(3000): robot.measured(); time.sleep(0.02)\n"
    )
    arguments = [cell.settings.model_dump_json(), str(cell.clock_path)]
    with subprocess.Popen([sys.executable, "-c", script, *arguments], stdout=subprocess.PIPE) as parent:
        assert parent.stdout is not None
        owner = Path(f"/proc/{int(parent.stdout.readline())}")
        cell.wait_until_under_way()
        parent.kill()
    cell.wait_until(lambda: not owner.exists() or "Z" in (owner / "stat").read_text().split()[2])
    assert not cell.controller.moving
    cell.assert_stands()
    cell.assert_smooth()


def test_another_client_moves_the_tool_on_a_straight_line(cell: UrCell) -> None:
    script = (
        "import sys; from rtde_control import RTDEControlInterface\n"
        "control = RTDEControlInterface(sys.argv[1])\n"
        "assert control.moveL([float(v) for v in sys.argv[2:]], 0.5, 2.0)\n"
        "control.stopScript()\n"
    )
    start, line_mm = _tool_pose(HOME_DEG), np.array([50.0, 150.0, -100.0])
    goal_m_rad = [*(start[:3, 3] + line_mm) / 1e3, *rotation_vector(start[:3, :3])]
    words = [cell.settings.host, *map(str, goal_m_rad)]
    subprocess.run([sys.executable, "-c", script, *words], check=True, capture_output=True, timeout=60)
    tools = np.array([_tool_pose(joints_deg) for joints_deg in cell.trace_deg[::20]])
    gone_mm = tools[:, :3, 3] - start[:3, 3]
    shares = gone_mm @ line_mm / (line_mm @ line_mm)
    assert np.abs(gone_mm - shares[:, None] * line_mm).max() < 0.01
    assert np.allclose(tools[:, :3, :3], start[:3, :3], atol=1e-5)
    assert np.allclose(_tool_pose(cell.controller.joints_deg)[:3, 3], start[:3, 3] + line_mm, atol=1e-3)


def _tool_pose(joints_deg: Sequence[float] | NDArray[np.float64]) -> NDArray[np.float64]:
    """`base_from_tool` with the stand-in's tool: 100 mm before the flange, turned by 0.5 rad."""
    from scipy.spatial.transform import Rotation

    flange_from_tool = np.eye(4)
    flange_from_tool[:3, :3] = Rotation.from_rotvec([0.0, 0.0, 0.5]).as_matrix()
    flange_from_tool[2, 3] = 100.0
    base_from_tool: NDArray[np.float64] = flange_pose("ur10e", list(joints_deg)) @ flange_from_tool
    return base_from_tool


def test_a_line_that_the_arm_cannot_follow_ends_the_program(cell: UrCell) -> None:
    cell.in_world(lambda: cell.controller.start_movel((5.0, 0.0, 0.0, 0.0, 0.0, 0.0), 0.5, 2.0))
    assert cell.controller.fault == "no path along that line"
    cell.assert_stands()


def test_a_push_for_a_while_springs_back(cell: UrCell, robot: UrRobot) -> None:
    cell.in_world(lambda: cell.controller.nudge([0.5] * 6, 0.3))
    assert cell.joints_deg() == pytest.approx(HOME_DEG + 0.5)
    cell.clock.sleep(0.4)
    assert cell.joints_deg() == pytest.approx(HOME_DEG)
    assert robot.measured().fault == ""


def test_a_missing_ur_rtde_is_named(cell: UrCell, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "rtde_control.py").write_text("raise ImportError('there is none')")
    monkeypatch.setenv("PYTHONPATH", str(tmp_path))
    with pytest.raises(DeviceRefused, match=r"the package ur-rtde.*there is none"):
        cell.open()


def test_statistics_can_be_asked_after_closing(cell: UrCell, robot: UrRobot) -> None:
    robot.measured()
    robot.close()
    assert robot.statistics()["samples"] > 0


def test_the_stand_in_refuses_a_world_that_is_not_in_real_time(tmp_path: Path) -> None:
    reactor = Reactor(ClockWriter(tmp_path / "clock", speed=10.0))
    with pytest.raises(InputError, match="real time"):
        UrController(reactor, ControllerSettings())


@pytest.mark.parametrize("turn_deg", [0.0, 1e-7, 30.0, 180.0])
def test_rotation_vectors_of_the_stand_in_are_those_of_scipy(turn_deg: float) -> None:
    from scipy.spatial.transform import Rotation

    axis = np.array([2.0, -1.0, 2.0]) / 3.0
    rotation = Rotation.from_rotvec(np.radians(turn_deg) * axis).as_matrix()
    again = Rotation.from_rotvec(rotation_vector(rotation)).as_matrix()
    assert np.allclose(again, rotation, atol=1e-9)


def test_the_stand_in_stands_where_universal_robots_own_figures_say() -> None:
    # All joints at 0: the arm lies along -x. a2 + a3 = 1184.25 mm; d4 + d6 = 290.7 mm; d1 - d5 = 60.85 mm.
    assert np.allclose(flange_pose("ur10e", [0.0] * 6)[:3, 3], [-1184.25, -290.7, 60.85], atol=1e-9)


@pytest.mark.parametrize("key", ["watchdog_s", "attention_s"])
def test_no_setting_lets_the_arm_move_unwatched_for_more_than_half_a_second(key: str) -> None:
    with pytest.raises(ValidationError, match=rf"{key}\n  Input should be less than or equal to 0\.5"):
        Settings.model_validate({"host": "192.0.2.7", key: 0.51})
