"""What can go wrong with the arm in a run: it is noticed and named, and nothing moves until a person says so."""

from __future__ import annotations

import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any
from unittest import mock

import cells
import pytest
from cells import SIDE, TOP, CellFolder
from expected_pictures import mislabelled
from failures import MORE_LIGHTS, assert_complete_once_mended, assert_told, fail_in_a_burst

from coupole.errors import DeviceLost
from coupole.storage.arm_faults import ArmFaults
from drivers.kuka.rsi import KukaRsi
from sim.world.client import World

ROBOT_FAULTS = pytest.mark.parametrize(
    "fault",
    [
        {"kind": "emergency_stop"},
        pytest.param({"kind": "late_rsi"}, marks=pytest.mark.full),
        {"kind": "rsi_link_loss", "seconds": 60.0},
    ],
    ids=lambda fault: str(fault["kind"]),
)


@pytest.fixture
def joining(cell: CellFolder) -> CellFolder:
    """A cell of one view whose world is kept by the test."""
    cell.join()
    return cell


@pytest.fixture
def lifelike(tmp_path: Path) -> CellFolder:
    """The same at the pace of life, with a burst that is long enough for a silent robot to be given up in it."""
    cell = CellFolder(tmp_path, speed=1.0)
    cell.rig_data["robot"]["settings"] = {"link_timeout_s": 1.0}
    cell.join()
    cell.write(lights=MORE_LIGHTS)
    return cell


@contextmanager
def _once(world: World, condition: Callable[[dict[str, Any]], bool], fault: dict[str, Any]) -> Iterator[None]:
    """Let `fault` happen when the world's state first meets `condition`, while the body runs."""

    def watch() -> None:
        cells.wait_until(lambda: condition(world.ask("state")), "the moment of a fault")
        world.ask("fault", fault=fault)

    watcher = threading.Thread(target=watch)
    watcher.start()
    try:
        yield
    finally:
        watcher.join()


def _moves(state: dict[str, Any]) -> bool:
    return bool(state["arm_moving"])


@ROBOT_FAULTS
def test_a_robot_that_fails_in_a_burst_ends_the_run_with_four_and_a_safe_cell(
    lifelike: CellFolder, fault: dict[str, Any]
) -> None:
    ended = fail_in_a_burst(lifelike, fault)
    assert_told(lifelike, ended, "robot")
    lifelike.confirm()
    assert_complete_once_mended(lifelike)


@ROBOT_FAULTS
def test_a_robot_that_fails_in_a_motion_ends_the_run_with_four_and_is_resumed_after_a_reset(
    joining: CellFolder, fault: dict[str, Any]
) -> None:
    with joining.world() as world:
        with _once(world, _moves, fault | ({"seconds": 5.0} if "seconds" in fault else {})):
            ended = joining.acquire()
        cells.wait_until(lambda: cells.safe(world), "a safe cell")
        assert_told(joining, ended, "robot")
        assert cells.events(joining.run_folder, "burst") == []
        world.ask("reset_robot")
        joining.confirm()
        resumed = joining.acquire("--resume", joining.run_folder)
    assert resumed.code == 0, resumed.err
    cells.assert_each_shot_proven_once(joining.run_folder)
    assert mislabelled(joining, joining.run_folder) == []


def test_a_latched_emergency_stop_is_not_run_over_until_it_is_reset(joining: CellFolder) -> None:
    with joining.world() as world:
        with _once(world, _moves, {"kind": "emergency_stop"}):
            assert joining.acquire().code == 4
        joining.confirm()
        assert joining.acquire("--resume", joining.run_folder).code == 4
        assert cells.events(joining.run_folder, "burst") == []


def test_after_a_fault_of_the_arm_nothing_moves_without_a_persons_word_and_yes_does_not_give_it(
    joining: CellFolder,
) -> None:
    with joining.world() as world:
        with _once(world, _moves, {"kind": "emergency_stop"}):
            joining.acquire()
        world.ask("reset_robot")
        before = world.ask("state")["joints_deg"]
        run = joining.run_folder
        for again in (("--resume", run), ("--output", joining.folder / "elsewhere")):
            ended = joining.acquire(*again, "--yes", typed="y\n")
            assert ended.code == 4, ended
            assert "robot: expected a confirmation by a person" in ended.document["error"]
            assert "emergency stop" in ended.err
        live = cells.here("live", joining.plan, "--yes")
        assert live.code == 4, live
        assert cells.here("meter", joining.plan, "--yes").code == 4
        assert world.ask("state")["joints_deg"] == before
    assert cells.events(run, "resume") == []
    assert not (joining.folder / "elsewhere").exists()


def test_a_word_without_a_name_is_none(joining: CellFolder) -> None:
    ArmFaults(joining.folder / "storage" / "state").note("emergency stop")
    assert cells.here("confirm", joining.rig, "--name", " ").code == 2
    assert cells.here("confirm", joining.rig).code == 2
    assert joining.acquire().code == 4


