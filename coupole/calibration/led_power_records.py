"""From frames of a white tile to the record of the LEDs' power."""

from __future__ import annotations

import io
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from coupole.calibration import light_pictures as pictures
from coupole.calibration import optics
from coupole.calibration.irradiance import Emission
from coupole.calibration.led_power import LedPower, Positions, TileView, calibrate_led_power
from coupole.calibration.light_frames import LightFrame, LightFrames, channel_mask, channels_of
from coupole.calibration.light_records import (
    Progress,
    dark_signal,
    linearise,
    map_beside,
    record_input,
    sealed_outcome,
)
from coupole.calibration.record import Limit, Parameter
from coupole.calibration.report import Outcome
from coupole.calibration.rotations import Floats
from coupole.calibration.spectralon import Tile
from coupole.calibration.workflow import Wish
from coupole.errors import InputError

_PATCHES = 4
"""Along each side of the tile."""
_LEAST_PIXELS = 6
_MOST_U = 0.02
_MOST_UNUSABLE = 0.02


@dataclass(frozen=True)
class Setting:
    """What the tile's pictures are read with."""

    tile: Tile
    base_from_support: Floats
    positions: Positions
    lens: optics.Intrinsics
    dark: Path | None = None
    response: Path | None = None
    flat: Path | None = None
    emission: Emission = "lambertian"

    @property
    def base_from_tile(self) -> Floats:
        return self.base_from_support @ self.tile.support_from_tile.matrix()


def led_power_outcome(frames: LightFrames, setting: Setting, wish: Wish, progress: Progress) -> Outcome:
    """Power of each LED per channel, from the tile's views. Raises InputError as `calibrate_led_power` does."""
    lit = [frame for frame in frames.lit if frame.light.startswith("led")]
    if not lit:
        raise InputError("LED power: no frame under an LED; acquire `coupole plan new spectralon`")
    channels = channels_of(frames.pattern)
    by_view: dict[tuple[str, float], list[LightFrame]] = {}
    for frame in lit:
        by_view.setdefault((frame.view, frame.exposure_us), []).append(frame)
    read = _Reader(frames, setting, lit[0].read().shape)
    views: dict[str, list[TileView]] = {channel: [] for channel in channels}
    done = 0
    for found in by_view.values():
        patches = read.patches(found[0].base_from_camera)
        seen = {channel: np.zeros((2, len(found), len(patches[0]))) for channel in channels}
        saturated = np.zeros(len(found), np.bool_)
        for n, frame in enumerate(found):
            for channel, (mean, u, full) in read.means(frame, patches[1]).items():
                seen[channel][:, n] = mean, u
                saturated[n] |= full
            done += 1
            progress(done, len(lit))
        leds = np.array([int(frame.light[3:]) for frame in found])
        for channel in channels:
            views[channel].append(
                TileView(
                    found[0].view,
                    0,
                    setting.base_from_tile,
                    patches[0],
                    found[0].base_from_camera[:3, 3],
                    leds,
                    seen[channel][0],
                    seen[channel][1],
                    saturated,
                )
            )
    powers = {
        channel: calibrate_led_power(views[channel], setting.positions, setting.tile, emission=setting.emission)
        for channel in channels
    }
    parameters = _parameters(powers)
    height, width = read.shape
    green = powers["G"]
    good = np.isfinite(green.power) & (green.power > 0)
    worst = float(np.median(green.u_against_mean()[good]))
    unusable = float(np.mean(~np.isfinite(green.power)))
    remarks = list(dict.fromkeys(remark for power in powers.values() for remark in power.remarks))
    inputs = [pair for path in (setting.dark, setting.response, setting.flat) for pair in record_input(path)]
    return sealed_outcome(
        "led-power",
        wish,
        frames,
        (width, height),
        parameters,
        _covariance(powers),
        partial(pictures.draw_led_power, powers, setting.positions),
        limits=(
            Limit(what="median uncertainty against the mean", found=worst, limit=_MOST_U, unit=""),
            Limit(what="share of LEDs without a usable picture", found=unusable, limit=_MOST_UNUSABLE, unit=""),
        ),
        files={f"{wish.name}.csv": power_table(powers).encode()},
        fixed={"tile.reflectance": setting.tile.reflectance, "tile.minnaert": setting.tile.minnaert},
        remarks=(f"emission profile `{setting.emission}`", *remarks),
        more_inputs=inputs,
    )


def power_table(powers: Mapping[str, LedPower]) -> str:
    """CSV: power of each LED and channel, own uncertainty, derivative by each common figure.

    The covariance of two LEDs' relative powers is that of the common figures between their derivatives, and
    u_own^2 on the diagonal.
    """
    first = next(iter(powers.values()))
    text = io.StringIO()
    columns = ["id"]
    for channel in powers:
        columns += [f"power_{channel}", f"u_own_{channel}", f"u_{channel}"]
        columns += [f"d_{name}_{channel}" for name in first.common_names]
    text.write("# power in DN s^-1 m^2 sr, uncertainties relative; 0: dead, nan: no usable picture\n")
    text.write(",".join(columns) + "\n")
    for n, led in enumerate(first.ids):
        row = [f"{led}"]
        for power in powers.values():
            row += [f"{power.power[n]:.9g}", f"{power.u_own[n]:.4g}", f"{power.u()[n]:.4g}"]
            row += [f"{value:.5g}" for value in power.common[n]]
        text.write(",".join(row) + "\n")
    return text.getvalue()


