"""Chooses the exposure times of a view, and the times of each LED, so that all limits are met in the least
time."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import combinations

import numpy as np
from numpy.typing import NDArray

Integers = NDArray[np.int64]
Floats = NDArray[np.float32]

_TIMES_OF_A_VIEW = 3
_CLIPPED_STEP_S = 4.0
"""Penalty, as a time, for each step by which an LED's shortest exposure is above its longest allowed one."""
_NOISY_S, _NOISY_SHARE_S = 0.3, 5.0
"""Penalties, as times: for an LED that is noisier than required, and for an LED whose whole share of pixels is
missing."""
_SUBSETS_AT_ONCE = 256


@dataclass(frozen=True)
class LightLimits:
    """Groups of LEDs that need the same exposures. Exposures are places among the plan's exposures."""

    longest: Integers
    """[groups] last place at which few enough pixels are clipped; -1: none."""
    rates: Floats
    """[groups, quantiles] rates of the object's pixels in their light, DN per us."""
    counts: Integers
    """[groups] number of LEDs."""


@dataclass(frozen=True)
class Wish:
    """Required noise, and the cost of exposures."""

    precisions: Floats
    """[places, groups, quantiles] inverse variances of the rates in one frame; 0 where it clips."""
    snr: float
    share: float
    """Share of the pixels that must reach the ratio."""
    most: int
    """Largest number of exposures of one LED."""
    step_s: NDArray[np.float64]
    """[places] time of a step."""
    burst_s: NDArray[np.float64]
    """[places] time of a burst in addition to the steps of its LEDs."""


def chosen_times(limits: LightLimits, wish: Wish) -> list[tuple[int, ...]]:
    """Return [groups] places of the exposures of each LED. The view has at most three exposures, chosen so that
    all LEDs together take the least time. If several choices cost the same, the shortest exposures are used, which
    give the least light."""
    first = max(0, int(limits.longest.min()))
    places = range(first, len(wish.step_s))
    sizes = range(1, _TIMES_OF_A_VIEW + 1)
    subsets = [subset for size in sizes for subset in combinations(places, size)]
    costs_s = _costs_s([subset for subset in subsets if len(subset) <= wish.most], limits, wish)
    number_of = {subset: number for number, subset in enumerate(subsets)}
    parts_of = [[number_of[part] for part in _parts(times, wish.most)] for times in subsets]
    totals_s = [
        float(costs_s[parts].min(axis=0) @ limits.counts) + float(wish.burst_s[list(times)].sum())
        for times, parts in zip(subsets, parts_of, strict=True)
    ]
    best = parts_of[int(np.argmin(np.round(totals_s, 6)))]
    return [subsets[best[part]] for part in costs_s[best].argmin(axis=0)]


def _parts(times: tuple[int, ...], most: int) -> list[tuple[int, ...]]:
    return [part for size in range(1, min(len(times), most) + 1) for part in combinations(times, size)]


def _costs_s(subsets: Sequence[tuple[int, ...]], limits: LightLimits, wish: Wish) -> NDArray[np.float64]:
    """Return [subsets, groups], the time of these exposures of one LED, with penalties for limits that they
    miss."""
    square = (limits.rates / np.float32(wish.snr)) ** 2
    reached_shares = np.empty((len(subsets), len(limits.longest)))
    for begin in range(0, len(subsets), _SUBSETS_AT_ONCE):
        some = subsets[begin : begin + _SUBSETS_AT_ONCE]
        precision = np.stack([wish.precisions[list(subset)].sum(axis=0) for subset in some])
        reached_shares[begin : begin + len(some)] = (precision * square >= 1.0).mean(axis=2)
    lack = np.maximum(wish.share - reached_shares, 0.0)
    shortest = np.array([subset[0] for subset in subsets])
    too_long = np.maximum(shortest[:, None] - limits.longest, 0) * _CLIPPED_STEP_S
    steps_s = np.array([wish.step_s[list(subset)].sum() for subset in subsets])
    return np.asarray(steps_s[:, None] + too_long + np.where(lack > 0.0, _NOISY_S, 0.0) + _NOISY_SHARE_S * lack)
