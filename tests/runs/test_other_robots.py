"""Runs with the arm on another wire, or with another arm: each is as good as RSI; what nothing describes stays."""

from __future__ import annotations

from contextlib import nullcontext
from pathlib import Path
from typing import Any

import cells
import pytest
from cells import SIDE, TOP, CellFolder
from expected_pictures import mislabelled
from gige import gige_port, needs_aravis
from ur import needs_ur_rtde

from coupole.plan.cell import read_cell
from coupole.plan.rig_devices import planning_arm

EKI = "drivers.kuka.eki:KukaEki"
UR = "drivers.ur:UrRobot"


@pytest.fixture
def eki(cell: CellFolder) -> CellFolder:
    """A small cell whose arm hangs on EthernetKRL."""
    cell.rig_data["robot"] = {"driver": EKI}
    cell.write(views=[TOP, SIDE])
    return cell


@pytest.mark.parametrize(
    "name",
    [
        "sim",
        pytest.param("sim-gige", marks=needs_aravis),
        pytest.param("sim-eki", marks=pytest.mark.full),
        pytest.param("sim-ur", marks=(needs_ur_rtde, pytest.mark.full)),
        pytest.param("sim-ur5e", marks=needs_ur_rtde),
    ],
)
def test_the_devices_of_each_shipped_rig_open_and_test_themselves(name: str) -> None:
    with gige_port() if name == "sim-gige" else nullcontext():
        ended = cells.command("devices", "--rig", cells.REPO / f"configs/rigs/{name}.yaml")
    assert ended.code == 0, ended.err
    assert ended.err.count("simulated") >= 3


def test_a_plan_runs_through_ethernetkrl(eki: CellFolder) -> None:
    ended = eki.acquire()
    assert ended.code == 0, ended.err
    run = eki.run_folder
    cells.assert_each_shot_proven_once(run)
    assert mislabelled(eki, run) == []
    (stop,) = cells.events(run, "stop")
    assert stop["robot"]["statuses"] > 0


def test_a_plan_is_rehearsed_through_ethernetkrl_faster_than_life(eki: CellFolder) -> None:
    """The rig of real devices, none of which is there: the rehearsal brings its own, of the same kind."""
    eki.rig_data["ledbox"]["settings"]["port"] = "/dev/ttyNOPE"
    eki.rig_data["camera"]["settings"] = {"address": "/nowhere"}
    eki.rig_data["robot"]["settings"] = {"address": "192.0.2.1:54600"}
    eki.rig_data["world"] = {"serves": "dry_run"}
    eki.write(lights={"kind": "all"})
    ended = eki.acquire("--dry-run", "--speed", "20")
    assert ended.code == 0, ended.err
    found = ended.document
    assert (found["proven"], found["missing"]) == (2160, 0)
    # Twenty times faster than life, a busy machine is late; never is it early.
    assert 0.9 < found["duration_s"] / found["preflight_s"] < 1.6


@pytest.mark.parametrize(
    ("fault", "words"),
    [
        ({"kind": "emergency_stop"}, "emergency stop"),
        ({"kind": "rsi_link_loss", "seconds": 60.0}, "link lost"),
    ],
    ids=["emergency-stop", "link-loss"],
)
def test_a_fault_of_the_controller_in_a_burst_ends_the_run_with_four_and_a_safe_cell(
    tmp_path: Path, fault: dict[str, Any], words: str
) -> None:
    cell = CellFolder(tmp_path, speed=1.0)
    cell.rig_data["robot"] = {"driver": EKI, "settings": {"link_timeout_s": 1.0}}
    cell.join()
    cell.write(lights={"kind": "every", "every": 4})
    with cell.world({**fault, "at_edge": 20}) as world:
        ended = cell.acquire()
        cells.wait_until(lambda: cells.safe(world), "a safe cell")
    assert ended.code == 4, ended
    assert "robot: expected" in ended.err
    assert words in ended.err


def test_an_arm_pushed_in_a_burst_has_it_taken_again(eki: CellFolder) -> None:
    eki.write(views=[TOP], lights={"kind": "every", "every": 4})
    eki.faults({"kind": "nudge_arm", "deg": 0.05, "seconds": 1.0, "at_edge": 100})
    ended = eki.acquire()
    assert ended.code == 0, ended.err
    run = eki.run_folder
    assert cells.reshot(run)
    assert [event["kind"] for event in cells.events(run, "fault")] == ["ArmMoved"]
    cells.assert_each_shot_proven_once(run)
    assert mislabelled(eki, run) == []


