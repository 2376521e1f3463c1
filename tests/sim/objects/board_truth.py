"""Where the corners of a ChArUco board are, by its measures alone."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from sim.objects.charuco import Charuco


def inner_corners_mm(board: Charuco) -> NDArray[np.float64]:
    """True chessboard corners [(squares_x - 1)(squares_y - 1), 3] by OpenCV's ids, in the board's frame."""
    column, row = np.meshgrid(np.arange(1, board.squares_x), np.arange(1, board.squares_y))
    x = (column - board.squares_x / 2) * board.square_mm
    y = (board.squares_y / 2 - row) * board.square_mm
    return np.stack([x, y, np.full(x.shape, board.thickness_mm)], axis=-1).reshape(-1, 3)
