"""Values of a view's single pixels under all its LEDs, block by block of triangles.

All values of a block are in memory, because each pixel's fit uses every LED. Frames are read once for each block.
A larger memory needs fewer readings and gives the same result.
"""

from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor
from contextlib import closing
from dataclasses import dataclass

import h5py
import numpy as np
from numpy.typing import NDArray

from coupole.kernels.lanes import LANES
from coupole.reflectance.extraction.extraction import Geometry
from coupole.reflectance.extraction.lamp_sight import Facets
from coupole.reflectance.extraction.measured_run import MeasuredRun, MeasuredView
from coupole.reflectance.extraction.radiance import Radiometry, Response, SignalReader
from coupole.reflectance.extraction.sample_codes import AWAY
from coupole.reflectance.extraction.sample_kernel import NO_VALUE, Lamps, Shots, fill_pixels
from coupole.reflectance.extraction.seen_surface import SeenSurface
from coupole.reflectance.extraction.view_samples import ViewPass
from coupole.reflectance.new_light.pictured_surface import Surface
from coupole.reflectance.parts_in_threads import first_alone
from coupole.reflectance.run_result import INTER_REFLECTION, ViewSamples

_TRIANGLES = 512
"""Number of triangles whose pixels a thread fills at a time."""


@dataclass(frozen=True)
class PixelBlock:
    """Pixels of some triangles of a view, in the order of triangles and channels."""

    pixels: NDArray[np.int32]
    """[n] places in a frame, row by row."""
    triangle: NDArray[np.int64]
    """[n] rows of the pixels' triangles in the view's file of samples."""
    channel: NDArray[np.int64]
    """[n]"""
    places_mm: NDArray[np.float32]
    """[n, 3] places that they see, base frame."""
    values: NDArray[np.float16]
    """[n, leds] f times the cosine of incidence, 1/sr, corrected for the use of their square roots
    (`fill_pixels`); NaN for pixels that are clipped or in shadow."""


@dataclass(frozen=True)
class FittedView:
    """A view of a run whose triangles have fits, for reading its frames again."""

    measured_run: MeasuredRun
    geometry: Geometry
    radiometry: Radiometry
    view: MeasuredView
    surface: Surface
    samples: ViewSamples
    """Its file in the result that has the fits."""

    @property
    def facets(self) -> Facets:
        """The triangles that the view sees."""
        return self.geometry.of(self.samples.triangles)


class PixelReader:
    """A view's pixels, ready for its frames."""

    def __init__(self, fitted_view: FittedView) -> None:
        surface, samples = fitted_view.surface, fitted_view.samples
        self._samples = samples
        self._places_mm = surface.places_mm.reshape(-1, 3)
        self._reader = SignalReader(
            fitted_view.radiometry, SeenSurface(surface.triangle_of_pixel, samples.triangles)
        )
        self._pass = ViewPass(fitted_view.measured_run, fitted_view.view, fitted_view.facets, self._reader)
        self._response = self._reader.response._replace(least_dn=np.float32(-np.inf))
        """Response without a lower limit: if pixels that noise has darkened were left out, the mean would be too
        bright."""

    @property
    def count(self) -> int:
        """Number of the pixels."""
        return len(self._reader.lists.places)

    def blocks(self, memory_bytes: int) -> list[slice]:
        """Return slices of rows of the view's file, with pixels' values that fit into a memory."""
        starts = self._reader.lists.starts[:: self._reader.pixels.shape[1]]
        pixel_bytes = 2 * len(self._samples.leds)
        most = max(int(memory_bytes // pixel_bytes), int(np.diff(starts).max(initial=1)))
        rows, first = [], 0
        while first < len(starts) - 1:
            end = max(int(np.searchsorted(starts, starts[first] + most, side="right")) - 1, first + 1)
            rows.append(slice(first, end))
            first = end
        return rows

    def read_block(self, rows: slice, threads: int) -> PixelBlock:
        """Read all frames, for the pixels of some rows. Raises StorageError for a damaged frame."""
        lists, channels = self._reader.lists, self._reader.pixels.shape[1]
        first, end = (int(lists.starts[row * channels]) for row in (rows.start, rows.stop))
        counts = self._reader.pixels[rows]
        triangle = np.repeat(np.arange(rows.start, rows.stop), counts.sum(axis=1))
        channel = np.repeat(np.tile(np.arange(channels), len(counts)), counts.ravel())
        pixels = lists.places[first:end]
        values = np.full((end - first, len(self._samples.leds)), NO_VALUE, np.uint16)
        places_mm = self._places_mm[pixels]
        batches = self._pass.batches()
        with closing(batches), ThreadPoolExecutor(threads) as pool, h5py.File(self._samples.path, "r") as file:
            for part, batch in zip(self._pass.parts, batches, strict=True):
                light = light_of(file, rows, part, channels)
                lit_pixels = LitPixels(rows, places_mm, light, values[:, part])
                fill_rows(pool, self._reader, self._response, batch, lit_pixels, np.float32(1.0))
        return PixelBlock(pixels, triangle, channel, places_mm, values.view(np.float16))


@dataclass(frozen=True)
class LitPixels:
    """The pixels of some rows under some LEDs."""

    rows: slice
    places_mm: NDArray[np.float32]
    """[pixels, 3] places that the pixels see."""
    light: tuple[NDArray[np.uint8], NDArray[np.float32]]
    """Codes and shares of direct light for the triangles of these rows under the LEDs (`light_of`)."""
    values: NDArray[np.uint16]
    """[pixels, leds] values, which are to be filled."""


def fill_rows(
    pool: ThreadPoolExecutor,
    reader: SignalReader,
    response: Response,
    batch: tuple[Shots, Lamps],
    pixels: LitPixels,
    root_share: np.float32,
) -> None:
    """Fill the values of pixels from the frames of their LEDs. Noise lowers the mean of square roots; the share
    `root_share` of this loss is added; this share is 1 if each pixel is fitted alone."""
    lists, (codes, direct), rows = reader.lists, pixels.light, pixels.rows
    channels = reader.pixels.shape[1]
    first = int(lists.starts[rows.start * channels])

    def fill(some: slice) -> None:
        begin = int(lists.starts[some.start * channels])
        ends = lists.starts[some.start * channels + 1 : some.stop * channels + 1]
        of_rows = slice(some.start - rows.start, some.stop - rows.start)
        of_pixels = slice(begin - first, int(ends[-1]) - first)
        fill_pixels(
            begin, ends.reshape(-1, channels), lists, response, reader.darks, *batch, pixels.places_mm[of_pixels],
            codes[of_rows], direct[of_rows], pixels.values[of_pixels], root_share,
        )  # fmt: skip

    starts = range(rows.start, rows.stop, _TRIANGLES)
    parts = [slice(first_row, min(first_row + _TRIANGLES, rows.stop)) for first_row in starts]
    list(pool.map(first_alone(fill), parts))


def light_of(
    file: h5py.File, rows: slice, part: slice, channels: int
) -> tuple[NDArray[np.uint8], NDArray[np.float32]]:
    """Return the codes [b, 8] of some triangles and LEDs, and the share [b, leds, channels] of direct light."""
    codes = np.full((rows.stop - rows.start, LANES), AWAY, np.uint8)
    codes[:, : part.stop - part.start] = file["codes"][rows, part]
    if INTER_REFLECTION not in file:
        return codes, np.ones((len(codes), part.stop - part.start, channels), np.float32)
    return codes, np.float32(1.0) - file[INTER_REFLECTION][rows, part].astype(np.float32)
