"""All corners of all images of a board, as observations."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from coupole.calibration.lens.board import Sighting
from coupole.calibration.rotations import Floats

PIXEL_SIGMA_PX = 0.1
"""Stated noise of a corner, per coordinate; the adjustment estimates the true one."""


@dataclass(frozen=True)
class Corners:
    """All corners of all images, one after the other."""

    board_mm: Floats
    pixels: Floats
    view: np.ndarray[tuple[int], np.dtype[np.intp]]
    """[n] number of the image of each corner."""
    parts: tuple[slice, ...]
    """Slice of each image's corners."""

    @staticmethod
    def of(sightings: Sequence[Sighting]) -> Corners:
        counts = [len(sighting.ids) for sighting in sightings]
        ends = np.cumsum(counts)
        return Corners(
            np.concatenate([sighting.board_mm for sighting in sightings]),
            np.concatenate([sighting.pixels for sighting in sightings]),
            np.repeat(np.arange(len(counts)), counts),
            tuple(slice(int(end - count), int(end)) for count, end in zip(counts, ends, strict=True)),
        )

    def in_camera(self, camera_from_board: Floats) -> Floats:
        """Return [n, 3], mm."""
        pose = camera_from_board[self.view]
        return np.asarray((pose[:, :3, :3] @ self.board_mm[:, :, None])[..., 0] + pose[:, :3, 3])