class _Reader:
    """Reads mean signals of the tile's patches."""

    def __init__(self, frames: LightFrames, setting: Setting, shape: tuple[int, ...]) -> None:
        self.shape = (shape[0], shape[1])
        self._white_dn, self._setting = frames.white_dn, setting
        self._dark = dark_signal(frames, setting.dark)
        channels = channels_of(frames.pattern)
        self._straight: dict[str, Callable[[Floats], Floats]] = {
            channel: linearise(setting.response, channel) for channel in channels
        }
        self._masks = {channel: channel_mask(self.shape, frames.pattern, channel) for channel in channels}
        self._flat = None if setting.flat is None else map_beside(setting.flat, "flat-field", "g")

    def patches(self, base_from_camera: Floats) -> tuple[Floats, list[NDArray[np.intp]]]:
        """Middles [m, 3] of the patches in the base frame, and the pixels [k, 2] (row, column) that see each."""
        tile = self._setting.tile
        base_from_tile = self._setting.base_from_tile
        half = tile.side_mm / 2.0 - tile.margin_mm
        edges = np.linspace(-half, half, _PATCHES + 1)
        corners, middles = [], []
        for i in range(_PATCHES):
            for j in range(_PATCHES):
                (left, right), (top, bottom) = edges[i : i + 2], edges[j : j + 2]
                corners += [(left, top), (right, top), (right, bottom), (left, bottom)]
                middles.append((0.5 * (left + right), 0.5 * (top + bottom)))
        camera_from_tile = np.linalg.inv(base_from_camera) @ base_from_tile
        flat = np.column_stack([np.array(corners), np.zeros(len(corners))])
        seen = flat @ camera_from_tile[:3, :3].T + camera_from_tile[:3, 3]
        if (seen[:, 2] <= 0).any():
            raise InputError("LED power: the tile lies behind the camera; correct its place in its description")
        polygons = optics.project(seen, self._setting.lens.vector()).pixels.reshape(-1, 4, 2)
        pixels = [_inside(polygon, self.shape) for polygon in polygons]
        _refuse_few(min(len(one) for one in pixels))
        points = np.column_stack([np.array(middles), np.zeros(len(middles))])
        return points @ base_from_tile[:3, :3].T + base_from_tile[:3, 3], pixels

    def means(
        self, frame: LightFrame, patches: Sequence[NDArray[np.intp]]
    ) -> dict[str, tuple[Floats, Floats, bool]]:
        """By channel: mean signal of each patch over flat field, DN/s; its uncertainty; whether saturated."""
        raw = frame.read()
        signal = raw - self._dark(frame)
        found = {}
        for channel, mask in self._masks.items():
            means, us, full = np.zeros(len(patches)), np.zeros(len(patches)), False
            for p, pixels in enumerate(patches):
                rows, columns = pixels[mask[pixels[:, 0], pixels[:, 1]]].T
                values = self._straight[channel](signal[rows, columns].astype(np.float64))
                if self._flat is not None:
                    values = values / self._flat[rows, columns]
                values = values / (frame.exposure_us * 1e-6)
                means[p], us[p] = values.mean(), values.std(ddof=1) / np.sqrt(len(values))
                full |= bool((raw[rows, columns] >= self._white_dn).any())
            found[channel] = means, us, full
        return found


def _refuse_few(least: int) -> None:
    if least == 0:
        raise InputError(
            "LED power: a part of the tile lies outside the picture; correct its place in its description, or "
            "leave out that view"
        )
    if least < 4 * _LEAST_PIXELS:
        raise InputError(
            f"LED power: expected {4 * _LEAST_PIXELS} pixels or more on each part of the tile, found {least}; go "
            "nearer, or take a larger tile"
        )


def _inside(polygon: Floats, shape: tuple[int, int]) -> NDArray[np.intp]:
    """[k, 2] row and column of the pixels inside a convex polygon [4, 2]; none if it leaves the picture."""
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


def _parameters(powers: Mapping[str, LedPower]) -> list[Parameter]:
    """What all LEDs share, by channel; their own powers stand in the table."""
    found = []
    for channel, power in powers.items():
        good = np.isfinite(power.power) & (power.power > 0)
        u = np.sqrt(np.diag(power.common_covariance))
        freedom = power.degrees_of_freedom
        mean = float(np.mean(power.power[good]))
        found.append(
            Parameter(
                name=f"mean_power.{channel}",
                value=mean,
                u=mean * float(np.sqrt(np.mean(power.u_own[good] ** 2) / good.sum())),
                degrees_of_freedom=freedom,
                dominated_by="noise; what LEDs share stands below",
            )
        )
        found += [
            Parameter(
                name=f"{name}.{channel}",
                value=float(value),
                u=float(one),
                degrees_of_freedom=freedom,
                dominated_by="the tile's description",
            )
            for name, value, one in zip(power.common_names, power.found, u, strict=True)
        ]
    return found


def _covariance(powers: Mapping[str, LedPower]) -> Floats:
    from scipy.linalg import block_diag

    blocks = []
    for channel, power in powers.items():
        mean = next(p for p in _parameters({channel: power}) if p.name.startswith("mean_power"))
        blocks += [np.array([[mean.u**2]]), power.common_covariance]
    return np.asarray(block_diag(*blocks))
