"""The board: its pattern, and its corners in an image.

A board's frame is OpenCV's: x along the rows of squares, y along the columns, z into the board. The origin is the
outer corner of a ChArUco board, or the first inner corner of a chess board. OpenCV finds the corners in an 8-bit
image of one colour. They are then fitted to the pixels of that colour with their full bit depth (`corner_fit`).
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np
from numpy.typing import NDArray
from pydantic import Field, field_validator, model_validator

from coupole.calibration.artefact import Described, Temperature, UsedArtefact, expansion_of, read_described
from coupole.calibration.grey_image import Channel, Picture
from coupole.calibration.lens.corner_fit import enough_pixels, fit_corners
from coupole.calibration.rotations import Floats

Count = Annotated[int, Field(ge=3, le=200)]
Millimetres = Annotated[float, Field(gt=0, le=1000)]

LEAST_CORNERS = 8
_SEARCHED_PX = 700
"""Least side of a reduced image in which a board is searched for."""
_REDUCTIONS = (4, 2)
_SAME_SIDE = 0.01
"""Largest relative difference between the certified side of squares and the side in the description."""
CLIPPED_SHARE = 0.02
"""Largest share of white pixels about the corners. An image with a larger share is left out, because clipping
shifts edges."""


class Board(Described):
    """A board as its owner or its certificate describes it (YAML)."""

    schema_version: Literal[1] = 1
    kind: Literal["charuco", "chessboard"]
    corners: tuple[Count, Count]
    """Inner corners along x and y: one less than squares."""
    square_mm: Millimetres
    scale_u_ppm: Annotated[float, Field(ge=0, le=20_000)] = 50.0
    """Standard uncertainty of its scale, from print, measurement and temperature. It is left out if `artefact` has
    a certified `square_mm`."""
    marker_mm: Millimetres | None = None
    dictionary: str = "DICT_5X5_250"
    """OpenCV's name of the markers' dictionary."""
    legacy_pattern: bool = False
    """ChArUco as printed by OpenCV before 4.6, which starts with a marker if the number of rows is even."""

    @field_validator("dictionary")
    @classmethod
    def _check_dictionary(cls, name: str) -> str:
        import cv2

        if not name.startswith("DICT_") or not hasattr(cv2.aruco, name):
            raise ValueError(f"no dictionary of OpenCV; found {name}, expected e.g. DICT_5X5_250")
        return name

    @model_validator(mode="after")
    def _markers_fit(self) -> Board:
        if self.kind == "charuco" and not 0 < (self.marker_mm or 0) < self.square_mm:
            raise ValueError("a ChArUco board with `marker_mm`, smaller than `square_mm`")
        return self

    @model_validator(mode="after")
    def _certificate_fits(self) -> Board:
        square_mm = None if self.artefact is None else self.artefact.square_mm
        if square_mm is None:
            return self
        if abs(square_mm.value - self.square_mm) > _SAME_SIDE * self.square_mm:
            raise ValueError(f"artefact.square_mm of this board, {self.square_mm:g} mm within 1 %")
        if "scale_u_ppm" in self.model_fields_set:
            raise ValueError("no `scale_u_ppm` beside a certified artefact.square_mm, which has an uncertainty")
        return self

    def measured_at(self, temperature: Temperature) -> tuple[Board, tuple[UsedArtefact, ...]]:
        """Return the board with the lengths that it has at a temperature, by its certificate, and the data of it
        that a record keeps. Without a certificate it is the same board."""
        artefact = self.artefact
        if artefact is None:
            return self, ()
        certified_side = artefact.square_mm
        side_mm = self.square_mm if certified_side is None else certified_side.value
        u_side = 1e-6 * self.scale_u_ppm if certified_side is None else certified_side.u / certified_side.value
        expansion, u_expansion = expansion_of(artefact, temperature)
        u_ppm = 1e6 * float(np.hypot(u_side, u_expansion))
        used_artefact = UsedArtefact(
            role="board",
            artefact=artefact,
            measured_c=temperature.celsius,
            u_measured_k=temperature.u_k,
            measured_by=temperature.source,
            correction_ppm=1e6 * expansion,
            u_scale_ppm=u_ppm,
        )
        changes = {"square_mm": side_mm * (1.0 + expansion), "scale_u_ppm": u_ppm}
        return self.model_copy(update=changes), (used_artefact,)

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
        """False for a chess board that looks the same upside down; its pose is then ambiguous by half a turn."""
        return self.kind == "charuco" or sum(self.corners) % 2 == 1


@dataclass(frozen=True)
class Sighting:
    """The corners seen in one image."""

    name: str
    """Name of the view or file."""
    ids: NDArray[np.intp]
    """Numbers of the corners [n], into `Board.points_mm`."""
    board_mm: Floats
    """[n, 3]."""
    pixels: Floats
    """[n, 2] px; the centre of the first pixel is (0, 0)."""
    u_px: Floats | None = None
    """[n] standard uncertainty of a corner's coordinates, root mean square of both, from its pixels alone; None if
    the corners were not fitted."""


def read_board(path: Path) -> Board:
    """Read a board's description. Raises InputError with every problem of the file."""
    return read_described(path, Board)


