"""The dome's boards as rigid bodies: from the table, the LEDs on each board and its nominal pose."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from coupole.calibration.point_sets import Indices, rigid_motion
from coupole.calibration.rotations import Floats
from coupole.errors import InputError
from coupole.plan.led_table import LedTable

_PLANE = 2
"""Rank of points that do not lie on one line."""
_PARALLEL = np.cos(np.radians(2.0))


@dataclass(frozen=True)
class Boards:
    """Boards [b] and the places [n] of LEDs on them; a place is a row of the dome's table.

    A board's frame has its origin in the middle of its LEDs, z along their normal (into the dome) and x from its
    first LED towards its last, projected into the board's plane.
    """

    numbers: NDArray[np.int64]
    """[b] numbers of the boards in the table."""
    board_of: Indices
    """[n] rows of `numbers`."""
    base_from_board: Floats
    """[b, 4, 4] by the table."""
    places_mm: Floats
    """[n, 3] places of the LEDs in the frame of their board."""

    def rows_of(self, board: int) -> Indices:
        """Return the places on a board, which is given by its row of `numbers`."""
        return self._rows_of[board]

    @cached_property
    def _rows_of(self) -> tuple[Indices, ...]:
        return tuple(np.flatnonzero(self.board_of == board) for board in range(len(self.numbers)))

    def in_base(self, base_from_board: Floats, offsets_mm: Floats | float = 0.0) -> Floats:
        """Return the centres [n, 3] of the LEDs, for these poses of the boards and offsets of the LEDs on the
        boards."""
        pose = base_from_board[self.board_of]
        turned_mm: Floats = np.einsum("nij,nj->ni", pose[:, :3, :3], self.places_mm + offsets_mm)
        return turned_mm + pose[:, :3, 3]


def board_poses(boards: Boards, found_mm: Floats) -> Floats:
    """Return `base_from_board` [b, 4, 4]. A pose follows from the LEDs that were found at `found_mm` [n, 3] (NaN
    where none was found). A board with fewer than three such LEDs has its pose in the table."""
    poses = boards.base_from_board.copy()
    for board in range(len(poses)):
        rows = boards.rows_of(board)
        rows = rows[np.isfinite(found_mm[rows, 0])]
        if np.linalg.matrix_rank(boards.places_mm[rows] - boards.places_mm[rows[:1]], tol=1.0) >= _PLANE:
            poses[board] = rigid_motion(boards.places_mm[rows], found_mm[rows])
    return poses


def boards_of(table: LedTable) -> Boards:
    """The boards of a dome's table. Raises InputError if the LEDs of one board have different normals."""
    numbers, board_of = np.unique(table.boards, return_inverse=True)
    poses = np.broadcast_to(np.eye(4), (len(numbers), 4, 4)).copy()
    places_mm = np.empty_like(table.positions_mm)
    for board, number in enumerate(numbers):
        rows = np.flatnonzero(board_of == board)
        normal = table.normals[rows].mean(axis=0)
        normal /= np.linalg.norm(normal)
        if (table.normals[rows] @ normal).min() < _PARALLEL:
            raise InputError(
                f"dome's table: board {number} has LEDs whose normals differ by more than 2 degrees; a flat board "
                "has one normal. Correct the table, or give single LEDs separate boards"
            )
        middle_mm = table.positions_mm[rows].mean(axis=0)
        along = table.positions_mm[rows[-1]] - table.positions_mm[rows[0]]
        along = along - (along @ normal) * normal
        if np.linalg.norm(along) < 1e-6:  # an LED alone: any direction in the board
            along = np.cross(normal, np.eye(3)[int(np.argmin(np.abs(normal)))])
        x = along / np.linalg.norm(along)
        poses[board, :3, :] = np.column_stack([x, np.cross(normal, x), normal, middle_mm])
        places_mm[rows] = (table.positions_mm[rows] - middle_mm) @ poses[board, :3, :3]
    return Boards(numbers, board_of.astype(np.intp), poses, places_mm)
