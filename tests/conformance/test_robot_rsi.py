"""What every Robot must do, run on the RSI driver; and what this one must do besides."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
from collections.abc import Iterator
from contextlib import closing
from pathlib import Path

import numpy as np
import pytest
from robot_conformance import AWAY_DEG, HOME_DEG, KukaCell, RobotConformance

from coupole.errors import DeviceError, DeviceFault, DeviceLost, DeviceTimeout


class TestKukaRsi(RobotConformance):
    @pytest.fixture(params=[4, 12], ids=["4ms", "12ms"])
    def cell(self, request: pytest.FixtureRequest, tmp_path: Path) -> Iterator[KukaCell]:
        with closing(KukaCell(tmp_path, request.param)) as cell:
            yield cell

    def test_a_few_late_answers_are_counted_and_survived(self, cell: KukaCell) -> None:
        robot = cell.open()
        robot.move_to(AWAY_DEG)
        cell.wait_until_under_way()
        cell.in_world(lambda: cell.controller.late(5))
        assert np.allclose(robot.wait_settled().joints_deg, AWAY_DEG, atol=1e-3)
        assert robot.statistics()["late_answers"] == 5

    def test_many_late_answers_are_a_fault(self, cell: KukaCell) -> None:
        robot = cell.open()
        robot.move_to(AWAY_DEG)
        cell.wait_until_under_way()
        cell.in_world(lambda: cell.controller.late(70))
        with pytest.raises(DeviceFault, match="late answers"):
            robot.wait_settled()
        robot.stop()
        cell.clock.sleep(0.1)
        cell.wait_until(lambda: not cell.controller.moving)
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
            "from sim.clock import SharedClock; from drivers.kuka_rsi import KukaRsi, Settings\n"
            "robot = KukaRsi(Settings.model_validate_json(sys.argv[1]), SharedClock(Path(sys.argv[2])))\n"
            f"robot.move_to(numpy.array({AWAY_DEG.tolist()}))\n"
            "print(robot._process.pid, flush=True)\n"
            "time.sleep(60)\n"
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
