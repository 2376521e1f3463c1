"""A white tile in frames: mean signals of its patches, and the calibrations that are needed to read the
patches."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from coupole.calibration import optics
from coupole.calibration.artefact import LightSpectrum, UsedArtefact, used_as
from coupole.calibration.earlier import read_accepted
from coupole.calibration.light.frames import LightFrame, LightFrames, channel_mask, channels_of
from coupole.calibration.light.glare_correction import read_glare
from coupole.calibration.light.lit_cell import LitCell
from coupole.calibration.light.records import dark_signal, linearise, map_beside
from coupole.calibration.light.spectralon import Tile
from coupole.calibration.light.tile_views import Positions, TileView
from coupole.calibration.rotations import Floats
from coupole.errors import InputError
from coupole.plan.led_table import read_led_table

_PATCHES = 4
"""Number of patches along each side of the tile."""
_LEAST_PIXELS = 6


@dataclass(frozen=True, kw_only=True)
class Setting(LitCell):
    """Calibrations and descriptions for reading the tile's frames."""

    tile: Tile
    light: LightSpectrum | None = None
    """Spectrum of the LEDs, if the rig names one. It weights a certificate's wavelengths."""

    @property
    def base_from_tile(self) -> Floats:
        return self.base_from_support @ self.tile.support_from_tile.matrix()

    def tile_of(self, channel: str) -> Tile:
        """Return the tile as a channel sees it."""
        return self.tile.of_channel(channel, self.light)

    def artefacts(self, channels: Sequence[str]) -> tuple[UsedArtefact, ...]:
        """Return the part of a record with the tile's certificate."""
        figures: dict[str, float] = {}
        for channel in channels:
            tile = self.tile_of(channel)
            figures |= {f"reflectance.{channel}": tile.reflectance, f"u_reflectance.{channel}": tile.u_reflectance}
        return used_as("tile", self.tile.artefact, figures)


def calibrated_positions(leds: Path) -> Positions:
    """Return the positions of the LEDs from a record of the kind `leds`. Raises InputError for a record of another
    kind.

    The record's uncertainties are neglected, because 0.05 mm at 1.5 m change an irradiance by only a tenth of the
    scatter of flashes.
    """
    record = read_accepted(leds, "leds")
    table = read_led_table(leds.parent / next(file.name for file in record.files if file.name.endswith(".csv")))
    return Positions(table.ids, table.positions_mm, table.normals)


