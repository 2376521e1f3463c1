"""Veil of scattered light over a picture, as a sum of parts. A calibration finds the share of each part.

A pixel shows its own light and a veil: sum over k of a_k (K_k * own)(x). K_0 is the same everywhere (the mean of
the picture). The others are normal distributions of decreasing width, `WIDTHS` times the picture's width. Each has
the sum 1 in the plane. Light from beyond the picture's edge is not known, and counts as zero. ISO 9358 measures
the same figure as one number, the veiling glare index. Talvala et al. (SIGGRAPH 2007) and McCann and Rizzi (2007)
show that the part which does not depend on the scene is smooth. So the veil is computed on blocks of pixels, far
larger than any blur.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]

WIDTHS: dict[str, float] = {"even": np.inf, "turned": 0.1, "wide": 0.2, "middle": 0.08, "near": 0.03}
"""Standard deviation of each part, as a share of the picture's width. Infinite means the same everywhere."""
TURNED = "turned"
"""The part of the picture that is turned about its middle: light that goes from the sensor to a face of the lens
and back."""
PARTS = tuple(WIDTHS)
_ACROSS = 96
"""Approximate number of blocks along the picture's width."""
_ROUNDS = 4
"""Number of terms of the series in powers of the shares. The next term is below 1e-7 of white for a veil of 4 %.
"""
_REACH = 4.0
"""Number of standard deviations at which a part is cut off."""


def block_px_of(width_px: int) -> int:
    """Return the side of a block in pixels. It is even because of the Bayer pattern."""
    return max(2, 2 * round(width_px / _ACROSS / 2))


def light_of_blocks(signal: NDArray[np.float32] | Floats, mask: NDArray[np.bool_], block_px: int) -> Floats:
    """Return [block rows, block columns] light of one channel: the sum of `signal` [h, w] over the pixels of
    `mask` [h, w], per pixel of a whole block. Blocks that the picture's edge cuts have less light."""
    height, width = signal.shape
    rows, columns = -(-height // block_px), -(-width // block_px)
    whole = np.zeros((rows * block_px, columns * block_px))
    whole[:height, :width] = np.where(mask, signal, 0.0)
    per_block = max(1, int(np.count_nonzero(mask[:block_px, :block_px])))
    return np.asarray(whole.reshape(rows, block_px, columns, block_px).sum(axis=(1, 3)) / per_block)


def parts_of(light: Floats, width_blocks: float) -> Floats:
    """Return [parts, block rows, block columns], the veil of each part for `light` of blocks and a share of 1.
    `width_blocks` is the picture's width, in blocks."""
    from scipy.ndimage import gaussian_filter

    return np.stack(
        [
            np.full(light.shape, light.mean())
            if np.isinf(width)
            else gaussian_filter(
                light[::-1, ::-1] if name == TURNED else light,
                width * width_blocks,
                mode="constant",
                truncate=_REACH,
            )
            for name, width in WIDTHS.items()
        ]
    )


def veil_of(light: Floats, shares: Floats, width_blocks: float) -> Floats:
    """Return [block rows, block columns], the veil in `light`, which includes it. The veil comes from own light,
    that is, from `light` without the veil. It is solved in rounds, until the neglected rest is below 1e-7 of
    white."""
    veil = np.zeros(light.shape)
    for _ in range(_ROUNDS):
        veil = np.tensordot(shares, parts_of(light - veil, width_blocks), axes=1)
    return veil


def at_pixels(blocks: Floats, rows: NDArray[np.intp], columns: NDArray[np.intp], block_px: int) -> Floats:
    """Return [..., n], values of `blocks` [..., block rows, block columns] at pixels [n], interpolated linearly
    between blocks' middles."""
    row, row_share = _between(rows, block_px, blocks.shape[-2])
    column, column_share = _between(columns, block_px, blocks.shape[-1])
    below, right = np.minimum(row + 1, blocks.shape[-2] - 1), np.minimum(column + 1, blocks.shape[-1] - 1)
    upper = (1.0 - column_share) * blocks[..., row, column] + column_share * blocks[..., row, right]
    lower = (1.0 - column_share) * blocks[..., below, column] + column_share * blocks[..., below, right]
    return np.asarray((1.0 - row_share) * upper + row_share * lower)


def of_white(size_px: tuple[int, int], pixels: Floats) -> Floats:
    """Return [n, parts], the light that each part with a share of 1 adds to a black point at pixels [n, 2] (x, y)
    in a completely white picture. Multiplied by the shares, it gives the veiling glare index there."""
    width, height = size_px
    block_px = block_px_of(width)
    white = light_of_blocks(np.ones((height, width)), np.ones((height, width), np.bool_), block_px)
    columns, rows = np.asarray(pixels, np.intp).T
    return at_pixels(parts_of(white, width / block_px), rows, columns, block_px).T


def _between(pixels: NDArray[np.intp], block_px: int, count: int) -> tuple[NDArray[np.intp], Floats]:
    """Return the block before each pixel, and the interpolation weight of the next block."""
    place = np.clip((pixels + 0.5) / block_px - 0.5, 0.0, count - 1.0)
    first = np.floor(place).astype(np.intp)
    return first, place - first
