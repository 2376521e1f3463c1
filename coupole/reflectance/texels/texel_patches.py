"""Patches of a view: the values, under all LEDs, of texels that are spread over the view, so that they can be
fitted again with fewer values."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from coupole.reflectance.texels.grid_fit import texels_of_grid
from coupole.reflectance.texels.pixel_file import ViewTexels
from coupole.reflectance.texels.pixel_values import FittedView, PixelBlock, PixelReader
from coupole.reflectance.texels.texel_grid import TexelSquares, texel_grid
from coupole.reflectance.texels.texel_values import TexelBlock, TexelReader
from coupole.reflectance.texels.view_centres import FitStart
from coupole.reflectance.texels.view_texels import texels_of_view
from coupole.reflectance.triangle_fit import TriangleMaterials

_SIDE = 64
"""Number of texels across a patch."""
_MARGIN = 8
"""Number of texels at the edges of a patch that are fitted, but not compared: half of their neighbours are
missing."""
_FULL = 0.5
"""Least number of seen pixels of a patch, as a share of those of the fullest patch."""
Part = tuple[slice, slice]


@dataclass(frozen=True)
class Patch:
    """Texels of a part of a view, in rising order of their places in it."""

    triangle: NDArray[np.int32]
    """[h, w] for each texel the row, in the view's file, of the triangle that it sees; -1 for none."""
    places: NDArray[np.int64]
    """[n] places in `triangle`, row by row."""
    places_mm: NDArray[np.float32]
    """[n, 3] places that they see, base frame."""
    values: NDArray[np.float16]
    """[n, channels, leds] f times the cosine of incidence, 1/sr; NaN where there is none. A single pixel has
    values of one channel."""
    channel: NDArray[np.int64]
    """[n] of single pixels; empty for squares."""
    squares: TexelSquares | None
    """None for single pixels."""

    @property
    def is_inner(self) -> NDArray[np.bool_]:
        """[n] True for texels that have all their neighbours."""
        height, width = self.triangle.shape
        row, column = np.divmod(self.places, width)
        is_inner: NDArray[np.bool_] = (
            (np.minimum(row, column) >= _MARGIN) & (row < height - _MARGIN) & (column < width - _MARGIN)
        )
        return is_inner

    def fit(self, start: FitStart, is_used: NDArray[np.bool_], threads: int) -> TriangleMaterials:
        """Fit the texels to their values where `is_used` [n, leds]. Return the materials of all n texels, NaN
        without a fit."""
        values = np.where(is_used[:, None], self.values, np.float16(np.nan))
        if self.squares is None:
            own_values = values[np.arange(len(values)), self.channel]
            triangle = self.triangle.reshape(-1)[self.places].astype(np.int64)
            pixels = self.places.astype(np.int32)
            block = PixelBlock(pixels, triangle, self.channel, self.places_mm, own_values)
            texels = texels_of_view(start, [block], threads)
            fitted_places = texels.pixels
        else:
            block_of_squares = TexelBlock(self.places, self.places_mm, values)
            texels = texels_of_grid(start, self.squares, [block_of_squares], threads)
            fitted_places = self.squares.grid.texel_of_pixel.reshape(-1)[texels.pixels]
        return _of_all(texels, np.searchsorted(self.places, fitted_places), len(self.places))


def read_patches(fitted_view: FittedView, side_px: int, count: int, threads: int) -> list[Patch]:
    """Read the frames of a view for about `count` of its patches. Raises StorageError for a damaged frame."""
    surface = fitted_view.surface
    parts = _spread_parts(surface.triangle_of_pixel >= 0, _SIDE * side_px, count)
    triangle = np.full_like(surface.triangle_of_pixel, -1)
    for part in parts:
        triangle[part] = surface.triangle_of_pixel[part]
    view_of_parts = replace(fitted_view, surface=replace(surface, triangle_of_pixel=triangle))
    if side_px == 1:
        return list(_of_pixels(view_of_parts, parts, threads))
    return list(_of_squares(view_of_parts, side_px, parts, threads))


def _spread_parts(is_seen: NDArray[np.bool_], side_px: int, count: int) -> list[Part]:
    """Return parts of a picture in which much of the object is seen."""
    height, width = is_seen.shape
    parts = [
        (slice(row, min(row + side_px, height)), slice(column, min(column + side_px, width)))
        for row in range(0, height, side_px)
        for column in range(0, width, side_px)
    ]
    seen_counts = np.array([np.count_nonzero(is_seen[part]) for part in parts])
    full_parts = np.flatnonzero(seen_counts >= max(1.0, _FULL * seen_counts.max()))
    numbers = np.unique(np.linspace(0, len(full_parts) - 1, count).astype(int))
    return [parts[number] for number in full_parts[numbers]]


def _of_pixels(fitted_view: FittedView, parts: list[Part], threads: int) -> Iterator[Patch]:
    triangle = fitted_view.surface.triangle_of_pixel
    block = PixelReader(fitted_view).read_block(slice(0, len(fitted_view.samples.triangles)), threads)
    row, column = np.divmod(block.pixels.astype(np.int64), triangle.shape[1])
    for part in parts:
        some, places = _inside(part, row, column)
        channel, own_values = block.channel[some], block.values[some]
        values = np.full((len(some), fitted_view.radiometry.channels, own_values.shape[1]), np.nan, np.float16)
        values[np.arange(len(some)), channel] = own_values
        yield Patch(triangle[part], places, block.places_mm[some], values, channel, None)


def _of_squares(fitted_view: FittedView, side_px: int, parts: list[Part], threads: int) -> Iterator[Patch]:
    reader = TexelReader(fitted_view, texel_grid(fitted_view.surface, side_px))
    squares, shape = reader.squares(), reader.grid.triangle.shape
    block = reader.read_band(slice(0, shape[0]), threads)
    row, column = np.divmod(block.texels, shape[1])
    for pixels in parts:
        rows, columns = (slice(of.start // side_px, -(-of.stop // side_px)) for of in pixels)
        some, places = _inside((rows, columns), row, column)
        patch_squares = squares.part(rows, columns)
        no_channel = np.empty(0, np.int64)
        yield Patch(
            patch_squares.grid.triangle,
            places,
            block.places_mm[some],
            block.values[some],
            no_channel,
            patch_squares,
        )


def _inside(
    part: Part, row: NDArray[np.int64], column: NDArray[np.int64]
) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Return which texels, by their rows and columns [n], lie in a part of a picture, and their places in this
    part, in rising order."""
    rows, columns = part
    is_inside = (row >= rows.start) & (row < rows.stop) & (column >= columns.start) & (column < columns.stop)
    some = np.flatnonzero(is_inside)
    places = (row[some] - rows.start) * (columns.stop - columns.start) + column[some] - columns.start
    order = np.argsort(places)
    return some[order], places[order]


def _of_all(texels: ViewTexels, fitted_rows: NDArray[np.int64], count: int) -> TriangleMaterials:
    """Return materials of `count` texels, of which `fitted_rows` were fitted."""
    rows = [texels.normals, texels.kd, texels.ks, texels.alpha]
    whole = [np.full((count, *values.shape[1:]), np.nan) for values in rows]
    for values, of_fitted in zip(whole, rows, strict=True):
        values[fitted_rows] = of_fitted
    normals, kd, ks, alpha = whole
    return TriangleMaterials(normals, kd, ks, alpha, np.zeros(count))
