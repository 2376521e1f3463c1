"""Frames as DNG and TIFF: other programs read the camera's own numbers, and what the frame is."""

from __future__ import annotations

import io
import json
import shutil
import subprocess
from pathlib import Path
from typing import Any

import cells
import numpy as np
import pytest
import rawpy
from archives import Frame, MadeRun, make_run
from hypothesis import given, settings
from hypothesis import strategies as st
from places import SHARED_DATA

from coupole.devices import FrameFormat
from coupole.errors import ChecksumMismatch, InputError
from coupole.exchange import dng, tiff
from coupole.exchange.export import FramePatterns, export_run
from coupole.exchange.exported_frame import Picture
from coupole.exchange.formats import Source, Writer, formats_of
from coupole.plan.shot_id import ShotId
from coupole.storage import frame_file
from coupole.storage.archive import archive_run
from coupole.storage.bitshuffle import CODECS

PATTERNS = ("GBRG", "GRBG", "RGGB", "BGGR")
REFERENCE = SHARED_DATA / "raw/colorchart.dng"

OF_FRAMES = formats_of(Source.RUN, Writer.FRAMES)


def picture(pixels: Frame, *, pattern: str = "GBRG", black_dn: int = 64, white_dn: int = 4095) -> Picture:
    """Pixels with the least that must be known of them."""
    about = {"shot": "top/led0417/e0", "simulated": True, "camera": "memory camera sim-0"}
    return Picture(
        pixels, pattern, black_dn, white_dn, exposure_us=8000, taken_utc="2026-11-23T08:39:19.485Z", about=about
    )


def random_pixels(height: int, width: int, most: int, seed: int = 1) -> Frame:
    return np.random.default_rng(seed).integers(0, most + 1, (height, width)).astype(np.uint16)


def tags_of(content: bytes) -> dict[str, Any]:
    """Tags of a file's image by name, as tifffile reads them."""
    import tifffile

    with tifffile.TiffFile(io.BytesIO(content)) as file:
        return {tag.name: tag.value for tag in file.pages[0].tags.values()}


@pytest.fixture
def made(tmp_path: Path) -> MadeRun:
    return make_run(tmp_path / "runs")


@pytest.fixture
def out(tmp_path: Path) -> Path:
    return tmp_path / "out"


def export(
    made: MadeRun, to: str, out: Path, views: tuple[str, ...] = (), shots: tuple[str, ...] = ()
) -> list[str]:
    """Names of the files that were written."""
    found = export_run(made.run, to, out, patterns=FramePatterns(views, shots))
    names = sorted(path.name for path in out.iterdir())
    assert found.files == len(names)
    assert found.bytes == sum(path.stat().st_size for path in out.iterdir())
    return names


# -- DNG --------------------------------------------------------------------------------------------------


def as_libraw_reads(content: bytes) -> Any:
    return rawpy.imread(io.BytesIO(content))


@pytest.mark.parametrize("pattern", PATTERNS)
@given(
    height=st.integers(11, 60),
    width=st.integers(11, 90),
    most=st.sampled_from([1, 4095, 16383, 65535]),
    black_dn=st.integers(0, 400),
)
@settings(max_examples=12, deadline=None)
def test_libraw_reads_a_dng_bit_exact_whatever_its_size_and_depth(
    pattern: str, height: int, width: int, most: int, black_dn: int
) -> None:
    pixels = random_pixels(height * 2, width * 2, most)
    content = dng.encode(picture(pixels, pattern=pattern, black_dn=black_dn, white_dn=max(most, 500)))
    with as_libraw_reads(content) as raw:
        assert np.array_equal(raw.raw_image, pixels)


@pytest.mark.parametrize("pattern", PATTERNS)
def test_libraw_finds_pattern_and_levels_in_a_dng(pattern: str) -> None:
    with as_libraw_reads(dng.encode(picture(random_pixels(64, 96, 4095), pattern=pattern))) as raw:
        letters = raw.color_desc.decode()
        assert "".join(letters[place] for place in raw.raw_pattern.reshape(-1)) == pattern
        assert raw.black_level_per_channel == [64, 64, 64, 64]
        assert raw.white_level == 4095


def test_libraw_develops_a_dng_of_a_grey_card_to_grey() -> None:
    grey = np.full((64, 96), 2000, np.uint16)
    with as_libraw_reads(dng.encode(picture(grey))) as raw:
        shown = raw.postprocess(use_camera_wb=True, no_auto_bright=True)
    assert shown.shape == (64, 96, 3)
    assert np.ptp(shown[20:40, 20:60].astype(int)) <= 2


def test_a_monochrome_frame_is_read_bit_exact_by_libraw() -> None:
    pixels = random_pixels(64, 96, 4095)
    with as_libraw_reads(dng.encode(picture(pixels, pattern="MONO"))) as raw:
        assert np.array_equal(raw.raw_image, pixels)


