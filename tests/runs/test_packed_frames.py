"""Frames stored as two pixels in three bytes: the same frames, in three quarters of the space."""

from __future__ import annotations

from pathlib import Path

import cells
import h5py
import numpy as np
import pytest
import tifffile
from archives import DATA, FORMAT, METADATA, MadeRun, make_run, noisy_frame
from cells import CellFolder
from expected_pictures import mislabelled

from coupole.errors import StorageError
from coupole.storage import frame_file
from coupole.storage.frame_file_creation import create
from coupole.storage.view_writer import ViewWriter


@pytest.fixture
def made(tmp_path: Path) -> MadeRun:
    return make_run(tmp_path, packed=True)


def test_a_run_that_packs_its_frames_proves_and_keeps_the_same_pictures(tmp_path: Path) -> None:
    cell = CellFolder(tmp_path)
    cell.rig_data["storage"]["pixels"] = "packed12"
    cell.write()
    ended = cell.acquire()
    assert ended.code == 0, ended.err
    assert ended.document["bytes"] == ended.document["frames"] * 128 * 96 * 3 // 2
    cells.assert_each_shot_proven_once(cell.run_folder)
    assert mislabelled(cell, cell.run_folder) == []
    assert cells.here("verify", cell.run_folder, "--json").code == 0


def test_packed_frames_take_three_quarters_of_the_space(made: MadeRun, tmp_path: Path) -> None:
    whole = make_run(tmp_path / "whole")
    packed_px, whole_px = (frame_file.read_layout(run.run.view_path("top")).frame_bytes for run in (made, whole))
    assert packed_px * 4 == whole_px * 3


def test_packed_frames_are_read_with_numpy_as_the_file_says(made: MadeRun) -> None:
    shot, frame = next(iter(made.run.proven().items()))
    with h5py.File(made.run.folder / frame.file) as file:
        assert "a[7:0], b[3:0] a[11:8], b[11:4]" in file[DATA].attrs["packing"]
        assert np.array_equal(cells.unpacked(file[DATA][frame.index]), made.frames[str(shot)])


def test_the_store_and_verify_read_packed_frames(made: MadeRun) -> None:
    for shot, frame in made.run.proven().items():
        path = made.run.folder / frame.file
        layout, memory = frame_file.read_layout(path), np.empty_like(made.frames[str(shot)])
        frame_file.read_frame_into(path, layout, frame.index, memory)
        for pixels in (memory, frame_file.read_frame(path, layout, frame.index)):
            assert np.array_equal(pixels, made.frames[str(shot)])
    assert cells.here("verify", made.run.folder).code == 0


def test_packed_frames_are_archived_as_whole_pixels(made: MadeRun) -> None:
    import hdf5plugin  # noqa: F401  # registers the filter

    assert cells.here("archive", made.run.folder).code == 0
    shot, frame = next(iter(made.run.proven().items()))
    with h5py.File(made.run.folder / frame.file) as file:
        assert file[DATA].dtype == np.uint16
        assert "packing" not in file[DATA].attrs
        assert np.array_equal(file[DATA][frame.index], made.frames[str(shot)])
    assert cells.here("verify", made.run.folder).code == 0


def test_packed_frames_are_exported(made: MadeRun, tmp_path: Path) -> None:
    assert cells.here("export", made.run.folder, "--to", "tiff", "--out", tmp_path / "out").code == 0
    exported = sorted((tmp_path / "out").rglob("*.tif*"))
    pictures = [tifffile.imread(path).tobytes() for path in exported]
    assert sorted(pictures) == sorted(pixels.tobytes() for pixels in made.frames.values())


def test_a_frame_that_has_more_bits_is_not_packed_and_not_cut(tmp_path: Path) -> None:
    path = tmp_path / "view.h5"
    create(path, 2, FORMAT, {**METADATA, "title": "view"}, is_packed=True)
    writer = ViewWriter(path, {})
    pixels = noisy_frame(1, FORMAT)
    pixels[0, 0] = 4096
    with pytest.raises(StorageError, match=r"cannot be packed: .* 12 bits, found a bit above them in 4096"):
        writer.store(pixels, frame_id=1, camera_ns=1, exposure_us=8000)
    writer.close()


def test_a_rig_that_would_pack_fourteen_bits_is_refused_at_its_line(tmp_path: Path) -> None:
    cell = CellFolder(tmp_path)
    cell.rig_data["storage"]["pixels"] = "packed12"
    cell.rig_data["sensor"]["bit_depth"] = 14
    cell.write()
    ended = cells.here("check", cell.plan)
    assert ended.code == 2
    assert "storage.pixels: frames cannot be packed: expected an even width and 12 bits at most" in ended.err
