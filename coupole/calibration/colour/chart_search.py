"""Searches for a chart's rows and columns in a picture: even areas of similar size on a grid.

The picture is reduced, and its even areas are found at several bounds of evenness. Three neighbouring areas start
a grid. The grid grows step by step, so it follows perspective and distortion. Patches that were not found (black
ones in a black frame) follow from the others.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from itertools import permutations
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from coupole.calibration.rotations import Floats

_REDUCED_PX = 900
"""Longer side of the picture that is searched."""
_STEPS = (0.015, 0.025, 0.04, 0.07, 0.12)
"""Bounds of evenness: largest steps between neighbouring pixels, as a share of the picture's white, in values for
the eye."""
_AREA = (40.0, 0.06)
"""Least area of a patch, in reduced pixels, and its largest share of the picture."""
_CONVEX, _SQUARE = 0.85, 0.7
"""Least shares of an area: of its convex hull, and of the rectangle around it."""
_MOST_AREAS = 200
_NEIGHBOURS = 6
_ALIKE = (0.55, 1.8)
"""Limits of the ratio of the sizes of neighbouring areas of one chart."""
_NEAR = 0.25
"""Largest distance of an area from its expected place, as a share of the step between patches."""
_LEAST_SHARE = 0.4
"""Least share of a chart's patches that must be found."""
_LEAST_FOUND = 6


@dataclass(frozen=True)
class _Areas:
    """Even areas of the reduced picture."""

    middles: Floats
    """[n, 2] reduced pixels."""
    sizes: Floats
    """[n] side of a square of the same area."""


Grid = dict[tuple[int, int], int]
"""Number of an area by its column and row. The count of columns and rows begins anywhere."""


def search_corners(values: NDArray[np.float32], rows: int, columns: int) -> list[Floats]:
    """Return places [4, 2] px that the middles of a chart's corner patches may have, in turn. The most likely
    grids are first.

    `values` [H, W, 3] are linear. A place may begin at any corner of the chart; `KnownChart` shows which. The list
    is empty if no grid is found.
    """
    factor = max(1.0, max(values.shape[:2]) / _REDUCED_PX)
    areas = _even_areas(_for_the_eye(values, factor))
    return [
        (place + 0.5) * factor - 0.5
        for grid in _grids(areas, rows, columns)
        for place in _placed_grid(grid, areas, rows, columns)
    ]


def _for_the_eye(values: NDArray[np.float32], factor: float) -> NDArray[np.float32]:
    """Return [h, w, 3] reduced, from 0 to 1, with equal steps for the eye in dark and light."""
    height, width = values.shape[:2]
    size = (max(1, round(width / factor)), max(1, round(height / factor)))
    small = cv2.resize(np.nan_to_num(values, nan=0.0), size, interpolation=cv2.INTER_AREA)
    white = np.maximum(np.quantile(small, 0.995, axis=(0, 1)), 1e-12)
    eye = np.clip(small / white, 0.0, 1.0) ** (1.0 / 2.2)
    return np.asarray(cv2.GaussianBlur(eye.astype(np.float32), (0, 0), 0.8))


def _even_areas(eye: NDArray[np.float32]) -> _Areas:
    box = np.ones((3, 3), np.uint8)
    step = np.asarray(cv2.dilate(eye, box) - cv2.erode(eye, box)).max(axis=2)
    middles: list[Floats] = []
    sizes: list[float] = []
    for bound in _STEPS:
        even = np.where(step < bound, np.uint8(1), np.uint8(0))
        outlines, _ = cv2.findContours(even, cv2.RETR_LIST, cv2.CHAIN_APPROX_NONE)
        for outline in outlines:
            area = float(cv2.contourArea(outline))
            if not _AREA[0] <= area <= _AREA[1] * step.size or not _is_patch(outline, area):
                continue
            moments = cv2.moments(outline)
            middle = np.array([moments["m10"], moments["m01"]]) / moments["m00"]
            size = float(np.sqrt(area))
            near = [
                n for n, earlier_middle in enumerate(middles) if np.abs(earlier_middle - middle).max() < 0.3 * size
            ]
            if not near:
                middles.append(middle)
                sizes.append(size)
            elif size > sizes[near[0]]:
                middles[near[0]], sizes[near[0]] = middle, size
    order = np.argsort(sizes)[::-1][:_MOST_AREAS]
    return _Areas(np.array(middles).reshape(-1, 2)[order], np.array(sizes)[order])


def _is_patch(outline: NDArray[Any], area: float) -> bool:
    hull = float(cv2.contourArea(cv2.convexHull(outline)))
    _, (width, height), _ = cv2.minAreaRect(outline)
    is_long = max(width, height) > 3.0 * max(min(width, height), 1e-9)
    return not is_long and area > _CONVEX * hull and area > _SQUARE * width * height


