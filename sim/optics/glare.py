"""Veiling glare of lens and camera: light of the whole picture that is scattered over each pixel.

It has three parts. Haze is the same everywhere (light that lens barrel and sensor's window reflect back and
forth). A lobe about each point falls by a power of the distance (scratches, dust and coatings of the glass). A
ghost is the picture turned about its middle, and unsharp (light that goes from the sensor to a face of the lens
and back). Light from beyond the picture's edge causes no glare. The calibration that looks for glare shares
nothing of this.
"""

from __future__ import annotations

from functools import lru_cache
from typing import Annotated

import numpy as np
from numpy.typing import NDArray
from pydantic import BaseModel, ConfigDict, Field, model_validator

Electrons = NDArray[np.float32]
Floats = NDArray[np.float64]
Share = Annotated[float, Field(ge=0, le=0.2)]
Part = Annotated[float, Field(ge=0, le=1)]

_ACROSS = 128
"""Least number of cells along the picture's longer side on which scattered light is computed."""


class Glare(BaseModel):
    """Glare of the camera."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    share: tuple[Share, Share, Share] = (0.01, 0.01, 0.01)
    """Light of a black point in the middle of a completely white picture, over the white: red, green, blue."""
    haze: Part = 0.4
    """Share of the glare that is the same everywhere."""
    ghost: Part = 0.05
    """Share of the glare that is a turned picture. The rest is the lobe."""
    core: Annotated[float, Field(gt=0, le=1)] = 0.05
    """Radius of the lobe's middle, as a share of the picture's width."""
    falls_by: Annotated[float, Field(ge=2, le=5)] = 3.0
    """Exponent of the distance with which the lobe falls."""
    ghost_blur: Annotated[float, Field(gt=0, le=0.5)] = 0.12
    """Standard deviation of the ghost's blur, as a share of the picture's width."""

    @model_validator(mode="after")
    def _whole(self) -> Glare:
        if self.haze + self.ghost > 1.0:
            raise ValueError("`haze` and `ghost` are shares of one glare: expected no more than 1 together")
        return self

    def over(self, mean_e: Electrons, channels: NDArray[np.int64]) -> Electrons:
        """Return [h, w] electrons with the glare added. `channels` [2, 2] are those of `SensorModel.channels`."""
        out = mean_e.copy()
        for channel in np.unique(channels):
            veil = self.share[channel] * self.scattered_light(mean_e, channels == channel)
            for row, column in np.argwhere(channels == channel):
                out[row::2, column::2] += veil[row::2, column::2]
        return out

    def of_white(self, size_px: tuple[int, int], channel: int = 1) -> Floats:
        """Return [h, w], the glare of a black point at each pixel in a completely white picture, as a share of
        white."""
        white = np.ones((size_px[1], size_px[0]), np.float32)
        return np.asarray(self.share[channel] * self.scattered_light(white, np.ones((2, 2), np.bool_)), np.float64)

    def scattered_light(self, mean_e: Electrons, cell_mask: NDArray[np.bool_]) -> Electrons:
        """Return [h, w], scattered light of the pixels at some places of the Bayer cell, for a share of 1."""
        import cv2

        height, width = mean_e.shape
        side = max(2, 2 * (max(height, width) // (2 * _ACROSS)))
        rows, columns = -(-height // side), -(-width // side)
        sparse = np.zeros((rows * side, columns * side), np.float32)
        for row, column in np.argwhere(cell_mask):
            sparse[row:height:2, column:width:2] = mean_e[row::2, column::2]
        cells = sparse.reshape(rows, side, columns, side).sum(axis=(1, 3), dtype=np.float64)
        cells /= side**2 * cell_mask.mean()
        veil = self._of_cells(cells, width / side)
        large = cv2.resize(veil, (columns * side, rows * side), interpolation=cv2.INTER_CUBIC)
        return np.asarray(large[:height, :width], np.float32)

    def _of_cells(self, cells: Floats, width: float) -> Floats:
        """Scattered light of cells [rows, columns]; `width` is the picture's width, in cells."""
        lobe, blur = _spectra(cells.shape, self.core * width, self.falls_by, self.ghost_blur * width)
        veil = self.haze * np.full(cells.shape, cells.mean())
        veil += (1.0 - self.haze - self.ghost) * _convolve(cells, lobe)
        return veil + self.ghost * _convolve(cells[::-1, ::-1], blur)


@lru_cache(maxsize=4)
def _spectra(
    shape: tuple[int, int], core: float, falls_by: float, blur: float
) -> tuple[NDArray[np.complex128], NDArray[np.complex128]]:
    """Lobe and ghost's blur, both 1 in the middle of a wholly white picture, in the frequency domain of twice the
    picture's size."""
    away2 = _square_distances(shape)
    kernels = (1.0 + away2 / core**2) ** (-falls_by / 2.0), np.exp(-0.5 * away2 / blur**2)
    return (
        np.fft.rfft2(kernels[0] / _at_the_middle(kernels[0], shape)),
        np.fft.rfft2(kernels[1] / _at_the_middle(kernels[1], shape)),
    )


def _square_distances(shape: tuple[int, int]) -> Floats:
    """[2 rows, 2 columns] squared distances from the first cell, around the edges."""
    rows, columns = (np.minimum(np.arange(2 * size), 2 * size - np.arange(2 * size)) for size in shape)
    return np.asarray(rows[:, None].astype(float) ** 2 + columns[None].astype(float) ** 2)


def _at_the_middle(kernel: Floats, shape: tuple[int, int]) -> float:
    """Return the sum of a kernel over the cells of a picture, as seen from its middle."""
    white = np.ones(shape)
    return float(_convolve(white, np.fft.rfft2(kernel))[shape[0] // 2, shape[1] // 2])


def _convolve(cells: Floats, spectrum: NDArray[np.complex128]) -> Floats:
    shape = (2 * cells.shape[0], 2 * cells.shape[1])
    whole = np.fft.irfft2(np.fft.rfft2(cells, shape) * spectrum, shape)
    return np.asarray(whole[: cells.shape[0], : cells.shape[1]])
