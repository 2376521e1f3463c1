"""Pixels of a surface that a beam reaches.

Rays are traced from every fourth pixel in both directions. Where these rays differ, rays are traced from all
pixels between them. Then the edges of shadows are followed from cell to cell until they end. A spot of light or
shadow is missed if it lies between four rays and touches no edge that was found.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from coupole.kernels import kernel
from coupole.kernels.embree import COHERENT, FAR, LANES, packet
from coupole.motion.occlusion import RAY_START_MM
from coupole.motion.packet_rays import PacketMesh, blocked16, trace
from coupole.reflectance.new_light.beams import Beam
from coupole.reflectance.new_light.pictured_surface import Surface, in_strips
from coupole.reflectance.parts_in_threads import in_threads

Codes = NDArray[np.uint8]

NONE, AWAY, LIT, SHADED, ASKED = range(5)
"""Codes of a pixel: no surface; the surface or the emitter faces away; lit or shaded by a ray; a ray is needed."""
CELL_PX = 4
DISTANT_MM = 3000.0
"""Distance beyond which objects cast no shadow of distant light."""
_RAYS = 1 << 15
_PACKET = 4
"""Number of grid rays, down and across, that are traced together."""


def trace_beam(mesh: PacketMesh, surface: Surface, beam: Beam, codes: Codes) -> None:
    """Fill `codes` [h, w], which say whether the beam reaches each pixel; `mesh` casts the shadows."""
    by = _facing(surface, beam), beam.place, beam.axis, beam.exponent
    in_strips(
        len(codes), lambda rows: _begin(surface.triangle_of_pixel[rows], surface.places_mm[rows], *by, codes[rows])
    )
    _trace(mesh, surface, beam, _asked_on_grid(codes), codes)
    open_cells = np.ones(codes[::CELL_PX, ::CELL_PX].shape, np.bool_)
    in_strips(len(open_cells) - 1, lambda cells: _close_cells(codes, cells.start, open_cells[cells]))
    fresh = np.ascontiguousarray(np.argwhere(open_cells))  # functions are compiled for each layout
    while len(fresh):
        _trace(mesh, surface, beam, _asked_in(codes, fresh), codes)
        fresh = _open_neighbours(codes, open_cells, fresh)
    in_strips(len(codes), lambda rows: _fill(codes, rows.start, rows.stop))


def _trace(mesh: PacketMesh, surface: Surface, beam: Beam, pixels: NDArray[np.int64], codes: Codes) -> None:
    on = surface.triangle_of_pixel.reshape(-1), surface.places_mm.reshape(-1, 3), surface.normals
    how, flat = (blocked16(), mesh.scene, COHERENT), codes.reshape(-1)

    def some(first: int) -> None:
        _trace_rays(*how, pixels[first : first + _RAYS], *on, beam.near, beam.place, flat)

    in_threads(some, len(pixels), part=_RAYS)


@kernel
def _trace_rays(  # type: ignore[no-untyped-def]
    function, scene, arguments, pixels, triangle_of_pixel, places_mm, normals, near, place, codes
):
    """Find the codes of some pixels by a ray from each; neighbours in the list are traced together."""
    rays, words, valid = packet()
    for first in range(0, len(pixels), LANES):
        lanes = min(LANES, len(pixels) - first)
        for lane in range(lanes):
            pixel = pixels[first + lane]
            triangle = triangle_of_pixel[pixel]
            for k in range(3):
                start_mm = places_mm[pixel, k] + RAY_START_MM * normals[triangle, k]
                rays[k, lane] = start_mm
                rays[4 + k, lane] = place[k] - start_mm if near else DISTANT_MM * place[k]
        trace(function, scene, rays, words, valid, lanes, np.float32(1.0), arguments)
        for lane in range(lanes):
            codes[pixels[first + lane]] = SHADED if rays[FAR, lane] < 0.0 else LIT


@kernel
def _asked_on_grid(codes):  # type: ignore[no-untyped-def]
    """Return the pixels of the grid that need a ray, in squares whose rays are traced together."""
    (height, width), side = codes.shape, _PACKET * CELL_PX
    pixels = np.empty(((height + CELL_PX - 1) // CELL_PX) * ((width + CELL_PX - 1) // CELL_PX), np.int64)
    count = 0
    for top in range(0, height, side):
        for left_column in range(0, width, side):
            for row in range(top, min(top + side, height), CELL_PX):
                for column in range(left_column, min(left_column + side, width), CELL_PX):
                    if codes[row, column] == ASKED:
                        pixels[count] = row * width + column
                        count += 1
    return pixels[:count]


def _facing(surface: Surface, beam: Beam) -> NDArray[np.bool_]:
    """[triangles] True if they face a beam. The beam is on the same side for all places of a triangle's plane."""
    if not beam.near:
        return surface.normals @ beam.place > 0.0
    return surface.normals @ beam.place > surface.offsets_mm


