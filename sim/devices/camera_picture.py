"""Effects of a camera's own settings on the outgoing picture: region, binning, mirroring, look-up table, ..."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray


@dataclass(frozen=True)
class PictureSettings:
    """Settings of a camera with a Bayer pattern GBRG; the defaults change only the region."""

    left_px: int
    top_px: int
    width_px: int
    height_px: int
    """Height of the region, counted in pixels of the binned, decimated image."""
    binning: tuple[int, int] = (1, 1)
    decimation: tuple[int, int] = (1, 1)
    """Across and down."""
    mirror_axes: tuple[bool, bool] = (False, False)
    """Left to right, and top to bottom."""
    gamma: float = 1.0
    inverts: bool = False
    """True if the look-up table is in use. The table of this camera inverts the image."""
    balance: tuple[float, float] = (1.0, 1.0)
    """Factors on red and blue pixels."""
    test_pattern: bool = False
    """A horizontal ramp replaces the sensor's image."""


def read_out(frame: NDArray[np.uint16], settings: PictureSettings, white_dn: int) -> NDArray[np.uint16]:
    """Return the image that leaves the camera, [height_px, width_px], for the sensor's image [h, w]."""
    image = frame
    if settings.test_pattern:
        image = np.broadcast_to(np.arange(frame.shape[1], dtype=np.uint16), frame.shape)
    (across, down), (every_column, every_row) = settings.binning, settings.decimation
    if across * down > 1:
        rows, columns = image.shape[0] // down, image.shape[1] // across
        cells = image[: rows * down, : columns * across].reshape(rows, down, columns, across)
        image = cells.mean(axis=(1, 3)).astype(np.uint16)
    image = image[::every_row, ::every_column]
    left_px, top = settings.left_px, settings.top_px
    image = image[top : top + settings.height_px, left_px : left_px + settings.width_px]
    if settings.mirror_axes[0]:
        image = image[:, ::-1]
    if settings.mirror_axes[1]:
        image = image[::-1]
    if settings.balance != (1.0, 1.0):
        image = image.copy()
        for place, factor in (((1, 0), settings.balance[0]), ((0, 1), settings.balance[1])):
            pixels = image[place[0] :: 2, place[1] :: 2]
            pixels[:] = np.minimum(pixels * factor, white_dn)
    if settings.gamma != 1.0:
        image = (white_dn * (image / white_dn) ** settings.gamma).astype(np.uint16)
    return white_dn - image if settings.inverts else image
