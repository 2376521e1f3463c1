"""The ChArUco board: OpenCV finds on its triangles what it would find on its own print."""

from __future__ import annotations

import cv2
import numpy as np
import pytest
from board_truth import inner_corners_mm
from numpy.typing import NDArray

from coupole.appearance.shapes.triangles import flat_normals
from coupole.errors import InputError
from sim.objects.charuco import Charuco, charuco_board, opencv_board
from sim.scene.surface import Surface

_PIXELS_PER_MM = 10.0
BOARDS = (Charuco(), Charuco(5, 7, 20.0, 15.0, "DICT_4X4_50"), Charuco(6, 4, 16.0, 12.0, "DICT_6X6_100"))


def from_above(surface: Surface) -> tuple[NDArray[np.uint8], NDArray[np.float64]]:
    """Orthographic picture of what faces up, sampled at pixel centres, and its upper left corner, mm."""
    up = flat_normals(surface.corners_mm)[:, 2] > 0.5
    places = surface.corners_mm[up][:, :, :2]
    low, high = places.reshape(-1, 2).min(axis=0), places.reshape(-1, 2).max(axis=0)
    corner = np.array([low[0], high[1]])
    pixels = (places - corner) * [_PIXELS_PER_MM, -_PIXELS_PER_MM] - 0.5
    grey = np.array([255 * m.diffuse[1] for m in surface.materials])[surface.material[up]]
    picture = np.zeros(np.ceil((high - low) * _PIXELS_PER_MM).astype(int)[::-1], np.uint8)
    for corners, level in zip(pixels, grey, strict=True):
        (left, top), (right, bottom) = (
            np.ceil(corners.min(axis=0)).astype(int),
            np.floor(corners.max(axis=0)).astype(int),
        )
        x, y = np.meshgrid(np.arange(left, right + 1), np.arange(top, bottom + 1))
        starts, steps = corners, np.roll(corners, -1, axis=0) - corners
        side = [u * (y - b) - v * (x - a) for (a, b), (u, v) in zip(starts, steps, strict=True)]
        picture[top : bottom + 1, left : right + 1][np.max(side, axis=0) <= 1e-9] = level
    return picture, corner


@pytest.mark.parametrize("board", BOARDS, ids=lambda b: f"{b.squares_x}x{b.squares_y}")
def test_opencv_finds_every_corner_where_the_truth_says_it_is(board: Charuco) -> None:
    picture, first_mm = from_above(charuco_board(board))
    found, ids, _, _ = cv2.aruco.CharucoDetector(opencv_board(board)).detectBoard(picture)
    truth_mm = inner_corners_mm(board)
    assert sorted(ids.ravel()) == list(range(len(truth_mm)))
    places = first_mm + (found[:, 0] + 0.5) / [_PIXELS_PER_MM, -_PIXELS_PER_MM]
    assert np.abs(places - truth_mm[ids.ravel(), :2]).max() < 0.02


@pytest.mark.parametrize("board", BOARDS, ids=lambda b: f"{b.squares_x}x{b.squares_y}")
def test_ids_run_as_in_opencv(board: Charuco) -> None:
    theirs = opencv_board(board).getChessboardCorners()
    middle = 0.5 * board.square_mm * np.array([board.squares_x, board.squares_y])
    ours = inner_corners_mm(board)
    assert np.allclose((theirs[:, :2] - middle) * [1.0, -1.0], ours[:, :2], atol=1e-4)
    assert np.all(ours[:, 2] == board.thickness_mm)


def test_half_of_the_squares_are_black_and_markers_have_a_black_rim() -> None:
    surface = charuco_board(Charuco())
    up = flat_normals(surface.corners_mm)[:, 2] > 0.5
    a, b, c = np.moveaxis(surface.corners_mm, 1, 0)
    area = 0.5 * np.linalg.norm(np.cross(b - a, c - a), axis=1)
    black = [m.name.startswith("black") for m in surface.materials]
    share = area[np.array(black)[surface.material]].sum() / (12 * 9 * 16.0**2)
    assert area[up].sum() == pytest.approx((12 * 16 + 10) * (9 * 16 + 10))
    assert 0.5 + 0.5 * (12 / 16) ** 2 * 24 / 49 < share < 0.5 + 0.5 * (12 / 16) ** 2


@pytest.mark.parametrize(
    ("board", "word"),
    [
        (Charuco(dictionary="DICT_9X9"), "DICT_9X9"),
        (Charuco(marker_mm=16.0), "16"),
        (Charuco(squares_x=30, squares_y=30, dictionary="DICT_4X4_50"), "450"),
    ],
)
def test_a_board_that_opencv_cannot_have_is_refused(board: Charuco, word: str) -> None:
    with pytest.raises(InputError, match=word):
        charuco_board(board)