def detect(board: Board, picture: Picture) -> Sighting | str:
    """Return the board's corners in a picture (in green if it has colours), or the reason why it cannot be
    used."""
    import cv2

    best: Sighting | None = None
    for ids, rough in _searches(board, picture):
        if len(ids) < LEAST_CORNERS:
            return f"{len(ids)} of {len(board.points_mm)} corners seen, {LEAST_CORNERS} needed"
        first_x, first_y, width, height = cv2.boundingRect(rough.astype(np.float32))
        if (
            share := picture.white_share(slice(first_y, first_y + height), slice(first_x, first_x + width))
        ) > CLIPPED_SHARE:
            return f"clipped: {share:.0%} of the pixels on the board are saturated. Expose shorter"
        rough_sighting = Sighting(picture.name, ids, board.points_mm[ids], rough)
        sighting = _refined_corners(rough_sighting, board, picture, "green")
        if best is None or len(sighting.ids) >= len(best.ids):
            best = sighting
        if len(sighting.ids) == len(board.points_mm):
            break
    assert best is not None  # the image itself is searched last
    if len(best.ids) < LEAST_CORNERS:
        return f"{len(best.ids)} of {len(ids)} corners are sharp enough, {LEAST_CORNERS} needed"
    if np.linalg.matrix_rank(best.board_mm[:, :2] - best.board_mm[0, :2]) < 2:
        return "all corners seen lie on one line"
    return best


def _searches(board: Board, picture: Picture) -> Iterator[tuple[NDArray[np.intp], Floats]]:
    """Yield numbers and approximate places of corners, to about a pixel. A large image is first searched at a
    quarter and at half of its size; these results count only if all corners are found. Then it is searched at its
    own size. Corners of a reduced image are equally good as initial values of the fit."""
    search = _chess if board.kind == "chessboard" else _charuco
    most: tuple[NDArray[np.intp], Floats] = np.zeros(0, dtype=np.intp), np.zeros((0, 2))
    for factor in (*(n for n in _REDUCTIONS if min(picture.size_px) >= n * _SEARCHED_PX), 1):
        ids, corners = search(board, _eight_bits(picture.reduced(factor)))
        if len(ids) >= len(most[0]):
            most = ids, factor * corners + 0.5 * (factor - 1)
        if factor == 1 or len(ids) == len(board.points_mm):
            yield most


def in_channel(board: Board, picture: Picture, channel: Channel, green: Sighting) -> Sighting:
    """Return the corners of a sighting in green, fitted in another colour of its picture."""
    return _refined_corners(green, board, picture, channel)


def _refined_corners(rough: Sighting, board: Board, picture: Picture, channel: Channel) -> Sighting:
    """Return the corners to a fraction of a pixel, without false ones. OpenCV's gradient method locates corners
    that are too close together for a fit."""
    window_px = _window_px(board, rough.ids, rough.pixels)
    values, mask = picture.values_and_mask(channel)
    if not enough_pixels(mask, window_px):
        side_px = max(2, int(window_px / np.sqrt(2)))
        return replace(rough, pixels=refine(picture.plane(channel), rough.pixels, side_px))
    fit = fit_corners(values, mask, rough.pixels, window_px)
    u_px = np.sqrt(0.5 * np.trace(fit.covariance_px2[fit.fits], axis1=1, axis2=2))
    return Sighting(rough.name, rough.ids[fit.fits], rough.board_mm[fit.fits], fit.pixels[fit.fits], u_px)


