"""What is on disk: frames that others can read, a journal that survives a crash, a full disk, a flipped byte."""

from __future__ import annotations

import json
import os
import resource
import signal
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pytest
import xxhash

from coupole import journal, ledger, run, store
from coupole.devices import ArmState, FrameFormat
from coupole.errors import DiskFull, InputError, StorageError
from coupole.journal import Journal
from coupole.run import Inputs, Run
from coupole.store import ViewWriter

FORMAT = FrameFormat(height_px=64, width_px=128, bit_depth=12, bayer_pattern="GBRG", black_dn=64, white_dn=4095)
ODD = FrameFormat(height_px=30, width_px=50, bit_depth=12, bayer_pattern="GBRG", black_dn=64, white_dn=4095)
METADATA = {"title": "test", "sample": "relief", "simulated": True, "pixel_pitch_um": 44.0}
DATA = "entry/instrument/detector/data"
FRAMES = "entry/instrument/detector/frames"
SLOTS = 6


def frame(number: int, of: FrameFormat = FORMAT) -> np.ndarray[Any, np.dtype[np.uint16]]:
    """Pixels in page-aligned memory, as drivers deliver them."""
    import mmap

    memory = np.frombuffer(mmap.mmap(-1, of.frame_bytes), np.uint16).reshape(of.height_px, of.width_px)
    memory[:] = np.random.default_rng(number).integers(0, 4096, memory.shape)
    return memory


def write_view(path: Path, proven: int = 3, stored: int = 1, of: FrameFormat = FORMAT) -> dict[str, int]:
    """A view's file with proven and merely stored frames; returns the checksums of the proven shots."""
    store.create(path, SLOTS, of, METADATA)
    writer = ViewWriter(path, {})
    checksums = {}
    try:
        for number in range(proven + stored):
            slot = writer.put(frame(number, of), frame_id=100 + number, camera_ns=1000 * number, exposure_us=8000)
            if number < proven:
                shot = f"{path.stem}/led{number:04d}/e0"
                checksums[shot] = writer.prove(slot, shot, led=number, step=number, t_trigger_ns=number)
        writer.sync()
    finally:
        writer.close()
    return checksums


# ----------------------------------------------------------------------------------------- one file for each view


def test_frames_are_read_by_plain_h5py(tmp_path: Path) -> None:
    write_view(tmp_path / "top.h5")
    with h5py.File(tmp_path / "top.h5") as file:
        for number in range(4):
            assert np.array_equal(file[DATA][number], frame(number))


def test_the_frame_table_is_read_by_plain_h5py(tmp_path: Path) -> None:
    write_view(tmp_path / "top.h5")
    with h5py.File(tmp_path / "top.h5") as file:
        table = file[FRAMES][:]
    assert table["shot"][:4].tolist() == [b"top/led0000/e0", b"top/led0001/e0", b"top/led0002/e0", b""]
    assert table["frame_id"][:4].tolist() == [100, 101, 102, 103]
    assert table["exposure_us"][:4].tolist() == [8000] * 4


def test_measured_poses_are_read_by_plain_h5py(tmp_path: Path) -> None:
    store.create(tmp_path / "top.h5", 1, FORMAT, METADATA)
    writer = ViewWriter(tmp_path / "top.h5", {})
    flange, camera = np.diag([1.0, 2.0, 3.0, 1.0]), np.diag([4.0, 5.0, 6.0, 1.0])
    assert writer.add_pose(ArmState((1, 2, 3, 4, 5, 6), flange, 77, moving=False), camera) == 0
    writer.close()
    with h5py.File(tmp_path / "top.h5") as file:
        pose = file["entry/instrument/robot/poses"][0]
    assert pose["t_ns"] == 77
    assert pose["joints_deg"].tolist() == [1, 2, 3, 4, 5, 6]
    assert np.array_equal(pose["base_from_flange"], flange)
    assert np.array_equal(pose["base_from_camera"], camera)


def test_poses_of_a_reopened_view_are_added_behind_those_it_has(tmp_path: Path) -> None:
    store.create(tmp_path / "top.h5", 1, FORMAT, METADATA)
    for number in range(2):
        writer = ViewWriter(tmp_path / "top.h5", {})
        assert writer.add_pose(ArmState((0,) * 6, np.eye(4), 5, moving=False), np.eye(4)) == number
        writer.close()


