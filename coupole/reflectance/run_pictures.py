"""Pictures of LEDs that were kept for the check, in blocks of 2 x 2 pixels, and the predictions of the fits for
the same blocks."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import h5py
import numpy as np
from numpy.typing import NDArray

from coupole.reflectance.extraction.lamp_sight import lit_on
from coupole.reflectance.run_result import FRAMES, RunResult, ViewSamples
from coupole.reflectance.triangle_fit import TriangleSamples


@dataclass(frozen=True)
class CheckFrames:
    """Pictures of one view for the check."""

    share: NDArray[np.float16]
    """[leds, h / 2, w / 2, channels] shares of the camera's range; NaN where there is none."""
    leds: NDArray[np.int64]
    noise: NDArray[np.float64]
    """[leds] mean absolute error of `share` from noise; NaN if it is not known."""
    triangle: NDArray[np.int32]
    """[channels, h / 2, w / 2] place of the triangle that a pixel sees, among the triangles of the view's file, or
    -1."""

    def pairs(self, rows: slice, channel: int) -> tuple[NDArray[np.int64], NDArray[np.float32]]:
        """Return two arrays for the blocks whose pixel sees a triangle in `rows` of the view's file: the
        triangle's place among these rows [blocks], and `share` [blocks, leds].
        """
        order, places = self._blocks_by_place[channel]
        first, end = np.searchsorted(places, [rows.start, rows.stop])
        leds, height, width, channels = self.share.shape
        flat = self.share.reshape(leds, height * width, channels)
        return places[first:end] - rows.start, flat[:, order[first:end], channel].T.astype(np.float32)

    def picture(self, values: NDArray[np.floating]) -> NDArray[np.float32]:
        """[h / 2, w / 2, channels] picture of values [triangles of the view, channels]; NaN where no triangle is
        seen."""
        of_none = np.append(values, np.full((1, values.shape[1]), np.nan), axis=0).astype(np.float32)
        return np.stack([of_none[places, channel] for channel, places in enumerate(self.triangle)], axis=-1)

    @cached_property
    def _blocks_by_place(self) -> list[tuple[NDArray[np.int64], NDArray[np.int64]]]:
        """Return the blocks of each channel in the order of the triangles that they see, and these triangles."""
        channels = []
        for places in self.triangle.reshape(len(self.triangle), -1):
            order = np.argsort(places, kind="stable")
            channels.append((order, places[order].astype(np.int64)))
        return channels


def read_check_frames(result: RunResult, view: ViewSamples) -> CheckFrames:
    """Read the pictures of a view that extraction kept for the check."""
    with h5py.File(result.folder / FRAMES / view.path.name, "r") as file:
        share, leds, noise, offsets = (file[name][()] for name in ("share", "leds", "noise", "offsets"))
    with h5py.File(view.path, "r") as file:
        triangle_of_pixel = file["seen"][()]
    height, width = share.shape[1:3]
    triangle = np.stack([triangle_of_pixel[row::2, column::2][:height, :width] for row, column in offsets])
    return CheckFrames(share, leds, noise, triangle)


@dataclass(frozen=True)
class HeldOut:
    """Some triangles of a view under the LEDs that were kept for the check: samples, and blocks of pictures."""

    rows: slice
    """Rows of the view's file."""
    places: NDArray[np.int64]
    """[n] places of these triangles among the triangles of the fits."""
    samples: TriangleSamples
    share: NDArray[np.float64]
    """[n, leds, channels] share of the camera's range for f cos_i = 1."""
    columns: list[int]
    """Index of each LED of the pictures among the LEDs of the samples."""
    blocks: tuple[tuple[NDArray[np.int64], NDArray[np.float32]], ...]
    """Triangle [blocks] that each block sees, and measured values [blocks, pictures], by channel."""

    def pixels(self, values: NDArray[np.floating], channel: int) -> NDArray[np.floating]:
        """[blocks, pictures] values of the blocks, from values [n, leds, channels]."""
        block_values: NDArray[np.floating] = values[:, self.columns, channel][self.blocks[channel][0]]
        return block_values


def held_out(
    result: RunResult, view: ViewSamples, settings: dict[str, Any], memory_bytes: int
) -> Iterator[HeldOut]:
    """Yield a view's triangles, block by block. Inter-reflection is subtracted from the pictures, as from the
    samples."""
    is_held_out = np.isin(view.leds, settings["left_out"])
    frames, column = read_check_frames(result, view), {int(led): n for n, led in enumerate(view.leds[is_held_out])}
    columns = [column[int(led)] for led in frames.leds]
    for rows in result.view_blocks(view, memory_bytes):
        some = result.view_samples(view, rows, is_held_out)
        lit = lit_on(some.centres_mm, some.led_mm, view.led_normals[is_held_out], settings["emission"] == "paper")
        direct = result.direct_shares(view, rows, is_held_out)[:, columns]
        blocks = []
        for channel in range(result.channels):
            place, measured_values = frames.pairs(rows, channel)
            blocks.append((place, measured_values * direct[place, :, channel]))
        places = np.searchsorted(result.triangles, view.triangles[rows])
        share = lit[..., None] * view.full_scales[is_held_out]
        yield HeldOut(rows, places, some, share, columns, tuple(blocks))
