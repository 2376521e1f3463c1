"""The world as a process: how it ends, what it leaves, and what of it may die without the rest."""

from __future__ import annotations

import os
import signal
from collections.abc import Callable
from pathlib import Path
from unittest import mock

import cells
import pytest
from cells import CellFolder

from coupole.errors import DeviceLost
from sim.world import client
from sim.world.client import World
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
