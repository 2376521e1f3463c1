"""From DN to linear signal per second over the flat field, and its means over the triangles that pixels see."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numba
import numpy as np
from numpy.typing import NDArray

from coupole.calibration.earlier import read_earlier
from coupole.calibration.light.frames import LightFrame, channel_mask
from coupole.calibration.light.records import dark_signal, linearise, map_beside
from coupole.reflectance.extraction.measured_run import MeasuredRun
from coupole.reflectance.extraction.seen_surface import SeenSurface

RANGE_LEFT_OUT = 0.02
"""Of the camera's range, at both ends (seed 003, 5.1)."""


@dataclass(frozen=True)
class Means:
    """Of one frame, [triangles, channels]."""

    signal: NDArray[np.float32]
    """DN/s over the flat field; NaN where no pixel is, where one is at the range's top, or the mean is at its
    bottom."""
    u_signal: NDArray[np.float32]
    """Relative, of noise."""


class SignalReader:
    """Reads frames of one view."""

    def __init__(self, measured: MeasuredRun, surface: SeenSurface) -> None:
        frames, records = measured.frames, measured.records
        self._white_dn, self._black_dn = frames.white_dn, frames.black_dn
        self._dark: Callable[[LightFrame], NDArray[np.float32]] = dark_signal(frames, records.get("dark"))
        width, height = frames.size_px
        places = surface.rows, surface.columns
        letters = np.zeros((height, width), np.int8)
        for number, channel in enumerate(measured.channels):
            letters[channel_mask((height, width), frames.pattern, channel)] = number
        self._channel = letters[places]
        flat = np.ones((height, width), np.float32)
        if "flat-field" in records:
            flat = map_beside(records["flat-field"], "flat-field", "g", frames)
        self._flat = flat[places]
        self._surface = surface
        self._places = (surface.rows.astype(np.int64) * width + surface.columns).astype(np.int64)
        self._curve, self._noise = _response(measured)
        self.pixels = np.zeros((len(surface.triangles), len(measured.channels)), np.int32)
        np.add.at(self.pixels, (surface.triangle, self._channel), 1)

    def means(self, frame: LightFrame) -> Means:
        """Mean signals of the triangles in one frame. Raises StorageError."""
        raw = frame.read().ravel()
        dark = self._dark(frame).ravel()
        shape = self.pixels.shape
        top_dn = self._white_dn - RANGE_LEFT_OUT * (self._white_dn - self._black_dn)
        least = RANGE_LEFT_OUT * (self._white_dn - self._black_dn)
        sums, variances, full = np.zeros(shape), np.zeros(shape), np.zeros(shape, np.bool_)
        above = np.zeros(shape)
        _sum(
            raw, dark, self._places, self._surface.triangle, self._channel, self._flat, self._curve, self._noise,
            top_dn, sums, variances, above, full,
        )  # fmt: skip
        with np.errstate(invalid="ignore", divide="ignore"):
            signal = sums / self.pixels
            unusable = full | (self.pixels == 0) | ~(above / self.pixels > least)
            relative = np.sqrt(variances) / np.abs(sums)
        signal[unusable], relative[unusable] = np.nan, np.nan
        return Means((signal / (frame.exposure_us * 1e-6)).astype(np.float32), relative.astype(np.float32))


def _response(measured: MeasuredRun) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """[channels, 3] c2, c3 and range of the response, [channels, 2] variance in the dark (DN^2) and gain (DN/e);
    without a record a straight line, and NaN."""
    path, channels = measured.records.get("response"), measured.channels
    curve, noise = np.zeros((len(channels), 3)), np.full((len(channels), 2), np.nan)
    curve[:, 2] = 1.0
    if path is not None:
        record = read_earlier(path, "response", measured.frames.about, measured.frames.size_px)
        for number, channel in enumerate(channels):
            linearise(path, channel, measured.frames)  # refuses a record of another camera
            curve[number] = [record.value(name) for name in (f"c2.{channel}", f"c3.{channel}", "range_dn")]
            noise[number] = [record.value(f"{name}.{channel}") for name in ("dark_variance_dn2", "gain_dn_per_e")]
    return curve, noise


@numba.njit(cache=True, nogil=True)
def _sum(  # type: ignore[no-untyped-def]
    raw, dark, places, triangle, channel, flat, curve, noise, top_dn, sums, variances, above, full
):
    """Sums of linear signal over the flat field, their variances by noise, sums of DN above dark, and whether a
    pixel was at the top of the range."""
    for pixel in range(len(places)):
        t, c = triangle[pixel], channel[pixel]
        dn = float(raw[places[pixel]])
        signal = dn - dark[places[pixel]]
        x = signal / curve[c, 2]
        straight = signal * (1.0 + x * (curve[c, 0] + x * curve[c, 1]))
        sums[t, c] += straight / flat[pixel]
        above[t, c] += signal
        variances[t, c] += (noise[c, 0] + noise[c, 1] * max(signal, 0.0)) / (flat[pixel] * flat[pixel])
        full[t, c] |= dn >= top_dn
