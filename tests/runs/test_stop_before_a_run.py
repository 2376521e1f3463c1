"""`coupole stop` reaches a session before its run begins: while it checks the plan, or opens devices."""

from __future__ import annotations

import subprocess
from pathlib import Path

import cells
import pytest
from cells import CellFolder

from coupole.acquisition.starting import starting

PREFLIGHT, OPENING = "views, shots, frames", "opening the devices"


def _until(process: subprocess.Popen[str], words: str) -> None:
    """Read what a session says until a line has these words."""
    assert process.stderr is not None
    assert any(words in line for line in iter(process.stderr.readline, "")), f"it never said {words!r}"


def _moves_and_lights(cell: CellFolder) -> list[str]:
    runs = (cell.folder / "storage").glob("2*")
    return [event["event"] for run in runs for event in cells.events(run) if event["event"] in ("move", "begin")]


@pytest.mark.parametrize("words", [PREFLIGHT, OPENING])
def test_a_session_that_is_starting_is_stopped_and_does_nothing(tmp_path: Path, words: str) -> None:
    cell = CellFolder(tmp_path)
    cell.join()
    with cell.world() as world:
        process = cells.start("acquire", cell.plan, "--yes")
        _until(process, words)
        stopped = cells.here("stop", *([cell.plan] if words == PREFLIGHT else []))
        assert stopped.code == 0, stopped.err
        assert f"stopped before the run began: {cell.plan}" in " ".join((stopped.out + stopped.err).split())
        assert process.poll() is not None, "it has ended when the answer is given"
        assert cells.finish(process).code == 130
        state = world.ask("state")
        assert not state["shining"]
        assert not state["arm_moving"]
        assert _moves_and_lights(cell) == []
        assert not list(starting())


def test_a_run_that_is_being_resumed_is_stopped_by_its_folder(tmp_path: Path) -> None:
    cell = CellFolder(tmp_path)
    cell.write(lights={"kind": "every", "every": 2})  # it has long not ended when it is stopped
    process = cell.start_acquire()
    run = cell.run_folder
    cells.wait_until(lambda: cells.frame_lines(run) > 3, "proven frames")
    assert cells.here("stop", run).code == 0
    cells.finish(process)
    before = _moves_and_lights(cell)
    process = cells.start("acquire", "--resume", run, "--yes")
    _until(process, OPENING)
    stopped = cells.here("stop", run)
    assert stopped.code == 0, stopped.err
    assert cells.finish(process).code == 130
    assert _moves_and_lights(cell) == before
    assert cell.acquire("--resume", run).document["missing"] == 0


def test_a_session_that_is_starting_has_nothing_to_pause(tmp_path: Path) -> None:
    cell = CellFolder(tmp_path)
    process = cells.start("acquire", cell.plan, "--yes")
    _until(process, PREFLIGHT)
    paused = cells.here("pause")
    assert paused.code == 2
    assert "the run has not begun; `coupole stop` ends it" in " ".join((paused.out + paused.err).split())
    process.terminate()
    assert cells.finish(process).code == 143


def test_of_several_sessions_that_are_starting_one_must_be_named(tmp_path: Path) -> None:
    names = ("one", "other")
    for name in names:
        (tmp_path / name).mkdir()
    all_cells = [CellFolder(tmp_path / name) for name in names]
    processes = [cells.start("acquire", cell.plan, "--yes") for cell in all_cells]
    cells.wait_until(lambda: len(list(starting())) == 2, "two sessions")
    stopped = cells.here("stop")
    assert stopped.code == 2
    assert all(str(cell.plan) in stopped.err for cell in all_cells)
    for cell, process in zip(all_cells, processes, strict=True):
        assert cells.here("stop", cell.plan).code == 0
        assert cells.finish(process).code == 130
