"""Chooses views one after the other, each the one that takes most uncertainty away beside those before it.

The measure is the mean over the surface of half the logarithm of the covariance's determinant (D-optimality): what
a further view tells of a part becomes less with each view that the part has, so that the choice by turns is near
the best one (Nemhauser et al. 1978 for functions of this kind; here it is a rule, no proof).
"""

from __future__ import annotations

from collections.abc import Sequence
from copy import deepcopy
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from coupole.reflectance.suggestion.view_information import Information, ViewInformation

ENOUGH = 0.1
"""Gain of a further view, for the five unknowns together, below which none is added: 2 % of each."""


@dataclass(frozen=True)
class ViewChoice:
    """Chosen views, in the order of their worth."""

    views: tuple[int, ...]
    """Numbers of the candidates."""
    value: float
    """Gain of all of them together, the mean over materials and parts."""


def choose_views(
    candidates: Sequence[Sequence[ViewInformation]],
    number: int,
    priors: Sequence[Information],
    weights: NDArray[np.float64],
    most: int,
) -> ViewChoice:
    """Choose at most `most` of the candidates, each of which has its information for each supposed material, with
    one `number` of their numbers of LEDs. `weights` [n] are those of the parts."""
    so_far, shares = deepcopy(list(priors)), weights / weights.sum()
    chosen_views, value = list[int](), 0.0

    def gain_of(candidate: Sequence[ViewInformation]) -> float:
        gains = [
            known.gains(view, number) @ shares[view.parts] for known, view in zip(so_far, candidate, strict=True)
        ]
        return float(np.mean(gains))

    while len(chosen_views) < min(most, len(candidates)):
        trials = {
            place: gain_of(candidate) for place, candidate in enumerate(candidates) if place not in chosen_views
        }
        best = max(trials, key=lambda place: trials[place])
        if trials[best] < ENOUGH:
            break
        chosen_views.append(best)
        value += trials[best]
        for known, view in zip(so_far, candidates[best], strict=True):
            known.add(view, number)
    return ViewChoice(tuple(chosen_views), value)
