"""A view's file: frames that others can read, slots that overwrite nothing proven."""

from __future__ import annotations

import mmap
import os
from pathlib import Path

import h5py
import numpy as np
import pytest
import xxhash
from view_files import DATA, FORMAT, FRAMES, METADATA, ODD, SLOTS, frame, write_view

from coupole.devices import ArmState, FrameFormat
from coupole.errors import StorageError
from coupole.storage import frame_file
from coupole.storage.frame_file_creation import create
from coupole.storage.view_writer import ViewWriter


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
    create(tmp_path / "top.h5", 1, FORMAT, METADATA)
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
    create(tmp_path / "top.h5", 1, FORMAT, METADATA)
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
    assert frame_file.read_facts(tmp_path / "top.h5") == {"pattern": "GBRG", "black_dn": 64, "white_dn": 4095}


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
    states = frame_file.read_frames(tmp_path / "top.h5")["state"].tolist()
    assert states == [frame_file.PROVEN] * 3 + [frame_file.STORED] + [frame_file.FREE] * 2


def test_after_a_sync_the_file_says_of_each_frame_what_it_is_though_it_was_never_closed(tmp_path: Path) -> None:
    """A process that is killed closes nothing."""
    path = tmp_path / "top.h5"
    create(path, 3, FORMAT, METADATA)
    writer = ViewWriter(path, {})
    slot = writer.store(frame(1), frame_id=1, camera_ns=1, exposure_us=8000)
    writer.prove(slot, "top/led0007/e0", led=7)
    writer.sync()
    record = frame_file.read_frames(path)[slot]
    assert (record["state"], record["led"], record["shot"]) == (frame_file.PROVEN, 7, b"top/led0007/e0")
    writer.close()


def test_reopening_keeps_proven_slots_and_frees_all_others(tmp_path: Path) -> None:
    path = tmp_path / "top.h5"
    write_view(path, proven=3, stored=2)
    writer = ViewWriter(path, {"top/led0000/e0": 0, "top/led0002/e0": 2})
    writer.close()
    states = frame_file.read_frames(path)["state"].tolist()
    assert states == [frame_file.PROVEN, frame_file.FREE, frame_file.PROVEN] + [frame_file.FREE] * 3


def test_frames_written_after_reopening_overwrite_nothing_proven(tmp_path: Path) -> None:
    path = tmp_path / "top.h5"
    write_view(path, proven=2, stored=0)
    writer = ViewWriter(path, {"top/led0001/e0": 1})
    slots = {writer.store(frame(50 + k), frame_id=k, camera_ns=k, exposure_us=8000) for k in range(5)}
    writer.close()
    assert slots == {0, 2, 3, 4, 5}
    assert np.array_equal(frame_file.read_frame(path, frame_file.read_layout(path), 1), frame(1))


@pytest.mark.parametrize(("of", "begin"), [(FORMAT, 0), (FORMAT, 512), (FORMAT, 2), (ODD, 0)])
def test_frames_are_read_into_memory_of_any_alignment(tmp_path: Path, of: FrameFormat, begin: int) -> None:
    """FORMAT's frames can be read past the page cache, ODD's are no whole pages."""
    path = tmp_path / "top.h5"
    write_view(path, of=of)
    memory = np.frombuffer(mmap.mmap(-1, of.frame_bytes + begin), np.uint16)[begin // 2 :]
    pixels = memory.reshape(of.height_px, of.width_px)
    for slot in range(3):
        frame_file.read_frame_into(path, frame_file.read_layout(path), slot, pixels)
        assert np.array_equal(pixels, frame(slot, of))


def test_a_frame_behind_the_end_of_a_file_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "top.h5"
    write_view(path)
    layout = frame_file.read_layout(path)
    os.truncate(path, layout.data_offset + layout.frame_bytes + 512)
    with pytest.raises(StorageError, match="ends within slot 1"):
        frame_file.read_frame_into(path, layout, 1, frame(0))


def test_a_freed_slot_is_used_again(tmp_path: Path) -> None:
    create(tmp_path / "top.h5", 1, FORMAT, METADATA)
    writer = ViewWriter(tmp_path / "top.h5", {})
    slot = writer.store(frame(0), frame_id=1, camera_ns=1, exposure_us=8000)
    writer.free(slot)
    assert writer.store(frame(1), frame_id=2, camera_ns=2, exposure_us=8000) == slot
    writer.close()


def test_more_frames_than_slots_are_an_error_that_says_so(tmp_path: Path) -> None:
    create(tmp_path / "top.h5", 1, FORMAT, METADATA)
    writer = ViewWriter(tmp_path / "top.h5", {})
    writer.store(frame(0), frame_id=1, camera_ns=1, exposure_us=8000)
    with pytest.raises(StorageError, match="no slot is free"):
        writer.store(frame(1), frame_id=2, camera_ns=2, exposure_us=8000)
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
        frame_file.read_layout(tmp_path / "top.h5")
