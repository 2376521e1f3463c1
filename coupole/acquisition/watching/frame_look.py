"""Reduces a frame to a grid of means, fast enough for the thread that stores it."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from coupole.devices import FrameFormat
from coupole.kernels import kernel

_COLUMNS = 128
"""Greatest number of bins across a frame. A bin of the full-size camera is 32 pixels wide, so a displacement of
0.2 mm is an eighth of a bin."""
_ROWS_READ = 4
"""Greatest number of rows that are read of each bin, in pairs spread over it. The speed of the memory is the
limit."""


@dataclass(frozen=True)
class FrameLook:
    """The part of a frame that is kept."""

    mean_dn: NDArray[np.float32]
    """[rows, columns] mean of a bin's pixels above black, all colours together."""
    is_clipped: NDArray[np.bool_]
    """[rows, columns] True where a pixel of the bin is at the top of its range."""


@dataclass(frozen=True)
class LookGrid:
    """Bins of frames of one format: whole Bayer cells, at most 128 across."""

    frame_format: FrameFormat
    is_sparse: bool = False
    """True if only one pair of rows of each bin is read. This is enough for dark frames, and takes half of the
    time."""

    @property
    def bin_px(self) -> int:
        """Side of a bin."""
        return max(2, 2 * math.ceil(self.frame_format.width_px / _COLUMNS / 2))

    @property
    def _pair_step(self) -> int:
        """Step in pairs of rows: one pair in this number of pairs is read."""
        return max(1, self.bin_px // (2 if self.is_sparse else _ROWS_READ))

    @property
    def rows_in_bin(self) -> int:
        """Rows of a bin that are read."""
        return 2 * len(range(0, self.bin_px // 2, self._pair_step))

    @property
    def pixels_in_bin(self) -> int:
        return self.rows_in_bin * self.bin_px

    def look(self, pixels: NDArray[np.uint16]) -> FrameLook:
        """The look of a frame [H, W]. Bins that are not whole are left out."""
        rows, columns = (side // self.bin_px for side in pixels.shape)
        mean_dn = np.empty((rows, columns), np.float32)
        is_clipped = np.empty((rows, columns), np.bool_)
        frame_format = self.frame_format
        white_dn = np.uint16(frame_format.white_dn)
        _bin_means(pixels, mean_dn, is_clipped, self.bin_px, self._pair_step, white_dn, frame_format.black_dn)
        return FrameLook(mean_dn, is_clipped)


def compile_now() -> None:
    """Compile before the first frame is due, for writable buffers and for read-only ones."""
    pixels = np.zeros((2, 2), np.uint16)
    grid = LookGrid(FrameFormat(2, 2, 12, "MONO", 0, 4095))
    grid.look(pixels)
    pixels.flags.writeable = False
    grid.look(pixels)


@kernel
def _bin_means(pixels, mean_dn, is_clipped, bin_px, pair_step, white_dn, black_dn):  # type: ignore[no-untyped-def]
    """Add up whole rows before bins, so that the loop over pixels can be vectorised."""
    rows, columns = mean_dn.shape
    width = columns * bin_px
    sums = np.empty(width, np.uint32)
    tops = np.empty(width, np.uint16)
    for row in range(rows):
        sums[:] = 0
        tops[:] = 0
        pixel_count = 0
        for pair in range(0, bin_px // 2, pair_step):
            for line in range(2):
                values = pixels[row * bin_px + 2 * pair + line]
                pixel_count += bin_px
                for k in range(width):
                    sums[k] += np.uint32(values[k])
                    tops[k] = values[k] if values[k] > tops[k] else tops[k]
        for column in range(columns):
            total = 0.0
            has_top = False
            for k in range(column * bin_px, (column + 1) * bin_px):
                total += sums[k]
                has_top |= tops[k] >= white_dn
            mean_dn[row, column] = total / pixel_count - black_dn
            is_clipped[row, column] = has_top
