"""Conversion of DN to linear signal over the flat field, and the pixels of each triangle."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import lru_cache, partial
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from coupole.calibration.earlier import read_earlier
from coupole.calibration.light.frames import LightFrame, LightFrames, channel_mask
from coupole.calibration.light.glare_correction import GlareCorrection, read_glare
from coupole.calibration.light.records import dark_signal, linearise, map_beside
from coupole.kernels import kernel
from coupole.reflectance.extraction.frame_veils import FrameVeils, dark_of_blocks
from coupole.reflectance.extraction.measured_run import MeasuredRun
from coupole.reflectance.extraction.seen_surface import SeenSurface

RANGE_LEFT_OUT = 0.02
"""Share of the camera's range that is left out at both ends (Lucat et al. 2025, 5.1)."""


class Radiometry:
    """Data that convert the DN of a run's frames to linear signal, read once for all its views."""

    def __init__(self, measured_run: MeasuredRun) -> None:
        frames, records = measured_run.frames, measured_run.records
        width, height = frames.size_px
        self.white_dn, self.black_dn = frames.white_dn, frames.black_dn
        self._dark_of_view = lru_cache(maxsize=2)(partial(_dark_in_view, frames, records.get("dark")))
        self.channel = np.zeros((height, width), np.int8)
        """[h, w] number of a pixel's channel."""
        for number, channel in enumerate(measured_run.channels):
            self.channel[channel_mask((height, width), frames.pattern, channel)] = number
        self.channels = len(measured_run.channels)
        self.flat = np.ones((height, width), np.float32)
        self.glare: GlareCorrection | None = read_glare(records["glare"], frames) if "glare" in records else None
        self.curve, self.noise, self.u_pixel = _response(measured_run)
        if "flat-field" in records:
            self.flat, u_pixel = _flat_field(measured_run)
            self.u_pixel = np.full(self.channels, u_pixel)

    def dark(self, frame: LightFrame) -> NDArray[np.float32]:
        """[h, w] DN of a frame without light, by the record, or by the dark frames of its view and of the views
        before it. Later views are not used. So a view's samples are the same, whether they are taken as soon as
        the view is complete or after the run."""
        return self._dark_of_view(frame.view)(frame)

    def veils(self, frames: Sequence[LightFrame]) -> FrameVeils | None:
        """Return the data that give the glare of frames of one view; None without a record of glare."""
        if self.glare is None:
            return None
        alike = {frame.exposure_us: frame for frame in frames}
        darks = {t: dark_of_blocks(self.dark(frame), self.channel, self.glare) for t, frame in alike.items()}
        return FrameVeils(self.glare, self.channel, self.curve, self.top_dn, darks)

    @property
    def top_dn(self) -> float:
        """Upper end of the camera's range that is used."""
        return self.white_dn - RANGE_LEFT_OUT * (self.white_dn - self.black_dn)


class PixelLists(NamedTuple):
    """Pixels of one view in the order of triangles and channels, for compiled code."""

    starts: NDArray[np.int64]
    """[triangles channels + 1] first place of each triangle's channel in the arrays below; the last number is the
    length of these arrays."""
    places: NDArray[np.int32]
    """[pixels] places in a frame, counted row by row."""
    even: NDArray[np.float32]
    """[pixels] 1 over the flat field."""


class Response(NamedTuple):
    """Response of the camera's channels, for compiled code."""

    curve: NDArray[np.float32]
    """[channels, 2] coefficients of the square and the cube of a signal in DN."""
    noise: NDArray[np.float32]
    """[channels, 2] variance in the dark, DN^2, and gain, DN/e; NaN if they are not known."""
    top_dn: np.float32
    """Upper end of the range that is used."""
    least_dn: np.float32
    """Least mean of a triangle above the dark signal."""


