"""An image for calibrations: RAW, grey or in three colours. It is used one colour at a time."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from coupole.errors import InputError

Channel = Literal["green", "red", "blue"]
CHANNELS: tuple[Channel, ...] = ("green", "red", "blue")
"""Green comes first, because the other colours are compared with it."""
MONO, COLOUR = "MONO", "COLOUR"
_RESIZED = (np.uint8, np.uint16, np.float32, np.float64)
"""Types for which OpenCV can compute means."""


@dataclass(frozen=True)
class Picture:
    """The values of one camera image, without its black level."""

    values: NDArray[Any]
    """[H, W]; of pattern `COLOUR` [H, W, 3]: red, green, blue."""
    pattern: str
    """Names of the four pixels at the top left of a RAW frame, row by row; or `MONO`, or `COLOUR`."""
    white: float
    """Value of saturation."""
    name: str = "picture"

    @staticmethod
    def of_grey(values: NDArray[Any], *, white: float | None = None, name: str = "picture") -> Picture:
        """Make a picture from a grey image [H, W]. Without `white`, saturation is the largest number of the
        image's type."""
        if white is None:
            white = float(np.iinfo(values.dtype).max) if np.issubdtype(values.dtype, np.integer) else float("inf")
        return Picture(values, MONO, white, name)

    @property
    def size_px(self) -> tuple[int, int]:
        """Width and height."""
        return self.values.shape[1], self.values.shape[0]

    def plane(self, channel: Channel = "green") -> NDArray[Any]:
        """Return one colour at full size [H, W]; grey counts as green. Raises InputError if another colour of a
        grey image is requested."""
        if self.pattern == COLOUR:
            return np.asarray(self.values[..., ("red", "green", "blue").index(channel)])
        if self.pattern == MONO:
            self._refuse_grey(channel)
            return self.values
        return plane(self.values, self.pattern, channel)

    def values_and_mask(self, channel: Channel = "green") -> tuple[NDArray[Any], NDArray[np.bool_]]:
        """Return the values [H, W], with the pixels of one colour not interpolated. The mask of these pixels is a
        tile [h, w] that repeats over the image."""
        if self.pattern in (COLOUR, MONO):
            return self.plane(channel), np.ones((1, 1), np.bool_)
        mask = np.array([letter == channel[0].upper() for letter in self.pattern]).reshape(2, 2)
        return self.values, mask

    def reduced(self, factor: int) -> NDArray[Any]:
        """Return green (or grey) at a fraction of the size [H // factor, W // factor], as means over squares of
        pixels. In a RAW image only the green pixels count. The middle of pixel (x, y) of the result is at factor
        (x, y) + (factor - 1) / 2 of the image."""
        import cv2

        if factor == 1:
            return self.plane()
        height, width = (side // factor * factor for side in self.values.shape[:2])
        values = self.values[:height, :width]
        if self.pattern == COLOUR:
            values = cv2.extractChannel(np.ascontiguousarray(values), 1)
        elif self.pattern != MONO:
            values = _mean_of_greens(values, self.pattern)
        size_px = (width // factor, height // factor)
        if values.dtype not in _RESIZED:
            values = values.astype(np.float32)
        if values.shape[::-1] == size_px:
            return values
        return np.asarray(cv2.resize(values, size_px, interpolation=cv2.INTER_AREA))

    def white_share(self, rows: slice, columns: slice) -> float:
        """Return the share of saturated pixels in a part of the image, among its green (or grey) pixels."""
        values, mask = self.values_and_mask()
        tile_rows, tile_columns = mask.shape
        first_row, first_column = max(rows.start, 0), max(columns.start, 0)
        first_row, first_column = first_row - first_row % tile_rows, first_column - first_column % tile_columns
        part = values[first_row : rows.stop, first_column : columns.stop]
        white_count = pixel_count = 0
        for row, column in np.argwhere(mask):
            is_white = part[row::tile_rows, column::tile_columns] >= self.white
            white_count += int(np.count_nonzero(is_white))
            pixel_count += is_white.size
        return white_count / max(pixel_count, 1)

    def _refuse_grey(self, channel: Channel) -> None:
        if channel != "green":
            raise InputError(
                f"{self.name}: the image is grey, and has no {channel} channel. Give colour pictures, or runs of "
                "a colour camera"
            )


def plane(frame: NDArray[Any], pattern: str, channel: Channel = "green") -> NDArray[np.float32]:
    """Return one channel of a RAW frame [H, W] at full size [H, W], DN. Edges in the result have the places of
    edges in the frame.

    `pattern` has the names of the four pixels at the frame's top left, row by row; `MONO` has one channel. The
    value is a mean over the channel's pixels with the weights 1 2 1 in both directions. The weights of green
    pixels always sum to 8, those of red and blue to 4. They are symmetric about each pixel, so the image is not
    shifted.
    """
    import cv2

    if pattern == MONO:
        return frame.astype(np.float32)
    sparse = np.zeros(frame.shape, np.float32)
    for place, letter in enumerate(pattern):
        if letter == channel[0].upper():
            sparse[place // 2 :: 2, place % 2 :: 2] = frame[place // 2 :: 2, place % 2 :: 2]
    weights = np.array([1.0, 2.0, 1.0]) / np.sqrt(8.0 if channel == "green" else 4.0)
    # The border is mirrored about its pixels, which keeps the colour pattern.
    return np.asarray(cv2.sepFilter2D(sparse, -1, weights, weights, borderType=cv2.BORDER_REFLECT_101))


def _mean_of_greens(frame: NDArray[Any], pattern: str) -> NDArray[Any]:
    """Return [H / 2, W / 2], the mean of the two green pixels in each square of four of a RAW frame."""
    import cv2

    height, width = frame.shape
    # The columns of a row in pairs, as two channels: OpenCV takes one of them without a copy of both.
    rows = [np.ascontiguousarray(frame[first::2]).reshape(height // 2, width // 2, 2) for first in range(2)]
    upper, lower = (cv2.extractChannel(rows[place // 2], place % 2) for place in range(4) if pattern[place] == "G")
    return np.asarray(cv2.addWeighted(upper, 0.5, lower, 0.5, 0.0))
