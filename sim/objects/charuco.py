"""ChArUco board: a chessboard whose white squares carry markers, as OpenCV's calibration requires.

Every black or white cell is a rectangle of triangles: unlike in a texture, edges are exact at any magnification.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from coupole.appearance.shapes.triangles import Array, skirt
from coupole.errors import InputError
from sim.objects import appearance
from sim.objects.surfaces import joined_surface, of_material
from sim.scene.surface import Surface


@dataclass(frozen=True)
class Charuco:
    """Dimensions of a board; defaults are assumed."""

    squares_x: int = 12
    squares_y: int = 9
    square_mm: float = 16.0
    marker_mm: float = 12.0
    dictionary: str = "DICT_5X5_250"
    """OpenCV's name of the markers' dictionary."""
    thickness_mm: float = 4.0
    margin_mm: float = 5.0
    """White border around the squares, which the detector needs; 20 leaves room for stickers."""


def charuco_board(board: Charuco) -> Surface:
    """A plate standing on z = 0 with the board on its top, z = `thickness_mm`.

    The origin is below the board's middle; x runs along the rows of squares, and with y pointing up the first
    square is at the top left.
    """
    xs_mm, ys_mm, black = cells(board)
    top = _rectangles(xs_mm, ys_mm, board.thickness_mm)
    is_black = np.repeat(black.ravel(), 2)
    return joined_surface(
        [
            of_material(top[~is_black], appearance.WHITE_PRINT),
            of_material(top[is_black], appearance.BLACK_PRINT),
            of_material(skirt(top), appearance.WHITE_PRINT),
        ]
    )


def opencv_board(board: Charuco) -> Any:
    """The same board for OpenCV's detector.

    Raises InputError if OpenCV has no such dictionary, or if the markers do not fit.
    """
    import cv2

    if not hasattr(cv2.aruco, board.dictionary):
        raise InputError(
            f"board: expected a dictionary of OpenCV such as DICT_5X5_250, found {board.dictionary!r}; "
            "use one of cv2.aruco.DICT_*"
        )
    dictionary = cv2.aruco.getPredefinedDictionary(getattr(cv2.aruco, board.dictionary))
    markers, available = board.squares_x * board.squares_y // 2, len(dictionary.bytesList)
    if not 0 < board.marker_mm < board.square_mm or markers > available:
        raise InputError(
            f"board: expected at most {available} markers, smaller than the squares of {board.square_mm} mm; "
            f"found {markers} of {board.marker_mm} mm; choose smaller markers, fewer squares or another dictionary"
        )
    return cv2.aruco.CharucoBoard((board.squares_x, board.squares_y), board.square_mm, board.marker_mm, dictionary)


def cells(board: Charuco) -> tuple[Array, Array, NDArray[np.bool_]]:
    """Lines x [columns + 1] increasing and y [rows + 1] decreasing, mm, and which cells [rows, columns] are black.

    The lines are those of squares, of markers and of the markers' bits.
    """
    import cv2

    dictionary = opencv_board(board).getDictionary()
    bits = dictionary.markerSize + 2
    margin_mm = 0.5 * (board.square_mm - board.marker_mm)
    steps_mm = np.concatenate([[0.0], margin_mm + board.marker_mm * np.arange(bits + 1) / bits])
    per_square = len(steps_mm)

    def lines_mm(squares: int) -> Array:
        inside = (np.arange(squares)[:, None] * board.square_mm + steps_mm).ravel()
        all_mm = np.concatenate(
            [[-board.margin_mm], inside, squares * board.square_mm + np.array([0.0, board.margin_mm])]
        )
        return np.asarray(all_mm - 0.5 * squares * board.square_mm)

    black = np.zeros((board.squares_y * per_square + 2, board.squares_x * per_square + 2), bool)
    marker = 0
    for row in range(board.squares_y):
        for column in range(board.squares_x):
            top, column_start = 1 + row * per_square, 1 + column * per_square
            if (row + column) % 2 == 0:
                black[top : top + per_square, column_start : column_start + per_square] = True
                continue
            marker_image = cv2.aruco.generateImageMarker(dictionary, marker, bits)
            black[top + 1 : top + 1 + bits, column_start + 1 : column_start + 1 + bits] = (
                np.asarray(marker_image) == 0
            )
            marker += 1
    return lines_mm(board.squares_x), -lines_mm(board.squares_y), black


def _rectangles(xs_mm: Array, ys_mm: Array, z_mm: float) -> Array:
    """Corners [2 cells, 3, 3] of the cells between lines, row by row, the two triangles of a cell together."""
    x, y = np.meshgrid(xs_mm, ys_mm)
    points = np.stack([x, y, np.full(x.shape, z_mm)], axis=-1)
    a, b, c, d = points[1:, :-1], points[1:, 1:], points[:-1, 1:], points[:-1, :-1]
    return np.stack([np.stack([a, b, c], axis=2), np.stack([a, c, d], axis=2)], axis=2).reshape(-1, 3, 3)
