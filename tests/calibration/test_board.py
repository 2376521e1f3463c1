"""Boards: their descriptions, and their corners in pictures of every kind."""

from __future__ import annotations

from functools import cache
from pathlib import Path

import cv2
import numpy as np
import pytest
from boards import CHARUCO, CHESS, LENS, as_dn, magnified, picture_of, texture_of
from numpy.typing import NDArray
from synthesis import Array

from coupole.calibration.grey_image import Picture
from coupole.calibration.lens import board as board_module
from coupole.calibration.lens.board import Board, Sighting, detect, in_channel, read_board
from coupole.errors import InputError

PATTERNS = ("GBRG", "GRBG", "RGGB", "BGGR")
BOARDS = pytest.mark.parametrize("board", [CHARUCO, CHESS], ids=lambda board: board.kind)


def found(board: Board, picture: Picture) -> Sighting:
    sighting = detect(board, picture)
    assert isinstance(sighting, Sighting), sighting
    return sighting


def rms(distances: Array) -> float:
    return float(np.sqrt(np.mean(np.sum(distances**2, axis=1))))


@BOARDS
@pytest.mark.parametrize(("dtype", "white"), [(np.uint8, 255), (np.uint16, 4095)], ids=["8 bits", "12 bits"])
def test_corners_are_found_to_a_fiftieth_of_a_pixel(board: Board, dtype: type, white: int) -> None:
    picture = picture_of(board, 3)
    image = as_dn(picture.pixels, white, noise_dn=white / 400).astype(dtype)
    seen = found(board, Picture.of_grey(image, white=float(white)))
    error = seen.pixels - picture.corners[seen.ids]
    assert len(seen.ids) > 0.9 * len(board.points_mm)
    assert rms(error) < 0.02
    assert np.abs(error.mean(axis=0)).max() < 0.005


@BOARDS
def test_a_board_seen_upside_down_has_the_same_numbers(board: Board) -> None:
    for seed in (1, 4):  # turned by different angles
        picture = picture_of(board, seed)
        seen = found(board, Picture.of_grey(as_dn(picture.pixels, 255).astype(np.uint8)))
        assert np.abs(seen.pixels - picture.corners[seen.ids]).max() < 0.5


@pytest.mark.parametrize("pattern", PATTERNS)
def test_the_green_pixels_of_a_raw_frame_give_corners_where_they_are_in_the_frame(pattern: str) -> None:
    picture = picture_of(CHARUCO, 2)
    frame = raw(picture.pixels, picture.pixels, pattern)
    seen = found(CHARUCO, Picture(frame, pattern, 4095.0))
    error = seen.pixels - picture.corners[seen.ids]
    assert rms(error) < 0.03
    assert np.abs(error.mean(axis=0)).max() < 0.005


@pytest.mark.parametrize("pattern", PATTERNS)
def test_lateral_colour_is_seen_between_green_and_red(pattern: str) -> None:
    green, red = picture_of(CHARUCO, 2), picture_of(CHARUCO, 2, magnified(LENS, 1.003))
    frame = raw(green.pixels, red.pixels, pattern)
    in_green = found(CHARUCO, Picture(frame, pattern, 4095.0))
    in_red = in_channel(CHARUCO, Picture(frame, pattern, 4095.0), "red", in_green)
    error = in_red.pixels - red.corners[in_red.ids]
    apart = (red.corners - green.corners)[in_red.ids]
    assert rms(error) < 0.2
    assert np.abs(error.mean(axis=0)).max() < 0.03
    slope = np.sum((in_red.pixels - in_green.pixels) * apart) / np.sum(apart**2)
    assert 0.8 < slope < 1.2


