"""`discard: after_fit` where plan or disk do not allow it: refused beforehand, waited for, or ended clearly."""

from __future__ import annotations

import os
import re
import signal
import tempfile
from collections.abc import Iterator
from pathlib import Path

import cells
import pytest
from beside_runs import begun, result_of
from discarded_runs import all_discarded, discarding_cell, everything_is_there, resume
from small_disks import small_disk_at

from coupole.storage.given_back import why_not

pytestmark = [
    pytest.mark.timeout(900),
    pytest.mark.usefixtures("hurried"),
    pytest.mark.skipif(
        bool(why_not(Path(tempfile.gettempdir()))), reason="the disk cannot give back parts of files"
    ),
]


@pytest.fixture
def small_disk(tmp_path: Path) -> Iterator[Path]:
    """A disk of its own, with room for less than three views and their samples."""
    with small_disk_at(tmp_path / "disk", kib=140 * 1024) as disk:
        yield disk


@pytest.mark.parametrize(
    ("plan", "options", "words"),
    [
        ({}, (), "expected a run with `--reflectance`"),
        (
            {"lights": {"kind": "adaptive", "until": {"lights": 20}}},
            ("--reflectance",),
            "expected LEDs that are known beforehand",
        ),
        ({"lights": {"kind": "ids", "ids": [1, 2, 3]}}, ("--reflectance",), "expected five LEDs or more"),
        ({"calibrations": "none"}, ("--reflectance",), "expected calibration records"),
    ],
)
def test_a_plan_that_cannot_be_processed_beside_is_refused(
    tmp_path: Path, plan: dict[str, object], options: tuple[str, ...], words: str
) -> None:
    cell = discarding_cell(tmp_path)
    cell.write(**plan)
    ended = cell.acquire(*options)
    assert ended.code == 3, ended.err
    assert words in ended.err
    if "calibrations" not in plan:
        place = re.search(rf"{re.escape(str(cell.plan))}:(\d+):(\d+): discard: ", ended.err)
        assert place is not None, ended.err
        line = cell.plan.read_text().splitlines()[int(place[1]) - 1]
        assert "after_fit" in line[int(place[2]) - 1 :][:24]
    assert not (tmp_path / "storage").exists() or not list((tmp_path / "storage").glob("2*"))


def test_preflight_tells_the_space_at_a_time_and_refuses_less(tmp_path: Path, small_disk: Path) -> None:
    cell = discarding_cell(tmp_path, cells.RELIEF)  # samples that take as much room as frames
    cell.rig_data["storage"]["folder"] = str(small_disk)
    cell.write()
    checked = cells.here("check", cell.plan, "--json")
    assert checked.code == 0, checked.err
    peak = checked.document["peak_bytes"]
    free = os.statvfs(small_disk).f_bavail * os.statvfs(small_disk).f_frsize
    with (small_disk / "ballast").open("wb") as file:
        os.posix_fallocate(file.fileno(), 0, free - peak + 100_000)
    refused = cells.here("check", cell.plan, "--no-disk-speed", "--json")
    assert refused.code == 3
    assert "though frames are discarded, the run needs" in refused.document["refusals"][0]


@pytest.mark.parametrize("ending", ["goes on", "is killed", "hangs"])
def test_a_run_waits_for_room_and_ends_clearly_if_none_comes(
    tmp_path: Path, small_disk: Path, ending: str
) -> None:
    cell = discarding_cell(tmp_path, cells.RELIEF)  # samples that take as much room as frames
    cell.rig_data["storage"]["folder"] = str(small_disk)
    cell.write()
    (tmp_path / "storage").symlink_to(small_disk)
    process, worker = begun(cell)
    if ending != "goes on":
        os.kill(worker, signal.SIGSTOP)
    with (small_disk / "ballast").open("wb") as file:  # somebody else takes what preflight has seen
        os.posix_fallocate(file.fileno(), 0, 25_000_000)
    if ending == "goes on":
        ended = cells.finish(process)
        assert ended.code == 0, ended.err
        kinds = [line["event"] for line in cells.events(cell.run_folder)]
        third = [n for n, kind in enumerate(kinds) if kind == "settled"][2]
        assert "discard" in kinds[:third]  # it has waited for it
        assert ended.document["reflectance"]["is_whole"], ended.err
    else:
        if ending == "is killed":
            os.kill(worker, signal.SIGKILL)
        ended = cells.finish(process)
        assert ended.code == 6, ended.err
        assert "no more frames are discarded" in ended.err
        assert ("stopped (SIGSTOP)" if ending == "hangs" else "killed by signal 9") in ended.err
        everything_is_there(cell.run_folder)
    if ending == "is killed":  # one that hung was killed by the controller: it is resumed no differently
        (small_disk / "ballast").unlink()
        resume(cell.run_folder)
    if ending != "hangs":
        all_discarded(cell.run_folder, result_of(cell))