@pytest.mark.parametrize(
    ("group", "nx_class"),
    [
        ("entry", "NXentry"),
        ("entry/instrument", "NXinstrument"),
        ("entry/instrument/detector", "NXdetector"),
        ("entry/instrument/robot", "NXpositioner"),
        ("entry/sample", "NXsample"),
        ("entry/data", "NXdata"),
    ],
)
def test_groups_have_their_nexus_class(tmp_path: Path, group: str, nx_class: str) -> None:
    write_view(tmp_path / "top.h5")
    with h5py.File(tmp_path / "top.h5") as file:
        assert file[group].attrs["NX_class"] == nx_class


def test_the_default_plot_leads_to_the_frames(tmp_path: Path) -> None:
    write_view(tmp_path / "top.h5")
    with h5py.File(tmp_path / "top.h5") as file:
        entry = file[file.attrs["default"]]
        shown = entry[entry.attrs["default"]]
        assert shown[shown.attrs["signal"]] == file[DATA]


def test_levels_and_pattern_stand_in_the_file(tmp_path: Path) -> None:
    write_view(tmp_path / "top.h5")
    assert store.read_facts(tmp_path / "top.h5") == {"pattern": "GBRG", "black_dn": 64, "white_dn": 4095}


def test_frames_lie_contiguous_on_a_4096_byte_boundary(tmp_path: Path) -> None:
    write_view(tmp_path / "top.h5")
    with h5py.File(tmp_path / "top.h5") as file:
        data = file[DATA]
        assert data.chunks is None
        assert data.id.get_offset() % 4096 == 0
        assert data.id.get_storage_size() == SLOTS * FORMAT.frame_bytes


def test_checksums_are_xxh3_of_the_bytes_on_disk(tmp_path: Path) -> None:
    checksums = write_view(tmp_path / "top.h5")
    with h5py.File(tmp_path / "top.h5") as file:
        offset, table = file[DATA].id.get_offset(), file[FRAMES][:]
    content = (tmp_path / "top.h5").read_bytes()
    for slot, shot in enumerate(checksums):
        start = offset + slot * FORMAT.frame_bytes
        on_disk = xxhash.xxh3_64_intdigest(content[start : start + FORMAT.frame_bytes])
        assert on_disk == checksums[shot] == int(table["xxh3"][slot])


def test_slots_are_free_stored_or_proven(tmp_path: Path) -> None:
    write_view(tmp_path / "top.h5", proven=3, stored=1)
    states = store.read_frames(tmp_path / "top.h5")["state"].tolist()
    assert states == [store.PROVEN] * 3 + [store.STORED] + [store.FREE] * 2


def test_reopening_keeps_proven_slots_and_frees_all_others(tmp_path: Path) -> None:
    path = tmp_path / "top.h5"
    write_view(path, proven=3, stored=2)
    writer = ViewWriter(path, {"top/led0000/e0": 0, "top/led0002/e0": 2})
    assert writer.free_slots == 4
    writer.close()
    states = store.read_frames(path)["state"].tolist()
    assert states == [store.PROVEN, store.FREE, store.PROVEN] + [store.FREE] * 3


def test_frames_written_after_reopening_overwrite_nothing_proven(tmp_path: Path) -> None:
    path = tmp_path / "top.h5"
    write_view(path, proven=2, stored=0)
    writer = ViewWriter(path, {"top/led0001/e0": 1})
    slots = {
        writer.put(frame(50 + k), frame_id=k, camera_ns=k, exposure_us=8000) for k in range(writer.free_slots)
    }
    writer.close()
    assert slots == {0, 2, 3, 4, 5}
    assert np.array_equal(store.read_frame(path, store.read_layout(path), 1), frame(1))


def test_a_freed_slot_is_used_again(tmp_path: Path) -> None:
    store.create(tmp_path / "top.h5", 1, FORMAT, METADATA)
    writer = ViewWriter(tmp_path / "top.h5", {})
    slot = writer.put(frame(0), frame_id=1, camera_ns=1, exposure_us=8000)
    writer.free(slot)
    assert writer.put(frame(1), frame_id=2, camera_ns=2, exposure_us=8000) == slot
    writer.close()


