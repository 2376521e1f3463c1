"""The board: what is printed on it, and its corners in an image.

A board's frame is OpenCV's: x along the rows of squares, y along the columns, z into the board; the origin is the
outer corner of a ChArUco board, the first inner corner of a chess board. Corners are found in 8-bit pictures and
refined in all the bits that the image has; in a RAW frame on the green pixels, which are half of all.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np
from numpy.typing import NDArray
from pydantic import Field, field_validator, model_validator

from coupole import yamlfile
from coupole.calibration.rotations import Floats
from coupole.plan import Model

Channel = Literal["green", "red", "blue"]
Count = Annotated[int, Field(ge=3, le=200)]
Millimetres = Annotated[float, Field(gt=0, le=1000)]

LEAST_CORNERS = 8
CLIPPED_SHARE = 0.02
"""Where more pixels than this about the corners are white, edges are eaten: such an image is left out."""


class Board(Model):
    """A board as its owner measured it (YAML)."""

    schema_version: Literal[1] = 1
    kind: Literal["charuco", "chessboard"]
    corners: tuple[Count, Count]
    """Inner corners along x and y: one less than squares."""
    square_mm: Millimetres
    scale_u_ppm: Annotated[float, Field(ge=0, le=20_000)] = 50.0
    """Standard uncertainty of all its lengths together: print, measurement, warmth."""
    marker_mm: Millimetres | None = None
    dictionary: str = "DICT_5X5_250"
    """OpenCV's name of the markers' dictionary."""
    legacy_pattern: bool = False
    """ChArUco as OpenCV before 4.6 printed it, which starts with a marker where rows are even in number."""

    @field_validator("dictionary")
    @classmethod
    def _known(cls, name: str) -> str:
        import cv2

        if not name.startswith("DICT_") or not hasattr(cv2.aruco, name):
            raise ValueError(f"no dictionary of OpenCV; found {name}, expected e.g. DICT_5X5_250")
        return name

    @model_validator(mode="after")
    def _markers_fit(self) -> Board:
        if self.kind == "charuco" and not 0 < (self.marker_mm or 0) < self.square_mm:
            raise ValueError("a ChArUco board with `marker_mm`, smaller than `square_mm`")
        return self

    @property
    def points_mm(self) -> Floats:
        """All corners [n, 3] in the board's frame, row by row."""
        across, down = self.corners
        grid = np.zeros((across * down, 3))
        grid[:, :2] = np.mgrid[0:across, 0:down].T.reshape(-1, 2) * self.square_mm
        if self.kind == "charuco":
            grid[:, :2] += self.square_mm
        return grid

    @property
    def has_a_top(self) -> bool:
        """False for a chess board that looks the same upside down; its pose is then known up to half a turn."""
        return self.kind == "charuco" or sum(self.corners) % 2 == 1


@dataclass(frozen=True)
class Sighting:
    """The corners seen in one image."""

    name: str
    """Of the view or file."""
    ids: NDArray[np.intp]
    """Which corners [n], numbers into `Board.points_mm`."""
    board_mm: Floats
    """[n, 3]."""
    pixels: Floats
    """[n, 2], centre of the first pixel (0, 0)."""


def read_board(path: Path) -> Board:
    """A board's description. Raises InputError with every problem of the file."""
    return yamlfile.read(path).validate(Board)


