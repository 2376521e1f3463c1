"""The exposures that the LEDs of a view need, as its proven frames show."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from coupole.plan.choices import FrameSample
from coupole.plan.exposures import AutoExposure
from coupole.plan.shot_id import Led, ShotLabel
from coupole.preflight.exposure_advice import Noise, noise_of_pairs

Floats = NDArray[np.float32]
Booleans = NDArray[np.bool_]

FULL = 0.95
"""Share of the range above black that counts as full. It is below 1, so that noise does not reach saturation."""
QUANTILES = 48
"""Number of signal rates that represent the rates of all pixels in an LED's light."""
_JUDGED_MARGIN, _HELP_MARGIN = 1.03, 1.05
"""Factors by which the required ratio is multiplied when frames are judged, because a pixel's ratio is computed
from noisy pixels.
"""
_SOME_PIXELS = 1000
_LIT = 0.1
"""A pixel is lit by an LED if its rate is at least this share of its reference."""
_REFERENCE_QUANTILE = 0.75
_SEEN_SIGMA = 4.0
_LEAST_DN = 1.0
"""Least signal of the object. The black level is not known more exactly."""
_CLIPPED_FACTOR = 4.0
"""Assumed brightness of pixels that clip in all exposures, relative to the brightness that fills the range."""


@dataclass(frozen=True)
class Merged:
    """The frames of one LED, combined for each pixel of the samples. Clipped pixels do not count."""

    rate: Floats
    """[n] signal, DN per us, weighted by the inverse of its variance; it is infinite where all frames clip."""
    snr: Floats
    """[n] signal over noise; 0 where all frames clip."""


@dataclass(frozen=True)
class Judgement:
    """An LED's frames compared with the plan's demands."""

    clipped_share: float
    """Share of all pixels that clip in the shortest of its frames."""
    reached_share: float
    """Share of the object's pixels in its light that reach the ratio; 1 if it lights none."""
    full_rate: float
    """Signal rate that only the allowed share of the pixels exceeds, DN per us."""
    lit_rates: Floats
    """[quantiles] rates of the object's pixels in its light, DN per us, rising; empty if it lights none."""


