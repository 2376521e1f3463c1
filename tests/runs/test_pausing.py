"""A running acquisition that is paused, continued, followed and stopped, by a signal and from another terminal."""

from __future__ import annotations

import signal
import subprocess
import time
from collections.abc import Iterator
from pathlib import Path

import cells
import pytest
from cells import CellFolder
from real_cells import true_dose_lux_h

from sim.world.client import World


@pytest.fixture
def standing(tmp_path: Path) -> Iterator[tuple[CellFolder, World]]:
    """A cell whose world outlives its controllers, and a plan of several bursts."""
    cell = CellFolder(tmp_path, speed=2.0)
    cell.join()
    cell.write(lights=cells.SOME_LIGHTS, repeats=4)
    with cell.world() as world:
        yield cell, world


def under_way(cell: CellFolder) -> tuple[subprocess.Popen[str], Path]:
    """A run that has proven frames."""
    process = cell.start_acquire()
    run = cell.run_folder
    cells.wait_until(lambda: cells.frame_lines(run) > 0, "proven frames")
    return process, run


def test_a_run_pauses_between_bursts_and_goes_on(standing: tuple[CellFolder, World]) -> None:
    cell, world = standing
    process, run = under_way(cell)
    process.send_signal(signal.SIGUSR1)
    cells.wait_until(lambda: cells.events(run, "pause"), "the pause")
    assert cells.here("status", run, "--json").document["state"] == "paused"
    paused_at = cells.frame_lines(run)
    assert cells.safe(world)
    time.sleep(0.5)
    assert cells.frame_lines(run) == paused_at < 4 * 54
    process.send_signal(signal.SIGUSR1)
    assert cells.finish(process).code == 0
    kinds = [event["event"] for event in cells.events(run)]
    assert kinds.index("pause") < kinds.index("continue") < kinds.index("stop")
    cells.assert_each_shot_proven_once(run)


def test_a_paused_run_can_be_stopped(standing: tuple[CellFolder, World]) -> None:
    cell, world = standing
    process, run = under_way(cell)
    paused = cells.here("pause", run, "--json")
    assert (paused.code, paused.document["state"], paused.document["pid"]) == (0, "paused", process.pid)
    assert cells.events(run, "pause")
    assert cells.safe(world)
    verified = cells.here("verify", run)
    assert verified.code == 5
    assert (
        f"process {process.pid} is at work on this run: verify it again when this process has ended"
        in verified.err
    )
    assert "--resume" not in verified.err
    stopped = cells.here("stop", run, "--json")
    assert (stopped.code, stopped.document["state"]) == (0, "interrupted"), stopped.err
    assert stopped.document["reason"].startswith("stopped by the operator (`coupole stop`")
    assert cells.safe(world)
    assert cells.finish(process).code == 130
    ended = cells.here("go-on", run)
    assert ended.code == 2
    assert "no process of this user acquires into this run" in ended.err


def test_a_run_is_followed_from_another_terminal_and_stopped_in_a_burst(
    standing: tuple[CellFolder, World],
) -> None:
    cell, world = standing
    process = cell.start_acquire()
    run = cell.run_folder
    follower = cells.start("status", run, "--follow")
    cells.wait_until(lambda: cells.frame_lines(run) > 0, "proven frames")
    stopped = cells.here("stop", run)
    assert stopped.code == 0, stopped.err
    assert "lights are off, the arm is at rest, the camera is disarmed" in stopped.err
    assert cells.safe(world)
    assert cells.finish(process).code == 130
    seen = cells.finish(follower)
    assert seen.code == 0
    assert "interrupted: " in seen.err
    assert f"--resume {run}" in " ".join(seen.err.split())


def test_who_asks_a_run_that_was_frozen_in_a_burst_is_told_the_figures_of_its_journal(
    standing: tuple[CellFolder, World],
) -> None:
    cell, world = standing
    process = cell.start_acquire()
    run = cell.run_folder
    cells.wait_until(
        lambda: len(cells.events(run, "burst")) > 1 and world.ask("state")["shining"], "a burst's light"
    )
    process.send_signal(signal.SIGSTOP)
    time.sleep(2.0)
    process.send_signal(signal.SIGCONT)
    cells.wait_until(lambda: cells.events(run, "pause"), "the hold")
    told = cells.here("pause", run, "--json").document
    noted = cells.here("status", run, "--json").document
    assert told["state"] == noted["state"] == "paused"
    assert told["proven"] == noted["proven"] + noted["darks_proven"] == cells.frame_lines(run)
    assert told["dose_lux_h"] == pytest.approx(noted["dose_lux_h"], rel=1e-6)
    assert cells.here("stop", run).code == 0
    assert cells.finish(process).code == 130


def test_the_light_of_a_suspended_burst_ends_where_the_lights_were_switched_off(
    standing: tuple[CellFolder, World],
) -> None:
    """It had counted on until the program went on: a night's suspension cost the object a whole table."""
    cell, world = standing
    cell.write(object={"id": "relief", "mesh": str(cells.RELIEF)}, lights={"kind": "all"}, repeats=1)
    process = cell.start_acquire()
    run = cell.run_folder
    cells.wait_until(lambda: world.ask("state")["shining"], "a burst's light")
    process.send_signal(signal.SIGTSTP)
    cells.wait_until(lambda: cells.state_of(process.pid) == "T", "a stopped process")
    time.sleep(6.0)  # longer than the table
    process.send_signal(signal.SIGCONT)
    cells.wait_until(lambda: cells.events(run, "pause"), "the hold")
    true_lux_h = true_dose_lux_h(cell, world).max()
    told_lux_h = cells.here("status", run, "--json").document["dose_lux_h"]
    planned_lux_h = max(cells.events(run, "begin")[-1]["planned_lux_h"])
    assert true_lux_h <= 1.001 * told_lux_h + 1e-9
    assert true_lux_h < 0.8 * planned_lux_h, "it was suspended when it was nearly over"
    assert told_lux_h < (true_lux_h + planned_lux_h) / 2
    assert cells.here("stop", run).code == 0
    assert cells.finish(process).code == 130


def test_a_word_that_was_given_up_while_the_run_was_stopped_is_not_obeyed_later(
    standing: tuple[CellFolder, World],
) -> None:
    cell, world = standing
    process, run = under_way(cell)
    assert cells.here("pause", run).code == 0
    paused_at = cells.frame_lines(run)
    process.send_signal(signal.SIGSTOP)
    asked = cells.start("go-on", run)
    assert asked.stderr is not None
    assert f"process {process.pid} is stopped" in asked.stderr.readline()
    shown = cells.here("status", run)
    assert f"process {process.pid} is stopped" in shown.err
    assert f"kill -CONT {process.pid}" in " ".join(shown.err.split())
    asked.send_signal(signal.SIGINT)
    ended = cells.finish(asked)
    assert (ended.code, "does not obey this `coupole go-on` later" in ended.err) == (130, True)
    process.send_signal(signal.SIGCONT)
    end_s = time.monotonic() + 2.0
    while time.monotonic() < end_s:
        assert cells.safe(world)
        assert cells.here("status", run, "--json").document["state"] == "paused"
    assert cells.frame_lines(run) == paused_at
    assert "is stopped" not in cells.here("status", run).err
    assert cells.here("stop", run).code == 0
    assert cells.finish(process).code == 130
