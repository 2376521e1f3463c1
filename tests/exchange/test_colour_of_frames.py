"""Frames for the eye: patches of known reflectance, photographed by reckoning with the CIE's own
observer, and what other programs make of the files."""

from __future__ import annotations

import io
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import rawpy
import tifffile
from colour_cases import D65, lamp, patches, sensor, write_tables
from lazily import lazily
from PIL import Image, ImageCms

from coupole.errors import InputError
from coupole.exchange import dng, tiff_for_the_eye
from coupole.exchange.camera_colour import CameraColour, camera_colour
from coupole.exchange.exported_frame import Picture

colour: Any = lazily("colour")

BLACK, WHITE = 256, 16383
SIDE = 32
"""Of a patch, px."""
RGB = {"R": 0, "G": 1, "B": 2}


@pytest.fixture(scope="module")
def tables(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Path]:
    return write_tables(tmp_path_factory.mktemp("spectra"))


@pytest.fixture(scope="module")
def known(tables: tuple[Path, Path]) -> CameraColour:
    return camera_colour(*tables)


@pytest.fixture(scope="module")
def photograph() -> Picture:
    """The patches side by side under the LED; white fills the range of green, which sees most."""
    signals = patches()[0] * lamp() @ sensor()
    levels = np.rint(BLACK + (WHITE - BLACK) * signals / signals.max()).astype(np.uint16)
    mosaic = np.zeros((SIDE, SIDE * len(levels)), np.uint16)
    for place, letter in enumerate("GBRG"):
        mosaic[place // 2 :: 2, place % 2 :: 2] = np.repeat(levels[:, RGB[letter]], SIDE // 2)
    about = {"shot": "top/led0417/e0", "simulated": True, "led": 417}
    return Picture(mosaic, "GBRG", BLACK, WHITE, exposure_us=8000, taken_utc="", about=about)


def differences(linear: np.ndarray) -> np.ndarray:
    """[25] dE00 of the middles of patches in a linear picture [h, w, 3] of sRGB."""
    middles = linear[SIDE // 2, SIDE // 2 :: SIDE]
    found = colour.RGB_to_XYZ(middles, "sRGB", D65)
    pairs = (colour.XYZ_to_Lab(xyz, D65) for xyz in (found, patches()[1]))
    return np.asarray(colour.delta_E(*pairs, method="CIE 2000"))


def opened(content: bytes) -> tuple[np.ndarray, ImageCms.ImageCmsProfile]:
    with tifffile.TiffFile(io.BytesIO(content)) as file:
        page = file.pages[0]
        return page.asarray() / 65535.0, ImageCms.ImageCmsProfile(io.BytesIO(page.iccprofile))


@pytest.mark.parametrize("linear", [False, True])
def test_a_tiff_for_the_eye_shows_the_colours_under_daylight(
    photograph: Picture, known: CameraColour, linear: bool
) -> None:
    codes, profile = opened(tiff_for_the_eye.encode(photograph, known, linear=linear))
    decoded = codes if linear else colour.cctf_decoding(codes, "sRGB")
    off = differences(decoded)
    assert off.mean() < 2.0
    assert np.quantile(off, 0.95) < 5.5
    assert off[-1] < 0.02  # white
    half = Image.new("RGB", (1, 1), (128, 20, 240))
    shown = ImageCms.profileToProfile(half, profile, ImageCms.createProfile("sRGB")).getpixel((0, 0))
    encoded = 255 * np.asarray(colour.cctf_encoding(np.array([128, 20, 240]) / 255, "sRGB"))
    assert shown == pytest.approx(encoded if linear else (128, 20, 240), abs=1)


def test_what_is_saturated_is_white_in_a_tiff_for_the_eye(known: CameraColour) -> None:
    about = {"shot": "top/led0417/e0", "simulated": True, "led": 417}
    full = Picture(np.full((16, 16), WHITE, np.uint16), "GBRG", BLACK, WHITE, 8000, taken_utc="", about=about)
    codes, _ = opened(tiff_for_the_eye.encode(full, known, linear=True))
    np.testing.assert_allclose(codes, 1.0, atol=2e-3)


def test_libraw_develops_the_colours_of_a_dng(photograph: Picture, known: CameraColour) -> None:
    def developed(content: bytes) -> np.ndarray:
        with rawpy.imread(io.BytesIO(content)) as raw:
            shown = raw.postprocess(
                use_camera_wb=True, no_auto_bright=True, gamma=(1, 1), output_bps=16, user_flip=0
            )
        return np.asarray(shown) / 65535.0

    off = differences(developed(dng.encode(photograph, known)))
    assert off.mean() < 2.0
    assert np.quantile(off, 0.95) < 5.5
    assert differences(developed(dng.encode(photograph))).mean() > 8.0  # without the matrix


def test_a_monochrome_dng_refuses_colours_and_claims_none(photograph: Picture, known: CameraColour) -> None:
    grey = replace(photograph, pattern="MONO")
    with pytest.raises(InputError, match="--sensor-spectra: the camera's pattern is MONO"):
        dng.encode(grey, known)
    assert b"ColorMatrix1" not in dng.encode(grey)


def test_white_of_a_record_goes_before_that_of_the_spectra(tables: tuple[Path, Path]) -> None:
    measured = camera_colour(*tables, lambda led: np.array([0.5, 1.0, 0.25]))
    assert measured.neutral(7).tolist() == [0.5, 1.0, 0.25]
    assert "record" in measured.origin


@pytest.mark.parametrize(
    ("rows", "why"),
    [
        ("400;1;1;0\n500;1;1;0\n600;1;1;0\n", "one channel sees no light"),
        ("400;1;1;1\n500;2;2;2\n600;1;1;1\n", "channels are too similar"),
        ("400;1;1;1.000002\n500;2;2.000001;2\n600;1;1;1\n", "channels are too similar"),
        ("400;1\n500;1\n600;1\n", "expected column 1 to 1, found 2"),
        ("400;1;1;1\n500;1;-1;1\n600;1;1;1\n", "column 2 goes below 0"),
    ],
)
def test_tables_that_cannot_be_are_refused(tables: tuple[Path, Path], tmp_path: Path, rows: str, why: str) -> None:
    path = tmp_path / "sensor.csv"
    path.write_text(rows)
    with pytest.raises(InputError, match=why):
        camera_colour(path, tables[1])
