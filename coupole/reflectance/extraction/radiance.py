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


class Radiometry:
    """What turns the DN of a run's frames into linear signal, read once for all its views."""

    def __init__(self, measured: MeasuredRun) -> None:
        frames, records = measured.frames, measured.records
        width, height = frames.size_px
        self.white_dn, self.black_dn = frames.white_dn, frames.black_dn
        self.dark: Callable[[LightFrame], NDArray[np.float32]] = dark_signal(frames, records.get("dark"))
        self.channel = np.zeros((height, width), np.int8)
        """[h, w] number of a pixel's channel."""
        for number, channel in enumerate(measured.channels):
            self.channel[channel_mask((height, width), frames.pattern, channel)] = number
        self.channels = len(measured.channels)
        self.flat = np.ones((height, width), np.float32)
        self.curve, self.noise, self.u_pixel = _response(measured)
        if "flat-field" in records:
            self.flat, u_pixel = _flat_field(measured)
            self.u_pixel = np.full(self.channels, u_pixel)


class SignalReader:
    """Reads frames of one view."""

    def __init__(self, radiometry: Radiometry, surface: SeenSurface) -> None:
        places = surface.rows, surface.columns
        self._radiometry, self._surface = radiometry, surface
        self._channel, self._flat = radiometry.channel[places], radiometry.flat[places]
        self._places = surface.rows.astype(np.int64) * radiometry.flat.shape[1] + surface.columns
        self.pixels = np.zeros((len(surface.triangles), radiometry.channels), np.int32)
        np.add.at(self.pixels, (surface.triangle, self._channel), 1)
        with np.errstate(divide="ignore"):
            self.u_response = radiometry.u_pixel / np.sqrt(self.pixels)
            """[triangles, channels] relative standard uncertainty that all means share, of pixels' responses."""

    def means(self, frame: LightFrame) -> Means:
        """Mean signals of the triangles in one frame. Raises StorageError."""
        known, shape = self._radiometry, self.pixels.shape
        least = RANGE_LEFT_OUT * (known.white_dn - known.black_dn)
        sums, variances, full = np.zeros(shape), np.zeros(shape), np.zeros(shape, np.bool_)
        above = np.zeros(shape)
        _sum(
            frame.read().ravel(), known.dark(frame).ravel(), self._places, self._surface.triangle, self._channel,
            self._flat, known.curve, known.noise, known.white_dn - least, sums, variances, above, full,
        )  # fmt: skip
        with np.errstate(invalid="ignore", divide="ignore"):
            signal = sums / self.pixels
            unusable = full | (self.pixels == 0) | ~(above / self.pixels > least)
            relative = np.sqrt(variances) / np.abs(sums)
        signal[unusable], relative[unusable] = np.nan, np.nan
        return Means((signal / (frame.exposure_us * 1e-6)).astype(np.float32), relative.astype(np.float32))


def _response(measured: MeasuredRun) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.float64]]:
    """[channels, 3] c2, c3 and range of the response, [channels, 2] variance in the dark (DN^2) and gain (DN/e),
    [channels] relative spread of pixels' own responses (0 where the scene did not let it be measured); without a
    record a straight line, and NaN."""
    path, channels = measured.records.get("response"), measured.channels
    curve, noise = np.zeros((len(channels), 3)), np.full((len(channels), 2), np.nan)
    u_pixel = np.full(len(channels), np.nan)
    curve[:, 2] = 1.0
    if path is not None:
        record = read_earlier(path, "response", measured.frames.about, measured.frames.size_px)
        for number, channel in enumerate(channels):
            linearise(path, channel, measured.frames)  # refuses a record of another camera
            curve[number] = [record.value(name) for name in (f"c2.{channel}", f"c3.{channel}", "range_dn")]
            noise[number] = [record.value(f"{name}.{channel}") for name in ("dark_variance_dn2", "gain_dn_per_e")]
            u_pixel[number] = record.fixed.get(f"prnu.{channel}", 0.0)
    return curve, noise, u_pixel


def _flat_field(measured: MeasuredRun) -> tuple[NDArray[np.float32], float]:
    """[h, w] fall-off and response of each pixel, and the latter's relative standard uncertainty: their spread,
    where a record does not say how well they were measured."""
    path, frames = measured.records["flat-field"], measured.frames
    fall_off, response = (map_beside(path, "flat-field", name, frames) for name in ("g", "pixel_response"))
    record = read_earlier(path, "flat-field", frames.about, frames.size_px)
    return fall_off * response, float(record.fixed.get("u_pixel_response", np.std(response)))


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