def _grids(areas: _Areas, rows: int, columns: int) -> Iterator[Grid]:
    """Yield grids of the right size, those with most patches first. Each set of areas comes once."""
    grids_found: dict[frozenset[int], Grid] = {}
    patch_count = rows * columns
    for start in range(len(areas.sizes)):
        if any(start in members and len(members) > 0.8 * patch_count for members in grids_found):
            continue
        for right, down in permutations(_around(areas, start), 2):
            grid = _grow_grid(areas, start, right, down, max(rows, columns))
            if len(grid) >= max(_LEAST_FOUND, _LEAST_SHARE * patch_count) and _fits(grid, rows, columns):
                grids_found.setdefault(frozenset(grid.values()), grid)
            if len(grid) == patch_count:
                break
    yield from sorted(grids_found.values(), key=len, reverse=True)[:20]


def _around(areas: _Areas, start: int) -> list[int]:
    """Return the numbers of the nearest areas of similar size."""
    ratio = areas.sizes / areas.sizes[start]
    away = np.linalg.norm(areas.middles - areas.middles[start], axis=1)
    alike = (ratio > _ALIKE[0]) & (ratio < _ALIKE[1]) & (away > 0.8 * areas.sizes[start])
    near = np.flatnonzero(alike & (away < 4.0 * areas.sizes[start]))
    return [int(n) for n in near[np.argsort(away[near])][:_NEIGHBOURS]]


def _grow_grid(areas: _Areas, start: int, right: int, down: int, most: int) -> Grid:
    """Return the grid of an area and its neighbours to the right and below; empty if these are not neighbours on a
    grid."""
    middles = areas.middles
    x, y = middles[right] - middles[start], middles[down] - middles[start]
    lengths = np.linalg.norm(x), np.linalg.norm(y)
    turn = float(x[0] * y[1] - x[1] * y[0])  # above 0: clockwise in a picture, whose y is down
    if turn < 0.6 * lengths[0] * lengths[1] or not 0.4 < lengths[0] / lengths[1] < 2.5:
        return {}
    grid: Grid = {(0, 0): start, (1, 0): right, (0, 1): down}
    waiting = [(0, 0), (1, 0), (0, 1)]
    taken_areas = {start, right, down}
    while waiting:
        column, row = waiting.pop(0)
        for along, (step_x, step_y) in ((x, (1, 0)), (-x, (-1, 0)), (y, (0, 1)), (-y, (0, -1))):
            place = column + step_x, row + step_y
            if place in grid or max(abs(place[0]), abs(place[1])) >= most:
                continue
            here = grid[column, row]
            behind = grid.get((column - step_x, row - step_y))
            step = along if behind is None else middles[here] - middles[behind]
            away = np.linalg.norm(middles - (middles[here] + step), axis=1)
            nearest = int(np.argmin(away))
            ratio = areas.sizes[nearest] / areas.sizes[here]
            is_alike = _ALIKE[0] < ratio < _ALIKE[1]
            if nearest not in taken_areas and is_alike and away[nearest] < _NEAR * np.linalg.norm(step):
                grid[place] = nearest
                taken_areas.add(nearest)
                waiting.append(place)
    return grid


def _extent(grid: Grid) -> tuple[int, int, int, int]:
    """Return the first column and row, and the numbers of columns and rows."""
    places = np.array(list(grid))
    low, high = places.min(axis=0), places.max(axis=0)
    return int(low[0]), int(low[1]), int(high[0] - low[0]) + 1, int(high[1] - low[1]) + 1


def _fits(grid: Grid, rows: int, columns: int) -> bool:
    _, _, wide, high = _extent(grid)
    return (wide <= columns and high <= rows) or (wide <= rows and high <= columns)


def _placed_grid(grid: Grid, areas: _Areas, rows: int, columns: int) -> Iterator[Floats]:
    """Yield middles [4, 2] of the corner patches, in reduced pixels, clockwise, for every way in which the grid
    may be a part of the chart."""
    first_column, first_row, wide, high = _extent(grid)
    places = np.array(list(grid), np.float64) - (first_column, first_row)
    projection: Any = cv2.findHomography(places, areas.middles[list(grid.values())])[0]
    if projection is None:
        return
    for across, down in dict.fromkeys([(columns, rows), (rows, columns)]):
        for offset_x in range(across - wide + 1):
            for offset_y in range(down - high + 1):
                box = np.array([(0, 0), (across - 1, 0), (across - 1, down - 1), (0, down - 1)], np.float64)
                yield cv2.perspectiveTransform((box - (offset_x, offset_y))[None], projection)[0]