def refine(image: NDArray[Any], corners: Floats, window_px: int) -> Floats:
    """Return corners [n, 2] by OpenCV's `cornerSubPix`; `window_px` is half of its window."""
    import cv2

    grey = np.ascontiguousarray(image, dtype=np.float32)
    grey *= np.float32(255.0 / max(float(grey.max()), 1e-9))
    points = np.ascontiguousarray(corners, dtype=np.float32).reshape(-1, 1, 2)
    until = (cv2.TERM_CRITERIA_EPS + cv2.TERM_CRITERIA_MAX_ITER, 100, 1e-4)
    fine_corners = cv2.cornerSubPix(grey, points, (window_px, window_px), (-1, -1), until)
    return np.asarray(fine_corners, dtype=np.float64).reshape(-1, 2)


def _eight_bits(image: NDArray[Any]) -> NDArray[np.uint8]:
    """Return 8 bits for the search only, scaled to the image's extremes."""
    import cv2

    if image.dtype == np.uint8:
        return np.ascontiguousarray(image)
    step = max(1, image.shape[0] // 250)
    low, high = np.percentile(image[::step, ::step], [0.5, 99.5])
    scale = 255.0 / max(float(high - low), 1e-9)
    # `addWeighted` of one image, because it saturates at 0 and 255.
    return np.asarray(cv2.addWeighted(image, scale, image, 0.0, -scale * low, dtype=cv2.CV_8U), dtype=np.uint8)


def _window_px(board: Board, ids: NDArray[np.intp], corners: Floats) -> float:
    """Return the radius of the window about a corner, 2 to 11 px. It is a third of the distance to the nearest
    corner, and less than the distance to a ChArUco board's markers. Corners of markers lie on the diagonals, and
    would shift the result by half a pixel."""
    apart = np.linalg.norm(corners[:, None] - corners[None], axis=-1)
    np.fill_diagonal(apart, np.inf)
    steps = np.linalg.norm(board.points_mm[ids][:, None] - board.points_mm[ids][None], axis=-1)

    def nearest(step_mm: float) -> float:
        neighbours = apart[np.isclose(steps, step_mm)]
        return float(np.percentile(neighbours, 5)) if len(neighbours) else float(apart.min())

    radius_px = nearest(board.square_mm) / 3
    if board.kind == "charuco":
        white = (1 - (board.marker_mm or 0.0) / board.square_mm) / 2
        radius_px = min(radius_px, nearest(np.sqrt(2) * board.square_mm) * white - 1)
    return float(np.clip(radius_px, 2, 11))


def _charuco(board: Board, picture: NDArray[np.uint8]) -> tuple[NDArray[np.intp], Floats]:
    import cv2

    aruco = cv2.aruco
    squares = (board.corners[0] + 1, board.corners[1] + 1)
    markers = aruco.getPredefinedDictionary(getattr(aruco, board.dictionary))
    assert board.marker_mm is not None  # as `Board` has checked
    charuco = aruco.CharucoBoard(squares, board.square_mm, board.marker_mm, markers)
    charuco.setLegacyPattern(board.legacy_pattern)
    corners: Any
    ids: Any  # OpenCV's stubs do not say that both are None where no corner was found
    corners, ids, _, _ = aruco.CharucoDetector(charuco).detectBoard(picture)
    if ids is None:
        return np.zeros(0, dtype=np.intp), np.zeros((0, 2))
    return np.asarray(ids, dtype=np.intp).ravel(), np.asarray(corners, dtype=np.float64).reshape(-1, 2)


def _chess(board: Board, picture: NDArray[np.uint8]) -> tuple[NDArray[np.intp], Floats]:
    import cv2

    is_found, corners = cv2.findChessboardCorners(picture, board.corners)
    if not is_found:
        return np.zeros(0, dtype=np.intp), np.zeros((0, 2))
    points = np.asarray(corners, dtype=np.float64).reshape(-1, 2)
    if board.has_a_top and not _starts_dark(board, picture, points):
        points = points[::-1].copy()
    return np.arange(len(points)), points


def _starts_dark(board: Board, picture: NDArray[np.uint8], points: Floats) -> bool:
    """True if the square between the first four corners is darker than the next one. This fixes the order of the
    corners."""
    across = board.corners[0]
    centre = points[[0, 1, across, across + 1]].mean(axis=0)
    beside = points[[1, 2, across + 1, across + 2]].mean(axis=0)
    first, second = (picture[round(y), round(x)] for x, y in (centre, beside))
    return bool(first < second)
