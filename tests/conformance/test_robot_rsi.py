"""What every Robot must do, run on the RSI driver; and what this one must do besides."""

from __future__ import annotations

import os
import signal
import socket
import subprocess
import sys
from collections.abc import Iterator
from contextlib import closing, contextmanager
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray
from our_robot_conformance import OurRobotConformance
from robot_cells import KukaCell

from coupole.errors import DeviceError, DeviceFault, DeviceLost, DeviceRefused, DeviceTimeout
from coupole.testing.robot_conformance import AWAY_DEG, HOME_DEG
from drivers.kuka.rsi.driver import KukaRsi

KINDS: dict[str, dict[str, Any]] = {
    "4ms": {},
    "12ms": {"cycle_ms": 12},
    "real-time": {"lock_step": False, "speed": 1.0},
    "relative": {"mode": "relative"},
    "pose": {"corrects": "pose"},
    "pose-relative": {"corrects": "pose", "mode": "relative", "cycle_ms": 12},
}
"""The other ends of the wire. The whole class is run on the first of them, and with --full on all."""
_REACHES = "test_it_reaches_poses_and_measures_them_right"
_STOPS = "test_after_stop_no_axis_turns_farther_than_it_says"
_ESTOP = "test_an_emergency_stop_is_a_fault_that_only_a_new_driver_leaves_behind"
_FEW_LATE = "test_a_few_late_answers_are_counted_and_survived"
_MANY_LATE = "test_many_late_answers_are_a_fault"
_SMOOTH = "test_a_new_target_in_mid_motion_is_reached_smoothly"
ALSO_ON: dict[str, tuple[str, ...]] = {
    "12ms": (_REACHES, _STOPS, _ESTOP, _FEW_LATE, _MANY_LATE, _SMOOTH),
    "real-time": (_STOPS, _ESTOP),
    "relative": (_REACHES, _ESTOP, _FEW_LATE, _MANY_LATE),
    "pose": (_REACHES, _ESTOP, _FEW_LATE),
    "pose-relative": (_REACHES, _STOPS, _FEW_LATE),
}


def pytest_generate_tests(metafunc: pytest.Metafunc) -> None:
    if "kind" in metafunc.fixturenames:
        full, name = metafunc.config.getoption("full"), metafunc.function.__name__
        metafunc.parametrize("kind", [kind for kind in KINDS if full or name in ALSO_ON.get(kind, (name,))])


