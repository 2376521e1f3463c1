"""One view's samples, in batches of LEDs in the order of the frames' file, and in blocks of triangles.

f = S / (P E/Phi cos_i) (Lucat et al. 2025, Eqs. 1 to 3). S is the mean signal of a triangle's pixels, in DN/s over
the flat field, with dark and response removed. It is divided by the irradiance on the triangle from the LED's
power P, in DN/s m^2 sr. The mean over a triangle replaces the paper's prefilter of 0.1 degree, because
neighbouring LEDs are degrees apart.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Generator, Iterable, Iterator
from concurrent.futures import Executor, Future, ThreadPoolExecutor
from contextlib import closing
from dataclasses import dataclass
from functools import cached_property
from itertools import chain

import numpy as np
from numpy.typing import NDArray

from coupole.calibration.light.frames import LightFrame
from coupole.kernels.lanes import LANES
from coupole.reflectance.extraction.frame_ring import FrameRing
from coupole.reflectance.extraction.frame_veils import NO_VEILS, Veils
from coupole.reflectance.extraction.lamp_sight import Facets
from coupole.reflectance.extraction.measured_run import MeasuredRun, MeasuredView
from coupole.reflectance.extraction.radiance import SignalReader
from coupole.reflectance.extraction.sample_codes import AWAY
from coupole.reflectance.extraction.sample_kernel import NO_VALUE, Lamps, Shots, fill_samples
from coupole.reflectance.parts_in_threads import first_alone

BLOCK = 4096
"""Number of triangles in a block."""
_AHEAD = 4
"""Number of blocks of triangles, for each thread, that are being processed or wait until their samples are
taken."""


@dataclass(frozen=True)
class Samples:
    """Samples of some LEDs and triangles of a view."""

    leds: slice
    """Places in the view's LEDs."""
    rows: slice
    """Places of the triangles among the rows of the view's file."""
    codes: NDArray[np.uint8]
    """[triangles, leds]"""
    f: NDArray[np.float16]
    """[triangles, leds, channels] 1/sr; NaN without a sample."""
    u_own: NDArray[np.float16]
    """Relative standard uncertainty from noise."""
    glare: NDArray[np.float16]
    """Subtracted veil divided by the remaining signal; [0, 0, 0] without a record of the glare."""


