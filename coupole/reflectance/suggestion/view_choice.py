"""Chooses views one after the other. Each is the view that reduces the uncertainty most, given the views before
it.

The measure is the mean over the surface of half the logarithm of the covariance's determinant (D-optimality). The
information from a further view of a part becomes less with each view that the part has. So a choice of one view at
a time is near the best choice (Nemhauser et al. 1978 for functions of this kind; here it is a rule, no proof).
"""

from __future__ import annotations

from collections.abc import Sequence
from copy import deepcopy
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from coupole.reflectance.suggestion.view_information import Information, ViewInformation

ENOUGH = 0.1
"""Gain of a further view, for the five unknowns together, below which no view is added: 2 % of each."""


@dataclass(frozen=True)
class ViewChoice:
    """Chosen views, the most valuable one first."""

    views: tuple[int, ...]
    """Numbers of the candidates."""
    value: float
    """Gain of all views together: the mean over materials and parts."""


def choose_views(
    candidates: Sequence[Sequence[ViewInformation]],
    number: int,
    priors: Sequence[Information],
    weights: NDArray[np.float64],
    most: int,
) -> ViewChoice:
    """Choose at most `most` of the candidates by their information for each supposed material. `number` is the
    index of the number of LEDs. `weights` [n] are the weights of the parts."""
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
