"""Texels of a requested size: squares of a view's pixels that share one material.

The number of pixels across a texel follows from the width of the view's pixels on the surface. Pixels of a square
that see another surface than most of its pixels, nearer or farther away, belong to no texel.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from coupole.kernels import kernel
from coupole.reflectance.new_light.pictured_surface import Surface, in_strips

_SAMPLED = 1_000_000
"""Approximate number of pixels from which their size on the surface is found."""


@dataclass(frozen=True)
class TexelGrid:
    """Texels of a view, each a square of pixels: their triangles, and their pixels."""

    side_px: int
    triangle: NDArray[np.int32]
    """[rows, columns] for each texel the row, in the view's file, of the triangle that most of its pixels see; -1
    for none.
    """
    texel_of_pixel: NDArray[np.int32]
    """[h, w] place of a pixel's texel in the grid, row by row; -1 for none."""
    places_mm: NDArray[np.float32]
    """[rows, columns, 3] mean of the places that a texel's pixels see, base frame."""

    def part(self, rows: slice, columns: slice) -> TexelGrid:
        """Return a part of the grid, whose texels are numbered anew."""
        of_pixels = tuple(
            slice(of_side.start * self.side_px, of_side.stop * self.side_px) for of_side in (rows, columns)
        )
        number = self.texel_of_pixel[of_pixels]
        row, column = np.divmod(number, self.triangle.shape[1])
        new_number = (row - rows.start) * (columns.stop - columns.start) + column - columns.start
        return TexelGrid(
            self.side_px,
            self.triangle[rows, columns],
            np.where(number >= 0, new_number, -1).astype(np.int32),
            self.places_mm[rows, columns],
        )


@dataclass(frozen=True)
class TexelSquares:
    """Texels of a view as squares of pixels, which measure different channels at different places."""

    grid: TexelGrid
    bend: NDArray[np.float32]
    """[rows, columns] variance, rad^2, of each tilt, from triangles within a texel that are turned to each
    other."""
    channel_offsets: NDArray[np.float32]
    """[rows, columns, channels, 2] middle of each channel's pixels from the middle of all pixels of a texel, to
    the right and down, in widths of a texel."""
    channel_shares: NDArray[np.float64]
    """[channels] each channel's share of the pixels."""

    def part(self, rows: slice, columns: slice) -> TexelSquares:
        """Return a part of the texels."""
        bend, offsets = self.bend[rows, columns], self.channel_offsets[rows, columns]
        return TexelSquares(self.grid.part(rows, columns), bend, offsets, self.channel_shares)


def pixel_mm(surface: Surface) -> float:
    """Return the width of a view's pixels on the surface, mm: the root of the area that a pixel sees, as the
    median over the pixels. If the mesh is so coarse that pixels see the centres of its triangles, it is the
    mean."""
    step = max(1, math.isqrt(surface.triangle_of_pixel.size // _SAMPLED))
    places_mm = surface.places_mm
    here = places_mm[:-1:step, :-1:step]
    right, down = places_mm[:-1:step, 1::step] - here, places_mm[1::step, :-1:step] - here
    areas_mm2 = np.linalg.norm(np.cross(right, down), axis=2)
    median_mm2 = float(np.nanmedian(areas_mm2)) if np.isfinite(areas_mm2).any() else 0.0
    if median_mm2 > 0.0:
        return math.sqrt(median_mm2)
    seen_mm = surface.centres_mm
    extent_mm2 = float(np.prod(np.sort(np.ptp(seen_mm, axis=0))[1:]))
    return math.sqrt(extent_mm2 / max(1, int(np.count_nonzero(surface.triangle_of_pixel >= 0))))


def texel_grid(surface: Surface, side_px: int) -> TexelGrid:
    """Cut a view's picture into squares of `side_px`."""
    shape = surface.triangle_of_pixel.shape
    rows, columns = (-(-length // side_px) for length in shape)
    triangle = np.full((rows, columns), -1, np.int32)
    places_mm = np.zeros((rows, columns, 3), np.float32)
    texel_of_pixel = np.full(shape, -1, np.int32)
    most_mm = side_px * pixel_mm(surface)
    in_strips(
        rows,
        lambda some: _cut_rows(
            some.start, some.stop, side_px, most_mm, surface.triangle_of_pixel, surface.places_mm,
            surface.centres_mm, surface.normals, triangle, places_mm, texel_of_pixel,
        ),
    )  # fmt: skip
    return TexelGrid(side_px, triangle, texel_of_pixel, places_mm)


@kernel
def _cut_rows(  # type: ignore[no-untyped-def]
    first, end, side_px, most_mm, triangle_of_pixel, seen_mm, centres_mm, normals, triangle, places_mm,
    texel_of_pixel
):  # fmt: skip
    """Fill rows of texels. A pixel is left out if its place is farther than `most_mm` in front of or behind the
    plane of the triangle that most pixels of its square see."""
    for row in range(first, end):
        down = slice(row * side_px, (row + 1) * side_px)
        for column in range(triangle.shape[1]):
            across = slice(column * side_px, (column + 1) * side_px)
            numbers = triangle_of_pixel[down, across].copy().reshape(-1)
            numbers = numbers[numbers >= 0]
            if len(numbers) == 0:
                continue
            most = _most_frequent(numbers)
            members = _gather(
                triangle_of_pixel[down, across], seen_mm[down, across], centres_mm[most], normals[most], most_mm,
                row * triangle.shape[1] + column, places_mm[row, column], texel_of_pixel[down, across],
            )  # fmt: skip
            if members > 0:
                triangle[row, column] = most


@kernel
def _gather(triangle, seen_mm, centre_mm, normal, most_mm, texel, place_mm, texel_of_pixel):  # type: ignore[no-untyped-def]
    """Give a square's pixels to its texel, and find the mean of the places that they see. Return the number of
    these pixels."""
    members = 0
    for y in range(triangle.shape[0]):
        for x in range(triangle.shape[1]):
            above_mm = 0.0
            for k in range(3):
                above_mm += (seen_mm[y, x, k] - centre_mm[k]) * normal[k]
            if triangle[y, x] >= 0 and abs(above_mm) <= most_mm:
                texel_of_pixel[y, x] = texel
                members += 1
                for k in range(3):
                    place_mm[k] += seen_mm[y, x, k]
    for k in range(3):
        place_mm[k] /= max(members, 1)
    return members


@kernel
def _most_frequent(numbers):  # type: ignore[no-untyped-def]
    """Return the most frequent number; the lowest one, if several are equally frequent. `numbers` [n] are sorted
    in place."""
    numbers.sort()
    best, best_count, count = numbers[0], 0, 0
    for place in range(len(numbers)):
        count = count + 1 if place > 0 and numbers[place] == numbers[place - 1] else 1
        if count > best_count:
            best, best_count = numbers[place], count
    return best
