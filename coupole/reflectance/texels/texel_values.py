"""Values of a view's texels under all its LEDs: means of their pixels for each channel, computed in bands of rows.

Means are taken from the frames of a few LEDs at a time, so that only the means of the texels stay in memory, not
the values of the pixels. The lists of a band's pixels are filled for eight LEDs at once, as for single pixels
(`pixel_values`).
"""

from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor
from contextlib import closing
from dataclasses import dataclass

import h5py
import numpy as np
from numpy.typing import NDArray

from coupole.kernels import kernel
from coupole.kernels.lanes import LANES
from coupole.reflectance.extraction.radiance import Radiometry, SignalReader
from coupole.reflectance.extraction.sample_codes import REACHED
from coupole.reflectance.extraction.sample_kernel import NO_VALUE
from coupole.reflectance.extraction.seen_surface import SeenSurface
from coupole.reflectance.extraction.view_samples import ViewPass
from coupole.reflectance.parts_in_threads import first_alone
from coupole.reflectance.texels.pixel_values import FittedView, LitPixels, fill_rows, light_of
from coupole.reflectance.texels.texel_grid import TexelGrid, TexelSquares

_TEXELS = 1 << 13
"""Number of texels whose means a thread computes at a time."""
PIXEL_BYTES = 64
"""Memory of a pixel of a band, in bytes, besides the values of its texel: lists, darks, and values of eight
LEDs."""


@dataclass(frozen=True)
class TexelBlock:
    """Texels of some rows of a view's grid."""

    texels: NDArray[np.int64]
    """[n] places in the grid, row by row, in rising order."""
    places_mm: NDArray[np.float32]
    """[n, 3] base frame."""
    values: NDArray[np.float16]
    """[n, channels, leds] mean over a texel's pixels of f times the cosine of incidence, 1/sr. NaN if a pixel is
    clipped, or if more than half of a channel's pixels lie in shadow."""


