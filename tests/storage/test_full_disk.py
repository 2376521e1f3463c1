"""Disks without room: refused or told, and no half line left behind."""

from __future__ import annotations

import os
import resource
import signal
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import cells
import pytest
from cells import SIDE, TOP, CellFolder
from small_disks import small_disk_at
from view_files import FORMAT, METADATA, SLOTS, frame

from coupole.errors import DiskFull, StorageError
from coupole.preflight.preflight import room_bytes
from coupole.storage import journal
from coupole.storage.frame_file_creation import create
from coupole.storage.journal import Journal
from coupole.storage.journal_events import FaultNoted, SessionStarted, SessionStopped
from coupole.storage.ledger import Ledger
from coupole.storage.run import Run
from coupole.storage.run_inputs import Inputs
from coupole.storage.view_writer import ViewWriter


@pytest.fixture
def small_disk(tmp_path: Path, request: pytest.FixtureRequest) -> Iterator[Path]:
    """A disk of its own, of 1 MiB or so many as are asked for."""
    with small_disk_at(tmp_path / "disk", kib=1024 * getattr(request, "param", 1)) as disk:
        yield disk


def fill(disk: Path, leave_bytes: int) -> None:
    """Take all space of a disk but for some bytes (whole pages)."""
    facts = os.statvfs(disk)
    with (disk / "ballast").open("wb") as file:
        os.posix_fallocate(file.fileno(), 0, facts.f_bavail * facts.f_frsize - leave_bytes)


def _filled(disk: Path) -> bool:
    """False if somebody else took some of the space meanwhile."""
    try:
        fill(disk, 0)
    except OSError:
        return False
    return True


def test_a_ledger_on_a_full_disk_is_told_before_any_light_is_given(small_disk: Path) -> None:
    ledger = Ledger(small_disk, "shroud")
    ledger.plan("one", 1.0, None)
    ledger.prove_writable()
    fill(small_disk, 0)
    with pytest.raises(DiskFull, match="the disk is full"):
        ledger.prove_writable()
    assert ledger.read_history().total_lux_h == 1.0


def test_a_view_for_which_there_is_no_room_is_refused_and_leaves_no_file(small_disk: Path) -> None:
    with pytest.raises(DiskFull, match="the disk is full"):
        create(small_disk / "top.h5", 200, FORMAT, METADATA)
    assert list(small_disk.iterdir()) == []


@pytest.mark.parametrize("left_bytes", [0, 4096, 8192, 16384, 32768, 65536])
def test_a_view_for_which_a_disk_has_hardly_any_room_is_refused(small_disk: Path, left_bytes: int) -> None:
    """HDF5 crashes if it meets the full disk itself, when it closes the file: the arm moved then."""
    fill(small_disk, left_bytes)
    program = (
        "import sys; from pathlib import Path; from view_files import FORMAT, METADATA\n"
        "from coupole.errors import DiskFull; from coupole.storage.frame_file_creation import create\n"
        "try: create(Path(sys.argv[1]), 20, FORMAT, METADATA)\n"
        "except DiskFull: print('told')\n"
    )
    ended = subprocess.run(
        [sys.executable, "-c", program, str(small_disk / "top.h5")],
        capture_output=True,
        text=True,
        check=False,
        env={**os.environ, "PYTHONPATH": os.pathsep.join(sys.path)},
    )
    assert (ended.returncode, ended.stdout) == (0, "told\n"), ended.stderr
    assert not list(small_disk.glob("top*"))


def test_a_run_that_cannot_be_made_leaves_no_folder(small_disk: Path, tmp_path: Path) -> None:
    fill(small_disk, 16384)
    for name in ("plan.yaml", "rig.yaml"):
        (tmp_path / name).write_text("#" * 100_000)
    inputs = Inputs(tmp_path / "plan.yaml", tmp_path / "rig.yaml", ())
    with pytest.raises(StorageError, match="cannot make a run folder: No space left"):
        Run.create(small_disk / "runs", "small", inputs, {})
    assert list((small_disk / "runs").iterdir()) == []


