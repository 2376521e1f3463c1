"""A large picture as square tiles in levels, each half as wide as the one before; a page loads only the visible
tiles.

Level 0 is the whole picture; row 0 of a tile is its uppermost.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

TILE_PX = 256


@dataclass(frozen=True)
class Tile:
    """A square of a level; values outside the picture are NaN."""

    level: int
    column: int
    row: int
    values: NDArray[np.float32]
    """[n, TILE_PX, TILE_PX]"""

    def name(self, of: str) -> str:
        """Return the name of the tile's block."""
        return f"{of}-{self.level}-{self.column}-{self.row}"


def levels_of(width: int, height: int) -> list[list[int]]:
    """Return width and height, px, of each level; the last level fits into one tile."""
    sizes = [[width, height]]
    while max(sizes[-1]) > TILE_PX:
        sizes.append([-(-side // 2) for side in sizes[-1]])
    return sizes


def tiles_of(values: NDArray[np.float32]) -> Iterator[Tile]:
    """Yield the tiles of a picture's values [n, h, w], NaN where there is none."""
    height, width = values.shape[1:]
    for level, _ in enumerate(levels_of(width, height)):
        if level:
            values = halve_pictures(values)
        for row in range(-(-values.shape[1] // TILE_PX)):
            for column in range(-(-values.shape[2] // TILE_PX)):
                rows, columns = (slice(k * TILE_PX, (k + 1) * TILE_PX) for k in (row, column))
                part = np.full((len(values), TILE_PX, TILE_PX), np.nan, np.float32)
                inside = values[:, rows, columns]
                part[:, : inside.shape[1], : inside.shape[2]] = inside
                yield Tile(level, column, row, part)


def halve_pictures(values: NDArray[np.float32]) -> NDArray[np.float32]:
    """[n, ceil(h / 2), ceil(w / 2)] means over the pixels of each 2 x 2 that have a value."""
    count, height, width = values.shape
    means = np.empty((count, -(-height // 2), -(-width // 2)), np.float32)
    for whole, half in zip(values, means, strict=True):
        even = np.pad(whole, ((0, height % 2), (0, width % 2)), constant_values=np.nan)
        four = np.stack([even[row::2, column::2] for row in (0, 1) for column in (0, 1)])
        is_finite = np.isfinite(four)
        counts = is_finite.sum(axis=0)
        half[:] = np.where(counts, np.where(is_finite, four, 0.0).sum(axis=0) / np.maximum(counts, 1), np.nan)
    return means