def test_late_rsi_answers_cannot_happen_without_rsi(eki: CellFolder) -> None:
    eki.faults({"kind": "late_rsi"})
    ended = eki.acquire()
    assert ended.code == 2
    assert "rig.yaml:" in ended.err
    assert "no RSI answers" in ended.err


def test_nor_can_they_be_asked_of_a_world_that_runs(eki: CellFolder) -> None:
    with eki.world() as world:
        assert "has no RSI answers" in world.ask("fault", fault={"kind": "late_rsi"})["error"]
        assert "t_s" in world.ask("state")


@pytest.mark.parametrize(
    ("robot", "says"),
    [
        ({"kind": "rsi"}, "world.settings.robot.kind: expected eki"),
        ({"cycle_ms": 4}, "world.settings.robot.cycle_ms: unknown key"),
    ],
    ids=["kind", "setting"],
)
def test_the_stand_in_is_that_of_the_driver(eki: CellFolder, robot: dict[str, Any], says: str) -> None:
    eki.world_settings["robot"] = robot
    eki.write()
    ended = eki.acquire()
    assert ended.code == 2
    assert says in ended.err


def test_motions_that_the_controller_cannot_be_asked_for_are_found_when_the_rig_is_read(eki: CellFolder) -> None:
    eki.rig_data["motion"]["acceleration_deg_s2"] = 700
    eki.write()
    ended = eki.acquire()
    assert ended.code == 2
    assert "acceleration 116 % of the controller's own" in ended.err


def test_a_world_with_a_ur_does_not_run_at_another_speed_than_life(cell: CellFolder) -> None:
    cell.rig_data["robot"] = {"driver": UR}
    cell.write()
    ended = cell.acquire()
    assert ended.code == 2
    assert "ur-rtde works in real time" in ended.err


@pytest.mark.parametrize(("model", "views"), [("ur5e", [TOP]), ("ur10e", [TOP, SIDE])])
def test_a_plan_runs_on_a_ur(tmp_path: Path, model: str, views: list[dict[str, Any]]) -> None:
    pytest.importorskip("rtde_control", reason="ur-rtde is an optional extra")
    cell = CellFolder(tmp_path, speed=1.0)
    cell.moved_by_ur(model)
    cell.write(views=views)
    ended = cell.acquire()
    assert ended.code == 0, ended.err
    cells.assert_each_shot_proven_once(cell.run_folder)
    assert mislabelled(cell, cell.run_folder) == []
    assert cells.about(cell.run_folder)["devices"]["robot"]["model"] == model.upper().removesuffix("E")


def test_a_controller_of_another_arm_than_the_plans_is_refused(tmp_path: Path) -> None:
    pytest.importorskip("rtde_control", reason="ur-rtde is an optional extra")
    cell = CellFolder(tmp_path, speed=1.0)
    cell.moved_by_ur("ur10e")
    cell.world_settings["robot"] = {"model": "ur5e"}
    cell.write()
    ended = cell.acquire()
    assert ended.code == 4
    assert "expected a UR10e, as the rig has it; the controller says that it moves a UR5" in ended.err


def test_a_plan_for_an_arm_that_nothing_describes_is_refused_before_a_device_is_touched(tmp_path: Path) -> None:
    cell = CellFolder(tmp_path, speed=1.0)
    cell.rig_data["robot"] = {"driver": "drivers.ur.driver:UrRobot"}
    cell.world_settings["robot"] = {"kind": "ur"}
    cell.write()
    ended = cell.acquire()
    assert ended.code == 2
    assert "arm: expected the file of the arm that `drivers.ur.driver:UrRobot` moves" in ended.err


def test_the_planned_arm_has_the_speeds_of_rig_and_driver() -> None:
    rig = read_cell(cells.REPO / "configs/rigs/sim-eki.yaml").rig
    arm = planning_arm(rig)
    assert arm is not None
    assert arm.velocity_deg_s[0] == pytest.approx(0.3 * 300)


def test_the_planned_ur_has_the_leading_joints_speed_and_the_limits_of_its_driver() -> None:
    rig = read_cell(cells.REPO / "configs/rigs/sim-ur.yaml").rig
    narrowed = {**rig.robot.settings, "limits_deg": [[-170, 200], *[[-360, 360]] * 5]}
    arm = planning_arm(rig.model_copy(update={"robot": rig.robot.model_copy(update={"settings": narrowed})}))
    assert arm is not None
    assert arm.velocity_deg_s == pytest.approx((0.3 * 120.0,) * 6)
    assert arm.limits_deg[0] == (-170.0, 200.0)
