"""Pictures of LEDs that were kept for the check, block by block of 2 x 2 pixels, beside what fits make of them."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import h5py
import numpy as np
from numpy.typing import NDArray

from coupole.reflectance.run_result import FRAMES, RunResult, ViewSamples


@dataclass(frozen=True)
class CheckFrames:
    """Of one view."""

    share: NDArray[np.float16]
    """[leds, h / 2, w / 2, channels] of the camera's range; NaN where there is none."""
    leds: NDArray[np.int64]
    noise: NDArray[np.float64]
    """[leds] mean absolute error of `share` by noise; NaN where it is not known."""
    triangle: NDArray[np.int32]
    """[channels, h / 2, w / 2] place of what a pixel sees in the triangles of the view's file, or -1."""

    def pairs(self, rows: slice, channel: int) -> tuple[NDArray[np.int64], NDArray[np.float32]]:
        """Of the blocks whose pixel sees one of some rows of the view's file: its place among them [blocks], and
        `share` [blocks, leds]."""
        order, places = self._sorted[channel]
        first, end = np.searchsorted(places, [rows.start, rows.stop])
        leds, height, width, channels = self.share.shape
        flat = self.share.reshape(leds, height * width, channels)
        return places[first:end] - rows.start, flat[:, order[first:end], channel].T.astype(np.float32)

    def picture(self, values: NDArray[np.floating]) -> NDArray[np.float32]:
        """[h / 2, w / 2, channels] of values [triangles of the view, channels]; NaN where nothing is seen."""
        of_none = np.append(values, np.full((1, values.shape[1]), np.nan), axis=0).astype(np.float32)
        return np.stack([of_none[places, channel] for channel, places in enumerate(self.triangle)], axis=-1)

    @cached_property
    def _sorted(self) -> list[tuple[NDArray[np.int64], NDArray[np.int64]]]:
        """By channel: blocks in the order of what they see, and what they see."""
        found = []
        for places in self.triangle.reshape(len(self.triangle), -1):
            order = np.argsort(places, kind="stable")
            found.append((order, places[order].astype(np.int64)))
        return found


def read_check_frames(result: RunResult, view: ViewSamples) -> CheckFrames:
    """The pictures that extraction kept of a view."""
    with h5py.File(result.folder / FRAMES / view.path.name, "r") as file:
        share, leds, noise, offsets = (file[name][()] for name in ("share", "leds", "noise", "offsets"))
    with h5py.File(view.path, "r") as file:
        seen = file["seen"][()]
    height, width = share.shape[1:3]
    triangle = np.stack([seen[row::2, column::2][:height, :width] for row, column in offsets])
    return CheckFrames(share, leds, noise, triangle)