class TexelReader:
    """A view's texels, ready for its frames."""

    def __init__(self, fitted_view: FittedView, grid: TexelGrid) -> None:
        self._run, self._view, surface = fitted_view.measured_run, fitted_view.view, fitted_view.surface
        self._radiometry = radiometry = fitted_view.radiometry
        self._facets, self._samples = fitted_view.facets, fitted_view.samples
        self._triangle_of_pixel = surface.triangle_of_pixel
        self._seen_mm = surface.places_mm.reshape(-1, 3)
        self._mesh_normals = surface.normals
        self.grid = grid
        self.pixels_of_channels = grid.side_px**2 * channel_shares(radiometry)
        """[channels] number of pixels of a full texel."""

    @property
    def count(self) -> int:
        """Number of the texels."""
        return int(np.count_nonzero(self.grid.triangle >= 0))

    def squares(self) -> TexelSquares:
        """Return the texels with what their pixels' places do to them."""
        shares = self.pixels_of_channels / self.pixels_of_channels.sum()
        return TexelSquares(self.grid, self._bend(), self._channel_offsets(), shares)

    def _bend(self) -> NDArray[np.float32]:
        """[rows, columns] variance, rad^2, of each tilt of a texel whose pixels see triangles that are turned to
        each other: half of the variance of their mean, because under some LEDs not all of the pixels are lit."""
        texel = self.grid.texel_of_pixel.reshape(-1)
        pixels = np.flatnonzero(texel >= 0)
        seen_normals = self._mesh_normals[self._triangle_of_pixel.reshape(-1)[pixels]]
        shape = self.grid.triangle.shape
        counts = np.maximum(np.bincount(texel[pixels], minlength=self.grid.triangle.size), 1)
        sums = [np.bincount(texel[pixels], column, len(counts)) / counts for column in seen_normals.T]
        tilt_variance = 0.5 * np.maximum(1.0 - np.sum(np.square(sums), axis=0), 0.0)
        bend: NDArray[np.float32] = (0.5 * tilt_variance / counts).astype(np.float32).reshape(shape)
        return np.where(self.grid.triangle >= 0, bend, np.float32(0.0))

    def _channel_offsets(self) -> NDArray[np.float32]:
        """[rows, columns, channels, 2] middle of each channel's pixels from the middle of all pixels of a texel,
        to the right and down, in widths of a texel."""
        texel, width = self.grid.texel_of_pixel, self.grid.triangle.size
        row, column = np.nonzero(texel >= 0)
        number, channel = texel[row, column], self._radiometry.channel[row, column]
        middles = [_middles(number, row, column, width)]
        for number_of_channel in range(self._radiometry.channels):
            is_here = channel == number_of_channel
            middles.append(_middles(number[is_here], row[is_here], column[is_here], width))
        offsets = (np.stack(middles[1:], axis=1) - middles[0][:, None]) / self.grid.side_px
        return np.nan_to_num(offsets).astype(np.float32).reshape(*self.grid.triangle.shape, -1, 2)

    def bands(self, memory_bytes: int) -> list[slice]:
        """Return slices of rows of the grid, with texels' values that fit into a memory."""
        counts = np.count_nonzero(self.grid.triangle >= 0, axis=1)
        row_bytes = counts * texel_bytes(self._radiometry.channels, len(self._samples.leds), self.grid.side_px)
        rows, first = [], 0
        while first < len(counts):
            end = first + max(1, int(np.searchsorted(np.cumsum(row_bytes[first:]), memory_bytes, side="right")))
            if counts[first:end].any():
                rows.append(slice(first, end))
            first = end
        return rows

    def read_band(self, rows: slice, threads: int) -> TexelBlock:
        """Read all frames, for the texels of some rows of the grid. Raises StorageError for a damaged frame."""
        band = _Band.of(self.grid, rows, self._triangle_of_pixel)
        reader = SignalReader(self._radiometry, SeenSurface(band.triangle_of_pixel, self._samples.triangles))
        response = reader.response._replace(least_dn=np.float32(-np.inf))
        entries = _Entries.of(reader, self.grid.texel_of_pixel.reshape(-1), band.texels)
        view_pass = ViewPass(self._run, self._view, self._facets, reader)
        channels = self._radiometry.channels
        values = np.full((len(band.texels), channels, len(self._samples.leds)), np.nan, np.float16)
        of_pixels = np.full((len(reader.lists.places), LANES), NO_VALUE, np.uint16)
        seen_mm = self._seen_mm[reader.lists.places]
        root_share = np.float32(np.sum(1.0 / self.pixels_of_channels) / channels**2)
        batches = view_pass.batches()
        with closing(batches), ThreadPoolExecutor(threads) as pool, h5py.File(self._samples.path, "r") as file:
            for part, batch in zip(view_pass.parts, batches, strict=True):
                codes, direct = light_of(file, entries.rows, part, channels)
                of_pixels[:] = NO_VALUE
                of_leds = of_pixels[:, : part.stop - part.start]
                lit_pixels = LitPixels(entries.rows, seen_mm, (codes, direct), of_leds)
                fill_rows(pool, reader, response, batch, lit_pixels, root_share)
                is_reached = codes[:, : part.stop - part.start] == REACHED

                def mean(first: int, part: slice = part, is_reached: NDArray[np.bool_] = is_reached,
                         of_leds: NDArray[np.uint16] = of_leds) -> None:  # fmt: skip
                    some = slice(first, min(first + _TEXELS, len(values)))
                    values[some, :, part] = entries.means(some, of_leds, is_reached, channels)

                list(pool.map(first_alone(mean), range(0, len(values), _TEXELS)))
        return TexelBlock(band.texels, self.grid.places_mm.reshape(-1, 3)[band.texels], values)


def _middles(
    number: NDArray[np.integer], row: NDArray[np.int64], column: NDArray[np.int64], count: int
) -> NDArray[np.float64]:
    """[count, 2] mean column and row of the pixels with each number; NaN for none."""
    counts = np.bincount(number, minlength=count)
    with np.errstate(invalid="ignore"):
        return np.stack([np.bincount(number, place, count) / counts for place in (column, row)], axis=1)


def channel_shares(radiometry: Radiometry) -> NDArray[np.float64]:
    """[channels] each channel's share of the camera's pixels."""
    counts = np.bincount(radiometry.channel.ravel(), minlength=radiometry.channels)
    shares: NDArray[np.float64] = counts / radiometry.channel.size
    return shares


