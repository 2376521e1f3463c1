"""The world as a process: how it ends, what it leaves, and what of it may die without the rest."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
from collections.abc import Callable, Iterator
from pathlib import Path
from subprocess import PIPE
from typing import Any
from unittest import mock

import cells
import pytest
from cells import CellFolder
from places import REPO

from coupole.acquisition import opened_cell
from coupole.errors import DeviceLost
from coupole.preflight.job import read_job
from coupole.preflight.simulated_world import world_config
from sim.world import client
from sim.world.client import Config, World
from sim.world.scratch import world_folder


def folder_of(world: World) -> Path:
    return Path(world.endpoints["clock"]["path"]).parent


def kill(world: World) -> None:
    os.kill(world.endpoints["pid"], signal.SIGKILL)


def stop(world: World) -> None:
    world.ask("stop")


@pytest.mark.parametrize(
    ("end", "code", "words"),
    [
        (stop, 0, ""),
        (
            kill,
            4,
            "world: expected the stand-ins to serve until they are told to stop; their process ",
        ),
    ],
)
def test_coupole_sim_tells_by_its_exit_code_how_the_world_ended(
    cell: CellFolder, end: Callable[[World], None], code: int, words: str
) -> None:
    waits = World.wait

    def end_and_wait(world: World) -> None:
        end(world)
        waits(world)

    with mock.patch.object(client.World, "wait", end_and_wait):
        ended = cells.here("sim", cell.rig)
    assert ended.code == code, ended
    assert words in ended.err
    assert '"ledbox"' in ended.out


def config_of(cell: CellFolder) -> dict[str, Any]:
    job = read_job(cell.plan)
    return world_config(job.cell, job, job.cell.rig.sensor)


IN_THE_MAKING = """
import sys, time
from sim.world import world
world.World = lambda config, folder: [print("making", flush=True), time.sleep(60)]
sys.exit(world.main())
"""


@pytest.fixture
def in_the_making(cell: CellFolder) -> Iterator[subprocess.Popen[str]]:
    """A world whose code is compiled for a minute."""
    with subprocess.Popen(
        [sys.executable, "-c", IN_THE_MAKING], stdin=PIPE, stdout=PIPE, text=True, cwd=REPO, start_new_session=True
    ) as process:
        yield process
        process.kill()


def test_a_world_in_the_making_ends_with_whoever_wants_it(
    cell: CellFolder, in_the_making: subprocess.Popen[str]
) -> None:
    """It had compiled on for minutes, a whole core, after its run had been ended."""
    assert in_the_making.stdin is not None
    assert in_the_making.stdout is not None
    in_the_making.stdin.write(Config.model_validate(config_of(cell)).model_dump_json() + "\n")
    in_the_making.stdin.flush()
    assert in_the_making.stdout.readline() == "making\n"
    in_the_making.stdin.close()
    assert in_the_making.wait(30) == 0


def test_a_start_that_is_interrupted_leaves_no_world(cell: CellFolder) -> None:
    started = []

    def launch() -> subprocess.Popen[str]:
        started.append(
            subprocess.Popen(["sleep", "60"], stdin=PIPE, stdout=PIPE, text=True, start_new_session=True)
        )
        return started[0]

    def interrupted(*_: object) -> None:
        raise KeyboardInterrupt

    with (
        mock.patch.object(client, "_launch", launch),
        mock.patch.object(client, "_first_line", interrupted),
        pytest.raises(KeyboardInterrupt),
    ):
        World.start(config_of(cell))
    assert started[0].poll() == -signal.SIGKILL


def test_who_waits_for_a_slow_start_hears_what_for(cell: CellFolder) -> None:
    with mock.patch.object(opened_cell, "_SLOW_START_S", 0.0):
        ended = cells.here("acquire", cell.plan, "--yes")
    assert "compiles its code, once on each machine" in ended.err
    assert ended.code == 0


def test_what_a_killed_world_left_is_removed_by_the_next(cell: CellFolder) -> None:
    """And a world that lives keeps its own."""
    with cell.world() as living, cell.world() as killed:
        kill(killed)
        with pytest.raises(DeviceLost):
            killed.wait()
        assert folder_of(killed).is_dir()
        with cell.world():
            assert not folder_of(killed).exists()
            assert (folder_of(living) / "control").exists()
            assert living.ask("state")["t_s"] > 0


def test_a_world_that_is_told_to_end_leaves_nothing(cell: CellFolder) -> None:
    with cell.world() as world:
        os.kill(world.endpoints["pid"], signal.SIGTERM)
        world.wait()
        assert not folder_of(world).exists()


def test_a_folder_that_nobody_holds_is_removed_and_others_are_not(tmp_path: Path) -> None:
    abandoned, foreign = tmp_path / "coupole-world-abandoned", tmp_path / "other"
    abandoned.mkdir()
    foreign.mkdir()
    for folder in (abandoned, foreign):
        (folder / "lock").touch()
        (folder / "clock").write_bytes(bytes(8))
    with world_folder(tmp_path) as first:
        assert not abandoned.exists()
        with world_folder(tmp_path) as second:
            assert first.is_dir()
            assert second.is_dir()
    assert foreign.is_dir()
    assert not first.exists()
    assert not second.exists()