class TestKukaRsi(OurRobotConformance):
    @pytest.fixture
    def cell(self, kind: str, tmp_path: Path) -> Iterator[KukaCell]:
        with closing(KukaCell(tmp_path, **KINDS[kind])) as cell:
            yield cell

    def range_deg(self, cell: KukaCell) -> NDArray[np.float64]:
        """Corrections of the pose keep elbow and wrist as they were, and off their singularities."""
        if cell.settings.corrects == "pose":
            return np.array([(-80, 80), (-100, -60), (40, 120), (-100, 100), (20, 110), (-200, 200)])
        return super().range_deg(cell)

    def test_a_few_late_answers_are_counted_and_survived(self, cell: KukaCell) -> None:
        robot = cell.open()
        robot.move_to(AWAY_DEG)
        cell.wait_until_under_way()
        cell.in_world(lambda: cell.controller.late(5))
        assert np.allclose(robot.wait_settled().joints_deg, AWAY_DEG, atol=1e-3)
        late = robot.statistics()["late_answers"]
        assert late == 5 if cell.lock_step else late >= 5

    def test_many_late_answers_are_a_fault(self, cell: KukaCell) -> None:
        robot = cell.open(delay_limit=50)
        robot.move_to(AWAY_DEG)
        cell.wait_until_under_way()
        cell.in_world(lambda: cell.controller.late(70))
        with pytest.raises(DeviceFault, match="late answers"):
            robot.wait_settled()
        robot.stop()
        cell.clock.sleep(0.1)
        cell.wait_until(lambda: not cell.controller.moving)
        cell.assert_stands()
        with pytest.raises(DeviceFault, match="late answers"):
            robot.move_to(HOME_DEG)
        assert "late answers" in robot.measured().fault
        cell.assert_stands()

    def test_without_a_controller_opening_fails_and_leaves_no_process(
        self, cell: KukaCell, monkeypatch: pytest.MonkeyPatch
    ) -> None:
        cell.in_world(lambda: cell.controller.lose_link(1e6))
        cell.settings = cell.settings.model_copy(update={"connect_timeout_s": 0.5})
        started: list[subprocess.Popen[bytes]] = []
        popen = subprocess.Popen

        def watched(*args: object, **options: object) -> subprocess.Popen[bytes]:
            started.append(popen(*args, **options))  # type: ignore[call-overload]
            return started[-1]

        monkeypatch.setattr(subprocess, "Popen", watched)
        with pytest.raises(DeviceTimeout, match="0 came"):
            cell.open()
        assert [process.returncode is not None for process in started] == [True]

    def test_a_port_in_use_is_told(self, cell: KukaCell) -> None:
        cell.open()
        with pytest.raises(DeviceLost, match="in use"):
            cell.open()

    def test_closing_twice_or_with_a_dead_process_raises_nothing(self, cell: KukaCell) -> None:
        robot = cell.open()
        os.kill(robot._process.pid, signal.SIGKILL)
        robot._process.wait()
        with pytest.raises(DeviceLost):
            robot.measured()
        robot.close()
        robot.close()

    def test_a_killed_parent_leaves_no_process_and_the_arm_at_rest(self, cell: KukaCell) -> None:
        script = (
            "import sys, time, numpy; from pathlib import Path\n"
            "from sim.world.clock import SharedClock; from drivers.kuka.rsi.driver import KukaRsi, Settings\n"
            "robot = KukaRsi(Settings.model_validate_json(sys.argv[1]), SharedClock(Path(sys.argv[2])))\n"
            f"robot.move_to(numpy.array({AWAY_DEG.tolist()}))\n"
            "print(robot._process.pid, flush=True)\n"
            "for _ in range(3000): robot.measured(); time.sleep(0.02)\n"
        )
        arguments = [cell.settings.model_dump_json(), str(cell.clock_path)]
        with subprocess.Popen([sys.executable, "-c", script, *arguments], stdout=subprocess.PIPE) as parent:
            assert parent.stdout is not None
            loop = Path(f"/proc/{int(parent.stdout.readline())}")
            cell.wait_until_under_way()
            parent.kill()
        cell.wait_until(lambda: not loop.exists() or "Z" in (loop / "stat").read_text().split()[2])
        cell.wait_until(lambda: not cell.controller.moving)
        cell.assert_stands()
        cell.assert_smooth()
        again = cell.open()
        again.move_to(HOME_DEG)
        assert np.allclose(again.wait_settled().joints_deg, HOME_DEG, atol=1e-3)

    def test_every_error_is_a_device_error_with_a_remedy(self, cell: KukaCell) -> None:
        robot = cell.open()
        robot.close()
        with pytest.raises(DeviceError) as raised:
            robot.move_to(HOME_DEG)
        assert raised.value.remedy


# -- what else can be set, and what else can go wrong ---------------------------------------------------------


@contextmanager
def moved_cell(folder: Path, **settings: Any) -> Iterator[tuple[KukaCell, KukaRsi]]:
    """A cell whose arm has gone away from where RSI was started."""
    with closing(KukaCell(folder, **settings)) as cell:
        robot = cell.open()
        robot.move_to(AWAY_DEG)
        robot.wait_settled()
        yield cell, robot


def test_names_of_elements_sentype_and_any_step_of_the_ipoc_are_the_controllers(tmp_path: Path) -> None:
    names = {"sen_type": "Dome", "measured_tag": "Achsen", "correction_tag": "Korrektur", "sends_pose": True}
    with moved_cell(tmp_path, ipoc_step=1, **names) as (cell, _):
        assert np.allclose(cell.joints_deg(), AWAY_DEG, atol=1e-3)


def test_an_arm_that_swings_after_its_stop_is_not_settled_before_it_stands(tmp_path: Path) -> None:
    swing = {"vibration_deg": 0.1, "vibration_hz": 8.0, "vibration_decay_s": 0.2}
    with moved_cell(tmp_path, **swing) as (cell, robot):
        assert np.abs(cell.joints_deg() - AWAY_DEG).max() <= robot.settings.settle_deg
        beyond_deg = (np.array(cell.trace_deg) - AWAY_DEG) * np.sign(AWAY_DEG - HOME_DEG)
        assert beyond_deg.max() > 0.02
        settled_mm = cell.controller.true_base_from_flange()[:3, 3]
        cell.clock.sleep(0.3)
        assert np.abs(cell.controller.true_base_from_flange()[:3, 3] - settled_mm).max() < 0.1


def test_a_target_beyond_the_correction_limits_is_refused_before_anything_moves(tmp_path: Path) -> None:
    limits = {"axis_monitor_deg": (30.0,) * 6}
    with closing(KukaCell(tmp_path, limits=limits)) as cell:
        robot = cell.open(axis_correction_deg=(30.0,) * 6)
        with pytest.raises(DeviceRefused, match="A1 would be 50"):
            robot.move_to(AWAY_DEG)
        cell.assert_stands()
        robot.move_to(HOME_DEG + 29.0)
        assert np.allclose(robot.wait_settled().joints_deg, HOME_DEG + 29.0, atol=1e-3)


