"""Suspected errors in the model of a board's images: the lens's form, the board's shape and its print, a focus
that changes.

Modes of the lens are polynomials over the field minus the best lens of the record's own form. So the record's lens
is the best of that form over the whole field, and the modes are the rest (orthogonal in the sense of Plumlee, J.
Am. Stat. Assoc. 112, 2017).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.polynomial.legendre import legvander2d

from coupole.calibration import optics
from coupole.calibration.lens.corners import PIXEL_SIGMA_PX, Corners
from coupole.calibration.model_error import Suspect
from coupole.calibration.rotations import Floats

LENS, BOARD, PRINT, FOCUS = "lens", "board", "print", "focus"
PRINT_UNIT = 1e-3
"""Unit of the print's coefficients, which are width over height minus 1, and shear."""
_LENS_DEGREE, _BOARD_DEGREE = 6, 3
_GRID = 13


@dataclass(frozen=True)
class Field:
    """Patterns over the field that a lens of the record's form does not have."""

    lens: Floats
    """[9] intrinsics."""
    free: tuple[str, ...]
    size_px: tuple[int, int]
    best: Floats
    """[free + 3, modes] lens and turn of the camera that are nearest to each polynomial."""

    @staticmethod
    def of(lens: Floats, free: Sequence[str], size_px: tuple[int, int]) -> Field:
        bare = Field(lens, tuple(free), size_px, np.zeros((0, 0)))
        grid = bare.grid_px()
        slopes, polynomials = bare._own_derivatives(grid), bare._polynomials(grid)
        return Field(
            lens, tuple(free), size_px, np.asarray(np.linalg.lstsq(slopes, polynomials, rcond=None)[0], np.float64)
        )

    def grid_px(self) -> Floats:
        """Places [n, 2] all over the field."""
        width, height = self.size_px
        x, y = np.meshgrid(np.linspace(0, width - 1, _GRID), np.linspace(0, height - 1, _GRID))
        return np.stack([x.ravel(), y.ravel()], axis=1)

    def modes(self, pixels: Floats) -> Floats:
        """Return [2 n, modes], px, at pixels [n, 2]. Each mode is about 1 px."""
        return np.asarray(self._polynomials(pixels) - self._own_derivatives(pixels) @ self.best)

    def ray_u_px(self, covariance: Floats) -> float:
        """Return the standard uncertainty of a direction's image for a lens with this covariance [free, free]:
        root mean square over the field, both coordinates. A turn of the camera does not count."""
        slopes = self._own_derivatives(self.grid_px())
        turns, lens = slopes[:, -3:], slopes[:, :-3]
        without_turns = lens - turns @ np.linalg.lstsq(turns, lens, rcond=None)[0]
        return float(np.sqrt(2.0 * np.mean(np.einsum("ki,ij,kj->k", without_turns, covariance, without_turns))))

    def rms_px(self, coefficients: Floats, covariance: Floats) -> float:
        """Return the root mean square over the field of a pattern, both coordinates, with its uncertainty."""
        modes = self.modes(self.grid_px())
        squares = (modes @ coefficients) ** 2 + np.einsum("ki,ij,kj->k", modes, covariance, modes)
        return float(np.sqrt(2.0 * np.mean(squares)))

    def _own_derivatives(self, pixels: Floats) -> Floats:
        """Return derivatives [2 n, free + 3] with respect to the free lens parameters and to a turn of the
        camera."""
        rays = np.column_stack([(pixels - self.lens[2:4]) / self.lens[:2], np.ones(len(pixels))])
        projection = optics.project(rays, self.lens)
        by_lens = projection.by_intrinsics[:, :, [optics.NAMES.index(name) for name in self.free]]
        turns = np.cross(np.eye(3)[None], rays[:, None])
        by_turn = np.einsum("kij,kaj->kia", projection.by_point, turns)
        return np.concatenate([by_lens, by_turn], axis=2).reshape(2 * len(pixels), -1)

    def _polynomials(self, pixels: Floats) -> Floats:
        """Return [2 n, modes], products of Legendre's polynomials, in x and in y."""
        width, height = self.size_px
        x, y = 2.0 * pixels[:, 0] / (width - 1) - 1.0, 2.0 * pixels[:, 1] / (height - 1) - 1.0
        products = _products(x, y, 0, _LENS_DEGREE)
        modes = np.zeros((len(pixels), 2, 2 * products.shape[1]))
        modes[:, 0, : products.shape[1]] = modes[:, 1, products.shape[1] :] = products
        return modes.reshape(2 * len(pixels), -1)


