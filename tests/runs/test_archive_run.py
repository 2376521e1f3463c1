"""`coupole archive` and `coupole export` on runs: killed at any moment, on a full disk, between two sessions."""

from __future__ import annotations

import random
import shutil
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import cells
import pytest
from archives import MadeRun, make_run
from cells import SIDE, TOP, CellFolder
from small_disks import small_disk_at

from coupole.devices import FrameFormat
from coupole.plan.shot_id import ShotId
from coupole.storage import frame_file

LARGE = FrameFormat(height_px=512, width_px=768, bit_depth=12, bayer_pattern="GBRG", black_dn=64, white_dn=4095)
VIEWS = ("a", "b", "c")


def archived(run: Path) -> list[str]:
    """Views of a run that are archived."""
    return [path.stem for path in sorted((run / "views").glob("*.h5")) if frame_file.read_layout(path).is_archived]


def assert_frames_are_there(made: MadeRun) -> None:
    """All proven frames are read back, bit for bit; with the command, and with nothing but the frame_file."""
    verified = cells.here("verify", made.run.folder, "--json")
    assert verified.code == 0, verified
    assert verified.document["frames"] == len(made.frames)
    for shot, frame in made.run.proven().items():
        path = made.run.folder / frame.file
        pixels = frame_file.read_frame(path, frame_file.read_layout(path), frame.index)
        assert pixels.tobytes() == made.frames[str(shot)].tobytes(), shot


# -- the commands -----------------------------------------------------------------------------------------


@pytest.mark.parametrize("codec", ["lz4", "zstd"])
def test_archive_says_what_it_did(tmp_path: Path, codec: str) -> None:
    made = make_run(tmp_path)
    ended = cells.here("archive", made.run.folder, "--codec", codec, "--json")
    assert ended.code == 0, ended.err
    found = ended.document
    assert (found["run"], found["codec"], found["frames"]) == (str(made.run.folder), codec, 8)
    assert [view["view"] for view in found["views"]] == ["top", "side"]
    assert found["ratio"] > 1.5
    assert found["mb_s"] > 0
    assert found["freed_bytes"] > 0


def test_verify_and_status_say_the_same_of_an_archived_run(tmp_path: Path) -> None:
    made = make_run(tmp_path)

    def said() -> list[dict[str, Any]]:
        """Without what the manifest lists, which archiving completes."""
        found = [cells.here(what, made.run.folder, "--json").document for what in ("verify", "status")]
        return [{key: value for key, value in one.items() if key not in ("listed", "unlisted")} for one in found]

    before = said()
    cells.here("archive", made.run.folder)
    assert said() == before


def test_archiving_a_run_that_is_not_complete_ends_with_five(tmp_path: Path) -> None:
    made = make_run(tmp_path, missing=("top/led0001/e0",))
    ended = cells.here("archive", made.run.folder, "--json")
    assert ended.code == 5
    assert ended.document["exit_code"] == 5
    assert "--partial" in ended.err
    assert archived(made.run.folder) == []


def test_archiving_what_is_wrong_on_the_disk_ends_with_six(tmp_path: Path) -> None:
    made = make_run(tmp_path)
    path = made.run.view_path("side")
    with path.open("r+b") as file:
        file.seek(
            frame_file.read_layout(path).data_offset
            + made.run.proven()[ShotId.parse("side/led0001/e0")].index * 24576
        )
        file.write(b"\xff\xff")
    ended = cells.here("archive", made.run.folder, "--json")
    assert (ended.code, ended.document["kind"]) == (6, "ChecksumMismatch")
    assert archived(made.run.folder) == ["top"]


def test_export_says_what_it_did(tmp_path: Path) -> None:
    made = make_run(tmp_path)
    ended = cells.here("export", made.run.folder, "--to", "dng", "--views", "top", "--json")
    assert ended.code == 0, ended.err
    out = made.run.folder / "export"
    assert ended.document == {"out": str(out), "files": 4, "bytes": sum(p.stat().st_size for p in out.iterdir())}


def test_exporting_twice_to_one_folder_ends_with_two(tmp_path: Path) -> None:
    made = make_run(tmp_path)
    assert cells.here("export", made.run.folder, "--to", "dng").code == 0
    assert cells.here("export", made.run.folder, "--to", "dng").code == 2
    assert cells.here("export", made.run.folder, "--to", "dng", "--overwrite").code == 0


# -- kill -9 ----------------------------------------------------------------------------------------------


