"""One view's samples, batch by batch of LEDs in the order of the frames' file, block by block of triangles.

f = S / (P E/Phi cos_i): mean signal S of a triangle's pixels (DN/s over the flat field, dark and response taken
out) over the irradiance that the LED's power P (DN/s m^2 sr) throws on it (seed 003, Eqs. 1 to 3). The mean over a
triangle stands for the paper's prefilter of 0.1 degree: neighbouring LEDs are degrees apart.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from concurrent.futures import Executor, Future, ThreadPoolExecutor
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numba
import numpy as np
from llvmlite import ir
from numba import types
from numba.extending import intrinsic
from numpy.typing import NDArray

from coupole.calibration.light.frames import LightFrame
from coupole.reflectance.extraction.lamp_sight import REACHED, Facets, lit_by
from coupole.reflectance.extraction.measured_run import MeasuredRun, MeasuredView
from coupole.reflectance.extraction.radiance import SignalReader

Frame = NDArray[np.uint16]
Floats = NDArray[np.float64]

BLOCK = 4096
"""Triangles."""
_FRAMES = 8
"""In memory, and as many that are being read."""
_READERS = 2
MOST_F = 6e4
"""1/sr: the most that float16 has is 65504."""
_NAN = 0x7E00
"""As the bits of a float16."""


@dataclass(frozen=True)
class Samples:
    """Of some LEDs and triangles of a view."""

    leds: slice
    """Places in the view's LEDs."""
    rows: slice
    """Of the view's triangles."""
    codes: NDArray[np.uint8]
    """[leds, triangles]"""
    f: NDArray[np.float16]
    """[triangles, leds, channels] 1/sr; NaN where there is none."""
    u_own: NDArray[np.float16]
    """Relative standard uncertainty, of noise."""


@dataclass(frozen=True)
class ViewPass:
    """A view's frames and triangles, and what is known of both."""

    measured: MeasuredRun
    view: MeasuredView
    facets: Facets
    reader: SignalReader

    @cached_property
    def leds(self) -> NDArray[np.int64]:
        return np.array(list(self.view.by_led), np.int64)

    @property
    def together(self) -> int:
        """LEDs whose frames are read together."""
        return min(len(self.leds), max(1, _FRAMES // max(map(len, self.view.by_led.values()))))

    def samples(self, codes_of: Callable[[slice, Executor], NDArray[np.uint8]], threads: int) -> Iterator[Samples]:
        """All samples; `codes_of` gives the codes of some LEDs [leds, triangles], with the threads of a pool."""
        parts = [slice(n, min(n + self.together, len(self.leds))) for n in range(0, len(self.leds), self.together)]
        count = len(self.facets.centres_mm)
        blocks = [slice(first, min(first + BLOCK, count)) for first in range(0, count, BLOCK)]
        for frame in self.view.frames:
            self.reader.prepare(frame)
        with ThreadPoolExecutor(threads) as pool, ThreadPoolExecutor(_READERS) as readers:
            ahead = self._read(parts[0], readers)
            for number, part in enumerate(parts):
                frames = [[(frame, read.result()) for frame, read in frames] for frames in ahead]
                ahead = self._read(parts[number + 1], readers) if number + 1 < len(parts) else []
                codes = codes_of(part, pool)
                yield from pool.map(lambda rows: self._block(part, rows, frames, codes[:, rows]), blocks)  # noqa: B023  all are taken before the next

    def _read(self, part: slice, readers: Executor) -> list[list[tuple[LightFrame, Future[Frame]]]]:
        frames = [self.view.by_led[int(led)] for led in self.leds[part]]
        return [[(frame, readers.submit(frame.read)) for frame in mine] for mine in frames]

    def _block(
        self,
        part: slice,
        rows: slice,
        frames: list[list[tuple[LightFrame, Frame]]],
        codes: NDArray[np.uint8],
    ) -> Samples:
        shape = (rows.stop - rows.start, len(frames), self.reader.pixels.shape[1])
        f, u_own = np.full(shape, _NAN, np.uint16), np.full(shape, _NAN, np.uint16)
        centres_mm, normals = self.facets.centres_mm[rows], self.facets.normals[rows]
        led_mm, led_normals = self.measured.leds.of(self.leds[part])
        for number, mine in enumerate(frames):
            read = [self.reader.means(frame, pixels, rows, codes[number]) for frame, pixels in mine]
            exposures_us = [frame.exposure_us for frame, _ in mine]
            signal, u_signal = read[0] if len(read) == 1 else merged(exposures_us, read)
            _reflectance(
                signal, u_signal, centres_mm, normals, led_mm[number], led_normals[number],
                self.measured.power_of(mine[0][0]), self.measured.emission == "paper", codes[number],
                f[:, number], u_own[:, number],
            )  # fmt: skip
        return Samples(part, rows, codes, f.view(np.float16), u_own.view(np.float16))


def merged(
    exposures_us: list[float], read: list[tuple[NDArray[np.float32], NDArray[np.float32]]]
) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """Signal and its relative uncertainty of all exposures under one LED, weighted by their variances; by their
    times where noise is not known."""
    signals = np.stack([signal for signal, _ in read]).astype(np.float64)
    absolute = signals * np.stack([u_signal for _, u_signal in read])
    times = np.array(exposures_us)[:, None, None]
    weights = np.where(np.isnan(absolute).all(), np.broadcast_to(times, signals.shape), absolute**-2.0)
    weights = np.where(np.isfinite(signals) & np.isfinite(weights), weights, 0.0)
    with np.errstate(invalid="ignore", divide="ignore"):
        total = weights.sum(axis=0)
        signal = np.sum(weights * np.nan_to_num(signals), axis=0) / total
        relative = total**-0.5 / signal if np.isfinite(absolute).any() else np.full(signal.shape, np.nan)
    return signal.astype(np.float32), relative.astype(np.float32)


def _half(_context, _number):  # type: ignore[no-untyped-def]
    """The bits of a float16: the nearest to a float32."""

    def generate(_context, builder, _signature, values):  # type: ignore[no-untyped-def]
        return builder.bitcast(builder.fptrunc(values[0], ir.HalfType()), ir.IntType(16))

    return types.uint16(types.float32), generate


_half_bits: Any = intrinsic(_half)


@numba.njit(cache=True, nogil=True)
def _reflectance(  # type: ignore[no-untyped-def]
    signal, u_signal, centres, normals, led_centre, led_normal, power, paper, codes, f, u
):
    """Into `f` and `u` [triangles, channels], bits of float16, where there is a value."""
    towards = np.empty(3)
    for triangle in range(len(signal)):
        if codes[triangle] != REACHED:
            continue
        lit = lit_by(centres[triangle], led_centre, led_normal, paper, towards)
        cosine = 0.0
        for k in range(3):
            cosine += towards[k] * normals[triangle, k]
        by_unit = 1.0 / (lit * cosine)
        for channel in range(signal.shape[1]):
            value = signal[triangle, channel] * by_unit / power[channel] if power[channel] > 0.0 else np.nan
            if abs(value) < MOST_F:
                f[triangle, channel] = _half_bits(np.float32(value))
                u[triangle, channel] = _half_bits(u_signal[triangle, channel])
