"""KTX 2.0 textures, read by others: container by ktx-parse, levels by zstandard, blocks by texture2ddecoder."""

from __future__ import annotations

import base64
from itertools import pairwise
from pathlib import Path
from typing import Any

import cells
import cv2
import numpy as np
import pytest
import texture2ddecoder
import trimesh
import zstandard
from checkers import ktx2_contents, needs_checkers
from relight_cases import Coat, waves, write_result

from coupole.exchange.atlas.ktx2_file import TexelFormat, encode_ktx2
from coupole.exchange.atlas.mip_levels import COLOUR, DIRECTION, SHARE, mip_levels
from coupole.reflectance.run_result import RunResult

RGBA8, BC5, BC7_SRGB = 37, 141, 146
"""VkFormat"""
DECODE = {BC5: texture2ddecoder.decode_bc5, BC7_SRGB: texture2ddecoder.decode_bc7}
MODELS = {RGBA8: 1, BC5: 132, BC7_SRGB: 134}
LINEAR, SRGB = 1, 2


def linear(codes: np.ndarray) -> np.ndarray:
    shares = codes / 255.0
    found: np.ndarray = np.where(shares <= 0.04045, shares / 12.92, ((shares + 0.055) / 1.055) ** 2.4)
    return found


def painted(height: int, width: int) -> np.ndarray:
    """A smooth picture [h, w, 3] of codes, with fine grain."""
    y, x = np.mgrid[:height, :width]
    waves_there = [128 + 90 * np.sin(x / 23.0), 110 + 60 * np.cos(y / 17.0), 90 + 50 * np.sin((x + y) / 29.0)]
    grain = np.random.default_rng(2).normal(0.0, 2.0, (height, width))
    return np.clip(np.rint(np.stack(waves_there, axis=2) + grain[..., None]), 0, 255).astype(np.uint8)


