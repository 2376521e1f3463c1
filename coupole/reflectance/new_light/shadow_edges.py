"""Which pixels of a surface a beam reaches.

Rays are traced from every fourth pixel in both directions, and from all between where these differ; then shadows'
edges are followed from cell to cell until they end. What is missed is a spot of light or shadow that lies between
four rays and touches no edge that was found.
"""

from __future__ import annotations

import os
from concurrent.futures import ThreadPoolExecutor
from typing import Any

import numba
import numpy as np
from numpy.typing import NDArray

from coupole.motion.occlusion import RAY_START_MM, blocked_along
from coupole.reflectance.new_light.beams import Beam
from coupole.reflectance.new_light.pictured_surface import Surface, in_strips

Codes = NDArray[np.uint8]

NONE, AWAY, LIT, SHADED, ASKED = range(5)
"""Of a pixel: no surface; it or the emitter looks away; what a ray found; a ray is needed."""
CELL_PX = 4
DISTANT_MM = 3000.0
"""What is farther casts no shadow of distant light."""
_RAYS = 1 << 17


def reached(rays: Any, surface: Surface, beam: Beam) -> Codes:
    """[h, w] codes; `rays` is the mesh's `ray_mesh`."""
    codes = np.empty(surface.seen.shape, np.uint8)
    facing = surface.seen, surface.places_mm, surface.normals, beam.near, beam.place, beam.axis, beam.exponent
    in_strips(len(codes), lambda rows: _begin(facing[0][rows], facing[1][rows], *facing[2:], codes[rows]))
    _trace(rays, surface, beam, _asked_on_grid(codes), codes)
    open_cells = _open_cells(codes)
    fresh = np.argwhere(open_cells)
    while len(fresh):
        _trace(rays, surface, beam, _asked_in(codes, fresh), codes)
        fresh = _spread(codes, open_cells, fresh)
    _fill(codes)
    return codes


def _trace(rays: Any, surface: Surface, beam: Beam, pixels: NDArray[np.int64], codes: Codes) -> None:
    seen, places_mm, flat = surface.seen.reshape(-1), surface.places_mm.reshape(-1, 3), codes.reshape(-1)

    def trace(first: int) -> None:
        mine = pixels[first : first + _RAYS]
        starts_mm, ways_mm = np.empty((2, len(mine), 3), np.float32)
        _begin_rays(mine, seen, places_mm, surface.normals, beam.near, beam.place, starts_mm, ways_mm)
        flat[mine] = np.where(blocked_along(rays, starts_mm, ways_mm), SHADED, LIT)

    with ThreadPoolExecutor(len(os.sched_getaffinity(0))) as pool:
        list(pool.map(trace, range(0, len(pixels), _RAYS)))


@numba.njit(cache=True, nogil=True)
def _begin_rays(pixels, seen, places_mm, normals, near, place, starts_mm, ways_mm):  # type: ignore[no-untyped-def]
    for n in range(len(pixels)):
        triangle = seen[pixels[n]]
        for k in range(3):
            start_mm = places_mm[pixels[n], k] + RAY_START_MM * normals[triangle, k]
            starts_mm[n, k] = start_mm
            ways_mm[n, k] = place[k] - start_mm if near else DISTANT_MM * place[k]


def _asked_on_grid(codes: Codes) -> NDArray[np.int64]:
    rows, columns = np.nonzero(codes[::CELL_PX, ::CELL_PX] == ASKED)
    found: NDArray[np.int64] = (rows * codes.shape[1] + columns) * CELL_PX
    return found


@numba.njit(cache=True, nogil=True)
def _begin(seen, places_mm, normals, near, place, axis, exponent, codes):  # type: ignore[no-untyped-def]
    """Codes by the normals alone."""
    for row in range(seen.shape[0]):
        for column in range(seen.shape[1]):
            triangle = seen[row, column]
            if triangle < 0:
                codes[row, column] = NONE
                continue
            facing, leaving = 0.0, 0.0
            for k in range(3):
                way = place[k] - places_mm[row, column, k] if near else place[k]
                facing += way * normals[triangle, k]
                leaving -= way * axis[k]
            dark = facing <= 0.0 or (exponent > 0 and leaving <= 0.0)
            codes[row, column] = AWAY if dark else ASKED


@numba.njit(cache=True, nogil=True)
def _open_cells(codes):  # type: ignore[no-untyped-def]
    """[cells down, cells across] True where rays at the corners are missing or differ, or the surface ends."""
    height, width = codes.shape
    down, across = (height + CELL_PX - 1) // CELL_PX, (width + CELL_PX - 1) // CELL_PX
    found = np.ones((down, across), np.bool_)
    for i in range(down - 1):
        for j in range(across - 1):
            row, column = i * CELL_PX, j * CELL_PX
            one = codes[row, column]
            if one not in (LIT, SHADED) or codes[row, column + CELL_PX] != one:
                continue
            if codes[row + CELL_PX, column] != one or codes[row + CELL_PX, column + CELL_PX] != one:
                continue
            whole = True
            for y in range(row, row + CELL_PX):
                for x in range(column, column + CELL_PX):
                    whole &= codes[y, x] != NONE
            found[i, j] = not whole
    return found


@numba.njit(cache=True, nogil=True)
def _asked_in(codes, cells):  # type: ignore[no-untyped-def]
    """Pixels of cells [n, 2] that need a ray."""
    height, width = codes.shape
    found = np.empty(len(cells) * CELL_PX * CELL_PX, np.int64)
    count = 0
    for cell in range(len(cells)):
        row, column = cells[cell, 0] * CELL_PX, cells[cell, 1] * CELL_PX
        for y in range(row, min(row + CELL_PX, height)):
            for x in range(column, min(column + CELL_PX, width)):
                if codes[y, x] == ASKED:
                    found[count] = y * width + x
                    count += 1
    return found[:count]


@numba.njit(cache=True, nogil=True)
def _spread(codes, open_cells, fresh):  # type: ignore[no-untyped-def]
    """Open the closed neighbours of cells [n, 2] with a pixel at the common side that differs from them; which."""
    down, across = open_cells.shape
    found = np.empty((4 * len(fresh), 2), np.int64)
    count = 0
    for cell in range(len(fresh)):
        i, j = fresh[cell]
        for di, dj in ((-1, 0), (1, 0), (0, -1), (0, 1)):
            y, x = i + di, j + dj
            if y < 0 or x < 0 or y >= down or x >= across or open_cells[y, x]:
                continue
            if _differs(codes, i * CELL_PX, j * CELL_PX, di, dj, codes[y * CELL_PX, x * CELL_PX]):
                open_cells[y, x] = True
                found[count, 0], found[count, 1] = y, x
                count += 1
    return found[:count]


@numba.njit(cache=True, nogil=True)
def _differs(codes, row, column, down, across, one):  # type: ignore[no-untyped-def]
    """Whether one of a cell's pixels at its side was found to be other than `one`."""
    height, width = codes.shape
    other = SHADED if one == LIT else LIT
    for step in range(CELL_PX):
        y = row + (step if down == 0 else (CELL_PX - 1 if down > 0 else 0))
        x = column + (step if across == 0 else (CELL_PX - 1 if across > 0 else 0))
        if y < height and x < width and codes[y, x] == other:
            return True
    return False


@numba.njit(cache=True, nogil=True)
def _fill(codes):  # type: ignore[no-untyped-def]
    """What is still asked lies in closed cells and is as their corners."""
    for row in range(codes.shape[0]):
        for column in range(codes.shape[1]):
            if codes[row, column] == ASKED:
                codes[row, column] = codes[row - row % CELL_PX, column - column % CELL_PX]
