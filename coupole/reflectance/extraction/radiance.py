"""From DN to linear signal per second over the flat field, and its means over the triangles that pixels see."""

from __future__ import annotations

from collections.abc import Callable

import numba
import numpy as np
from numpy.typing import NDArray

from coupole.calibration.earlier import read_earlier
from coupole.calibration.light.frames import LightFrame, channel_mask
from coupole.calibration.light.records import dark_signal, linearise, map_beside
from coupole.reflectance.extraction.lamp_sight import REACHED
from coupole.reflectance.extraction.measured_run import MeasuredRun
from coupole.reflectance.extraction.seen_surface import SeenSurface

RANGE_LEFT_OUT = 0.02
"""Of the camera's range, at both ends (seed 003, 5.1)."""


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
    """Pixels of one view in the order of triangles and channels, and what they mean in its frames."""

    def __init__(self, radiometry: Radiometry, surface: SeenSurface) -> None:
        self._radiometry = radiometry
        count, channels = len(surface.triangles), radiometry.channels
        self.pixels = np.zeros((count, channels), np.int32)
        """[triangles, channels]"""
        _count(surface.places, radiometry.channel, self.pixels)
        with np.errstate(divide="ignore"):
            self.u_response = radiometry.u_pixel / np.sqrt(self.pixels)
            """[triangles, channels] relative standard uncertainty that all means share, of pixels' responses."""
        self._starts = np.concatenate([[0], np.cumsum(self.pixels.ravel(), dtype=np.int64)])
        """[triangles channels + 1] of a triangle's channel in what follows."""
        self._places = np.empty(self._starts[-1], np.int32)
        """[pixels] in a frame, row by row."""
        _list(surface.places, radiometry.channel, self._starts[:-1].copy(), self._places)
        self._flat = np.float32(1.0) / radiometry.flat.ravel()[self._places]
        self._inverse = (1.0 / np.maximum(np.arange(self.pixels.max(initial=0) + 1), 1)).astype(np.float32)
        scale = radiometry.curve[:, 2:]
        self._curve = (radiometry.curve[:, :2] / np.hstack([scale, scale**2])).astype(np.float32)
        self._noise = radiometry.noise.astype(np.float32)
        self._dark: dict[float, NDArray[np.float32]] = {}

    def prepare(self, frame: LightFrame) -> None:
        """What frames of its exposure need, before threads want it."""
        if frame.exposure_us not in self._dark:
            self._dark[frame.exposure_us] = self._radiometry.dark(frame).ravel()[self._places]

    def means(
        self, frame: LightFrame, pixels: NDArray[np.uint16], rows: slice, codes: NDArray[np.uint8]
    ) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
        """[b, channels] mean signals of the triangles in `rows` that light has reached, DN/s over the flat field,
        and their relative uncertainties, by noise.

        NaN where no pixel is, where one is at the range's top, or the mean is at its bottom.
        """
        known, channels = self._radiometry, self._radiometry.channels
        least = RANGE_LEFT_OUT * (known.white_dn - known.black_dn)
        signal = np.full((rows.stop - rows.start, channels), np.nan, np.float32)
        u_signal = np.full(signal.shape, np.nan, np.float32)
        _means(
            pixels.ravel(), self._dark[frame.exposure_us], self._places, self._flat,
            self._starts[rows.start * channels : rows.stop * channels + 1],
            self._inverse / np.float32(frame.exposure_us * 1e-6), self._curve, self._noise,
            np.float32(known.white_dn - least), np.float32(least), codes, signal, u_signal,
        )  # fmt: skip
        return signal, u_signal


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
def _count(triangle, channel, pixels):  # type: ignore[no-untyped-def]
    for row in range(triangle.shape[0]):
        for column in range(triangle.shape[1]):
            if triangle[row, column] >= 0:
                pixels[triangle[row, column], channel[row, column]] += 1


@numba.njit(cache=True, nogil=True)
def _list(triangle, channel, next_place, places):  # type: ignore[no-untyped-def]
    """Into `places` the numbers of pixels; `next_place` [triangles channels] is where a list goes on."""
    channels = len(next_place) // (triangle.max() + 1) if len(places) else 1
    width = triangle.shape[1]
    for row in range(triangle.shape[0]):
        for column in range(width):
            if triangle[row, column] >= 0:
                mine = triangle[row, column] * channels + channel[row, column]
                places[next_place[mine]] = row * width + column
                next_place[mine] += 1


@numba.njit(cache=True, nogil=True)
def _means(raw, dark, places, flat, starts, inverse, curve, noise, top_dn, least_dn, codes, signals, u_signals):  # type: ignore[no-untyped-def]
    """Means of linear signal over the flat field, and what variance noise gives them, in single precision: a few
    values of 12 bits. `flat` is 1 over the field, `inverse` [n] 1 over n pixels and the time. A triangle with a
    pixel at the range's top has no mean."""
    none, one = np.float32(0.0), np.float32(1.0)
    channels = signals.shape[1]
    for triangle in range(len(signals)):
        if codes[triangle] != REACHED:
            continue
        for c in range(channels):
            first, end = starts[triangle * channels + c], starts[triangle * channels + c + 1]
            total, above, variance, highest = none, none, none, none
            for pixel in range(first, end):
                dn = np.float32(raw[places[pixel]])
                highest = max(highest, dn)
                signal, even = dn - dark[pixel], flat[pixel]
                above += signal
                total += even * signal * (one + signal * (curve[c, 0] + signal * curve[c, 1]))
                variance += even * even * (noise[c, 0] + noise[c, 1] * max(signal, none))
            if end > first and highest < top_dn and above > least_dn * np.float32(end - first):
                signals[triangle, c] = total * inverse[end - first]
                u_signals[triangle, c] = np.sqrt(variance) / abs(total)