def test_twelve_bits_take_twelve_bits() -> None:
    pixels = random_pixels(64, 96, 4095)
    content = dng.encode(picture(pixels))
    assert tags_of(content)["BitsPerSample"] == 12
    assert tags_of(content)["StripByteCounts"] == (64 * 96 * 3 // 2,)


def test_a_pixel_beyond_twelve_bits_is_kept_in_sixteen() -> None:
    pixels = random_pixels(64, 96, 4095)
    pixels[3, 5] = 4096
    content = dng.encode(picture(pixels))
    assert tags_of(content)["BitsPerSample"] == 16
    with as_libraw_reads(content) as raw:
        assert raw.raw_image[3, 5] == 4096


@pytest.mark.skipif(shutil.which("exiftool") is None, reason="ExifTool is not installed")
@pytest.mark.parametrize("pattern", ["GBRG", "MONO"])
def test_exiftool_finds_nothing_amiss_in_a_dng_and_reads_how_it_was_taken(pattern: str, tmp_path: Path) -> None:
    made = picture(random_pixels(64, 96, 4095), pattern=pattern)
    made.about.update(f_number=8.0, focal_length_mm=35.0)
    path = tmp_path / "frame.dng"
    path.write_bytes(dng.encode(made))
    words = ["exiftool", "-validate", "-warning", "-error", "-a", "-j", "-n", "-G1", "-all", str(path)]
    (found,) = json.loads(subprocess.run(words, check=True, capture_output=True).stdout)
    assert found["ExifTool:Validate"] == "0 0 0"  # errors, warnings, minor ones
    assert {key: found[f"ExifIFD:{key}"] for key in ("ExposureTime", "FNumber", "FocalLength", "LensModel")} == {
        "ExposureTime": 0.008,
        "FNumber": 8,
        "FocalLength": 35,
        "LensModel": "35 mm f/8",
    }
    assert found["ExifIFD:DateTimeOriginal"] == found["IFD0:ModifyDate"] == "2026:11:23 08:39:19"
    assert (found["IFD0:Make"], found["IFD0:Model"]) == ("La Coupole", "memory camera sim-0 (simulated)")


def test_a_dng_says_that_it_is_simulated_and_that_its_colours_are_not_calibrated() -> None:
    tags = tags_of(dng.encode(picture(random_pixels(64, 96, 4095))))
    about = json.loads(tags["ImageDescription"])
    assert about["simulated"] is True
    assert about["colour"].startswith("not calibrated")
    assert tags["UniqueCameraModel"] == "La Coupole memory camera sim-0 (simulated)"
    assert tags["CalibrationIlluminant1"] == 0


def test_a_dng_holds_the_exposure_time() -> None:
    assert tags_of(dng.encode(picture(random_pixels(64, 96, 4095))))["ExifTag"]["ExposureTime"] == (1, 125)


def test_tags_of_a_dng_stand_in_ascending_order() -> None:
    import tifffile

    with tifffile.TiffFile(io.BytesIO(dng.encode(picture(random_pixels(64, 96, 4095))))) as file:
        codes = [tag.code for tag in file.pages[0].tags.values()]
    assert codes == sorted(set(codes))


@pytest.mark.skipif(not REFERENCE.exists(), reason="the reference DNG is not here")
def test_the_frame_of_a_real_dng_survives_ours_bit_exact() -> None:
    with rawpy.imread(str(REFERENCE)) as raw:
        pixels, black_dn, white_dn = raw.raw_image.copy(), raw.black_level_per_channel[0], int(raw.white_level)
        letters = raw.color_desc.decode()
        pattern = "".join(letters[place] for place in raw.raw_pattern.reshape(-1))
        before = raw.raw_colors.copy()
    ours = dng.encode(picture(pixels, pattern=pattern, black_dn=black_dn, white_dn=white_dn))
    with as_libraw_reads(ours) as raw:
        assert np.array_equal(raw.raw_image, pixels)
        assert np.array_equal(raw.raw_colors, before)
        assert (raw.black_level_per_channel[0], raw.white_level) == (black_dn, white_dn)


# -- TIFF -------------------------------------------------------------------------------------------------


@given(height=st.integers(1, 60), width=st.integers(1, 90))
@settings(max_examples=20, deadline=None)
def test_a_tiff_of_any_size_is_read_bit_exact(height: int, width: int) -> None:
    import tifffile

    pixels = random_pixels(height, width, 65535)
    found = tifffile.imread(io.BytesIO(tiff.encode(picture(pixels))))
    assert np.array_equal(found.reshape(pixels.shape), pixels)
    assert found.dtype == np.uint16


def test_a_tiff_says_what_it_shows() -> None:
    about = json.loads(tags_of(tiff.encode(picture(random_pixels(4, 6, 4095))))["ImageDescription"])
    assert about["shot"] == "top/led0417/e0"
    assert about["simulated"] is True
    assert (about["bayer_pattern"], about["black_dn"], about["white_dn"]) == ("GBRG", 64, 4095)


# -- a run ------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("to", OF_FRAMES)
def test_each_frame_becomes_a_file_named_after_its_shot(made: MadeRun, out: Path, to: str) -> None:
    names = export(made, to, out)
    assert names == sorted(f"{shot.replace('/', '_')}.{to}" for shot in made.frames)
    assert f"top_led0003_e0.{to}" in names


def test_exported_frames_are_bit_exact_and_under_their_own_names(made: MadeRun, out: Path) -> None:
    import tifffile

    export(made, "tiff", out)
    for shot, pixels in made.frames.items():
        assert np.array_equal(tifffile.imread(out / f"{shot.replace('/', '_')}.tiff"), pixels)


def test_an_archived_run_is_exported_as_it_was_before(made: MadeRun, tmp_path: Path) -> None:
    export(made, "dng", tmp_path / "before")
    archive_run(made.run, CODECS["lz4"])
    export(made, "dng", tmp_path / "after")
    for path in (tmp_path / "before").iterdir():
        assert (tmp_path / "after" / path.name).read_bytes() == path.read_bytes()


def test_a_file_tells_where_the_camera_stood_and_what_shone(made: MadeRun, out: Path) -> None:
    export(made, "dng", out, shots=("led0002/*",), views=("top",))
    about = json.loads(tags_of((out / "top_led0002_e0.dng").read_bytes())["ImageDescription"])
    assert (about["shot"], about["led"], about["exposure_us"]) == ("top/led0002/e0", 2, 8000)
    assert (about["board_temperature_c"], about["led_current_ma"]) == (25.1, 700)
    assert about["joints_deg"] == [1, 2, 3, 4, 5, 6]
    assert about["base_from_camera"] == (2 * np.eye(4)).tolist()
    assert about["run"] == made.run.folder.name


@pytest.mark.parametrize(
    ("views", "shots", "count"),
    [((), (), 8), (("top",), (), 4), (("t*",), ("led0001/e0",), 1), (("top", "side"), ("*/e0",), 8)],
)
def test_views_and_shots_are_chosen_by_patterns(
    made: MadeRun, out: Path, views: tuple[str, ...], shots: tuple[str, ...], count: int
) -> None:
    assert len(export(made, "dng", out, views, shots)) == count


def test_a_choice_without_a_frame_is_refused(made: MadeRun, out: Path) -> None:
    with pytest.raises(InputError, match="no proven frame matches"):
        export(made, "dng", out, views=("bottom",))


def test_a_format_that_is_not_known_is_refused_by_name(made: MadeRun, out: Path) -> None:
    with pytest.raises(InputError, match=f"expected one of {', '.join(OF_FRAMES)} for a run; found jpeg"):
        export(made, "jpeg", out)


def test_a_format_that_there_is_none_of_is_refused_by_all_that_a_run_has(made: MadeRun, out: Path) -> None:
    ended = cells.here("export", made.run.folder, "--to", "bogus", "--out", out)
    assert ended.code == 2
    formats = "dng, tiff, lp, dome, relight, ptm, rti, iiif, colmap, rocrate"
    assert f"--to: expected one of {formats} for a run; found bogus" in " ".join(ended.err.split())


def test_nothing_is_written_over_unless_that_is_asked(made: MadeRun, out: Path) -> None:
    out.mkdir()
    mine = out / "top_led0001_e0.dng"
    mine.write_bytes(b"mine")
    with pytest.raises(InputError, match="exists already"):
        export(made, "dng", out)
    assert [path.name for path in out.iterdir()] == [mine.name]
    assert mine.read_bytes() == b"mine"
    export_run(made.run, "dng", out, overwrite=True)
    assert mine.read_bytes() != b"mine"


def test_a_frame_that_changed_on_the_disk_is_not_exported(made: MadeRun, out: Path) -> None:
    path, frame = made.run.view_path("top"), made.run.proven()[ShotId.parse("top/led0001/e0")]
    layout = frame_file.read_layout(path)
    with path.open("r+b") as file:
        file.seek(layout.data_offset + frame.index * layout.frame_bytes)
        file.write(b"\xff\xff")
    with pytest.raises(ChecksumMismatch, match="top/led0001/e0 differs from what was proven"):
        export(made, "dng", out)
    assert not (out / "top_led0001_e0.dng").exists()


def test_frames_of_another_size_and_depth_are_exported_too(tmp_path: Path, out: Path) -> None:
    deep = FrameFormat(height_px=70, width_px=51, bit_depth=16, bayer_pattern="RGGB", black_dn=64, white_dn=65535)
    made = make_run(tmp_path / "runs", views=("deep",), shots=1, of=deep)
    export(made, "dng", out)
    with as_libraw_reads((out / "deep_led0000_e0.dng").read_bytes()) as raw:
        assert np.array_equal(raw.raw_image, made.frames["deep/led0000/e0"])