def test_a_limit_that_only_the_controller_knows_ends_in_a_fault(tmp_path: Path) -> None:
    with closing(KukaCell(tmp_path, limits={"axis_monitor_deg": (30.0,) * 6})) as cell:
        robot = cell.open()
        robot.move_to(AWAY_DEG)
        with pytest.raises(DeviceError):
            robot.wait_settled()
        cell.wait_until(lambda: "no packet for" in robot.measured().fault)
        assert "AXISCORRMON" in cell.controller.fault
        assert cell.controller.brakes_closed
        cell.assert_stands()


def test_a_motion_through_a_singularity_is_refused_where_the_pose_is_corrected(tmp_path: Path) -> None:
    with closing(KukaCell(tmp_path, corrects="pose")) as cell:
        robot = cell.open()
        with pytest.raises(DeviceRefused, match="the wrist's"):
            robot.move_to(np.array([0.0, -90.0, 90.0, 0.0, -60.0, 0.0]))
        cell.assert_stands()


@pytest.mark.parametrize(("ours", "theirs"), [("absolute", "relative"), ("relative", "absolute")])
def test_a_controller_that_was_set_to_the_other_mode_ends_in_a_fault(
    tmp_path: Path, ours: str, theirs: str
) -> None:
    with closing(KukaCell(tmp_path, mode=theirs)) as cell:
        robot = cell.open(mode=ours)
        robot.move_to(AWAY_DEG)
        with pytest.raises((DeviceFault, DeviceLost)):
            robot.wait_settled()
        with pytest.raises((DeviceFault, DeviceLost)):
            robot.move_to(HOME_DEG)
        cell.wait_until(lambda: not cell.controller.moving)
        cell.assert_stands()


def test_a_workspace_that_the_arm_would_leave_stops_it(tmp_path: Path) -> None:
    workspace = {"kind": "sphere", "centre_mm": (540, 0, 915), "radius_mm": 200, "stops": "outside"}
    with closing(KukaCell(tmp_path, workspaces=(workspace,))) as cell:
        robot = cell.open()
        robot.move_to(AWAY_DEG)
        with pytest.raises(DeviceError):
            robot.wait_settled()
        cell.wait_until(lambda: "no packet for" in robot.measured().fault)
        assert "workspace 1 violated" in cell.controller.fault
        cell.assert_stands()


def test_the_drivers_motion_stays_within_a_controllers_limits_of_acceleration_and_jerk(tmp_path: Path) -> None:
    with moved_cell(tmp_path, acceleration_limit_deg_s2=301.0, jerk_limit_deg_s3=3010.0) as (cell, _):
        assert cell.controller.fault == ""


def test_a_relative_session_drifts_not_a_step_at_rest(tmp_path: Path) -> None:
    with moved_cell(tmp_path, mode="relative") as (cell, _):
        cell.in_world(lambda: cell.controller.late(20))
        cell.assert_stands()


def test_packets_of_another_sender_are_not_listened_to(tmp_path: Path) -> None:
    with closing(KukaCell(tmp_path)) as cell, socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as other:
        robot = cell.open()
        host, port = cell.address.split(":")
        robot.move_to(AWAY_DEG)
        axes = " ".join(f'A{axis}="0.0"' for axis in range(1, 7))
        for ipoc in range(10):
            other.sendto(
                f'<Rob><AIPos {axes}/><Delay D="0"/><IPOC>{ipoc}</IPOC></Rob>'.encode(), (host, int(port))
            )
        assert np.allclose(robot.wait_settled().joints_deg, AWAY_DEG, atol=1e-3)
        assert robot.statistics()["foreign_packets"] == 10


def test_packets_that_can_no_longer_be_read_are_a_lost_link(tmp_path: Path) -> None:
    with closing(KukaCell(tmp_path)) as cell:
        robot = cell.open(link_timeout_s=0.3)
        robot.move_to(AWAY_DEG)
        cell.wait_until_under_way()
        cell.in_world(lambda: setattr(cell.controller._writer, "_axes_xml", b"<Achsen %f %f %f %f %f %f/>"))
        with pytest.raises(DeviceLost, match="no packet for"):
            robot.wait_settled()
        assert robot.statistics()["malformed_packets"] > 0


def test_a_session_without_delay_counter_that_may_be_running_is_not_taken_over(tmp_path: Path) -> None:
    with closing(KukaCell(tmp_path, delay_tag="")) as cell:
        with pytest.raises(DeviceTimeout, match="another program may have begun"):
            cell.open(connect_timeout_s=2.0)
        cell.assert_stands()
