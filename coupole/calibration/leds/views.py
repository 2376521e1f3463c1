"""Views of a dome's LEDs: few views that see each board often enough and from different directions.

An image shows one LED, so six sightings of 1080 LEDs are 6480 images with any choice of views; fewer views need
fewer moves, and views that see many boards at once determine their relative positions. Views are chosen one by
one: each time the one with the largest gain of information on boards that need more (log det of the information
matrix of a board's position; sequential D-optimal design, Fedorov, Theory of Optimal Experiments, 1972).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from coupole.calibration import optics
from coupole.calibration.leds.boards import Boards
from coupole.calibration.optics import Intrinsics
from coupole.calibration.rotations import Floats, inverses

ENOUGH = 6
"""Sightings of each LED (Lucat et al. 2025)."""
MOST_ANGLE_DEG = 65.0
"""Largest angle between an LED's normal and the direction to the camera; at larger angles the edges of boards hide
the LED."""
NEAREST_MM, FARTHEST_MM = 400.0, 2600.0
_START_MM = 50.0
"""Standard uncertainty of a board's position in the table."""
_ANGLE_SIGMA = np.radians(0.004)
"""Angular noise of one sighting, which comes mostly from the arm."""


@dataclass(frozen=True)
class LedView:
    """A candidate that was chosen, and the boards that are lit there."""

    candidate: int
    boards: tuple[int, ...]
    """Numbers of the boards in the table."""


@dataclass(frozen=True)
class LedViews:
    """A choice of views."""

    views: tuple[LedView, ...]
    images: int
    """Sum over the views of the number of LEDs on the lit boards."""
    few: tuple[int, ...]
    """Boards that too few candidates see."""
    u_mm: Floats
    """[b] expected standard uncertainty of each board's position, all directions together, without correlations
    between boards."""


def led_views(
    boards: Boards,
    base_from_camera: Floats,
    lens: Intrinsics,
    size_px: tuple[int, int],
    *,
    enough: int = ENOUGH,
    margin_px: float = 80.0,
) -> LedViews:
    """Choose among candidates [c, 4, 4] until each board is seen completely `enough` times."""
    visible, information = _sightings(boards, base_from_camera, lens, size_px, margin_px)
    views_needed = np.full(len(boards.numbers), enough)
    total_information = np.tile(np.eye(3) / _START_MM**2, (len(views_needed), 1, 1))
    free = np.ones(len(base_from_camera), np.bool_)
    views: list[LedView] = []
    gain = _gain(total_information, information)
    while True:
        useful = visible & free[:, None] & (views_needed > 0)[None]
        best = int(np.argmax(np.where(useful, gain, 0.0).sum(axis=1)))
        if not useful[best].any():
            break
        free[best] = False
        rows = np.flatnonzero(useful[best])
        total_information[rows] += information[best, rows]
        gain[:, rows] = _gain(total_information[rows], information[:, rows])
        views_needed[rows] -= 1
        views.append(LedView(best, tuple(int(n) for n in boards.numbers[rows])))
    leds = np.bincount(boards.board_of)
    of = {int(number): row for row, number in enumerate(boards.numbers)}
    images = sum(int(leds[of[number]]) for view in views for number in view.boards)
    few = tuple(int(n) for n in boards.numbers[views_needed > 0])
    return LedViews(
        tuple(views), images, few, np.sqrt(np.trace(np.linalg.inv(total_information), axis1=1, axis2=2))
    )


def boards_seen(
    boards: Boards, base_from_camera: Floats, lens: Intrinsics, size_px: tuple[int, int], margin_px: float
) -> NDArray[np.bool_]:
    """Return [c, b], True for boards that are seen completely from each of the poses [c, 4, 4]."""
    return _sightings(boards, base_from_camera, lens, size_px, margin_px)[0]


def _gain(known_information: Floats, information: Floats) -> Floats:
    """Return the gain of information [c, b] of each board by each view: the growth of log det."""
    return np.asarray(
        np.linalg.slogdet(known_information[None] + information)[1] - np.linalg.slogdet(known_information)[1]
    )


def _sightings(
    boards: Boards, base_from_camera: Floats, lens: Intrinsics, size_px: tuple[int, int], margin_px: float
) -> tuple[NDArray[np.bool_], Floats]:
    """Return the boards [c, b] that each candidate sees completely, and the information on their positions [c, b,
    3, 3], 1/mm^2."""
    leds_mm = boards.in_base(boards.base_from_board)
    normals = boards.base_from_board[boards.board_of, :3, 2]
    camera_from_base = inverses(base_from_camera)
    visible = np.empty((len(base_from_camera), len(leds_mm)), np.bool_)
    for number, pose in enumerate(camera_from_base):
        there = leds_mm @ pose[:3, :3].T + pose[:3, 3]
        towards = base_from_camera[number, :3, 3] - leds_mm
        distance = np.linalg.norm(towards, axis=1)
        facing = np.einsum("ni,ni->n", towards, normals) / distance
        visible[number] = (there[:, 2] > NEAREST_MM) & (distance < FARTHEST_MM)
        visible[number] &= facing > np.cos(np.radians(MOST_ANGLE_DEG))
        rows = np.flatnonzero(visible[number])
        pixels = optics.project(there[rows], lens.vector()).pixels
        inside = (pixels > margin_px) & (pixels < np.array(size_px) - 1 - margin_px)
        visible[number, rows] = inside.all(axis=1)
    count = len(boards.numbers)
    whole = np.stack([visible[:, boards.rows_of(b)].all(axis=1) for b in range(count)], axis=1)
    middles = boards.base_from_board[:, :3, 3]
    rays = middles[None] - base_from_camera[:, None, :3, 3]
    distance = np.linalg.norm(rays, axis=2, keepdims=True)
    rays = rays / distance
    across = np.eye(3) - rays[..., :, None] * rays[..., None, :]
    return whole, across / (distance[..., None] * _ANGLE_SIGMA) ** 2