class Evidence:
    """Frames of one view that are proven so far. `lux` [leds of the view] may have any scale."""

    def __init__(
        self,
        exposure: AutoExposure,
        lux_of_led: Mapping[int, float],
        first_leds: tuple[int, ...],
        samples: Mapping[ShotLabel, FrameSample],
    ) -> None:
        self.times_us = np.array(exposure.exposures_us, np.float64)
        self._exposure, self._lux_of_led, self._samples = exposure, lux_of_led, samples
        self.taken: dict[int, list[int]] = {}
        """Places of the exposures of each LED that are proven, shortest first."""
        for label in samples:
            if isinstance(label.light, Led) and label.repeat == 0:
                self.taken.setdefault(label.light.id, []).append(label.exposure)
        for places in self.taken.values():
            places.sort()
        self.first_leds = tuple(led for led in first_leds if led in self.taken)

    def sample(self, led: int, place: int) -> FrameSample:
        return self._samples[ShotLabel(Led(led), place)]

    @cached_property
    def full_dn(self) -> int:
        """Top of the range above black; 1 if nothing is proven."""
        return next((self._samples[label].full_dn for label in self._samples), 1)

    @cached_property
    def noise(self) -> Noise:
        """Noise, from frames that were taken twice."""
        pairs = []
        for label in self._samples:
            first = ShotLabel(label.light, label.exposure)
            if label.repeat == 1 and first in self._samples:
                a, b = self._samples[first], self._samples[label]
                pairs.append((a.signal_dn.astype(np.int32), b.signal_dn.astype(np.int32), a.full_dn))
        return noise_of_pairs(pairs)

    def merge(self, led: int) -> Merged:
        """Return an LED's frames together. Raises KeyError if none is proven."""
        noise, shape = self.noise, self.sample(led, self.taken[led][0]).signal_dn.shape
        total, weights = np.zeros(shape, np.float32), np.zeros(shape, np.float32)
        for place in self.taken[led]:
            sample, time_us = self.sample(led, place), np.float32(self.times_us[place])
            signal = sample.signal_dn.astype(np.float32)
            variance = np.float32(noise.read_dn**2) + np.float32(noise.gain_dn) * np.maximum(
                signal, np.float32(0.0)
            )
            weight = np.where(signal < sample.full_dn, time_us * time_us / variance, np.float32(0.0))
            total, weights = total + weight * signal / time_us, weights + weight
        with np.errstate(divide="ignore", invalid="ignore"):
            rate = np.where(weights > 0.0, total / weights, np.float32(np.inf)).astype(np.float32)
            snr = np.where(weights > 0.0, rate * np.sqrt(weights), np.float32(0.0)).astype(np.float32)
        return Merged(rate, snr)

    @cached_property
    def reference(self) -> tuple[Floats, Booleans]:
        """Return the upper quartile [n] of a pixel's rate divided by the illuminance, under the first LEDs, and
        the mask [n] of pixels that show the object."""
        rates = np.stack([self.merge(led).rate / np.float32(self._lux_of_led[led]) for led in self.first_leds])
        place = math.floor(_REFERENCE_QUANTILE * (len(rates) - 1))
        reference = np.partition(rates, place, axis=0)[place]
        time_us = min(self.times_us[self.taken[led][-1]] for led in self.first_leds)
        least_dn = max(_SEEN_SIGMA * self.noise.read_dn / math.sqrt(len(rates)), _LEAST_DN)
        bright = np.minimum(rates, np.float32(self.full_dn / self.times_us[0])).mean(axis=0)
        return reference, bright * time_us > least_dn

    def judge(self, led: int) -> Judgement:
        """Compare an LED's frames with the plan's demands. Raises KeyError if none is proven."""
        frames, exposure = self.merge(led), self._exposure
        is_lit = self._is_lit(led, frames)
        shortest = self.taken[led][0]
        full_rate = _upper(frames.rate, exposure.clipped_share)
        if not math.isfinite(full_rate):
            full_rate = _CLIPPED_FACTOR * self.full_dn / self.times_us[shortest]
        clipped_share = self.sample(led, shortest).clipped_share
        if not is_lit.any():
            return Judgement(clipped_share, 1.0, full_rate, np.zeros(0, np.float32))
        rates = np.minimum(frames.rate[is_lit], np.float32(self.full_dn / self.times_us[shortest]))
        places = np.linspace(0, len(rates) - 1, QUANTILES).round().astype(np.int64)
        reached_share = float(np.mean(frames.snr[is_lit] >= _JUDGED_MARGIN * exposure.snr))
        return Judgement(clipped_share, reached_share, full_rate, np.sort(rates)[places])

    def place_that_helps(self, led: int) -> int | None:
        """Return the first exposure that an LED does not have yet and that lets enough of its pixels reach the
        ratio. If no exposure is enough, return the last one that the LED does not have; None if the LED has all
        exposures."""
        frames, exposure = self.merge(led), self._exposure
        lit_pixels = np.flatnonzero(self._is_lit(led, frames))
        some_pixels = lit_pixels[:: max(1, len(lit_pixels) // _SOME_PIXELS)]
        pixels = some_pixels[np.isfinite(frames.rate[some_pixels])]
        rate, precision = frames.rate[pixels], (frames.snr[pixels] / np.maximum(frames.rate[pixels], 1e-12)) ** 2
        other_places = [place for place in range(len(self.times_us)) if place not in self.taken[led]]
        precisions = self.precisions(rate)
        for place in other_places:
            snr = rate * np.sqrt(precision + precisions[place])
            if np.sum(snr >= _HELP_MARGIN * exposure.snr) >= exposure.object_share * len(some_pixels):
                return place
        return other_places[-1] if other_places else None

    def precisions(self, rates: Floats) -> Floats:
        """Return [places, ...] inverse variances of `rates` [...] in one frame of each exposure; 0 where the frame
        clips."""
        times_us = self.times_us.astype(np.float32).reshape(-1, *(1,) * rates.ndim)
        signal = rates * times_us
        variance = self.noise.read_dn**2 + self.noise.gain_dn * np.maximum(signal, 0.0)
        precisions: Floats = np.where(signal < FULL * self.full_dn, times_us**2 / variance, 0.0).astype(np.float32)
        return precisions

    def _is_lit(self, led: int, frames: Merged) -> Booleans:
        reference, is_object = self.reference
        return is_object & (frames.rate >= _LIT * self._lux_of_led[led] * reference)


def _upper(values: Floats, share: float) -> float:
    """Return the value that this share of the values exceeds."""
    place = min(max(len(values) - 1 - math.floor(share * len(values)), 0), len(values) - 1)
    return float(np.partition(values, place)[place])
