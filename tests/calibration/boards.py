"""Pictures of boards with corners that are known: what detection is tested against."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cache

import numpy as np
from synthesis import Array, TrueLens, frame, render

from coupole.calibration.lens.board import Board

CHARUCO = Board(kind="charuco", corners=(10, 7), square_mm=16.0, marker_mm=12.0)
CHESS = Board(kind="chessboard", corners=(9, 6), square_mm=16.0)
SIZE_PX = (640, 480)
LENS = TrueLens((1000.0, 1002.0), (322.3, 236.8), (0.05, -0.02, 0.0008, -0.0006, 0.0))
TEXELS_PER_SQUARE = 96


def texture_of(board: Board) -> tuple[Array, float]:
    """The board as printed, 0 black to 1 white, its outer corner first, and its texels' size in mm."""
    import cv2

    across, down = board.corners[0] + 1, board.corners[1] + 1
    size = (across * TEXELS_PER_SQUARE, down * TEXELS_PER_SQUARE)
    if board.kind == "charuco":
        markers = cv2.aruco.getPredefinedDictionary(getattr(cv2.aruco, board.dictionary))
        printed = cv2.aruco.CharucoBoard((across, down), board.square_mm, board.marker_mm or 0.0, markers)
        pixels = printed.generateImage(size, marginSize=0)
    else:
        rows, columns = np.indices((size[1], size[0])) // TEXELS_PER_SQUARE
        pixels = 255 * ((rows + columns) % 2)
    return np.asarray(pixels) / 255.0, board.square_mm / TEXELS_PER_SQUARE


@dataclass(frozen=True)
class Picture:
    """A rendered board [H, W], 0 to 1, and where its corners truly are [n, 2]."""

    pixels: Array
    corners: Array


@cache
def picture_of(board: Board, seed: int, lens: TrueLens = LENS) -> Picture:
    """The board as a camera some 420 mm away sees it, tilted and turned."""
    random = np.random.default_rng(seed)
    texture, mm_per_texel = texture_of(board)
    centre = board.points_mm.mean(axis=0)
    outer = np.zeros(3) if board.kind == "charuco" else np.array([board.square_mm, board.square_mm, 0.0])
    turn = frame(np.zeros(3), np.array([*random.uniform(-25, 25, 2), random.uniform(-170, 170)]))
    camera_from_board = turn.copy()
    camera_from_board[:3, 3] = np.array([*random.uniform(-8, 8, 2), 420.0]) - turn[:3, :3] @ (centre + outer)
    points = (board.points_mm + outer) @ camera_from_board[:3, :3].T + camera_from_board[:3, 3]
    corners = lens.see(points)
    return Picture(render(lens, SIZE_PX, camera_from_board, texture, mm_per_texel), corners)


def magnified(lens: TrueLens, factor: float) -> TrueLens:
    """The lens as another colour sees through it."""
    fx, fy = lens.focal_px
    return replace(lens, focal_px=(fx * factor, fy * factor))


def as_dn(pixels: Array, white_dn: int, noise_dn: float = 0.0, seed: int = 0) -> Array:
    """A picture in DN: black 5 % and white 75 % of full scale, with noise."""
    noisy = (0.05 + 0.7 * pixels) * white_dn + np.random.default_rng(seed).normal(0, noise_dn, pixels.shape)
    return np.clip(np.rint(noisy), 0, white_dn)