def raw(green: Array, red: Array, pattern: str) -> Array:
    """A Bayer frame whose red pixels see `red`, all others `green`, each colour at a brightness of its own."""
    gain = {"R": 0.6, "G": 1.0, "B": 0.45}
    frame = np.zeros(green.shape)
    for place, colour in enumerate(pattern):
        at = np.s_[place // 2 :: 2, place % 2 :: 2]
        frame[at] = as_dn(red if colour == "R" else green, 4095)[at] * gain[colour]
    return np.rint(frame).astype(np.uint16)


def test_a_clipped_picture_is_named_so() -> None:
    picture = picture_of(CHARUCO, 0)
    overexposed = np.clip(as_dn(picture.pixels, 4095) * 1.6, 0, 4095).astype(np.uint16)
    assert "clipped" in str(detect(CHARUCO, Picture.of_grey(overexposed, white=4095.0)))


def test_a_picture_without_a_board_says_how_many_corners_it_has() -> None:
    empty = Picture.of_grey(np.full((480, 640), 100, np.uint8))
    assert detect(CHARUCO, empty) == "0 of 70 corners seen, 8 needed"


def test_a_board_that_is_partly_hidden_gives_the_corners_that_are_left() -> None:
    picture = picture_of(CHARUCO, 0)
    image = as_dn(picture.pixels, 255).astype(np.uint8)
    image[:, :330] = 128
    seen = found(CHARUCO, Picture.of_grey(image))
    assert 10 < len(seen.ids) < 60
    assert rms(seen.pixels - picture.corners[seen.ids]) < 0.03


MOST_PX = {
    "plain": 0.001,
    "tilted": 0.003,
    "partly covered": 0.001,
    "blurred": 0.02,
    "noisy": 0.02,
    "small and noisy": 0.02,
}
"""Scenes, and how far apart corners of two searches may be: less than their noise where blur and noise are
large."""
LARGE_PX = (1200, 1120)
"""Width and height of images that are searched at a quarter and half of their size."""


@cache
def large_image(board: Board, scene: str) -> NDArray[np.uint16]:
    """[H, W] a board in a large image, seen through a homography."""
    width, height = LARGE_PX
    texture, _ = texture_of(board)
    texture_height, texture_width = texture.shape
    share = 0.5 if scene.startswith("small") else 0.75
    seen = np.array([[-1.0, -0.8], [1.0, -0.7], [0.95, 0.8], [-1.0, 0.75]])
    if scene == "tilted":
        seen[1:3] *= (1.0, 0.35)
    corners = np.array([[0, 0], [texture_width, 0], [texture_width, texture_height], [0, texture_height]])
    places = (seen * share + 1.0) * (0.5 * width, 0.5 * height)
    to_image = cv2.getPerspectiveTransform(corners.astype(np.float32), places.astype(np.float32))
    image = cv2.warpPerspective(texture.astype(np.float32), to_image, LARGE_PX, borderValue=0.5)
    image = cv2.GaussianBlur(image, (0, 0), 2.0 if scene == "blurred" else 0.8)
    if scene == "partly covered":
        image[:, : width // 2] = 0.5
    return as_dn(np.asarray(image, np.float64), 4095, 80.0 if scene.endswith("noisy") else 8.0).astype(np.uint16)


@pytest.mark.parametrize(
    ("board", "pattern", "scene"),
    [
        (board, pattern, scene)
        for board, pattern in ((CHARUCO, "MONO"), (CHARUCO, "GBRG"), (CHESS, "MONO"))
        for scene in MOST_PX
        if board is not CHESS or scene != "partly covered"  # OpenCV finds whole chessboards only
    ],
)
def test_a_search_at_a_quarter_of_the_size_ends_at_the_same_corners(
    board: Board, pattern: str, scene: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    """And none of the corners is lost."""
    picture = Picture(large_image(board, scene), pattern, 4095.0)
    monkeypatch.setattr(board_module, "_SEARCHED_PX", 250)
    reduced = found(board, picture)
    monkeypatch.setattr(board_module, "_REDUCTIONS", ())
    whole = found(board, picture)
    assert set(reduced.ids) >= set(whole.ids)
    assert len(whole.ids) > 0.3 * len(board.points_mm)
    there = np.isin(reduced.ids, whole.ids)
    assert np.abs(reduced.pixels[there] - whole.pixels).max() < MOST_PX[scene]


def test_a_reduced_image_has_its_pixels_where_they_are_in_the_whole() -> None:
    """A slope of light: each mean is its value at the middle of the pixels."""
    column, row = np.meshgrid(np.arange(42.0), np.arange(31.0))
    slope = 100.0 + 3.0 * column + 5.0 * row
    for factor in (2, 4):
        y, x = np.indices((31 // factor, 42 // factor))
        middle = 0.5 * (factor - 1)
        expected = 100.0 + 3.0 * (factor * x + middle) + 5.0 * (factor * y + middle)
        for pattern in ("MONO", *PATTERNS):
            assert Picture(slope, pattern, 4095.0).reduced(factor) == pytest.approx(expected)
        in_colours = np.stack([0.0 * slope, slope, 0.0 * slope], axis=-1)
        assert Picture(in_colours, "COLOUR", 4095.0).reduced(factor) == pytest.approx(expected)


def test_saturated_pixels_of_a_raw_frame_are_counted_among_the_green_ones() -> None:
    frame = np.full((20, 30), 100.0)
    frame[4:8, 6:12] = 4095.0
    frame[::2, 1::2] = 4095.0  # all blue pixels, which the fit does not use
    assert Picture(frame, "GBRG", 4095.0).white_share(slice(5, 15), slice(7, 17)) == pytest.approx(12 / 61)
    assert Picture(np.where(frame > 200, 4095.0, 0.0), "MONO", 4095.0).white_share(
        slice(4, 8), slice(6, 12)
    ) == pytest.approx(1.0)


def test_a_description_is_read_and_its_mistakes_are_named_with_their_lines(tmp_path: Path) -> None:
    path = tmp_path / "board.yaml"
    path.write_text("kind: charuco\ncorners: [10, 7]\nsquare_mm: 16\nmarker_mm: 12\n")
    assert read_board(path) == CHARUCO
    path.write_text("kind: charuco\ncorners: [10, 7]\nsquare_mm: 16\nmarker_mm: 12\ndictionary: DICT_9X9\n")
    with pytest.raises(InputError, match=r"board\.yaml:5:13: dictionary: .*DICT_5X5_250"):
        read_board(path)
    path.write_text("kind: charuco\ncorners: [10, 7]\nsquare_mm: 16\n")
    with pytest.raises(InputError, match="marker_mm"):
        read_board(path)