@dataclass(frozen=True)
class ViewPass:
    """A view's frames and triangles, and the data that belong to both."""

    measured_run: MeasuredRun
    view: MeasuredView
    facets: Facets
    reader: SignalReader

    @cached_property
    def leds(self) -> NDArray[np.int64]:
        return np.array(list(self.view.by_led), np.int64)

    @property
    def together(self) -> int:
        """Number of LEDs whose frames are worked on together."""
        return min(len(self.leds), max(1, LANES // max(map(len, self.view.by_led.values()))))

    def samples(self, codes_of: Callable[[slice, Executor], NDArray[np.uint8]], threads: int) -> Iterator[Samples]:
        """Yield all samples; `codes_of` gives the codes of some LEDs [leds, triangles], with the threads of a
        pool."""
        count = len(self.facets.centres_mm)
        blocks = [slice(first, min(first + BLOCK, count)) for first in range(0, count, BLOCK)]
        batches, block = self.batches(), first_alone(self._block)
        with ThreadPoolExecutor(threads) as pool, closing(batches):
            for part in self.parts:
                codes = codes_of(part, pool)
                shots, lamps = next(batches)
                work = (pool.submit(block, part, rows, shots, lamps, codes[:, rows]) for rows in blocks)
                yield from _in_order(work, _AHEAD * threads)

    @property
    def parts(self) -> list[slice]:
        """Return the places in the view's LEDs whose frames are worked on together, one part after the other."""
        return [slice(n, min(n + self.together, len(self.leds))) for n in range(0, len(self.leds), self.together)]

    def batches(self) -> Generator[tuple[Shots, Lamps]]:
        """Yield frames and LEDs of each of the `parts`; the memory of a batch's frames is reused after it."""
        by_led = list(self.view.by_led.values())
        frames = [list(chain.from_iterable(by_led[part])) for part in self.parts]
        self.reader.prepare(self.view.frames)
        in_order, most = list(chain.from_iterable(frames)), max(map(len, frames))
        with FrameRing(in_order, self.measured_run.frames.size_px, most) as ring:
            for part, part_frames in zip(self.parts, frames, strict=True):
                slots = [ring.take() for _ in part_frames]
                yield self._shots(part_frames, ring.pixels, slots), self._lamps(part)
                ring.give_back(slots)

    def _shots(self, frames: list[LightFrame], pixels: NDArray[np.uint16], slots: list[int]) -> Shots:
        """Return frames of some LEDs in passes. A pass takes, for each LED, one frame with the pass's exposure, if
        there is one."""
        lane_of: dict[int, int] = {}
        passes: dict[tuple[float, int], dict[int, int]] = {}
        for frame, slot in zip(frames, slots, strict=True):
            lane, again = lane_of.setdefault(int(frame.led or 0), len(lane_of)), 0
            while lane in (pass_slots := passes.setdefault((frame.exposure_us, again), {})):
                again += 1
            pass_slots[lane] = slot
        slot_of = np.full((len(passes), LANES), slots[0], np.int64)
        there = np.zeros(slot_of.shape, np.uint8)
        for number, pass_slots in enumerate(passes.values()):
            slot_of[number, list(pass_slots)], there[number, list(pass_slots)] = list(pass_slots.values()), 1
        times_s = np.array([1e-6 * exposure_us for exposure_us, _ in passes], np.float32)
        exposures = np.array([self.reader.exposures[exposure_us] for exposure_us, _ in passes])
        return Shots(pixels, slot_of, there, times_s, exposures, self._veils(frames, pixels, slots))

    def _veils(self, frames: list[LightFrame], pixels: NDArray[np.uint16], slots: list[int]) -> Veils:
        """Return the glare of the LEDs of these frames, one lane for each LED."""
        veils = self.reader.veils
        if veils is None:
            return NO_VEILS
        of_led: dict[int, list[tuple[float, NDArray[np.uint16]]]] = {}
        for frame, slot in zip(frames, slots, strict=True):
            of_led.setdefault(int(frame.led or 0), []).append((frame.exposure_us, pixels[slot]))
        rates = np.zeros((int(np.prod(veils.grid[1:3])) * len(veils.glare.channels), LANES), np.float32)
        with ThreadPoolExecutor() as pool:
            for lane, (led, (veil, u_veil)) in enumerate(
                zip(of_led, pool.map(veils.of_led, of_led.values()), strict=True)
            ):
                rates[:, lane], self.reader.u_glare[led] = veil.ravel(), u_veil
        return Veils(rates, veils.grid)

    def _lamps(self, part: slice) -> Lamps:
        leds = self.leds[part]
        centres_mm, normals = self.measured_run.leds.of(leds)
        powers = np.stack([self.measured_run.power_of(self.view.by_led[int(led)][0]) for led in leds])
        powers = np.where(powers > 0.0, powers, np.nan)

        def across(values: NDArray[np.float64]) -> NDArray[np.float32]:
            """[..., 8]: one lane for each LED; the last LED fills the missing lanes."""
            return np.pad(values.T, ((0, 0), (0, LANES - len(leds))), mode="edge").astype(np.float32, order="C")

        return Lamps(across(centres_mm), across(normals), across(powers), self.measured_run.emission == "paper")

    def _block(self, part: slice, rows: slice, shots: Shots, lamps: Lamps, codes: NDArray[np.uint8]) -> Samples:
        leds = part.stop - part.start
        of_lanes = np.full((rows.stop - rows.start, LANES), AWAY, np.uint8)
        of_lanes[:, :leds] = codes.T
        shape = (len(of_lanes), leds, self.reader.pixels.shape[1])
        f, u_own = np.full(shape, NO_VALUE, np.uint16), np.full(shape, NO_VALUE, np.uint16)
        glare = np.full(shape if len(shots.veils.rates) else (0, 0, 0), NO_VALUE, np.uint16)
        fill_samples(
            rows.start, self.reader.lists, self.reader.response, self.reader.darks, shots, lamps,
            self.facets.centres_mm[rows], self.facets.normals[rows], of_lanes, f, u_own, glare,
        )  # fmt: skip
        halves = (values.view(np.float16) for values in (f, u_own, glare))
        return Samples(part, rows, of_lanes[:, :leds], *halves)


def _in_order(work: Iterable[Future[Samples]], most: int) -> Iterator[Samples]:
    """Yield the results of the work in its order. At most `most` pieces at a time are in work or wait until they
    are taken."""
    futures: deque[Future[Samples]] = deque()
    for future in work:
        futures.append(future)
        if len(futures) == most:
            yield futures.popleft().result()
    while futures:
        yield futures.popleft().result()
