"""The dome as it was built: its boards deviate slightly from the LED table, and wires may be swapped.

The controller has the table; frames are lit by the LEDs given here. This is the truth for the LED calibration.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import ClassVar

import numpy as np
from numpy.typing import NDArray
from pydantic import ConfigDict

from coupole.appearance.render.led_squares import Leds

_SHIFT, _TURN, _PLACE = 1, 2, 3
"""Numbers of the seed's random streams, by use."""


@dataclass(frozen=True)
class DomeErrors:
    """Deviations of the dome from its table; all normally distributed."""

    __pydantic_config__: ClassVar[ConfigDict] = ConfigDict(extra="forbid")

    seed: int = 1
    board_shift_mm: float = 0.0
    """Standard deviation of a board's position along each axis."""
    board_turn_deg: float = 0.0
    """Standard deviation of a board's rotation about each axis through its middle."""
    led_shift_mm: float = 0.0
    """Standard deviation of an LED's position on its board along each axis."""
    swapped: tuple[tuple[int, int], ...] = ()
    """Pairs of LEDs whose wires are swapped: each lights at the position of the other."""


def as_built(table: Leds, errors: DomeErrors) -> Leds:
    """Return the LEDs at their true positions. Ids and fluxes are the table's, but swapped LEDs exchange
    fluxes."""
    if not (errors.board_shift_mm or errors.board_turn_deg or errors.led_shift_mm or errors.swapped):
        return table
    from scipy.spatial.transform import Rotation

    positions_mm, normals = table.positions_mm.copy(), table.normals.copy()
    for board in np.unique(table.boards):
        on_board = table.boards == board
        turn_deg = errors.board_turn_deg * _normals(errors.seed, _TURN, int(board), 1)[0]
        turn = Rotation.from_rotvec(turn_deg, degrees=True).as_matrix()
        shift_mm = errors.board_shift_mm * _normals(errors.seed, _SHIFT, int(board), 1)[0]
        own_mm = errors.led_shift_mm * _normals(errors.seed, _PLACE, int(board), int(on_board.sum()))
        middle_mm = positions_mm[on_board].mean(axis=0)
        positions_mm[on_board] = (positions_mm[on_board] - middle_mm + own_mm) @ turn.T + middle_mm + shift_mm
        normals[on_board] = normals[on_board] @ turn.T
    row_of_led = {int(led): row for row, led in enumerate(table.ids)}
    at = np.arange(len(table.ids))
    for first, second in errors.swapped:
        a, b = row_of_led[first], row_of_led[second]
        at[[a, b]] = at[[b, a]]
    return replace(table, positions_mm=positions_mm[at], normals=normals[at], flux_lm=table.flux_lm[at])


def _normals(seed: int, purpose: int, board: int, count: int) -> NDArray[np.float64]:
    """Standard normal numbers [count, 3] of a board."""
    return np.random.default_rng((seed, purpose, board)).standard_normal((count, 3))