def test_more_frames_than_slots_are_an_error_that_says_so(tmp_path: Path) -> None:
    store.create(tmp_path / "top.h5", 1, FORMAT, METADATA)
    writer = ViewWriter(tmp_path / "top.h5", {})
    writer.put(frame(0), frame_id=1, camera_ns=1, exposure_us=8000)
    with pytest.raises(StorageError, match="no slot is free"):
        writer.put(frame(1), frame_id=2, camera_ns=2, exposure_us=8000)
    writer.close()


def test_frames_of_an_odd_size_are_written_buffered_and_right(tmp_path: Path) -> None:
    path = tmp_path / "odd.h5"
    write_view(path, of=ODD)
    writer = ViewWriter(path, {f"odd/led{k:04d}/e0": k for k in range(3)})
    assert not writer.direct
    writer.close()
    with h5py.File(path) as file:
        for number in range(3):
            assert np.array_equal(file[DATA][number], frame(number, ODD))


def test_a_file_that_is_no_view_is_a_storage_error(tmp_path: Path) -> None:
    (tmp_path / "top.h5").write_bytes(b"not hdf5")
    with pytest.raises(StorageError, match="not a view file"):
        store.read_layout(tmp_path / "top.h5")


# ---------------------------------------------------------------------------------------------------- a full disk


@pytest.fixture
def small_disk(tmp_path: Path) -> Iterator[Path]:
    """A disk of 1 MiB of its own."""
    disk = tmp_path / "disk"
    disk.mkdir()
    mounted = subprocess.run(
        ["mount", "-t", "tmpfs", "-o", "size=1m", "tmpfs", str(disk)], check=False, capture_output=True, text=True
    )
    if mounted.returncode != 0:
        pytest.skip(f"cannot mount a small tmpfs here: {mounted.stderr.strip()}")
    yield disk
    subprocess.run(["umount", str(disk)], check=True)


def fill(disk: Path, leave_bytes: int) -> None:
    """Take all space of a disk but for some bytes (whole pages)."""
    facts = os.statvfs(disk)
    with (disk / "ballast").open("wb") as file:
        os.posix_fallocate(file.fileno(), 0, facts.f_bavail * facts.f_frsize - leave_bytes)


def test_a_view_for_which_there_is_no_room_is_refused_and_leaves_no_file(small_disk: Path) -> None:
    with pytest.raises(DiskFull, match="the disk is full"):
        store.create(small_disk / "top.h5", 200, FORMAT, METADATA)
    assert list(small_disk.iterdir()) == []


def test_the_space_of_a_view_is_its_own_though_the_disk_fills_up(small_disk: Path) -> None:
    store.create(small_disk / "top.h5", SLOTS, FORMAT, METADATA)
    fill(small_disk, 0)
    writer = ViewWriter(small_disk / "top.h5", {})
    for number in range(SLOTS):
        writer.put(frame(number), frame_id=number, camera_ns=number, exposure_us=8000)
    writer.sync()
    writer.close()


def test_a_commit_on_a_full_disk_leaves_no_half_line(small_disk: Path) -> None:
    path = small_disk / "journal.jsonl"
    diary = Journal(path)
    diary.write("start", plan="p")
    diary.commit()
    before = path.read_bytes()
    fill(small_disk, 8192)
    diary.write("fault", message="x" * 20_000)
    with pytest.raises(DiskFull, match="Free space on it, then resume"):
        diary.commit()
    diary.close()
    assert path.read_bytes() == before


def test_lines_that_found_the_disk_full_never_count_and_later_ones_are_whole(small_disk: Path) -> None:
    path = small_disk / "journal.jsonl"
    diary = Journal(path)
    fill(small_disk, 4096)
    diary.write("frame", shot="x" * 20_000)
    with pytest.raises(DiskFull):
        diary.commit()
    (small_disk / "ballast").unlink()
    diary.write("stop")
    diary.commit()
    diary.close()
    assert [event["event"] for event in journal.read(path)] == ["stop"]