def test_the_space_of_a_view_is_its_own_though_the_disk_fills_up(small_disk: Path) -> None:
    create(small_disk / "top.h5", SLOTS, FORMAT, METADATA)
    fill(small_disk, 0)
    writer = ViewWriter(small_disk / "top.h5", {})
    for number in range(SLOTS):
        writer.store(frame(number), frame_id=number, camera_ns=number, exposure_us=8000)
    writer.sync()
    writer.close()


def test_a_commit_on_a_full_disk_leaves_no_half_line(small_disk: Path) -> None:
    path = small_disk / "journal.jsonl"
    diary = Journal(path)
    diary.write(SessionStarted(simulated=True))
    diary.commit()
    before = path.read_bytes()
    fill(small_disk, 8192)
    diary.write(FaultNoted(kind="Test", message="x" * 20_000))
    with pytest.raises(DiskFull, match="Free space on it, then resume"):
        diary.commit()
    diary.close()
    assert path.read_bytes() == before


def test_lines_that_found_the_disk_full_never_count_and_later_ones_are_whole(small_disk: Path) -> None:
    path = small_disk / "journal.jsonl"
    diary = Journal(path)
    fill(small_disk, 4096)
    diary.write(FaultNoted(kind="Test", message="x" * 20_000))
    with pytest.raises(DiskFull):
        diary.commit()
    (small_disk / "ballast").unlink()
    diary.write(SessionStopped(outcome="done"))
    diary.commit()
    diary.close()
    assert [event.event for event in journal.read_events(path)] == ["journal", "stop"]


def test_a_journal_over_a_limit_of_the_system_leaves_no_half_line(tmp_path: Path) -> None:
    path = tmp_path / "journal.jsonl"
    code = (
        "import sys; from pathlib import Path\n"
        "from coupole.storage.journal import Journal; from coupole.errors import StorageError\n"
        "from coupole.storage.journal_events import FaultNoted, SessionStarted\n"
        "diary = Journal(Path(sys.argv[1])); diary.write(SessionStarted()); diary.commit()\n"
        "diary.write(FaultNoted(kind='Test', message='x' * 50_000))\n"
        "try: diary.commit()\n"
        "except StorageError as error: print(type(error).__name__, error)\n"
    )

    def limited() -> None:
        signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
        resource.setrlimit(resource.RLIMIT_FSIZE, (10_000, 10_000))

    done = subprocess.run(
        [sys.executable, "-c", code, str(path)],
        check=True,
        capture_output=True,
        text=True,
        preexec_fn=limited,
        env={**os.environ, "PYTHONDONTWRITEBYTECODE": "1"},
    )
    assert done.stdout.startswith("StorageError ")
    assert "Raise the limit (`ulimit -f`)" in done.stdout
    assert [event.event for event in journal.read_events(path)] == ["journal", "start"]
    assert path.read_bytes().endswith(b"\n")


@pytest.mark.parametrize("small_disk", [64], indirect=True)
def test_a_session_whose_disk_filled_up_claims_no_frame_that_the_run_does_not_have(
    small_disk: Path, tmp_path: Path
) -> None:
    cell = CellFolder(tmp_path)
    cell.rig_data["storage"]["folder"] = str(small_disk / "storage")
    cell.write(views=[TOP, SIDE], lights={"kind": "every", "every": 5})
    process = cells.start("acquire", cell.plan, "--yes")
    views = cells.wait_until(lambda: [*small_disk.glob("storage/*/views/*.h5")], "a view's file")
    cells.wait_until(lambda: _filled(small_disk), "a full disk")
    ended = cells.finish(process)
    run = views[0].parent.parent
    assert ended.code == 6
    told = cells.here("status", run, "--json").document
    said = " ".join((ended.out + ended.err).split())
    assert f"failed: {told['proven']} of {told['shots']} shots proven" in said
    (small_disk / "ballast").unlink()
    assert cells.here("acquire", "--resume", run, "--yes", "--json").code == 0
    cells.assert_each_shot_proven_once(run)
    _assert_no_more_room_than_counted(run, frame_bytes=128 * 96 * 2)


def _assert_no_more_room_than_counted(run: Path, frame_bytes: int) -> None:
    """Frames of 25 kB: records and reports have a large share."""
    expected = cells.about(run)["expected"]
    taken_bytes = sum(path.stat().st_size for path in run.rglob("*") if path.is_file())
    assert taken_bytes <= room_bytes(expected["frames"], 2, frame_bytes)
