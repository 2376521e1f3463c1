"""A bench moves the arm only while a person at the cell holds the enabling switch, if the cell has one."""

from __future__ import annotations

import json
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import cells
import numpy as np
import pytest
from benches import HERE, Bench, bench, holding
from cells import CellFolder

from sim.world.client import World


def cell_with(folder: Path, switch: str, *, must_exist: bool = False) -> CellFolder:
    found = CellFolder(folder, speed=1.0)
    found.rig_data["console"] = {"at_the_cell": [HERE], "enabling_switch": must_exist}
    found.rig_data["motion"]["park_joints_deg"] = [60.0, -170.0, 150.0, 0.0, -70.0, 0.0]
    found.world_settings["ledbox"] = {"enabling_switch": switch}
    found.join()
    return found


@pytest.fixture(scope="module")
def at_cell(tmp_path_factory: pytest.TempPathFactory) -> Iterator[tuple[Bench, World]]:
    cell = cell_with(tmp_path_factory.mktemp("presence"), "released", must_exist=True)
    with cell.world(ledbox={"kind": "scpi", "enabling_switch": "released"}) as world, bench(cell.rig) as asked:
        yield asked, world


def hold(world: World, *, held: bool) -> None:
    assert "error" not in world.ask("fault", fault={"kind": "enabling_switch", "held": held})


def a1_deg(world: World) -> float:
    return float(world.ask("state")["joints_deg"][0])


def test_nothing_moves_by_hand_or_along_a_path_while_it_is_released(at_cell: tuple[Bench, World]) -> None:
    asked, world = at_cell
    hold(world, held=False)
    before_deg = a1_deg(world)
    assert asked.done("state")["arm"]["enabling_switch"] is True
    jogged = asked.ask("jog", axis="A1", direction=1, **{"from": HERE})
    path = asked.done("plan_path", to="park")
    driven = asked.ask("drive", path=path["path"])
    for found in (jogged, driven):
        assert "the enabling switch at the cell is not held" in found["error"]
    assert a1_deg(world) == before_deg


def test_a_motion_by_hand_ends_when_it_is_released(at_cell: tuple[Bench, World]) -> None:
    asked, world = at_cell
    hold(world, held=True)
    start_deg = a1_deg(world)
    with holding(asked, "A1", 1, share=0.4) as console:
        cells.wait_until(lambda: abs(a1_deg(world) - start_deg) > 1.0, "a motion")
        hold(world, held=False)
        work = asked.ended_work()
        told = console.stdout.read() if console.stdout else ""
    assert work["ended"] == "the enabling switch was released"
    assert "the enabling switch was released" in json.loads(told.splitlines()[-1])["ended"]
    rest_deg = a1_deg(world)
    time.sleep(0.3)
    assert a1_deg(world) == pytest.approx(rest_deg, abs=1e-3)
    assert world.ask("state")["arm_moving"] is False


def test_a_drive_stops_on_its_path_and_does_not_go_on_when_it_is_held_again(
    at_cell: tuple[Bench, World],
) -> None:
    asked, world = at_cell
    hold(world, held=True)
    path = asked.done("plan_path", to="park")
    start_deg = a1_deg(world)
    asked.done("drive", path=path["path"])
    cells.wait_until(lambda: abs(a1_deg(world) - start_deg) > 1.0, "a motion")
    hold(world, held=False)
    work = asked.ended_work()
    assert (work["state"], work["why"]) == ("stopped", "the enabling switch was released")
    rest_deg = a1_deg(world)
    assert abs(rest_deg - path["waypoints_deg"][-1][0]) > 1.0
    hold(world, held=True)
    time.sleep(0.3)
    assert a1_deg(world) == pytest.approx(rest_deg, abs=1e-3)


def test_a_box_that_falls_silent_counts_as_released(at_cell: tuple[Bench, World]) -> None:
    asked, world = at_cell
    hold(world, held=True)
    asked.drive("home")
    start_deg = a1_deg(world)
    with holding(asked, "A1", 1, share=0.4):
        cells.wait_until(lambda: abs(a1_deg(world) - start_deg) > 1.0, "a motion")
        world.ask("fault", fault={"kind": "mute_box", "seconds": 0.8})
        work = asked.ended_work()
    assert work["ended"] == "the enabling switch was not reported for 300 ms"


def test_a_cell_without_one_says_so_and_is_moved_all_the_same(tmp_path: Path) -> None:
    cell = cell_with(tmp_path, "none")
    with cell.world() as world, bench(cell.rig) as asked:
        assert asked.done("state")["arm"]["enabling_switch"] is False
        start = np.array(world.ask("state")["joints_deg"])
        with holding(asked, "A1", 1):
            cells.wait_until(lambda: abs(a1_deg(world) - start[0]) > 0.5, "a motion")
        report: Any = asked.done("self_test", device="ledbox")["report"]
        assert report["enabling switch"] == "no input for one"


def test_a_cell_whose_rig_has_one_is_not_moved_by_a_box_without_input(tmp_path: Path) -> None:
    cell = cell_with(tmp_path, "none", must_exist=True)
    with cell.world(), bench(cell.rig) as asked:
        found = asked.ask("jog", axis="A1", direction=1, **{"from": HERE})
    assert "the rig has an enabling switch" in found["error"]
