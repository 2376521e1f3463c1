"""Archived views: the same frames to any reader, in less room; and nothing is lost where something is wrong."""

from __future__ import annotations

import os
import subprocess
import sys
from collections.abc import Iterator
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import archives
import h5py
import hdf5plugin
import numpy as np
import pytest
from archives import DATA, FRAMES, Frame, MadeRun, make_run
from hypothesis import given, settings
from hypothesis import strategies as st

from coupole.devices import FrameFormat
from coupole.errors import ChecksumMismatch, InputError, StorageError, UnprovenError
from coupole.plan.shot_id import ShotId
from coupole.storage import frame_file
from coupole.storage.archive import KEPT_FOLDER, Archived, archive_run
from coupole.storage.bitshuffle import CODECS, FILL_DN, codec_of, compressed_tiles, tile_shape
from coupole.storage.run import Run
from coupole.storage.verification import verify
from coupole.storage.view_writer import ViewWriter

LZ4 = CODECS["lz4"]


@pytest.fixture
def made(tmp_path: Path) -> MadeRun:
    return make_run(tmp_path / "runs")


@pytest.fixture(params=list(CODECS))
def archived(made: MadeRun, request: pytest.FixtureRequest) -> MadeRun:
    archive_run(made.run, CODECS[request.param])
    return made


def views_bytes(run: Run) -> dict[str, bytes]:
    """Whatever lies in the folder of the views."""
    return {path.name: path.read_bytes() for path in (run.folder / "views").iterdir()}


def in_memory() -> h5py.File:
    return h5py.File("never written", "w", driver="core", backing_store=False)


# -- tiles ------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("codec", CODECS.values(), ids=list(CODECS))
@given(height=st.integers(1, 530), width=st.integers(1, 1100), seed=st.integers(0, 99))
@settings(max_examples=15, deadline=None)
def test_tiles_of_any_frame_are_what_the_filter_of_hdf5_reads(
    codec: Any, height: int, width: int, seed: int
) -> None:
    pixels = np.random.default_rng(seed).integers(0, 2 ** (1 + seed % 16), (height, width)).astype(np.uint16)
    tile = tile_shape(height, width)
    with in_memory() as file:
        data = file.create_dataset("d", pixels.shape, np.uint16, chunks=tile, **codec.filter)
        for place, compressed in compressed_tiles(pixels, tile, codec):
            data.id.write_direct_chunk(place, compressed)
        assert np.array_equal(data[:], pixels)


@pytest.mark.parametrize("codec", CODECS.values(), ids=list(CODECS))
def test_tiles_are_byte_for_byte_those_that_hdf5_writes_itself(codec: Any) -> None:
    pixels = np.random.default_rng(1).integers(0, 500, (512, 1024)).astype(np.uint16)
    tile = tile_shape(*pixels.shape)
    with in_memory() as file:
        data = file.create_dataset("d", pixels.shape, np.uint16, chunks=tile, **codec.filter)
        data[:] = pixels
        file.flush()
        for place, compressed in compressed_tiles(pixels, tile, codec):
            assert data.id.read_direct_chunk(place)[1] == compressed