class TileReader:
    """Reads mean signals of the tile's patches."""

    def __init__(self, frames: LightFrames, setting: Setting, shape: tuple[int, ...]) -> None:
        self.shape = (shape[0], shape[1])
        self._white_dn, self._setting = frames.white_dn, setting
        self._dark = dark_signal(frames, setting.dark)
        channels = channels_of(frames.pattern)
        self._straight: dict[str, Callable[[Floats], Floats]] = {
            channel: linearise(setting.response, channel, frames) for channel in channels
        }
        self._masks = {channel: channel_mask(self.shape, frames.pattern, channel) for channel in channels}
        self._flat = None if setting.flat is None else map_beside(setting.flat, "flat-field", "g", frames)
        self._glare = None if setting.glare is None else read_glare(setting.glare, frames)

    def view(self, view_frames: Sequence[LightFrame], tell: Callable[[], None]) -> dict[str, TileView]:
        """Read the tile in the frames of one view, each under one LED, by channel. `tell` is called after each
        frame.

        Raises InputError if the view does not show the whole tile.
        """
        base_from_camera = view_frames[0].base_from_camera
        points_mm, pixels = self.patches(base_from_camera)
        _refuse_few(min(map(len, pixels)))
        signals = {channel: np.zeros((2, len(view_frames), len(points_mm))) for channel in self._masks}
        is_saturated = np.zeros(len(view_frames), np.bool_)
        for n, frame in enumerate(view_frames):
            for channel, (mean, u, full) in self.means(frame, pixels).items():
                signals[channel][:, n] = mean, u
                is_saturated[n] |= full
            tell()
        leds = np.array([frame.led for frame in view_frames], dtype=np.int64)
        return {
            channel: TileView(
                view_frames[0].view,
                0,
                self._setting.base_from_tile,
                points_mm,
                base_from_camera[:3, 3],
                leds,
                signal,
                u_signal,
                is_saturated,
                np.array([frame.t_s for frame in view_frames]),
            )
            for channel, (signal, u_signal) in signals.items()
        }

    def sees(self, base_from_camera: Floats) -> bool:
        """Tell whether a view shows all of the tile."""
        return min(map(len, self.patches(base_from_camera)[1])) > 0

    def patches(self, base_from_camera: Floats) -> tuple[Floats, list[NDArray[np.intp]]]:
        """Return centres [m, 3] of the patches in the base frame, and the pixels [k, 2] (row, column) that see
        each patch. A patch that is not completely in the picture has no pixels."""
        tile = self._setting.tile
        base_from_tile = self._setting.base_from_tile
        half = tile.side_mm / 2.0 - tile.margin_mm
        edges = np.linspace(-half, half, _PATCHES + 1)
        corners, middles = [], []
        for i in range(_PATCHES):
            for j in range(_PATCHES):
                (left_mm, right_mm), (top_mm, bottom_mm) = edges[i : i + 2], edges[j : j + 2]
                corners += [(left_mm, top_mm), (right_mm, top_mm), (right_mm, bottom_mm), (left_mm, bottom_mm)]
                middles.append((0.5 * (left_mm + right_mm), 0.5 * (top_mm + bottom_mm)))
        camera_from_tile = np.linalg.inv(base_from_camera) @ base_from_tile
        flat = np.column_stack([np.array(corners), np.zeros(len(corners))])
        in_camera_mm = flat @ camera_from_tile[:3, :3].T + camera_from_tile[:3, 3]
        pixels = [np.zeros((0, 2), np.intp)] * len(middles)
        if (in_camera_mm[:, 2] > 0).all():
            polygons = optics.project(in_camera_mm, self._setting.lens.vector()).pixels.reshape(-1, 4, 2)
            pixels = [_inside(polygon, self.shape) for polygon in polygons]
        points = np.column_stack([np.array(middles), np.zeros(len(middles))])
        return points @ base_from_tile[:3, :3].T + base_from_tile[:3, 3], pixels

    def means(
        self, frame: LightFrame, patches: Sequence[NDArray[np.intp]]
    ) -> dict[str, tuple[Floats, Floats, bool]]:
        """Return for each channel the mean signal of each patch over the flat field, DN/s, its uncertainty, and
        whether the patch is saturated."""
        raw = frame.read()
        signal = self._linear_signal(raw, frame)
        means_of = {}
        for channel, mask in self._masks.items():
            means, u_means, full = np.zeros(len(patches)), np.zeros(len(patches)), False
            for p, pixels in enumerate(patches):
                rows, columns = pixels[mask[pixels[:, 0], pixels[:, 1]]].T
                values = signal[rows, columns].astype(np.float64)
                if self._glare is None:
                    values = self._straight[channel](values)
                if self._flat is not None:
                    values = values / self._flat[rows, columns]
                values = values / (frame.exposure_us * 1e-6)
                means[p], u_means[p] = values.mean(), values.std(ddof=1) / np.sqrt(len(values))
                full |= bool((raw[rows, columns] >= self._white_dn).any())
            means_of[channel] = means, u_means, full
        return means_of

    def _linear_signal(self, raw: NDArray[np.uint16], frame: LightFrame) -> NDArray[Any]:
        """Return the signal [h, w] above dark. If there is a record of the glare, the signal is linear and has no
        veil."""
        signal = raw - self._dark(frame)
        if self._glare is None:
            return signal
        linear = signal.astype(np.float64)
        for channel, mask in self._masks.items():
            linear[mask] = self._straight[channel](linear[mask])
        return self._glare.without_veil(linear, self._masks)


def _refuse_few(least: int) -> None:
    if least == 0:
        raise InputError(
            "LED power: a part of the tile lies outside the picture, or behind the camera; correct its place in "
            "its description, or leave out that view"
        )
    if least < 4 * _LEAST_PIXELS:
        raise InputError(
            f"LED power: expected {4 * _LEAST_PIXELS} pixels or more on each part of the tile, found {least}; go "
            "nearer, or take a larger tile"
        )


def _inside(polygon: Floats, shape: tuple[int, int]) -> NDArray[np.intp]:
    """Return [k, 2], row and column of the pixels inside a convex polygon [4, 2]; none if the polygon is partly
    outside the picture."""
    if (polygon < 0).any() or (polygon > np.array(shape[::-1]) - 1).any():
        return np.zeros((0, 2), np.intp)
    low, high = np.floor(polygon.min(axis=0)).astype(int), np.ceil(polygon.max(axis=0)).astype(int)
    columns, rows = np.meshgrid(np.arange(low[0], high[0] + 1), np.arange(low[1], high[1] + 1))
    points = np.stack([columns, rows], axis=-1)
    after = np.roll(polygon, -1, axis=0) - polygon
    away = points[:, :, None] - polygon
    side = after[:, 0] * away[..., 1] - after[:, 1] * away[..., 0]
    inside = (side >= 0).all(axis=-1) | (side <= 0).all(axis=-1)
    return np.stack([rows[inside], columns[inside]], axis=-1)