def _products(x: Floats, y: Floats, least: int, most: int) -> Floats:
    """Return [n, modes] of total degree `least` to `most`, each with a mean square of 1 over the square."""
    degrees = np.array([(i, j) for i in range(most + 1) for j in range(most + 1) if least <= i + j <= most])
    size = np.sqrt((2 * degrees[:, 0] + 1) * (2 * degrees[:, 1] + 1))
    table = legvander2d(x, y, (most, most)).reshape(len(x), most + 1, most + 1)
    return np.asarray(table[:, degrees[:, 0], degrees[:, 1]] * size)


def suspects_of(
    field: Field, corners: Corners, camera_from_board: Floats, by_point: Floats, pixels: Floats
) -> list[Suspect]:
    """Return the lens, the board, its print and the focus as suspects. `by_point` [n, 2, 3] and `pixels` [n, 2]
    belong to the corners computed in the camera frames `camera_from_board` [views, 4, 4]."""
    off = pixels - field.lens[2:4]
    focus = np.zeros((len(pixels), 2, len(camera_from_board)))
    focus[np.arange(len(pixels)), :, corners.view] = 2.0 * off / field.size_px[0]
    return [
        Suspect(LENS, field.modes(pixels) / PIXEL_SIGMA_PX),
        Suspect(BOARD, _of_board(corners, camera_from_board, by_point) / PIXEL_SIGMA_PX),
        Suspect(PRINT, _of_print(corners, camera_from_board, by_point) / PIXEL_SIGMA_PX),
        Suspect(FOCUS, focus.reshape(2 * len(pixels), -1) / PIXEL_SIGMA_PX),
    ]


def _of_print(corners: Corners, camera_from_board: Floats, by_point: Floats) -> Floats:
    """Return [2 n, 2] px for a board that is wider than high, and for a sheared one, for one `PRINT_UNIT` (unequal
    scales of printers: Strobl and Hirzinger, ICCV workshops 2011)."""
    places_mm = corners.board_mm - corners.board_mm.mean(axis=0)
    moves_mm = np.zeros((len(places_mm), 3, 2))
    moves_mm[:, 0, 0], moves_mm[:, 1, 0] = 0.5 * places_mm[:, 0], -0.5 * places_mm[:, 1]
    moves_mm[:, 0, 1] = places_mm[:, 1]
    in_camera = camera_from_board[corners.view, :3, :3] @ (PRINT_UNIT * moves_mm)
    return np.asarray((by_point @ in_camera).reshape(2 * len(places_mm), -1))


def _of_board(corners: Corners, camera_from_board: Floats, by_point: Floats) -> Floats:
    """Return [2 n, modes] px for heights of the board of about 1 mm. The heights are polynomials over the board,
    without those of a plane."""
    low, high = corners.board_mm.min(axis=0), corners.board_mm.max(axis=0)
    places = 2.0 * (corners.board_mm - low) / np.maximum(high - low, 1e-9) - 1.0
    up = camera_from_board[corners.view, :3, 2]
    rise = np.einsum("nij,nj->ni", by_point, up)
    heights = _products(places[:, 0], places[:, 1], 2, _BOARD_DEGREE)
    return np.asarray((rise[:, :, None] * heights[:, None, :]).reshape(2 * len(rise), -1))