def decoded_levels(contents: dict[str, Any]) -> list[np.ndarray]:
    """[h, w, 4] codes of each level, the largest first."""
    vulkan, width, height = (contents[key] for key in ("vkFormat", "pixelWidth", "pixelHeight"))
    found = []
    for data, size in contents["levels"]:
        blocks = zstandard.decompress(base64.b64decode(data))
        assert len(blocks) == size
        texels = blocks if vulkan == RGBA8 else DECODE[vulkan](blocks, width, height)
        picture = np.frombuffer(texels, np.uint8).reshape(height, width, 4)
        found.append(picture if vulkan == RGBA8 else picture[..., [2, 1, 0, 3]])  # the decoder's blue is first
        width, height = max(width // 2, 1), max(height // 2, 1)
    assert width == height == 1
    return found


@pytest.mark.parametrize("size", [(64, 64), (61, 90), (7, 250), (1, 5), (1, 1)])
def test_levels_are_averages_of_linear_light_by_area(size: tuple[int, int]) -> None:
    codes = painted(*size)
    levels = list(mip_levels(codes, np.ones(size, np.bool_), COLOUR))
    np.testing.assert_array_equal(levels[0], codes)
    assert levels[-1].shape == (1, 1, 3)
    exact = linear(codes).astype(np.float32)
    for above, level in pairwise(levels):
        height, width = max(above.shape[0] // 2, 1), max(above.shape[1] // 2, 1)
        assert level.shape == (height, width, 3)
        exact = cv2.resize(exact, (width, height), interpolation=cv2.INTER_AREA).reshape(height, width, 3)
        np.testing.assert_allclose(linear(level), exact, atol=0.004)
    np.testing.assert_allclose(linear(levels[-1][0, 0]), linear(codes).mean(axis=(0, 1)), atol=0.004)


def test_black_and_white_lines_become_the_grey_of_half_the_light() -> None:
    lines = np.zeros((8, 8, 3), np.uint8)
    lines[:, ::2] = 255
    grey = list(mip_levels(lines, np.ones((8, 8), np.bool_), COLOUR))[1]
    assert set(grey.ravel()) == {188}  # of sRGB; 128 would be half the codes
    assert set(list(mip_levels(lines, np.ones((8, 8), np.bool_), SHARE))[1].ravel()) == {128}


def test_no_level_shows_what_is_between_the_charts() -> None:
    codes, is_known = np.zeros((101, 64, 3), np.uint8), np.zeros((101, 64), np.bool_)
    is_known[3:40, 5:20] = is_known[60:99, 31:50] = True
    codes[is_known] = (200, 100, 50)
    for level in mip_levels(codes, is_known, COLOUR):
        assert np.abs(level.astype(int) - (200, 100, 50)).max() <= 1


def test_averages_of_directions_are_directions() -> None:
    tilt = np.radians(40.0)
    two = np.array([[np.sin(tilt), 0.0, np.cos(tilt)], [-np.sin(tilt), 0.0, np.cos(tilt)]])
    codes = np.rint(255 * (0.5 * np.tile(two, (4, 2, 1)) + 0.5)).astype(np.uint8)
    smaller = list(mip_levels(codes, np.ones((4, 4), np.bool_), DIRECTION))[1]
    assert np.abs(smaller.astype(int) - (128, 128, 255)).max() <= 1


@needs_checkers
@pytest.mark.parametrize("size", [(64, 96), (61, 90), (3, 257), (1, 1)])
@pytest.mark.parametrize("texel_format", list(TexelFormat))
def test_a_file_is_read_by_others_within_its_formats_error(
    texel_format: TexelFormat, size: tuple[int, int], tmp_path: Path
) -> None:
    """Of sizes that are no powers of two and no multiples of a block's four texels, too."""
    levels = list(mip_levels(painted(*size), np.ones(size, np.bool_), COLOUR))
    path = tmp_path / "map.ktx2"
    path.write_bytes(encode_ktx2(levels, texel_format, {"KTXwriter": "tests", "odd": "ä", "a": "123"}))
    contents = ktx2_contents(path)
    assert (contents["pixelHeight"], contents["pixelWidth"]) == size
    assert contents["notes"] == {"KTXwriter": "tests", "a": "123", "odd": "ä"}
    (descriptor,) = contents["dataFormatDescriptor"]
    assert descriptor["colorModel"] == MODELS[contents["vkFormat"]]
    assert descriptor["transferFunction"] == (SRGB if contents["vkFormat"] == BC7_SRGB else LINEAR)
    channels = 2 if texel_format is TexelFormat.BC5 else 3
    for n, (level, theirs) in enumerate(zip(levels, decoded_levels(contents), strict=True)):
        rms = np.sqrt(np.mean((theirs[..., :channels].astype(float) - level[..., :channels]) ** 2))
        contrast = level.std(axis=(0, 1)).mean()  # a block of a small level has the whole picture's colours
        assert rms <= (2.0 if n == 0 else max(0.6, contrast / 2.0)) * (texel_format is not TexelFormat.RGBA8)


@pytest.fixture(scope="module")
def result(tmp_path_factory: pytest.TempPathFactory) -> RunResult:
    return write_result(
        tmp_path_factory.mktemp("waves") / "result", waves(20), Coat((0.2, 0.1, 0.05), (0.06, 0.05, 0.04), 0.36)
    )


@needs_checkers
def test_an_exported_result_has_the_maps_of_obj(result: RunResult, tmp_path: Path) -> None:
    for to in ("ktx2", "obj"):
        ended = cells.here("export", result.folder, "--to", to, "--out", tmp_path / to, "--texel-mm", "0.3")
        assert ended.code == 0, ended.err
    files = {path.stem: ktx2_contents(path) for path in (tmp_path / "ktx2").glob("*.ktx2")}
    assert {name: file["vkFormat"] for name, file in files.items()} == {
        "base_color": BC7_SRGB,
        "specular": BC7_SRGB,
        "occlusion_roughness": BC5,
        "normal": RGBA8,
    }
    pictures = {
        path.stem: cv2.imread(str(path), cv2.IMREAD_UNCHANGED) for path in (tmp_path / "obj").glob("*.png")
    }
    both = np.stack([pictures["occlusion"], pictures["roughness"]], axis=2)
    known = pictures["roughness"] > 0
    wanted = {"base_color": pictures["base_color"][..., ::-1], "specular": pictures["specular"][..., ::-1]}
    wanted |= {"occlusion_roughness": both, "normal": pictures["normal"][..., ::-1] / 257.0}
    for name, file in files.items():
        assert file["notes"]["coupole.about"].startswith("simulated with Coupole")
        assert file["notes"]["KTXorientation"] == "rd"
        theirs = decoded_levels(file)[0][..., : wanted[name].shape[2]]
        errors = np.abs(theirs.astype(float) - wanted[name])[known]
        assert errors.mean() < 0.7, name
        assert errors.max() <= 4, name
    assert "ks / 0.06" in files["specular"]["notes"]["coupole.values"]
    mesh, same = (trimesh.load(tmp_path / to / "surface.obj", process=False) for to in ("ktx2", "obj"))
    np.testing.assert_allclose(mesh.vertices, same.vertices)
    np.testing.assert_allclose(mesh.visual.uv, same.visual.uv)