@given(height=st.integers(1, 5000), width=st.integers(1, 5000))
def test_tiles_are_small_and_hardly_reach_beyond_the_frame(height: int, width: int) -> None:
    rows, columns = tile_shape(height, width)
    assert (rows, columns) <= (256, 512)
    assert -height % rows < -(-height // 256)
    assert -width % columns < -(-width // 512)


def test_a_codec_that_does_not_exist_is_refused_by_name() -> None:
    with pytest.raises(InputError, match="expected one of lz4, zstd; found gzip"):
        codec_of("gzip")


# -- what a reader finds ----------------------------------------------------------------------------------


def test_archived_frames_are_read_bit_exact_by_plain_h5py(archived: MadeRun) -> None:
    assert hdf5plugin.get_filters("bshuf")
    found: dict[str, Frame] = {}
    for view in ("top", "side"):
        with h5py.File(archived.run.view_path(view)) as file:
            assert file[DATA].dtype == np.uint16
            for slot, record in enumerate(file[FRAMES][:]):
                if record["state"] == 2:
                    found[record["shot"].decode()] = file[DATA][slot]
    assert found.keys() == archived.frames.keys()
    assert all(np.array_equal(found[shot], pixels) for shot, pixels in archived.frames.items())


def test_archived_frames_are_read_bit_exact_by_the_store(archived: MadeRun) -> None:
    for shot, frame in archived.run.proven().items():
        path = archived.run.folder / frame.file
        pixels = frame_file.read_frame(path, frame_file.read_layout(path), frame.index)
        assert np.array_equal(pixels, archived.frames[str(shot)])
        memory = np.empty_like(pixels)
        frame_file.read_frame_into(path, frame_file.read_layout(path), frame.index, memory)
        assert np.array_equal(memory, pixels)


def contents(path: Path) -> dict[str, Any]:
    """All names of a view's file with attributes, links and values, but for the frames and what is new of them."""
    found: dict[str, Any] = {}

    def look(name: str, of: h5py.HLObject) -> None:
        value = of[()] if isinstance(of, h5py.Dataset) and of.name != f"/{DATA}" else None
        if name == FRAMES:
            value = value[value["state"] == frame_file.PROVEN]
        attributes = {
            k: np.asarray(v).tolist() for k, v in of.attrs.items() if k not in ("archived", "not_stored")
        }
        kind = (of.dtype, of.shape) if isinstance(of, h5py.Dataset) else None
        found[name] = (attributes, kind, value.tobytes() if isinstance(value, np.ndarray) else value)

    with h5py.File(path) as file:
        look("/", file)
        file.visititems(look)
        found["link"] = file["entry/data"].get("data", getlink=True).path
    return found


def test_frames_are_read_right_while_the_run_is_being_archived(made: MadeRun) -> None:
    """A reader knows a view's layout when another file comes to its place."""
    proven = made.run.proven()
    layouts = {frame.file: frame_file.read_layout(made.run.folder / frame.file) for frame in proven.values()}
    archive_run(made.run, LZ4)
    for shot, frame in proven.items():
        pixels = frame_file.read_frame(made.run.folder / frame.file, layouts[frame.file], frame.index)
        assert np.array_equal(pixels, made.frames[str(shot)])


def test_all_but_the_frames_is_kept_as_it_was(made: MadeRun) -> None:
    before = contents(made.run.view_path("top"))
    archive_run(made.run, LZ4)
    assert contents(made.run.view_path("top")) == before


def test_an_archive_says_that_it_is_one(archived: MadeRun) -> None:
    with h5py.File(archived.run.view_path("top")) as file:
        assert " by coupole " in file[DATA].attrs["archived"]
        assert "65535" in file[DATA].attrs["not_stored"]


def test_slots_without_a_proven_frame_are_free_and_read_as_65535(archived: MadeRun) -> None:
    with h5py.File(archived.run.view_path("top")) as file:
        table, data = file[FRAMES][:], file[DATA]
        free = np.flatnonzero(table["state"] != frame_file.PROVEN)
        assert free.tolist() == [0, 5, 6]
        assert table[free].tobytes() == bytes(3 * frame_file.FRAME_DTYPE.itemsize)
        assert all((data[slot] == FILL_DN).all() for slot in free)


def test_an_archived_run_verifies(archived: MadeRun) -> None:
    found = verify(archived.run)
    assert (found.ok, found.frames) == (True, 8)


@pytest.mark.parametrize("codec", list(CODECS))
def test_verify_finds_a_flipped_byte_of_an_archive(made: MadeRun, codec: str) -> None:
    archive_run(made.run, CODECS[codec])
    path, frame = made.run.view_path("top"), made.run.proven()[ShotId.parse("top/led0001/e0")]
    with h5py.File(path) as file:
        chunk = file[DATA].id.get_chunk_info_by_coord((frame.index, 0, 0))
    flip_byte(path, chunk.byte_offset + chunk.size // 2)
    found = verify(made.run)
    assert len(found.bad) == 1
    assert found.bad[0].startswith("top/led0001/e0: ")


def flip_byte(path: Path, offset: int) -> None:
    with path.open("r+b") as file:
        file.seek(offset)
        byte = file.read(1)[0]
        file.seek(offset)
        file.write(bytes([byte ^ 0x10]))


def test_frames_of_an_odd_size_are_archived_too(tmp_path: Path) -> None:
    odd = FrameFormat(height_px=301, width_px=523, bit_depth=12, bayer_pattern="MONO", black_dn=64, white_dn=4095)
    made = make_run(tmp_path, views=("odd",), shots=2, of=odd)
    archive_run(made.run, LZ4)
    assert verify(made.run).ok


# -- figures ----------------------------------------------------------------------------------------------


def test_the_space_that_was_freed_is_that_of_the_files(made: MadeRun) -> None:
    before = sum(made.run.view_path(view).stat().st_blocks * 512 for view in ("top", "side"))
    figures = archive_run(made.run, LZ4).figures()
    after = sum(made.run.view_path(view).stat().st_blocks * 512 for view in ("top", "side"))
    assert figures["freed_bytes"] == before - after > 0


def test_the_ratio_is_that_of_the_proven_frames(made: MadeRun) -> None:
    figures = archive_run(made.run, LZ4).figures()
    assert figures["bytes"] == 8 * archives.FORMAT.frame_bytes
    assert figures["ratio"] == pytest.approx(figures["bytes"] / figures["stored_bytes"], rel=1e-4)
    assert figures["ratio"] > 1.5


def test_archived_views_need_no_more_room_when_a_run_is_resumed(archived: MadeRun) -> None:
    assert archived.run.occupied_space().bytes == 2 * 7 * archives.FORMAT.frame_bytes


# -- what is archived, and what is not --------------------------------------------------------------------


def test_a_second_call_changes_nothing(archived: MadeRun) -> None:
    before = views_bytes(archived.run)
    again = archive_run(archived.run, LZ4)
    assert (again.views, again.already) == ([], ["top", "side"])
    assert views_bytes(archived.run) == before


def test_files_are_kept_as_they_were_where_that_is_asked(made: MadeRun) -> None:
    before = views_bytes(made.run)
    found = archive_run(made.run, LZ4, keep=True)
    kept = made.run.folder / KEPT_FOLDER
    assert {path.name: path.read_bytes() for path in kept.iterdir()} == before
    assert found.figures()["freed_bytes"] < 0
    assert verify(made.run).ok


def test_a_call_that_ended_after_keeping_a_file_is_gone_on_with(made: MadeRun) -> None:
    kept = made.run.folder / KEPT_FOLDER
    kept.mkdir()
    os.link(made.run.view_path("top"), kept / "top.h5")
    assert len(archive_run(made.run, LZ4, keep=True).views) == 2


def test_what_a_killed_call_left_is_written_over(made: MadeRun) -> None:
    (made.run.folder / "views" / "top.archive").write_bytes(b"\x89HDF torn")
    archive_run(made.run, LZ4)
    assert sorted(views_bytes(made.run)) == ["side.h5", "top.h5"]
    assert verify(made.run).ok


def test_a_run_that_is_not_complete_is_refused(tmp_path: Path) -> None:
    made = make_run(tmp_path, missing=("side/led0002/e0",))
    before = views_bytes(made.run)
    with pytest.raises(UnprovenError, match=r"1 frames are missing, the first side/led0002/e0\. Resume"):
        archive_run(made.run, LZ4)
    assert views_bytes(made.run) == before


def test_of_a_run_that_is_not_complete_only_complete_views_are_archived(tmp_path: Path) -> None:
    made = make_run(tmp_path, missing=("side/led0002/e0",))
    before = views_bytes(made.run)["side.h5"]
    found = archive_run(made.run, LZ4, partial=True)
    assert ([view.view for view in found.views], found.incomplete) == (["top"], ["side"])
    assert views_bytes(made.run)["side.h5"] == before


def test_a_run_that_another_process_acquires_into_is_refused(made: MadeRun) -> None:
    held = Run(made.run.folder).lock()
    try:
        with pytest.raises(InputError, match="another process"):
            archive_run(made.run, LZ4)
    finally:
        os.close(held)


def test_nothing_more_is_written_into_an_archived_view(archived: MadeRun) -> None:
    with pytest.raises(StorageError, match="is archived, so nothing can be written"):
        ViewWriter(archived.run.view_path("top"), {})


# -- what is wrong stays as it is -------------------------------------------------------------------------


def archive_is_refused(made: MadeRun, match: str, **options: Any) -> None:
    """It ends with a wrong checksum, and every file is as it was."""
    before = views_bytes(made.run)
    with pytest.raises(ChecksumMismatch, match=match):
        archive_run(made.run, LZ4, **options)
    assert views_bytes(made.run) == before


def test_a_frame_that_changed_on_the_disk_is_not_archived(made: MadeRun) -> None:
    path, slot = made.run.view_path("top"), made.run.proven()[ShotId.parse("top/led0001/e0")].index
    layout = frame_file.read_layout(path)
    flip_byte(path, layout.data_offset + slot * layout.frame_bytes + 777)
    archive_is_refused(made, "top/led0001/e0 differs from what was proven")


def test_a_record_that_contradicts_the_journal_is_not_archived(made: MadeRun) -> None:
    path, slot = made.run.view_path("top"), made.run.proven()[ShotId.parse("top/led0001/e0")].index
    flip_byte(path, frame_file.read_layout(path).table_offset + slot * frame_file.FRAME_DTYPE.itemsize + 12)
    archive_is_refused(made, f"slot {slot} should be recorded as top/led0001/e0")


def test_an_archive_that_does_not_read_back_does_not_replace_the_file(made: MadeRun) -> None:
    """A byte of the new file is flipped as soon as all frames are in it."""
    wanted = made.frames["top/led0001/e0"]
    (_, tile), *_ = compressed_tiles(wanted, tile_shape(*wanted.shape), LZ4)
    partial = made.run.folder / "views" / "top.archive"

    def spoil(what: str, done: int, total: int) -> None:
        if (what, done) == ("top: compress", total):
            flip_byte(partial, partial.read_bytes().index(tile) + len(tile) // 2)

    archive_is_refused_or_unreadable(made, spoil)


def archive_is_refused_or_unreadable(made: MadeRun, spoil: Any) -> None:
    """Spoilt tiles decode to other pixels, or not at all: both end in an error, and every file is as it was."""
    before = views_bytes(made.run)
    with pytest.raises(StorageError, match="The view is unchanged"):
        archive_run(made.run, LZ4, progress=spoil)
    assert views_bytes(made.run) == before


# -- NeXus ------------------------------------------------------------------------------------------------

CLASSES = {
    "/entry": "NXentry",
    "/entry/instrument": "NXinstrument",
    "/entry/instrument/detector": "NXdetector",
    "/entry/instrument/robot": "NXpositioner",
    "/entry/sample": "NXsample",
    "/entry/data": "NXdata",
}
UNITS = {"x_pixel_size": "um", "y_pixel_size": "um", "data": "DN"}


def nexus_problems(path: Path) -> Iterator[str]:
    """Where a file breaks the rules of NeXus that a plotting program relies on (NeXus manual, 2.3 and NXdata)."""
    with h5py.File(path) as file:
        groups: dict[str, h5py.Group] = {}
        file.visititems(lambda _, of: groups.update({of.name: of}) if isinstance(of, h5py.Group) else None)
        found = {name: group.attrs.get("NX_class") for name, group in groups.items()}
        if found != CLASSES:
            yield f"classes {found}"
        shown = file[file.attrs["default"]][file[file.attrs["default"]].attrs["default"]]
        if shown.attrs["NX_class"] != "NXdata" or not isinstance(shown[shown.attrs["signal"]], h5py.Dataset):
            yield "the default plot leads to no signal"
        detector = file["entry/instrument/detector"]
        for name, unit in UNITS.items():
            if detector[name].attrs.get("units") != unit:
                yield f"{name} is not in {unit}"
        if not isinstance(file["entry/title"][()], bytes):
            yield "the entry has no title"


@pytest.mark.parametrize("when", ["fresh", "archived"])
def test_files_keep_the_rules_of_nexus(made: MadeRun, when: str) -> None:
    if when == "archived":
        archive_run(made.run, LZ4)
    assert list(nexus_problems(made.run.view_path("top"))) == []


@pytest.mark.skipif(find_spec("punx") is None, reason="punx, the NeXus validator, is not installed: it wants Qt")
@pytest.mark.parametrize("when", ["fresh", "archived"])
def test_punx_finds_nothing_against_the_nexus_base_classes(made: MadeRun, when: str) -> None:
    if when == "archived":
        archive_run(made.run, LZ4)
    command = [sys.executable, "-m", "punx.main", "validate", "--report", "ERROR,WARN"]
    said = subprocess.run(
        [*command, str(made.run.view_path("top"))], check=True, capture_output=True, text=True, timeout=120
    ).stdout
    counts = {
        words[0]: int(words[1])
        for line in said.splitlines()
        if len(words := line.split()) > 2 and words[1].isdigit()
    }
    assert (counts["ERROR"], counts["WARN"]) == (0, 0), said
    assert counts["OK"] > 50


def test_the_result_of_nothing_to_do_has_no_ratio() -> None:
    assert Archived().figures()["ratio"] is None