@pytest.mark.full
def test_archiving_killed_again_and_again_loses_nothing_and_is_gone_on_with(
    tmp_path: Path, scale: Callable[[int, int], int]
) -> None:
    moments, torn = random.Random(4), 0
    made = make_run(tmp_path, views=VIEWS, shots=40, of=LARGE)
    for _ in range(scale(5, 60)):
        torn += kill_archive(made.run.folder, moments)
        assert_frames_are_there(made)
        if len(archived(made.run.folder)) == len(VIEWS):
            shutil.rmtree(made.run.folder)
            made = make_run(tmp_path, views=VIEWS, shots=40, of=LARGE)
    assert torn > 0, "no moment was in the middle of a view: the test has lost its meaning"
    assert cells.here("archive", made.run.folder).code == 0
    assert archived(made.run.folder) == list(VIEWS)
    assert sorted(path.name for path in (made.run.folder / "views").iterdir()) == ["a.h5", "b.h5", "c.h5"]
    assert_frames_are_there(made)


def kill_archive(run: Path, moments: random.Random) -> int:
    """Begin to archive and kill it at some moment; returns how many views were left in the middle of it."""
    process = cells.start("archive", run, "--codec", moments.choice(["lz4", "zstd"]))
    cells.wait_until(lambda: list(run.glob("views/*.archive")) or process.poll() is not None, "some work")
    time.sleep(moments.uniform(0.0, 0.15))
    process.kill()
    cells.finish(process)
    return len(list(run.glob("views/*.archive")))


# -- a full disk ------------------------------------------------------------------------------------------


@pytest.fixture
def small_disk(tmp_path: Path) -> Iterator[Path]:
    with small_disk_at(tmp_path / "disk", kib=24 * 1024) as disk:
        yield disk


@pytest.mark.parametrize("left_bytes", [0, 2**20, 2**21, 3 * 2**20])
def test_on_a_full_disk_archiving_ends_with_six_and_the_run_is_untouched(
    small_disk: Path, left_bytes: int
) -> None:
    made = make_run(small_disk / "runs", views=("top",), shots=10, of=LARGE)
    before = made.run.view_path("top").read_bytes()
    usage = shutil.disk_usage(small_disk)
    ballast = small_disk / "ballast"
    ballast.write_bytes(bytes(usage.free - left_bytes))
    ended = cells.here("archive", made.run.folder, "--json")
    assert (ended.code, ended.document["kind"]) == (6, "DiskFull"), ended
    assert "free some space, then archive again" in ended.err
    assert [path.name for path in (made.run.folder / "views").iterdir()] == ["top.h5"]
    assert made.run.view_path("top").read_bytes() == before
    ballast.unlink()
    assert cells.here("archive", made.run.folder).code == 0
    assert_frames_are_there(made)


def test_on_a_full_disk_exporting_ends_with_six_and_leaves_only_whole_files(small_disk: Path) -> None:
    made = make_run(small_disk / "runs", views=("top",), shots=10, of=LARGE)
    (small_disk / "ballast").write_bytes(bytes(shutil.disk_usage(small_disk).free - 2_000_000))
    ended = cells.here("export", made.run.folder, "--to", "dng", "--json")
    assert (ended.code, ended.document["kind"]) == (6, "DiskFull")
    written = sorted((made.run.folder / "export").iterdir())
    assert 0 < len(written) < 10
    assert all(path.stat().st_size > LARGE.frame_bytes * 3 // 4 for path in written)


# -- between two sessions ---------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def half_done(tmp_path_factory: pytest.TempPathFactory) -> tuple[CellFolder, Path]:
    """A run of two views that was killed on the way to its second."""
    cell = CellFolder(tmp_path_factory.mktemp("half"))
    cell.write(views=[TOP, SIDE])
    process = cell.start_acquire()
    run = cell.run_folder
    cells.wait_until(lambda: cells.frame_lines(run) and cells.events(run, "seal"), "the end of a view")
    process.kill()
    cells.finish(process)
    return cell, run


def test_a_run_goes_on_after_its_complete_views_were_archived(half_done: tuple[CellFolder, Path]) -> None:
    cell, run = half_done
    found = cells.here("archive", run, "--partial", "--json")
    assert found.code == 0, found.err
    (done,) = found.document["views"]
    assert found.document["incomplete"] == sorted({"top", "side"} - {done["view"]})
    file = run / "views" / f"{done['view']}.h5"
    kept = file.read_bytes()
    resumed = cell.acquire("--resume", run)
    assert resumed.code == 0, resumed.err
    assert file.read_bytes() == kept
    cells.assert_each_shot_proven_once(run)
    assert "data:image/jpeg" in (run / "report.html").read_text()
    assert cells.here("archive", run).code == 0
    assert archived(run) == ["side", "top"]
    cells.assert_each_shot_proven_once(run)
