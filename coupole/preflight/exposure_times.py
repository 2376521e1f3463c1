"""The exposure times of a view, and which of them each LED gets, so that all limits are met in the least time."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import combinations, pairwise

import numpy as np
from numpy.typing import NDArray

Integers = NDArray[np.int64]

_TIMES_OF_A_VIEW = 3
_STEP_S = 1.0
"""Time that one step of one LED beyond its limits is worth."""
_CLIPPED_OVER_NOISE = 4.0


@dataclass(frozen=True)
class LightLimits:
    """Limits of the exposure of some LEDs, in places among the plan's exposures."""

    longest: Integers
    """[n] last place at which not too much is clipped; -1: none."""
    shortest: Integers
    """[n] first place at which the ratio is reached; the last of all if none."""


def chosen_times(
    limits: LightLimits, periods_s: Sequence[float], *, range_steps: int, most: int, burst_s: float
) -> list[tuple[int, ...]]:
    """[n] places of the exposures of each LED: at most three for the view, `most` for an LED, such that all LEDs
    together take least time; of times that cost the same, the shortest, which give the least light. Two exposures
    of an LED are at most `range_steps` apart. A step takes `periods_s` [places], a burst `burst_s` beside its
    steps."""
    pairs, group_of = np.unique(np.stack([limits.longest, limits.shortest], axis=1), axis=0, return_inverse=True)
    counts = np.bincount(group_of.ravel(), minlength=len(pairs)).astype(np.float64)
    ends = max(0, int(limits.longest.min())), int(limits.shortest.max())
    places = range(min(ends), max(ends) + 1)
    subsets = [
        subset for size in range(1, min(_TIMES_OF_A_VIEW, most) + 1) for subset in combinations(places, size)
    ]
    costs = np.stack([_cost_s(subset, pairs, np.array(periods_s), range_steps) for subset in subsets])
    number_of = {subset: number for number, subset in enumerate(subsets)}
    best_s, best = np.inf, subsets[0]
    for times in (t for size in range(1, _TIMES_OF_A_VIEW + 1) for t in combinations(places, size)):
        within = [number_of[part] for part in _parts(times, most)]
        total_s = float(costs[within].min(axis=0) @ counts) + burst_s * len(times)
        if total_s < best_s - 1e-9:
            best_s, best = total_s, times
    parts = _parts(best, most)
    of_group = costs[[number_of[part] for part in parts]].argmin(axis=0)
    return [parts[of_group[group]] for group in group_of.ravel()]


def _parts(times: tuple[int, ...], most: int) -> list[tuple[int, ...]]:
    return [part for size in range(1, min(len(times), most) + 1) for part in combinations(times, size)]


def _cost_s(
    subset: tuple[int, ...], pairs: Integers, periods_s: NDArray[np.float64], range_steps: int
) -> NDArray[np.float64]:
    """[groups] time of these exposures of one LED, and what they are beyond its limits worth."""
    too_long = np.maximum(subset[0] - pairs[:, 0], 0) * _CLIPPED_OVER_NOISE
    too_short = np.maximum(pairs[:, 1] - subset[-1], 0)
    gaps = sum(max(longer - shorter - range_steps, 0) for shorter, longer in pairwise(subset))
    beyond = too_long + too_short + gaps
    return np.asarray(periods_s[list(subset)].sum() + _STEP_S * beyond)
