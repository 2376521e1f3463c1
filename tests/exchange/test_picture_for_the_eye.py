"""Relit pictures for the eye: a patch of known reflectance, as colour-science has it under daylight."""

from __future__ import annotations

import io
import json
from pathlib import Path
from typing import Any

import cells
import numpy as np
import pytest
import tifffile
from colour_cases import D65, lamp, patches, sensor, write_tables
from lazily import lazily
from PIL import Image, ImageCms
from relight_cases import Coat, sheet, write_result

colour: Any = lazily("colour")

YELLOW, WHITE = 15, -1
"""Of the chart."""


def patch_result(folder: Path, patch: int) -> Path:
    """A matt sheet of a patch, as the camera's channels see it under the dome's LEDs."""
    signals = sensor() * lamp()[:, None]
    kd = patches()[0][patch] @ signals / signals.sum(axis=0) / np.pi
    coat = Coat(kd=(float(kd[0]), float(kd[1]), float(kd[2])))
    return write_result(folder, sheet(np.zeros((6, 6)), 60.0), coat, camera_mm=(0.0, 0.0, 330.0)).folder


@pytest.fixture(scope="module")
def spectra(tmp_path_factory: pytest.TempPathFactory) -> list[str | Path]:
    paths = write_tables(tmp_path_factory.mktemp("spectra"))
    return ["--for-the-eye", "--sensor-spectra", paths[0], "--led-spectrum", paths[1]]


def relight(result: Path, *options: str | Path) -> cells.Ended:
    return cells.here("reflectance", "relight", result, "--fit", "ggx", "--direction", "0,0,1", *options)


@pytest.mark.parametrize(("patch", "most"), [(YELLOW, 1.0), (WHITE, 0.1)])
def test_a_flat_patch_has_its_colour_under_daylight(
    tmp_path: Path, spectra: list[str | Path], patch: int, most: float
) -> None:
    result = patch_result(tmp_path / "result", patch)
    for name, steps in (("eye.tiff", 65535), ("eye.png", 255)):
        ended = relight(result, *spectra, "--white", "1", "--to", tmp_path / name, "--json")
        assert ended.code == 0, ended.err
        if name == "eye.tiff":
            with tifffile.TiffFile(tmp_path / name) as file:
                codes, profile = file.pages[0].asarray(), file.pages[0].iccprofile
                about = json.loads(file.pages[0].description)
        else:
            picture = Image.open(tmp_path / name)
            codes, profile, about = np.asarray(picture), picture.info["icc_profile"], picture.info["Description"]
            about = json.loads(about)
        height, width = codes.shape[:2]
        shown = codes[height // 2, width // 2] / steps
        xyz = colour.RGB_to_XYZ(colour.cctf_decoding(shown, "sRGB"), "sRGB", D65)
        lab = [colour.XYZ_to_Lab(one, D65) for one in (xyz, patches()[1][patch])]
        assert colour.delta_E(*lab, method="CIE 2000") < most + (0.5 if steps == 255 else 0.0)
        assert ImageCms.ImageCmsProfile(io.BytesIO(profile)).profile.profile_description.startswith("sRGB")
        assert about["simulated"] is True
        assert about["white"] == 1.0
        assert "sensor.csv and led.csv" in about["colour"]


def test_without_a_white_the_brightest_thousandth_is_white(tmp_path: Path, spectra: list[str | Path]) -> None:
    result = patch_result(tmp_path / "result", WHITE)
    ended = relight(result, *spectra, "--to", tmp_path / "eye.png", "--json")
    assert ended.document["white"] == pytest.approx(1.0, abs=0.01)
    assert np.asarray(Image.open(tmp_path / "eye.png")).max() == 255


@pytest.mark.parametrize(
    ("options", "why"),
    [
        (("--to", "eye.npy"), "ends in .png, .tif, .tiff"),
        (("--to", "eye.png", "--turn", "8"), "not to a video"),
        (("--to", "eye.png", "--led", "7"), "an LED's picture are shares of the camera's range"),
    ],
)
def test_what_cannot_be_for_the_eye_is_refused(
    tmp_path: Path, spectra: list[str | Path], options: tuple[str, ...], why: str
) -> None:
    result = patch_result(tmp_path / "result", WHITE)
    before = sorted(tmp_path.iterdir())
    paths = [tmp_path / one if one.startswith("eye") else one for one in options]
    ended = relight(result, *spectra, *paths)
    assert ended.code == 2
    assert why in " ".join(ended.err.split())
    assert sorted(tmp_path.iterdir()) == before


def test_spectra_belong_together_and_to_pictures_for_the_eye(tmp_path: Path, spectra: list[str | Path]) -> None:
    result = patch_result(tmp_path / "result", WHITE)
    ended = relight(result, *spectra[:3], "--to", tmp_path / "eye.png")
    assert "expected --led-spectrum too" in " ".join(ended.err.split())
    ended = relight(result, *spectra[1:], "--to", tmp_path / "eye.png")
    assert "is for --for-the-eye" in " ".join(ended.err.split())
    grey = write_result(tmp_path / "grey", sheet(np.zeros((6, 6)), 60.0), channels=slice(0, 1)).folder
    ended = relight(grey, *spectra, "--to", tmp_path / "eye.png")
    assert "has no colours" in " ".join(ended.err.split())
    assert not (tmp_path / "eye.png").exists()
