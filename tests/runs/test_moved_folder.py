"""A run's folder that is moved, replaced or removed while frames are taken."""

from __future__ import annotations

import os
import shutil
import signal
from collections.abc import Callable, Iterator
from itertools import product
from pathlib import Path

import cells
import pytest
from cells import CellFolder
from in_part import in_part

from sim.world.client import World

OTHERS = b"of another run"


@pytest.fixture
def standing(tmp_path: Path) -> Iterator[tuple[CellFolder, World]]:
    """A cell whose world outlives its controllers, and a plan of several bursts in two views."""
    cell = CellFolder(tmp_path, speed=2.0)
    cell.join()
    cell.write(views=[cells.TOP, cells.SIDE], lights=cells.SOME_LIGHTS, repeats=2)
    with cell.world() as world:
        yield cell, world


def leave(place: Path) -> None: ...


def give_to_another(place: Path) -> None:
    """Another run's folder gets the name."""
    other = place.parent.parent / "other"
    other.mkdir()
    for name in ("report.html", "manifest.sha256"):
        (other / name).write_bytes(OTHERS)
    place.symlink_to(other)


@pytest.mark.parametrize(
    ("ending", "then"),
    in_part(
        product((None, signal.SIGTERM), (leave, give_to_another)), (None, give_to_another), (signal.SIGTERM, leave)
    ),
)
def test_a_moved_run_ends_and_says_where_it_is_and_nothing_is_written_where_it_was(
    standing: tuple[CellFolder, World], then: Callable[[Path], None], ending: signal.Signals | None
) -> None:
    cell, world = standing
    process = cells.start("acquire", cell.plan, "--yes")
    run = cell.run_folder
    cells.wait_until(lambda: cells.frame_lines(run) > 0, "proven frames")
    moved = run.with_name(f"{run.name}-moved")
    run.rename(moved)
    then(run)
    if ending:
        process.send_signal(ending)
    ended = cells.finish(process)
    assert ended.code in ({6, 143} if ending else {6}), ended
    assert cells.safe(world)
    if ended.code == 6:
        assert f"{run}: the run's folder was moved while frames were taken; it is {moved} now" in ended.err
    assert f"  frames  {moved}/views" in ended.err
    assert f"  go on   coupole acquire --resume {moved}\n" in ended.err
    assert cells.events(moved)[-1]["event"] == "stop"
    assert (moved / "report.html").is_file()
    if then is give_to_another:
        assert {path.name: path.read_bytes() for path in run.iterdir()} == dict.fromkeys(
            ("report.html", "manifest.sha256"), OTHERS
        )
        run.unlink()
    assert not run.exists()
    assert cell.acquire("--resume", moved).code == 0
    cells.assert_each_shot_proven_once(moved)


def test_a_run_whose_folder_is_removed_ends_and_does_not_make_another(standing: tuple[CellFolder, World]) -> None:
    cell, world = standing
    process = cells.start("acquire", cell.plan, "--yes")
    run = cell.run_folder
    cells.wait_until(lambda: cells.frame_lines(run) > 0, "proven frames")
    shutil.rmtree(run)
    ended = cells.finish(process)
    assert ended.code == 6, ended
    assert cells.safe(world)
    assert "was removed or replaced while frames were taken" in ended.err
    assert "--resume" not in ended.err
    assert not run.exists()


@pytest.mark.parametrize("name", ["run.json", "inputs", "views"])
def test_a_run_whose_description_is_removed_ends_and_says_so(
    standing: tuple[CellFolder, World], tmp_path: Path, name: str
) -> None:
    """It is not done, and it is resumed when the files are back."""
    cell, world = standing
    process = cells.start("acquire", cell.plan, "--yes")
    run = cell.run_folder
    cells.wait_until(lambda: cells.frame_lines(run) > 0, "proven frames")
    elsewhere = run / "elsewhere" if name == "views" else tmp_path / "elsewhere"
    (run / name).rename(elsewhere)
    ended = cells.finish(process)
    assert ended.code == 6, ended
    assert f"{run / name}" in ended.err
    assert "Put it back" in ended.err
    assert cells.safe(world)
    assert cells.events(run)[-1]["outcome"] == "failed"
    elsewhere.rename(run / name)
    assert cell.acquire("--resume", run).code == 0
    assert cells.here("verify", run).code == 0


def cut(path: Path) -> None:
    """What another program's mistake leaves of a file."""
    os.truncate(path, 100)


@pytest.mark.parametrize(
    ("happens", "words"),
    in_part(
        [
            (Path.unlink, "was removed or replaced while frames were"),
            (cut, "was cut while frames were"),
        ],
        (Path.unlink, "was removed or replaced while frames were"),
    ),
)
def test_a_views_file_that_is_lost_ends_the_run_which_is_not_called_done_later(
    standing: tuple[CellFolder, World], happens: Callable[[Path], None], words: str
) -> None:
    cell, world = standing
    process = cells.start("acquire", cell.plan, "--yes")
    run = cell.run_folder
    cells.wait_until(lambda: cells.frame_lines(run) > 0, "proven frames")
    (view,) = (run / "views").iterdir()
    happens(view)
    ended = cells.finish(process)
    assert ended.code == 6, ended.err
    assert words in ended.err
    assert cells.safe(world)
    again = cell.acquire("--resume", run)
    assert again.code == 6, again.err
    assert "begin a new run" in again.err


def test_a_view_that_is_lost_between_two_sessions_is_missed_and_its_run_not_done(
    standing: tuple[CellFolder, World],
) -> None:
    cell, _ = standing
    process = cells.start("acquire", cell.plan, "--yes")
    run = cell.run_folder
    cells.wait_until(lambda: cells.frame_lines(run) > 0, "proven frames")
    process.send_signal(signal.SIGTERM)
    assert cells.finish(process).code == 143
    (view,) = (run / "views").iterdir()
    kept = view.rename(view.with_suffix(".kept"))
    refused = cell.acquire("--resume", run)
    assert refused.code == 6, refused.err
    assert f"{view}: is missing, and the journal has proven frames of it" in refused.err
    kept.rename(view)
    assert cell.acquire("--resume", run).code == 0
    cells.assert_each_shot_proven_once(run)


def test_a_journal_that_is_cut_while_frames_are_taken_ends_the_run_and_its_frames_are_taken_again(
    standing: tuple[CellFolder, World],
) -> None:
    cell, world = standing
    process = cells.start("acquire", cell.plan, "--yes")
    run = cell.run_folder
    cells.wait_until(lambda: cells.frame_lines(run) > 0, "proven frames")
    os.truncate(run / "journal.jsonl", 200)
    ended = cells.finish(process)
    assert ended.code == 6, ended.err
    assert "was cut to" in ended.err
    assert cells.safe(world)
    assert cell.acquire("--resume", run).code == 0
    cells.assert_each_shot_proven_once(run)
