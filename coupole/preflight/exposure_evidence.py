"""The exposures that the LEDs of a view need, by its proven frames."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from coupole.plan.choices import FrameSample
from coupole.plan.plan import STEPS_PER_STOP, AutoExposure
from coupole.plan.shot_id import Led, ShotLabel
from coupole.preflight.exposure_advice import Noise, noise_of_pairs

Floats = NDArray[np.float32]
Booleans = NDArray[np.bool_]

FULL = 0.95
"""Share of the range above black that counts as full, so that noise does not reach saturation."""
_LIT = 0.1
"""A pixel is lit by an LED where its rate is at least so much of its reference."""
_REFERENCE_QUANTILE = 0.75
_SEEN_SIGMA = 4.0
_LEAST_DN = 1.0
"""Signal that the object has at least: black is not known better."""
_CLIPPED_FACTOR = 4.0
"""Brightness, over that which fills the range, of pixels that clip in all exposures: a guess."""


@dataclass(frozen=True)
class Merged:
    """The frames of one LED together, pixel by pixel of the samples; clipped ones do not count."""

    rate: Floats
    """[n] signal, DN per us, weighted by the inverse of its variance; infinite where all frames clip."""
    snr: Floats
    """[n] signal over noise; 0 where all frames clip."""


@dataclass(frozen=True)
class Judgement:
    """An LED's frames beside what the plan asks for."""

    clipped_share: float
    """Share of all pixels that clip in the shortest of its frames."""
    reached_share: float
    """Share of the object's pixels in its light that reach the ratio; 1 if it lights none."""
    full_rate: float
    """Rate that all but the allowed share of pixels stay below, DN per us."""
    dim_rate: float
    """Rate that all but the rest of the object's share of lit pixels exceed, DN per us; 0 if it lights none."""
    snr_of_dim: float
    """Ratio that all but the rest of the object's share of lit pixels exceed."""


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
        """The top of the range above black; 1 if nothing is proven."""
        return next((self._samples[label].full_dn for label in self._samples), 1)

    @cached_property
    def noise(self) -> Noise:
        """The noise of frames that were taken twice."""
        pairs = []
        for label in self._samples:
            first = ShotLabel(label.light, label.exposure)
            if label.repeat == 1 and first in self._samples:
                a, b = self._samples[first], self._samples[label]
                pairs.append((a.signal_dn.astype(np.int32), b.signal_dn.astype(np.int32), a.full_dn))
        return noise_of_pairs(pairs)

    @property
    def range_steps(self) -> int:
        """Steps between two exposures at which the longer one's clipped pixels just reach the ratio in the
        shorter."""
        stops = math.log2(max(FULL * self.full_dn / self.noise.signal_for(self._exposure.snr), 1.0))
        return max(1, math.floor(STEPS_PER_STOP * stops))

    def merge(self, led: int) -> Merged:
        """An LED's frames together. Raises KeyError if none is proven."""
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
        """[n] rate over the illuminance that a pixel has under the first LEDs, at their upper quartile; and where
        the object is seen."""
        rates = np.stack([self.merge(led).rate / np.float32(self._lux_of_led[led]) for led in self.first_leds])
        place = math.floor(_REFERENCE_QUANTILE * (len(rates) - 1))
        reference = np.partition(rates, place, axis=0)[place]
        time_us = min(self.times_us[self.taken[led][-1]] for led in self.first_leds)
        least_dn = max(_SEEN_SIGMA * self.noise.read_dn / math.sqrt(len(rates)), _LEAST_DN)
        bright = np.minimum(rates, np.float32(self.full_dn / self.times_us[0])).mean(axis=0)
        return reference, bright * time_us > least_dn

    def judge(self, led: int) -> Judgement:
        """Compare an LED's frames with what the plan asks for. Raises KeyError if none is proven."""
        frames, exposure = self.merge(led), self._exposure
        reference, is_object = self.reference
        is_lit = is_object & (frames.rate >= _LIT * self._lux_of_led[led] * reference)
        shortest = self.taken[led][0]
        full_rate = _upper(frames.rate, exposure.clipped_share)
        if not math.isfinite(full_rate):
            full_rate = _CLIPPED_FACTOR * self.full_dn / self.times_us[shortest]
        clipped_share = self.sample(led, shortest).clipped_share
        if not is_lit.any():
            return Judgement(clipped_share, 1.0, full_rate, 0.0, math.inf)
        snr, rate = frames.snr[is_lit], frames.rate[is_lit]
        reached_share = float(np.mean(snr >= exposure.snr))
        return Judgement(
            clipped_share, reached_share, full_rate, _upper(rate, exposure.object_share), _dim(snr, exposure)
        )


def _dim(snr: Floats, exposure: AutoExposure) -> float:
    """The ratio of the dim pixels; pixels that clip have none and are not dim."""
    exposed_snr = snr[snr > 0.0]
    return _upper(exposed_snr, exposure.object_share) if len(exposed_snr) else math.inf


def _upper(values: Floats, share: float) -> float:
    """The value that a share of the values exceeds."""
    place = min(max(len(values) - 1 - math.floor(share * len(values)), 0), len(values) - 1)
    return float(np.partition(values, place)[place])