def test_a_journal_over_a_limit_of_the_system_leaves_no_half_line(tmp_path: Path) -> None:
    path = tmp_path / "journal.jsonl"
    code = (
        "import sys; from pathlib import Path\n"
        "from coupole.journal import Journal; from coupole.errors import StorageError\n"
        "diary = Journal(Path(sys.argv[1])); diary.write('start'); diary.commit()\n"
        "diary.write('fault', message='x' * 50_000)\n"
        "try: diary.commit()\n"
        "except StorageError as error: print(type(error).__name__)\n"
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
    assert done.stdout.strip() == "StorageError"
    assert [event["event"] for event in journal.read(path)] == ["start"]
    assert path.read_bytes().endswith(b"\n")


# -------------------------------------------------------------------------------------------- journal and ledger


def test_lines_reach_the_file_with_the_commit_and_not_before(tmp_path: Path) -> None:
    path = tmp_path / "journal.jsonl"
    diary = Journal(path)
    diary.write("frame", shot="top/led0001/e0")
    assert path.read_bytes() == b""
    diary.commit()
    assert [event["shot"] for event in journal.read(path)] == ["top/led0001/e0"]
    diary.close()


def test_each_line_is_one_json_object_with_event_and_utc_time(tmp_path: Path) -> None:
    diary = Journal(tmp_path / "journal.jsonl")
    diary.write("view", name="top")
    diary.commit()
    diary.close()
    line = json.loads((tmp_path / "journal.jsonl").read_text())
    assert line["event"] == "view"
    assert line["t"].endswith("Z")


def test_lines_that_were_taken_are_written_by_append_alone(tmp_path: Path) -> None:
    diary = Journal(tmp_path / "journal.jsonl")
    diary.write("frame", shot="a")
    taken = diary.take()
    diary.write("stop")
    diary.commit()
    diary.append(taken)
    diary.close()
    assert [event["event"] for event in journal.read(tmp_path / "journal.jsonl")] == ["stop", "frame"]


def torn_journal(path: Path) -> None:
    """A journal whose last line a crash cut off."""
    diary = Journal(path)
    diary.write("start")
    diary.write("frame", shot="top/led0001/e0")
    diary.commit()
    diary.close()
    os.truncate(path, path.stat().st_size - 9)


def test_a_torn_last_line_is_passed_over(tmp_path: Path) -> None:
    torn_journal(tmp_path / "journal.jsonl")
    assert [event["event"] for event in journal.read(tmp_path / "journal.jsonl")] == ["start"]


def test_a_torn_last_line_is_closed_on_reopening_and_the_next_is_whole(tmp_path: Path) -> None:
    path = tmp_path / "journal.jsonl"
    torn_journal(path)
    diary = Journal(path)
    diary.write("resume")
    diary.commit()
    diary.close()
    assert [event["event"] for event in journal.read(path)] == ["start", "resume"]


def test_the_ledger_sums_all_doses_of_an_object(tmp_path: Path) -> None:
    for run_name, dose in (("one", 1.7), ("two", 0.4)):
        ledger.add(tmp_path, "shroud", run=run_name, dose_lux_h=dose)
    ledger.add(tmp_path, "other", run="three", dose_lux_h=9.0)
    assert ledger.total_lux_h(tmp_path, "shroud") == pytest.approx(2.1)


def test_an_object_without_a_ledger_has_received_nothing(tmp_path: Path) -> None:
    assert ledger.total_lux_h(tmp_path, "shroud") == 0.0


# ------------------------------------------------------------------------------------------------- a run's folder


@pytest.fixture
def inputs(tmp_path: Path) -> Inputs:
    for name in ("plan.yaml", "rig.yaml", "dome.csv"):
        (tmp_path / name).write_text(f"# {name}\n")
    return Inputs(tmp_path / "plan.yaml", tmp_path / "rig.yaml", (tmp_path / "dome.csv",))


@pytest.fixture
def finished(tmp_path: Path, inputs: Inputs) -> Run:
    """A run of one view and three shots, all proven."""
    labels = [f"led{k:04d}/e0" for k in range(3)]
    made = Run.create(tmp_path / "runs", "test", inputs, {"views": ["top"], "labels": labels})
    checksums = write_view(made.view_path("top"))
    diary = Journal(made.journal_path)
    diary.write("start")
    for slot, (shot, checksum) in enumerate(checksums.items()):
        prove_in(diary, shot, slot, f"{checksum:016x}")
    diary.commit()
    diary.close()
    return made


def prove_in(diary: Journal, shot: str, slot: int, checksum: str) -> None:
    diary.write("frame", shot=shot, file="views/top.h5", index=slot, frame_id=100 + slot, xxh3=checksum)


def test_a_whole_run_verifies(finished: Run) -> None:
    found = run.verify(finished)
    assert found.ok
    assert found.frames == 3


def test_verify_finds_a_flipped_byte(finished: Run) -> None:
    path = finished.view_path("top")
    layout = store.read_layout(path)
    with path.open("r+b") as file:
        file.seek(layout.data_offset + layout.frame_bytes + 777)
        byte = file.read(1)
        file.seek(-1, os.SEEK_CUR)
        file.write(bytes([byte[0] ^ 1]))
    found = run.verify(finished)
    assert not found.ok
    assert len(found.bad) == 1
    assert found.bad[0].startswith("top/led0001/e0: slot 1 of top.h5 has checksum ")


def test_verify_finds_a_missing_shot(finished: Run) -> None:
    lines = finished.journal_path.read_text().splitlines(keepends=True)
    finished.journal_path.write_text("".join(line for line in lines if "led0002" not in line))
    found = run.verify(finished)
    assert found.missing == ["top/led0002/e0"]
    assert not found.ok


def test_verify_finds_a_shot_that_stands_in_two_slots(finished: Run) -> None:
    writer = ViewWriter(finished.view_path("top"), {f"top/led{k:04d}/e0": k for k in range(3)})
    slot = writer.put(frame(9), frame_id=200, camera_ns=9, exposure_us=8000)
    writer.prove(slot, "top/led0001/e0")
    writer.close()
    assert run.verify(finished).bad == ["views/top.h5: top/led0001/e0 stands in 2 slots"]


def test_verify_finds_a_shot_that_was_proven_twice(finished: Run) -> None:
    diary = Journal(finished.journal_path)
    proven = finished.proven()["top/led0001/e0"]
    prove_in(diary, proven.shot, proven.index, proven.xxh3)
    diary.commit()
    diary.close()
    assert run.verify(finished).bad == ["top/led0001/e0: proven 2 times in the journal"]


def test_verify_finds_a_record_that_names_another_shot(finished: Run) -> None:
    path = finished.view_path("top")
    layout = store.read_layout(path)
    with path.open("r+b") as file:
        file.seek(layout.table_offset + store.FRAME_DTYPE.fields["shot"][1])  # type: ignore[index]
        file.write(b"top/led0007/e0")
    assert run.verify(finished).bad == ["top/led0000/e0: slot 0 of top.h5 is recorded as `top/led0007/e0`"]


def test_verify_finds_a_view_that_is_gone(finished: Run) -> None:
    finished.view_path("top").unlink()
    found = run.verify(finished)
    assert len(found.bad) == 1
    assert "top.h5" in found.bad[0]


def test_status_counts_proven_and_missing_shots(finished: Run) -> None:
    lines = finished.journal_path.read_text().splitlines(keepends=True)
    finished.journal_path.write_text("".join(lines[:-1]))
    found = run.status(finished)
    assert (found.shots, found.proven, found.missing) == (3, 2, 1)


def test_unchanged_files_are_not_refused(finished: Run, inputs: Inputs) -> None:
    finished.refuse_changes(inputs)


@pytest.mark.parametrize("name", ["plan.yaml", "rig.yaml", "dome.csv"])
def test_a_changed_file_is_refused_by_name(finished: Run, inputs: Inputs, tmp_path: Path, name: str) -> None:
    (tmp_path / name).write_text("something else\n")
    with pytest.raises(InputError) as refused:
        finished.refuse_changes(inputs)
    assert name in str(refused.value)
    assert [n for n in ("plan.yaml", "rig.yaml", "dome.csv") if n in str(refused.value)] == [name]


def test_a_run_that_is_locked_is_refused_to_another(finished: Run) -> None:
    held = finished.lock()
    with pytest.raises(InputError, match="another process is acquiring into this run"):
        Run(finished.folder).lock()
    os.close(held)


def test_a_lock_that_was_given_back_can_be_taken(finished: Run) -> None:
    os.close(finished.lock())
    os.close(Run(finished.folder).lock())


def test_a_folder_without_run_json_is_no_run(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="not a run folder"):
        Run(tmp_path)