def test_the_word_is_kept_in_the_journal_and_asked_for_once(joining: CellFolder) -> None:
    joining.write(views=[TOP, SIDE])
    with joining.world() as world:
        with _once(world, _moves, {"kind": "emergency_stop"}):
            joining.acquire()
        world.ask("reset_robot")
        run = joining.run_folder
        joining.confirm()
        with _once(world, lambda state: bool(state["shining"]), {"kind": "unplug_camera"}):
            assert joining.acquire("--resume", run).code == 4
    (resumed,) = cells.events(run, "resume")
    assert "emergency stop" in resumed["acknowledged"]
    assert "an operator" in resumed["acknowledged"]
    with joining.world():
        assert joining.acquire("--resume", run).code == 0
    assert cells.events(run, "resume")[-1]["acknowledged"] == ""


def test_an_arm_that_is_not_confirmed_to_be_at_rest_counts_as_a_fault_of_the_cell(joining: CellFolder) -> None:
    class Deaf(KukaRsi):
        def stop(self) -> None:
            raise DeviceLost("robot", expected="an answer", happened="there was none", remedy="Look at it.")

    joining.faults({"kind": "unplug_camera", "at_edge": 20})
    with joining.world({"kind": "unplug_camera", "at_edge": 20}), mock.patch("drivers.kuka.rsi.KukaRsi", Deaf):
        ended = joining.acquire()
    assert ended.code == 4
    assert "not sure that it is safe (arm stopped)" in ended.err
    (fault,) = ArmFaults(joining.folder / "storage" / "state").standing()
    assert "arm stopped" in fault.message
    with joining.world():
        assert "confirmation by a person" in joining.acquire("--resume", joining.run_folder).err


def test_an_arm_pushed_in_a_burst_that_springs_back_has_just_that_burst_taken_again(joining: CellFolder) -> None:
    """The other view stays as it was taken. So do the frames that were proven before the push; on a busy machine
    there may be none."""
    joining.write(views=[TOP, SIDE], lights=MORE_LIGHTS, order="as_written")
    first_edge = 270 + 12  # of the second view
    edge = first_edge + 100
    with joining.world({"kind": "nudge_arm", "deg": 0.05, "seconds": 1.0, "at_edge": edge}):
        ended = joining.acquire()
    run = joining.run_folder
    assert ended.code == 0, ended.err
    (moved,) = cells.events(run, "fault")
    assert moved["kind"] == "ArmMoved"
    assert moved["message"].startswith("side")
    assert {shot.split("/")[0] for shot in cells.reshot(run)} == {"side"}
    cells.assert_each_shot_proven_once(run)
    assert mislabelled(joining, run) == []
    side = [frame.record for shot, frame in cells.stored(run).items() if shot.startswith("side/")]
    assert all(record["step"] < edge - first_edge for record in side if record["pose"] == 0)
    assert 1 in {int(record["pose"]) for record in side} <= {0, 1}


def test_an_arm_that_stays_pushed_is_never_driven_back_unasked(joining: CellFolder) -> None:
    """A person may be what pushed it. It stays where it is, in the dark, until there is a word."""
    joining.write(lights=MORE_LIGHTS)
    with joining.world({"kind": "nudge_arm", "deg": 0.3, "at_edge": 100}) as world:
        ended = joining.acquire()
        pushed_deg = world.ask("state")["joints_deg"]
        assert cells.safe(world)
        assert_told(joining, ended, "robot")
        assert "has not come back by itself" in ended.err
        run = joining.run_folder
        stood_deg = cells.events(run, "settled")[-1]["joints_deg"]
        assert min(abs(a - b) for a, b in zip(pushed_deg, stood_deg, strict=True)) > 0.2
        assert joining.acquire("--resume", run).code == 4
        assert world.ask("state")["joints_deg"] == pushed_deg
        joining.confirm()
        assert joining.acquire("--resume", run).code == 0
    cells.assert_each_shot_proven_once(run)
    assert mislabelled(joining, run) == []


def test_where_the_arm_stood_before_and_after_each_burst_is_in_the_journal(joining: CellFolder) -> None:
    with joining.world() as world:
        assert joining.acquire().code == 0
        stands_deg = world.ask("state")["joints_deg"]
    (burst,) = cells.events(joining.run_folder, "burst")
    assert burst["joints_before_deg"] == pytest.approx(stands_deg, abs=2e-3)
    assert burst["joints_after_deg"] == pytest.approx(stands_deg, abs=2e-3)
    (stop,) = cells.events(joining.run_folder, "stop")
    assert stop["robot"]["late_answers"] == 0


def test_an_arm_that_leaves_its_way_is_stopped(joining: CellFolder) -> None:
    """Pushed by less than the driver calls not following, but by more than the way was found clear for."""
    with joining.world() as world:
        with _once(world, _moves, {"kind": "nudge_arm", "deg": 0.9}):
            ended = joining.acquire()
        cells.wait_until(lambda: cells.safe(world), "a safe cell")
    assert_told(joining, ended, "robot")
    assert "path that was checked" in ended.document["error"]
    assert cells.events(joining.run_folder, "burst") == []