@kernel
def _begin(triangle_of_pixel, places_mm, facing, place, axis, exponent, codes):  # type: ignore[no-untyped-def]
    """Fill the codes that follow from the normals of triangles and emitter alone."""
    for row in range(triangle_of_pixel.shape[0]):
        for column in range(triangle_of_pixel.shape[1]):
            triangle = triangle_of_pixel[row, column]
            codes[row, column] = NONE if triangle < 0 else ASKED if facing[triangle] else AWAY
        if exponent == 0:
            continue
        for column in range(triangle_of_pixel.shape[1]):
            leaving = 0.0
            for k in range(3):
                leaving += (places_mm[row, column, k] - place[k]) * axis[k]
            if leaving <= 0.0:
                codes[row, column] = min(codes[row, column], AWAY)


@kernel
def _close_cells(codes, first, open_cells):  # type: ignore[no-untyped-def]
    """Close cells in rows [n, cells across] from the `first` one on, if they have cells below and to the right. A
    cell stays open if rays at its corners are missing or differ, or if the surface ends there.
    """
    down, across = open_cells.shape
    for i in range(down):
        for j in range(across - 1):
            row, column = (first + i) * CELL_PX, j * CELL_PX
            code = codes[row, column]
            if code not in (LIT, SHADED) or codes[row, column + CELL_PX] != code:
                continue
            if codes[row + CELL_PX, column] != code or codes[row + CELL_PX, column + CELL_PX] != code:
                continue
            ends = False
            for y in range(row, row + CELL_PX):
                for x in range(column, column + CELL_PX):
                    ends |= codes[y, x] == NONE
            open_cells[i, j] = ends


@kernel
def _asked_in(codes, cells):  # type: ignore[no-untyped-def]
    """Return the pixels in cells [n, 2] that need a ray."""
    height, width = codes.shape
    pixels = np.empty(len(cells) * CELL_PX * CELL_PX, np.int64)
    count = 0
    for cell in range(len(cells)):
        row, column = cells[cell, 0] * CELL_PX, cells[cell, 1] * CELL_PX
        for y in range(row, min(row + CELL_PX, height)):
            for x in range(column, min(column + CELL_PX, width)):
                if codes[y, x] == ASKED:
                    pixels[count] = y * width + x
                    count += 1
    return pixels[:count]


@kernel
def _open_neighbours(codes, open_cells, fresh):  # type: ignore[no-untyped-def]
    """Open each closed neighbour of the cells [n, 2] if it has a pixel with another code at the common side;
    return the opened cells."""
    down, across = open_cells.shape
    opened_cells = np.empty((4 * len(fresh), 2), np.int64)
    count = 0
    for cell in range(len(fresh)):
        i, j = fresh[cell]
        for di, dj in ((-1, 0), (1, 0), (0, -1), (0, 1)):
            y, x = i + di, j + dj
            if y < 0 or x < 0 or y >= down or x >= across or open_cells[y, x]:
                continue
            if _differs(codes, i * CELL_PX, j * CELL_PX, di, dj, codes[y * CELL_PX, x * CELL_PX]):
                open_cells[y, x] = True
                opened_cells[count, 0], opened_cells[count, 1] = y, x
                count += 1
    return opened_cells[:count]


@kernel
def _differs(codes, row, column, down, across, expected_code):  # type: ignore[no-untyped-def]
    """Tell whether a pixel at the side of a cell is shaded although `expected_code` says lit, or the reverse."""
    height, width = codes.shape
    opposite = SHADED if expected_code == LIT else LIT
    for step in range(CELL_PX):
        y = row + (step if down == 0 else (CELL_PX - 1 if down > 0 else 0))
        x = column + (step if across == 0 else (CELL_PX - 1 if across > 0 else 0))
        if y < height and x < width and codes[y, x] == opposite:
            return True
    return False


@kernel
def _fill(codes, first, end):  # type: ignore[no-untyped-def]
    """Fill the pixels of some rows that still need a code. They lie in closed cells and have the code of the
    cell's corners."""
    for row in range(first, end):
        for column in range(codes.shape[1]):
            if codes[row, column] == ASKED:
                codes[row, column] = codes[row - row % CELL_PX, column - column % CELL_PX]
