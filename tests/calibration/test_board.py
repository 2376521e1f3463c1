"""Boards: their descriptions, and their corners in pictures of every kind."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from boards import CHARUCO, CHESS, LENS, as_dn, magnified, picture_of
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


@pytest.mark.parametrize("hidden", [False, True])
@pytest.mark.parametrize("board", [CHARUCO, CHESS])
def test_a_search_at_half_size_ends_at_the_same_corners(
    board: Board, hidden: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A fiftieth of a corner's noise; of a board that is partly hidden none is lost."""
    picture = picture_of(board, 3).pixels.copy()
    if hidden and board is CHARUCO:
        picture[:, : picture.shape[1] // 2] = 0.5
    seen = []
    for least_px in (10_000, 100):
        monkeypatch.setattr(board_module, "_HALVED_FROM_PX", least_px)
        seen.append(found(board, Picture.of_grey(as_dn(picture, 4095, 8.0), white=4095.0)))
    whole, half = seen
    assert len(half.ids) >= len(whole.ids) > 8
    there = np.isin(half.ids, whole.ids)
    assert rms(half.pixels[there] - whole.pixels) < 0.003


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