class SignalReader:
    """Pixels of one view by triangles and channels, and their means in the view's frames."""

    def __init__(self, radiometry: Radiometry, surface: SeenSurface) -> None:
        self._radiometry = radiometry
        count, channels = len(surface.triangles), radiometry.channels
        self.pixels = np.zeros((count, channels), np.int32)
        """[triangles, channels]"""
        _count(surface.places, radiometry.channel, self.pixels)
        root_counts = np.sqrt(np.maximum(self.pixels, 1))
        self.u_response = np.where(self.pixels > 0, radiometry.u_pixel / root_counts, np.inf)
        """[triangles, channels] relative standard uncertainty that all means share, from the responses of
        pixels."""
        starts = np.concatenate([[0], np.cumsum(self.pixels.ravel(), dtype=np.int64)])
        places = np.empty(starts[-1], np.int32)
        _list(surface.places, radiometry.channel, channels, starts[:-1].copy(), places)
        self.lists = PixelLists(starts, places, np.float32(1.0) / radiometry.flat.ravel()[places])
        scale = radiometry.curve[:, 2:]
        curve = radiometry.curve[:, :2] / np.hstack([scale, scale**2])
        least_dn = RANGE_LEFT_OUT * (radiometry.white_dn - radiometry.black_dn)
        self.response = Response(
            curve.astype(np.float32),
            radiometry.noise.astype(np.float32),
            np.float32(radiometry.white_dn - least_dn),
            np.float32(least_dn),
        )
        self.exposures: dict[float, int] = {}
        """Rows of `darks`, by exposures in us."""
        self.darks = np.empty((0, len(places)), np.float32)
        """[exposures, pixels] DN of frames without light, in the order of the lists."""
        self.veils: FrameVeils | None = None
        """The data that give the frames' glare; None without a record of glare."""
        self.u_glare: dict[int, NDArray[np.float64]] = {}
        """[channels] relative standard uncertainty of the glare in the frames of each LED that were read."""

    def prepare(self, frames: Sequence[LightFrame]) -> None:
        """Set `exposures`, `darks` and `veils` for frames of these exposures: the signal without light, and the
        glare."""
        self.veils = self._radiometry.veils(frames)
        alike = {frame.exposure_us: frame for frame in frames}
        self.exposures = {exposure_us: number for number, exposure_us in enumerate(alike)}
        self.darks = np.empty((len(alike), len(self.lists.places)), np.float32)
        for number, frame in enumerate(alike.values()):
            np.take(self._radiometry.dark(frame).ravel(), self.lists.places, out=self.darks[number], mode="clip")


def _dark_in_view(
    frames: LightFrames, record: Path | None, view: str
) -> Callable[[LightFrame], NDArray[np.float32]]:
    return dark_signal(frames.until(view), record)


def _response(measured_run: MeasuredRun) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.float64]]:
    """[channels, 3] c2, c3 and range of the response, [channels, 2] variance in the dark (DN^2) and gain (DN/e),
    [channels] relative spread of pixels' own responses (0 if the scene did not allow its measurement). Without a
    record the response is a straight line, and the other values are NaN."""
    path, channels = measured_run.records.get("response"), measured_run.channels
    curve, noise = np.zeros((len(channels), 3)), np.full((len(channels), 2), np.nan)
    u_pixel = np.full(len(channels), np.nan)
    curve[:, 2] = 1.0
    if path is not None:
        record = read_earlier(path, "response", measured_run.frames.about, measured_run.frames.size_px)
        for number, channel in enumerate(channels):
            linearise(path, channel, measured_run.frames)  # refuses a record of another camera
            curve[number] = [record.value(name) for name in (f"c2.{channel}", f"c3.{channel}", "range_dn")]
            noise[number] = [record.value(f"{name}.{channel}") for name in ("dark_variance_dn2", "gain_dn_per_e")]
            u_pixel[number] = record.fixed.get(f"prnu.{channel}", 0.0)
    return curve, noise, u_pixel


def _flat_field(measured_run: MeasuredRun) -> tuple[NDArray[np.float32], float]:
    """[h, w] fall-off and response of each pixel, and the relative standard uncertainty of the responses. If a
    record does not state this uncertainty, it is the spread of the responses."""
    path, frames = measured_run.records["flat-field"], measured_run.frames
    fall_off, response = (map_beside(path, "flat-field", name, frames) for name in ("g", "pixel_response"))
    record = read_earlier(path, "flat-field", frames.about, frames.size_px)
    return fall_off * response, float(record.fixed.get("u_pixel_response", np.std(response)))


@kernel
def _count(triangle, channel, pixels):  # type: ignore[no-untyped-def]
    for row in range(triangle.shape[0]):
        for column in range(triangle.shape[1]):
            if triangle[row, column] >= 0:
                pixels[triangle[row, column], channel[row, column]] += 1


@kernel
def _list(triangle, channel, channels, next_place, places):  # type: ignore[no-untyped-def]
    """Fill `places` with the numbers of pixels; `next_place` [triangles channels] is the place at which each list
    continues."""
    width = triangle.shape[1]
    for row in range(triangle.shape[0]):
        for column in range(width):
            if triangle[row, column] >= 0:
                list_number = triangle[row, column] * channels + channel[row, column]
                places[next_place[list_number]] = row * width + column
                next_place[list_number] += 1
