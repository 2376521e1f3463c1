"""A process that does not run: the arm brakes, lamps go dark, and a person is asked."""

from __future__ import annotations

import os
import random
import signal
import time
from datetime import date
from pathlib import Path

import cells
import freezing
import numpy as np
import pytest
from cells import SIDE, TOP
from freezing import Freeze
from ur import needs_ur_rtde

from coupole.acquisition.cell_bench.bench_client import ask_bench
from coupole.plan.cell import read_cell

ARMS = [
    "rsi",
    pytest.param("eki", marks=pytest.mark.full),
    pytest.param("ur", marks=(needs_ur_rtde, pytest.mark.full)),
]
TODAY = date.today().toordinal()
SLACK_DEG = 0.3
"""Four turns of an answering process that lag behind: some 0.08 s at this speed."""


@pytest.mark.parametrize("arm", ARMS)
def test_a_frozen_controller_leaves_no_arm_in_motion_and_no_lamp_on_and_asks(tmp_path: Path, arm: str) -> None:
    """Frozen in a motion, then in a burst, at moments of the day's draw; the run is done all the same."""
    cell, draw = freezing.cell_in(tmp_path, arm), random.Random(TODAY)
    with freezing.running(cell, arm) as (world, process):
        for moving in (True, False):
            assert freezing.moment(world, process, draw, moving=moving)
            seen = freezing.freeze(world, process.pid, Freeze(arm, "controller", moving))
            assert seen.wrong == [], seen
            assert freezing.go_on(cell.run_folder, process)
        ended = cells.finish(process)
    assert ended.code == 0, ended.err
    held = [fault for fault in cells.events(cell.run_folder, "fault") if fault["kind"] == "Held"]
    assert len(held) >= 2  # a busy machine may freeze it once more
    assert all("the program did not run for" in fault["message"] for fault in held)
    cells.assert_each_shot_proven_once(cell.run_folder)


@pytest.mark.parametrize("arm", ["rsi", pytest.param("ur", marks=(needs_ur_rtde, pytest.mark.full))])
def test_a_frozen_process_of_the_arm_ends_the_run_with_a_fault_and_the_arm_at_rest(
    tmp_path: Path, arm: str
) -> None:
    cell = freezing.cell_in(tmp_path, arm)
    with freezing.running(cell, arm) as (world, process):
        assert freezing.moment(world, process, random.Random(TODAY), moving=True)
        pid = freezing.frozen_pid(process, "arm's process")
        assert pid != process.pid
        seen = freezing.freeze(world, pid, Freeze(arm, "arm's process", while_moving=True))
        ended = cells.finish(process)
        assert seen.wrong == [], seen
        assert not world.ask("state")["arm_moving"]
    assert ended.code == 4
    assert f"first   coupole confirm {cell.rig} --name NAME" in ended.err
    told = cells.here("status", cell.run_folder, "--json").document
    assert told["go_on"]
    assert told["before_that"] == f"coupole confirm {cell.rig} --name NAME"
    assert cells.events(cell.run_folder, "fault")[0]["device"] == "robot"
    assert not cells.alive(pid)


def test_an_arm_that_is_driven_by_hand_does_not_move_again_after_a_freeze(tmp_path: Path) -> None:
    """Not even before the process has heard of SIGCONT: the motion is ended, not asked anew."""
    cell = freezing.cell_in(tmp_path, "rsi")
    plan = str(cell.plan)
    with freezing.world_of(cell, "rsi") as world:
        for view in (TOP["name"], SIDE["name"], TOP["name"]):
            process = cells.start("arm", cell.rig, "view", plan, view, "--yes")
            assert freezing.moment(world, process, random.Random(TODAY), moving=True)
            freezing.freeze(world, process.pid, Freeze("rsi", "controller", while_moving=True))
            at_once = world.ask("state")["joints_deg"]
            ended = cells.finish(process)
            assert ended.code == 130, ended.err
            assert "the program did not run for" in ended.err
            turned_deg = np.abs(np.subtract(world.ask("state")["joints_deg"], at_once)).max()
            assert turned_deg < SLACK_DEG


def test_a_metering_that_was_frozen_ends_as_nobody_can_let_it_go_on(tmp_path: Path) -> None:
    cell = freezing.cell_in(tmp_path, "rsi")
    with freezing.world_of(cell, "rsi") as world:
        process = cells.start("meter", cell.plan, "--yes")
        assert freezing.moment(world, process, random.Random(TODAY), moving=True)
        freezing.freeze(world, process.pid, Freeze("rsi", "controller", while_moving=True))
        ended = cells.finish(process)
        assert cells.safe(world)
    assert ended.code == 130, ended.err
    assert "the program did not run for" in ended.err


def test_a_bench_that_is_closed_and_not_sure_of_its_arm_ends_with_4_and_the_fault_stands(tmp_path: Path) -> None:
    """The process that answers the arm is frozen, at rest: the stop that a close asks for is not confirmed."""
    cell = freezing.cell_in(tmp_path, "rsi")
    with freezing.world_of(cell, "rsi"):
        bench = cells.start("bench", cell.rig, "--yes", "--json")
        assert bench.stdout is not None
        assert bench.stdout.readline()
        pid = freezing.frozen_pid(bench, "arm's process")
        assert pid != bench.pid
        os.kill(pid, signal.SIGSTOP)
        time.sleep(2.0)
        trouble = ask_bench(read_cell(cell.rig), "close")["trouble"]
        ended = cells.finish(bench)
        assert any("arm stopped" in words for words in trouble), trouble
        assert ended.code == 4
        refused = cells.here("arm", cell.rig, "home", "--yes")
    assert refused.code == 4, refused.err
    assert f"coupole confirm {cell.rig}" in refused.err


def test_ctrl_z_makes_the_cell_safe_before_the_process_stops_and_the_run_asks_when_it_goes_on(
    tmp_path: Path,
) -> None:
    cell = freezing.cell_in(tmp_path, "rsi")
    with freezing.running(cell, "rsi") as (world, process):
        assert freezing.moment(world, process, random.Random(TODAY), moving=True)
        process.send_signal(signal.SIGTSTP)
        cells.wait_until(lambda: _stopped(process.pid), "a stopped process")
        state = world.ask("state")
        assert not state["shining"]
        time.sleep(0.3)
        assert np.allclose(world.ask("state")["joints_deg"], state["joints_deg"], atol=1e-3)
        assert not world.ask("state")["arm_moving"]
        process.send_signal(signal.SIGCONT)
        assert freezing.go_on(cell.run_folder, process)
        ended = cells.finish(process)
    assert ended.code == 0, ended.err
    (held,) = [fault for fault in cells.events(cell.run_folder, "fault") if fault["kind"] == "Held"]
    assert held["message"].startswith("suspended by Ctrl-Z")
    cells.assert_each_shot_proven_once(cell.run_folder)


def _stopped(pid: int) -> bool:
    return Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[0] == "T"
