"""A sensor without light: offset, dark current and noise of each pixel, hot pixels.

A pixel's dark signal is offset + current * exposure * 2^((T - T0) / doubling): EMVA 1288 release 4.0, section 7.
The doubling temperature is taken as known. Frames are read one by one, and the straight line of each pixel needs
only the sums of y, y^2 and y t over the frames. So memory does not grow with the number of frames.

Read and row noise come from differences of two frames of one exposure, in which all fixed patterns cancel.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from coupole.errors import InputError

Maps = NDArray[np.float32]
HOT_SIGMA = 8.0
"""Limit of the dark current, in robust standard deviations above the median. A pixel above it is hot."""
_ROUNDING = 1.0 / 12.0
"""Variance of rounding to whole DN (EMVA 1288 release 4.0, section 2.4)."""
_MAD = 1.4826
_LEAST_FRAMES = 4
_LIT = 10.0
"""Largest height of a dark frame's mean above the line, divided by the scatter of the other frames. Above this
limit the frame was not dark."""
_LIT_DN = 0.5


@dataclass(frozen=True)
class DarkFrame:
    """One frame without light."""

    name: str
    exposure_s: float
    temperature_c: float
    """Temperature of the frame; NaN if unknown."""
    read: Callable[[], NDArray[np.uint16]]
    """Reads [H, W] DN."""


@dataclass(frozen=True)
class Dark:
    """Offset and dark current of every pixel; maps are [H, W] float32."""

    offset_dn: Maps
    current_dn_per_s: Maps
    """Dark current at `reference_c`."""
    noise_dn: Maps
    """Standard deviation of each pixel about its own line."""
    cofactor: NDArray[np.float64]
    """[2, 2] cofactor matrix of offset and current. Multiplied by a pixel's squared noise, it is their covariance
    (DN, s)."""
    degrees_of_freedom: int
    """Degrees of freedom of `noise_dn`."""
    read_noise_dn: float
    """Read noise of one pixel, without row noise and rounding."""
    read_noise_u_dn: float
    row_noise_dn: float
    row_noise_u_dn: float
    hot: NDArray[np.int64]
    """[hot, 2] row and column of hot pixels, the hottest first."""
    reference_c: float | None
    """None if not all frames have a temperature; the maps are then valid for the temperature of the frames."""
    doubling_k: float
    levels: tuple[tuple[float, float, float], ...]
    """Exposure (s), temperature (C), mean DN of each frame."""


def calibrate_dark(
    frames: Iterable[DarkFrame],
    *,
    white_dn: int,
    doubling_k: float = 6.5,
    progress: Callable[[int, int], None] = lambda done, total: None,
) -> Dark:
    """Fit a line to each pixel of frames without light.

    `doubling_k` is the rise of temperature that doubles dark current. It is a figure of silicon (Janesick, Photon
    Transfer, 2007, section 11.1.2), and is not estimated. Raises InputError for too few frames or exposures, for
    frames with light, and for saturated frames.
    """
    series = sorted(frames, key=lambda frame: (frame.exposure_s, frame.temperature_c))
    exposures = {frame.exposure_s for frame in series}
    if len(series) < _LEAST_FRAMES or len(exposures) < 2:
        raise InputError(
            f"dark: expected {_LEAST_FRAMES} or more dark frames of 2 or more exposures, found {len(series)} of "
            f"{len(exposures)}; acquire `coupole plan new darks`"
        )
    temperatures_c = [f.temperature_c for f in series if np.isfinite(f.temperature_c)]
    reference_c = float(np.mean(temperatures_c)) if len(temperatures_c) == len(series) else None
    seconds = np.array(
        [f.exposure_s * warmth_of(f.temperature_c, reference_c, doubling_k) for f in series], dtype=np.float64
    )
    sums = _Sums()
    pairs: list[tuple[float, float, float]] = []
    levels: list[tuple[float, float, float]] = []
    before: NDArray[np.uint16] | None = None
    for number, (frame, t_s) in enumerate(zip(series, seconds, strict=True)):
        pixels = frame.read()
        _refuse_saturated(frame, pixels, white_dn)
        sums.add(frame.name, pixels, t_s)
        levels.append((frame.exposure_s, frame.temperature_c, float(np.median(pixels.mean(axis=1)))))
        if before is not None and series[number - 1].exposure_s == frame.exposure_s:
            pairs.append((float(t_s), *_pair_variances(before, pixels)))
        before = pixels
        progress(number + 1, len(series))
    _refuse_lit([f.name for f in series], seconds, np.array([mean for _, _, mean in levels]))
    if not pairs:
        raise InputError("dark: expected two frames or more of one exposure; set `darks_per_view: 20` in the plan")
    offset, current, noise, cofactor = sums.lines()
    height, width = offset.shape
    return Dark(
        offset,
        current,
        noise,
        cofactor,
        len(series) - 2,
        *_noises(pairs, height, width),
        hot_pixels(current),
        reference_c,
        doubling_k,
        tuple(levels),
    )


def hot_pixels(current_dn_per_s: Maps, sigma: float = HOT_SIGMA) -> NDArray[np.int64]:
    """Return [hot, 2], row and column of pixels with a high dark current, the hottest first."""
    median = np.median(current_dn_per_s)
    scatter = _MAD * np.median(np.abs(current_dn_per_s - median))
    places = np.argwhere(current_dn_per_s > median + sigma * max(scatter, 1e-9))
    order = np.argsort(-current_dn_per_s[places[:, 0], places[:, 1]], kind="stable")
    return np.asarray(places[order], dtype=np.int64)


def _noises(pairs: list[tuple[float, float, float]], height: int, width: int) -> tuple[float, float, float, float]:
    """Return read noise and its uncertainty, and row noise and its uncertainty, DN.

    `pairs` are exposure time (s), variance within rows and variance of the rows (DN^2) of two successive frames.
    """
    at_s, within, row = np.array(pairs).T
    row_var = max(float(row.mean()), 0.0)
    # Variances of n numbers scatter by sqrt(2/n); neighbouring pairs share a frame, which halves their count.
    independent = max(1.0, (len(pairs) + 1) / 2)
    sigma = float(within.mean()) * np.sqrt(2.0 * len(pairs) / (independent * height * width))
    # The shot noise of dark current grows with time: read noise is the line's value at time zero.
    design = np.column_stack([np.ones_like(at_s), at_s])
    of_lines = np.linalg.pinv(design.T @ design)
    read_var = max(float((of_lines @ design.T @ within)[0]) - _ROUNDING, 1e-6)
    read_var_u = sigma * float(np.sqrt(of_lines[0, 0]))
    row_var_u = (row_var + float(within.mean()) / width) * np.sqrt(2.0 / (independent * height))
    row_noise = float(np.sqrt(row_var))
    return (
        float(np.sqrt(read_var)),
        float(read_var_u / (2 * np.sqrt(read_var))),
        row_noise,
        float(row_var_u / (2 * max(row_noise, np.sqrt(row_var_u)))),
    )


class _Sums:
    """Sums over frames, in four maps: the first frame, and y, y t and y^2 relative to it."""

    def __init__(self) -> None:
        self._t: list[float] = []
        self._maps: list[Maps] = []
        self._first: NDArray[np.uint16] | None = None

    def add(self, name: str, pixels: NDArray[np.uint16], t_s: float) -> None:
        if self._first is None:
            self._first = pixels.copy()
            self._maps = [np.zeros(pixels.shape, np.float32) for _ in range(3)]
        if pixels.shape != self._first.shape:
            raise InputError(f"{name}: {pixels.shape} pixels, the frames before it {self._first.shape}")
        # Relative to the first frame numbers are small, so that single precision resolves a thousandth of a DN.
        y = np.subtract(pixels, self._first, dtype=np.float32)
        self._t.append(t_s)
        self._maps[0] += y
        self._maps[1] += y * np.float32(t_s)
        self._maps[2] += y * y

    def lines(self) -> tuple[Maps, Maps, Maps, NDArray[np.float64]]:
        """Return offset, slope, scatter about the line, and the cofactor matrix of offset and slope."""
        assert self._first is not None
        t = np.array(self._t)
        design = np.column_stack([np.ones_like(t), t])
        cofactor = np.linalg.inv(design.T @ design)
        y, yt, yy = self._maps
        offset: Maps = np.float32(cofactor[0, 0]) * y + np.float32(cofactor[0, 1]) * yt
        slope: Maps = np.float32(cofactor[1, 0]) * y + np.float32(cofactor[1, 1]) * yt
        squares = np.maximum(yy - offset * y - slope * yt, np.float32(0.0))
        noise: Maps = np.sqrt(squares / np.float32(len(t) - 2))
        return np.add(offset, self._first, dtype=np.float32), slope, noise, cofactor


def _pair_variances(a: NDArray[np.uint16], b: NDArray[np.uint16]) -> tuple[float, float]:
    """Return the variance of a pixel within its row and the variance of the rows, for one frame, from the
    difference of two frames.

    Pixels with shot noise of their own (hot ones) are left out.
    """
    difference = np.subtract(a, b, dtype=np.float32)
    scatter = _MAD * max(float(np.median(np.abs(difference - np.median(difference)))), 1.0)
    difference[np.abs(difference) > 6.0 * scatter] = np.nan
    rows = np.nanmean(difference, axis=1)
    within = float(np.nanvar(difference - rows[:, None], ddof=0)) / 2.0
    width = difference.shape[1]
    within *= width / (width - 1.0)
    return within, float(np.var(rows, ddof=1)) / 2.0 - within / width


def _refuse_saturated(frame: DarkFrame, pixels: NDArray[np.uint16], white_dn: int) -> None:
    if float(np.mean(pixels >= white_dn)) > 0.01:
        raise InputError(
            f"{frame.name}: more than 1 % of a dark frame is saturated; close the dome, or expose less"
        )
    if float(np.mean(pixels == 0)) > 0.01:
        raise InputError(
            f"{frame.name}: more than 1 % of a dark frame's pixels are 0, so the noise is clipped; raise the "
            "camera's black level"
        )


def _refuse_lit(names: list[str], t_s: NDArray[np.float64], mean_dn: NDArray[np.float64]) -> None:
    """Raise InputError if single frames lie far above the line through the others."""
    slope, start = _robust_line(t_s, mean_dn)
    residuals_dn = mean_dn - start - slope * t_s
    scatter = max(_MAD * float(np.median(np.abs(residuals_dn - np.median(residuals_dn)))), _LIT_DN / _LIT)
    lit = [name for name, off in zip(names, residuals_dn, strict=True) if off > _LIT * scatter]
    if lit:
        raise InputError(
            f"dark: light fell into {len(lit)} of {len(names)} frames: {', '.join(lit[:5])}; close the dome and "
            "acquire again"
        )


def _robust_line(x: NDArray[np.float64], y: NDArray[np.float64]) -> tuple[float, float]:
    """Return the Theil-Sen estimate: the median of the slopes of all pairs."""
    i, j = np.triu_indices(len(x), 1)
    apart = np.abs(x[i] - x[j]) > 1e-9
    slope = float(np.median((y[i] - y[j])[apart] / (x[i] - x[j])[apart]))
    return slope, float(np.median(y - slope * x))


def warmth_of(temperature_c: float, reference_c: float | None, doubling_k: float) -> float:
    """Return the dark current at a temperature, relative to that at the reference temperature; 1 if this is not
    known."""
    return 1.0 if reference_c is None else float(2.0 ** ((temperature_c - reference_c) / doubling_k))