def plane(frame: NDArray[Any], pattern: str, channel: Channel = "green") -> Floats:
    """One channel of a RAW frame [H, W] at full size [H, W], DN: corners in it are corners in the frame.

    `pattern` is the names of the four pixels at the frame's top left, row by row; `MONO` has one channel. Pixels
    of other colours are left out of a mean with the weights 1 2 1 in both directions. Of green pixels it always
    finds a weight of 8, of red and blue of 4, and both lie evenly about each pixel: nothing is shifted.
    """
    if pattern == "MONO":
        return frame.astype(np.float64)
    sparse = np.zeros(frame.shape)
    for place, letter in enumerate(pattern):
        if letter == channel[0].upper():
            sparse[place // 2 :: 2, place % 2 :: 2] = frame[place // 2 :: 2, place % 2 :: 2]
    around = np.pad(sparse, 1, mode="reflect")  # reflection keeps the colours in step
    across = around[:, :-2] + 2 * around[:, 1:-1] + around[:, 2:]
    both = across[:-2] + 2 * across[1:-1] + across[2:]
    return np.asarray(both / (8 if channel == "green" else 4))


def detect(board: Board, image: NDArray[Any], name: str, *, white: float | None = None) -> Sighting | str:
    """The board's corners in a grey image [H, W], or why it cannot be used. `white` is the value of saturation."""
    import cv2

    if white is None:
        white = float(np.iinfo(image.dtype).max) if np.issubdtype(image.dtype, np.integer) else np.inf
    picture = _picture(image)
    ids, rough = _chess(board, picture) if board.kind == "chessboard" else _charuco(board, picture)
    if len(ids) < LEAST_CORNERS:
        return f"{len(ids)} of {len(board.points_mm)} corners seen, {LEAST_CORNERS} needed"
    outline = cv2.boundingRect(rough.astype(np.float32))
    part = image[max(outline[1], 0) : outline[1] + outline[3], max(outline[0], 0) : outline[0] + outline[2]]
    if (share := float(np.mean(part >= white))) > CLIPPED_SHARE:
        return f"clipped: {share:.0%} of the pixels on the board are saturated. Expose shorter"
    board_mm = board.points_mm[ids]
    if np.linalg.matrix_rank(board_mm[:, :2] - board_mm[0, :2]) < 2:
        return "all corners seen lie on one line"
    return Sighting(name, ids, board_mm, refine(image, rough, _window_px(board, ids, rough)))


def in_channel(board: Board, image: NDArray[Any], green: Sighting) -> Sighting:
    """The corners of a sighting in green, refined in another channel's plane [H, W]."""
    return replace(green, pixels=refine(image, green.pixels, _window_px(board, green.ids, green.pixels)))


def refine(image: NDArray[Any], corners: Floats, window_px: int) -> Floats:
    """Corners [n, 2] to a fraction of a pixel: where the gradients about them all point away or along."""
    import cv2

    scaled = np.ascontiguousarray(image, dtype=np.float32)
    scaled *= np.float32(255.0 / max(float(scaled.max()), 1e-9))
    points = np.ascontiguousarray(corners, dtype=np.float32).reshape(-1, 1, 2)
    until = (cv2.TERM_CRITERIA_EPS + cv2.TERM_CRITERIA_MAX_ITER, 100, 1e-4)
    found = cv2.cornerSubPix(scaled, points, (window_px, window_px), (-1, -1), until)
    return np.asarray(found, dtype=np.float64).reshape(-1, 2)


def _picture(image: NDArray[Any]) -> NDArray[np.uint8]:
    """8 bits for the search alone: dark to white as the image's own extremes."""
    if image.dtype == np.uint8:
        return np.ascontiguousarray(image)
    low, high = np.percentile(image, [0.5, 99.5])
    return np.asarray(np.clip((image - low) * (255.0 / max(high - low, 1e-9)), 0, 255), dtype=np.uint8)


def _window_px(board: Board, ids: NDArray[np.intp], corners: Floats) -> int:
    """Half the window of refinement, 2 to 11 px: a third of the way to the nearest corner, and short of a ChArUco
    board's markers, whose edges would pull corners by half a pixel."""
    apart = np.linalg.norm(corners[:, None] - corners[None], axis=-1)
    np.fill_diagonal(apart, np.inf)
    steps = np.linalg.norm(board.points_mm[ids][:, None] - board.points_mm[ids][None], axis=-1)
    neighbours = apart[np.isclose(steps, board.square_mm)]
    nearest = float(np.percentile(neighbours, 5)) if len(neighbours) else float(apart.min())
    white = (1 - (board.marker_mm or 0.0) / board.square_mm) / 2 if board.kind == "charuco" else 1.0
    return int(np.clip(min(nearest / 3, nearest * white - 1), 2, 11))


def _charuco(board: Board, picture: NDArray[np.uint8]) -> tuple[NDArray[np.intp], Floats]:
    import cv2

    aruco = cv2.aruco
    squares = (board.corners[0] + 1, board.corners[1] + 1)
    markers = aruco.getPredefinedDictionary(getattr(aruco, board.dictionary))
    assert board.marker_mm is not None  # as `Board` has checked
    printed = aruco.CharucoBoard(squares, board.square_mm, board.marker_mm, markers)
    printed.setLegacyPattern(board.legacy_pattern)
    found: Any
    ids: Any  # OpenCV's stubs do not say that both are None where no corner was found
    found, ids, _, _ = aruco.CharucoDetector(printed).detectBoard(picture)
    if ids is None:
        return np.zeros(0, dtype=np.intp), np.zeros((0, 2))
    return np.asarray(ids, dtype=np.intp).ravel(), np.asarray(found, dtype=np.float64).reshape(-1, 2)


def _chess(board: Board, picture: NDArray[np.uint8]) -> tuple[NDArray[np.intp], Floats]:
    import cv2

    found, corners = cv2.findChessboardCorners(picture, board.corners)
    if not found:
        return np.zeros(0, dtype=np.intp), np.zeros((0, 2))
    points = np.asarray(corners, dtype=np.float64).reshape(-1, 2)
    if board.has_a_top and not _starts_dark(board, picture, points):
        points = points[::-1].copy()
    return np.arange(len(points)), points


def _starts_dark(board: Board, picture: NDArray[np.uint8], points: Floats) -> bool:
    """True if the square between the first four corners is darker than the next: so all images begin alike."""
    across = board.corners[0]
    centre = points[[0, 1, across, across + 1]].mean(axis=0)
    beside = points[[1, 2, across + 1, across + 2]].mean(axis=0)
    first, second = (picture[round(y), round(x)] for x, y in (centre, beside))
    return bool(first < second)
