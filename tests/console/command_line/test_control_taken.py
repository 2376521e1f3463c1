"""Control of a cell that another person takes while the arm is driven."""

from __future__ import annotations

import json
import signal
import subprocess
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import cells
import numpy as np
import pytest
from cells import CellFolder
from served import Browser, served

from coupole.acquisition.cell_bench.bench_client import ask_bench
from coupole.console.cell.acquisitions import Acquisitions
from coupole.console.cell.bench_keeper import Bench
from coupole.console.people.accounts import Account, Role
from coupole.console.people.sessions import Control
from coupole.console.plans.plan_files import PlanFiles
from coupole.console.plans.plan_queue import PlanQueue
from coupole.plan.cell import read_cell
from sim.world.client import World

NOT_THERE_DEG = 3.0
"""Farther from its goal than this, an arm has not arrived."""


class Driven:
    """A cell whose arm takes its time, its console, and an engineer at its page."""

    def __init__(self, cell: CellFolder, world: World, engineer: Browser) -> None:
        self.cell, self.world, self.engineer, self.endings = cell, world, engineer, 0

    def is_moving(self) -> bool:
        return bool(self.world.ask("state")["arm_moving"])

    def off_deg(self, goal: str) -> float:
        """How far the arm is from home or park."""
        motion = read_cell(self.cell.rig).rig.motion
        goal_deg = motion.home_joints_deg if goal == "home" else motion.park_joints_deg
        return float(np.abs(np.array(self.world.ask("state")["joints_deg"]) - goal_deg).max())

    @contextmanager
    def driving(self, goal: str) -> Iterator[subprocess.Popen[str]]:
        """`coupole arm` with its arm under way; it stands at the end."""
        drive = cells.start("arm", self.cell.rig, goal, "--yes")
        cells.wait_until(self.is_moving, "the arm under way")
        yield drive
        cells.wait_until(lambda: not self.is_moving(), "the arm at rest")

    def takes_control(self, by: str) -> None:
        """Another person has control, who takes it, or who does something while nobody has it."""
        if by == "taking it":
            assert self.engineer.post("/api/v1/control/take").status == 200
        else:
            assert self.engineer.post("/api/v1/queue", {"hold": "lunch"}).status == 200

    def ending_is_logged(self) -> bool:
        """Tell whether the console's log has the end of a drive, once since this was asked before."""
        log = self.cell.folder / "storage/state/console/audit.jsonl"
        lines = [json.loads(line) for line in log.read_text().splitlines()]
        found = [line for line in lines if line.get("about") == "arm to park, under way"]
        new, self.endings = found[self.endings :], len(found)
        return [(line["status"], line["name"].endswith("(command line)")) for line in new] == [(409, True)]


@pytest.fixture(scope="module")
def driven(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Driven]:
    cell = CellFolder(tmp_path_factory.mktemp("driven"), speed=1.0)
    cell.rig_data["motion"]["speed_fraction"] = 0.05
    cell.join()
    cell.write()
    with cell.world() as world, served(cell) as service:
        yield Driven(cell, world, service.browser(token=service.token))


@pytest.fixture(autouse=True)
def nobody_in_control(driven: Driven) -> None:
    """The arm is at home, and nobody in control, before each test."""
    driven.engineer.post("/api/v1/control/take")
    assert driven.engineer.post("/api/v1/control/give", {}).status == 200
    queue = driven.cell.folder / "storage/state/console/queue.json"
    cells.wait_until(
        lambda: not queue.exists() or '"waiting"' not in queue.read_text(),
        "a queue that has nothing left to begin",
    )
    assert cells.here("arm", driven.cell.rig, "home", "--yes").code == 0


@pytest.fixture
def opened(driven: Driven) -> Iterator[None]:
    bench = cells.start("bench", driven.cell.rig, "--yes", "--json", stderr=subprocess.DEVNULL)
    assert bench.stdout is not None
    assert bench.stdout.readline()
    yield
    bench.send_signal(signal.SIGINT)
    assert cells.finish(bench).code == 0


@pytest.mark.parametrize("by", ["taking it", "acting"])
def test_an_arm_that_is_driven_stops_when_another_person_takes_control(driven: Driven, by: str) -> None:
    with driven.driving("park") as drive:
        driven.takes_control(by)
    ended = cells.finish(drive)
    assert (ended.code, "first engineer took control" in ended.err) == (130, True), ended
    assert driven.off_deg("park") > NOT_THERE_DEG
    assert driven.ending_is_logged()


def test_an_arm_of_an_open_bench_stops_when_another_person_takes_control(driven: Driven, opened: None) -> None:
    with driven.driving("park") as drive:
        driven.takes_control("taking it")
    ended = cells.finish(drive)
    assert (ended.code, "first engineer took control" in ended.err) == (130, True), ended
    assert driven.off_deg("park") > NOT_THERE_DEG
    assert driven.ending_is_logged()
    work = ask_bench(read_cell(driven.cell.rig), "state")["work"]
    assert (work["state"], "first engineer took control" in work["why"]) == ("stopped", True), work


def test_an_arm_that_is_driven_stops_though_control_is_given_back_at_once(driven: Driven) -> None:
    """Between two questions of the command: it asks every 0.1 s who is in control."""
    with driven.driving("park") as drive:
        driven.takes_control("taking it")
        assert driven.engineer.post("/api/v1/control/give", {}).status == 200
    ended = cells.finish(drive)
    assert (ended.code, "first engineer took control" in ended.err) == (130, True), ended
    assert driven.off_deg("park") > NOT_THERE_DEG


ADA, MAX = (Account(name, Role.ENGINEER) for name in ("Ada", "Max"))


@pytest.mark.parametrize(
    ("taken_by", "gives_back", "state"),
    [(MAX, False, "stopped"), (MAX, True, "stopped"), (ADA, False, "done"), (None, False, "done")],
    ids=["other", "other for a moment", "same", "nobody"],
)
def test_a_drive_that_a_person_began_at_the_page_ends_when_another_one_takes_control(
    driven: Driven, opened: None, tmp_path: Path, taken_by: Account | None, gives_back: bool, state: str
) -> None:
    cell, control = read_cell(driven.cell.rig), Control()
    control.take(ADA)
    acquisitions = Acquisitions(PlanQueue(tmp_path / "queue.json"), cell, tmp_path / "output")
    plans = PlanFiles(tmp_path, driven.cell.rig, tmp_path / "drawings")
    with Bench(cell, acquisitions, plans, tmp_path, control=control) as bench:
        bench.drive(bench.ask("plan_path", to="park")["path"], "Ada")
        cells.wait_until(driven.is_moving, "the arm under way")
        if taken_by is None:
            control.give(ADA, "")
        else:
            control.take(taken_by)
        if gives_back and taken_by is not None:
            control.give(taken_by, "")
        work = cells.wait_until(
            lambda: (now := bench.ask("state")["work"])["state"] != "running" and now, "its end"
        )
    assert (work["state"], "Max took control" in work["why"]) == (state, taken_by is MAX), work
    assert (driven.off_deg("park") > NOT_THERE_DEG) is (taken_by is MAX)