def texel_bytes(channels: int, leds: int, side_px: int) -> int:
    """Return the memory that a texel needs while its band is read."""
    return 2 * channels * leds + PIXEL_BYTES * side_px**2


@dataclass(frozen=True)
class _Band:
    """Some rows of a view's grid."""

    triangle_of_pixel: NDArray[np.int32]
    """[h, w] place of a pixel's texel; -1 for none, and outside of the band."""
    texels: NDArray[np.int64]
    """[n] places in the grid, in rising order."""

    @classmethod
    def of(cls, grid: TexelGrid, rows: slice, triangle_of_pixel: NDArray[np.int32]) -> _Band:
        of_pixels = slice(rows.start * grid.side_px, rows.stop * grid.side_px)
        triangle = np.full_like(triangle_of_pixel, -1)
        triangle[of_pixels] = np.where(grid.texel_of_pixel[of_pixels] >= 0, triangle_of_pixel[of_pixels], -1)
        texels = np.flatnonzero(grid.triangle[rows] >= 0) + rows.start * grid.triangle.shape[1]
        return cls(triangle, texels)


@dataclass(frozen=True)
class _Entries:
    """Pixels of a band, ordered by texel."""

    rows: slice
    """Rows of the view's file that the band's pixels see."""
    order: NDArray[np.int64]
    """[pixels] places in the lists of the reader."""
    starts: NDArray[np.int64]
    """[texels + 1] first place of each texel's pixels in `order`."""
    channel: NDArray[np.int64]
    """[pixels] channels, in the order of the lists."""
    triangle: NDArray[np.int64]
    """[pixels] triangles in the order of the lists, counted from the first of `rows`."""

    @classmethod
    def of(cls, reader: SignalReader, texel_of_pixel: NDArray[np.int32], texels: NDArray[np.int64]) -> _Entries:
        count, channels = reader.pixels.shape
        of_triangles = reader.pixels.sum(axis=1)
        used_rows = np.flatnonzero(of_triangles)
        rows = slice(int(used_rows[0]), int(used_rows[-1]) + 1)
        texel = np.searchsorted(texels, texel_of_pixel[reader.lists.places])
        return cls(
            rows,
            np.argsort(texel, kind="stable"),
            np.concatenate([[0], np.cumsum(np.bincount(texel, minlength=len(texels)))]),
            np.repeat(np.tile(np.arange(channels), count), reader.pixels.ravel()),
            np.repeat(np.arange(count), of_triangles) - rows.start,
        )

    def means(
        self, texels: slice, of_pixels: NDArray[np.uint16], is_reached: NDArray[np.bool_], channels: int
    ) -> NDArray[np.float32]:
        """[n, channels, leds] means of some texels, from bits of float16 [pixels, leds] in the order of the
        lists."""
        starts = self.starts[texels.start : texels.stop + 1]
        some = self.order[starts[0] : starts[-1]]
        means = np.full((len(starts) - 1, channels, of_pixels.shape[1]), np.nan, np.float32)
        values = of_pixels[some].view(np.float16).astype(np.float32)
        _mean(starts - starts[0], self.channel[some], is_reached[self.triangle[some]], values, means)
        return means


@kernel
def _mean(starts, channel, is_reached, values, means):  # type: ignore[no-untyped-def]
    """Fill `means` [texels, channels, leds] from values [pixels, leds]. A mean is over the pixels that light has
    reached, if these are at least half of all; it is NaN if one of them has no value."""
    channels, leds = means.shape[1:]
    sums, counts = np.empty((channels, leds)), np.empty((channels, leds), np.int64)
    members = np.empty(channels, np.int64)
    for texel in range(len(means)):
        sums[:], counts[:], members[:] = 0.0, 0, 0
        for pixel in range(starts[texel], starts[texel + 1]):
            members[channel[pixel]] += 1
            for led in range(leds):
                if is_reached[pixel, led]:
                    sums[channel[pixel], led] += values[pixel, led]
                    counts[channel[pixel], led] += 1
        for number in range(channels):
            for led in range(leds):
                if counts[number, led] > 0 and 2 * counts[number, led] >= members[number]:
                    means[texel, number, led] = sums[number, led] / counts[number, led]
