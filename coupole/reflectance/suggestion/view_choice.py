"""Chooses views one after the other, each the one that takes most uncertainty away beside those before it.

The measure is the mean over the surface of half the logarithm of the covariance's determinant (D-optimality): what
a further view tells of a part becomes less with each view that the part has, so that the choice by turns is near
the best one (Nemhauser et al. 1978 for functions of this kind; here it is a rule, no proof).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from coupole.reflectance.suggestion.expected_uncertainty import Information, covariance_of

Floats = NDArray[np.float64]

ENOUGH = 0.1
"""Gain of a further view, for the five unknowns together, below which none is added: 2 % of each."""


@dataclass(frozen=True)
class ViewChoice:
    """Chosen views, in the order of their worth."""

    views: tuple[int, ...]
    """Numbers of the candidates."""
    value: float
    """Mean over materials and parts, less that without any view."""


def choose_views(
    candidates: Sequence[Sequence[Information]],
    priors: Sequence[Information],
    weights: Floats,
    most: int,
) -> ViewChoice:
    """Choose at most `most` of the candidates; each has its information for each supposed material, of one number
    of LEDs. `weights` [n] are those of the parts."""
    so_far, chosen_views = list(priors), list[int]()
    value = begin = _value(so_far, weights)
    while len(chosen_views) < min(most, len(candidates)):
        trials = {
            number: _value(
                [of_material + of_view for of_material, of_view in zip(so_far, candidate, strict=True)], weights
            )
            for number, candidate in enumerate(candidates)
            if number not in chosen_views
        }
        best = max(trials, key=lambda number: trials[number])
        if trials[best] - value < ENOUGH:
            break
        chosen_views.append(best)
        value = trials[best]
        so_far = [of_material + of_view for of_material, of_view in zip(so_far, candidates[best], strict=True)]
    return ViewChoice(tuple(chosen_views), value - begin)


def _value(materials: Sequence[Information], weights: Floats) -> float:
    logarithms = [
        np.linalg.slogdet(covariance_of(information)[0])[1] @ weights / weights.sum() for information in materials
    ]
    return -0.5 * float(np.mean(logarithms))
