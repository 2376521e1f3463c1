"""The veil of glare in frames of one LED, from their own pixels. Each pixel is taken from the longest exposure
that does not clip it. The veil is computed on blocks of pixels, since it is smooth.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from coupole.calibration.light.glare_correction import GlareCorrection
from coupole.calibration.light.veil import light_of_blocks
from coupole.kernels import kernel

Floats = NDArray[np.float64]

GLARE, U_GLARE = "glare", "led_u_glare"
"""Names in a view's file of samples: the subtracted veil divided by the remaining signal, and the veil's relative
uncertainty."""


class Veils(NamedTuple):
    """Veils of up to eight LEDs, for compiled code."""

    rates: NDArray[np.float32]
    """[channels block rows block columns, 8] DN/s; empty without a record of the glare."""
    grid: NDArray[np.int64]
    """[4] side of a block, number of rows and of columns of blocks, width of a frame in pixels."""


NO_VEILS = Veils(np.zeros((0, 8), np.float32), np.ones(4, np.int64))


@dataclass(frozen=True)
class FrameVeils:
    """The data that give the veil of frames of one view."""

    glare: GlareCorrection
    channel: NDArray[np.int8]
    """[h, w] number of a pixel's channel."""
    curve: Floats
    """[channels, 3] coefficients c2 and c3, and range, of the response."""
    top_dn: float
    """Upper end of the camera's range that is used."""
    darks: Mapping[float, NDArray[np.float32]]
    """[channels, block rows, block columns] mean of frames of an exposure (us) without light, DN."""

    @property
    def grid(self) -> NDArray[np.int64]:
        rows, columns = self._shape
        return np.array([self.glare.block_px, rows, columns, self.channel.shape[1]], np.int64)

    @property
    def _shape(self) -> tuple[int, int]:
        height, width = self.channel.shape
        return -(-height // self.glare.block_px), -(-width // self.glare.block_px)

    def of_led(self, frames: Sequence[tuple[float, NDArray[np.uint16]]]) -> tuple[Floats, Floats]:
        """[channels, block rows, block columns] veil, DN/s, in frames of one LED, each with its exposure in us and
        its pixels [h w]; and the veil's relative standard uncertainty [channels]. Clipped pixels have an unknown
        amount of light: their share of the light is added to the uncertainty."""
        longest_first = sorted(frames, key=lambda frame: -frame[0])
        times_s = np.array([1e-6 * exposure_us for exposure_us, _ in longest_first])
        channels, block_px = len(self.glare.channels), self.glare.block_px
        light, clipped_light = np.zeros((channels, *self._shape)), np.zeros(channels)
        _add_light(
            tuple(pixels for _, pixels in longest_first), times_s,
            np.stack([self.darks[exposure_us] for exposure_us, _ in longest_first]),
            self.channel, self.curve, self.top_dn, block_px, light, clipped_light,
        )  # fmt: skip
        per_block = [np.count_nonzero(self.channel[:block_px, :block_px] == c) for c in range(channels)]
        total = np.maximum(light.sum(axis=(1, 2)), 1e-300)
        light /= np.array(per_block)[:, None, None]
        veils, u_veils = zip(*(self.glare.veil(light[c], c) for c in range(channels)), strict=True)
        return np.stack(veils), np.hypot(u_veils, clipped_light / total)


def dark_of_blocks(
    dark: NDArray[np.float32], channel: NDArray[np.int8], glare: GlareCorrection
) -> NDArray[np.float32]:
    """[channels, block rows, block columns] mean of `dark` [h, w] over the pixels of each channel in each
    block."""
    masks = [channel == number for number in range(len(glare.channels))]
    sums = np.stack([light_of_blocks(dark, mask, glare.block_px) for mask in masks])
    counts = np.stack([light_of_blocks(np.ones(dark.shape), mask, glare.block_px) for mask in masks])
    return np.asarray(sums / np.maximum(counts, 1e-9), np.float32)


@kernel
def _add_light(frames, times_s, darks, channel, curve, top_dn, block_px, light, clipped_light):  # type: ignore[no-untyped-def]
    """Add each pixel's linear signal, DN/s, to its block of `light` [channels, block rows, block columns]. Add the
    signal of pixels that all exposures clip to `clipped_light` [channels] too."""
    height, width = channel.shape
    for row in range(height):
        block_row = row // block_px
        for column in range(width):
            c, block_column = channel[row, column], column // block_px
            rate, is_clipped = 0.0, True
            for number in range(len(times_s)):
                dn = frames[number][row * width + column]
                signal = dn - darks[number, c, block_row, block_column]
                over = signal / curve[c, 2]
                rate = signal * (1.0 + over * (curve[c, 0] + over * curve[c, 1])) / times_s[number]
                if dn < top_dn:
                    is_clipped = False
                    break
            light[c, block_row, block_column] += rate
            if is_clipped:
                clipped_light[c] += rate
