"""The lights that add the most information to the lights taken so far, judged by the pictures under these.

Pictures between lights are interpolated from the pictures taken, by radial basis functions with a linear tail
(Lucat et al. 2025, 5.2). Each light taken is left out in turn and predicted from the others; Rippa (1999) gives
all these errors from one inverse. A large error shows that a highlight or an edge of shadow passes over the
object. So the errors of pictures are modelled over the directions of light as a random field of exponential
covariance. Its strength in each direction follows the errors found near this direction. The next light is the one
with the largest expected error of its picture (MacKay 1992). It counts as taken while the next one is chosen. So
do lights whose pictures are still to come.

Nothing is drawn at random, so a resumed run chooses the same lights.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import islice

import numpy as np
from numpy.typing import NDArray

from coupole.geometry import farthest_first

Floats = NDArray[np.float64]

FEWEST_TAKEN = 6
"""Fewest lights for which the errors of left-out lights are meaningful, because the linear tail alone has four
unknowns.
"""
_RANGE_RAD = np.radians(60.0)
"""Angle over which errors are similar. An angle of 25 degrees gives about the same choices."""
_NUGGET = 1e-6
_LEAST_SPACING_RAD = 1e-3
_LEAST_SHARE = 1e-6
"""Least error of a light, as a share of the largest error, because no light is known exactly."""
_ALTERNATIVES = 3
_BRIGHT_QUANTILE = 0.999


@dataclass(frozen=True)
class NextLights:
    """The choice after some lights."""

    lights: NDArray[np.int64]
    """Indices of the next lights. The light that adds most is first."""
    expected_rms: float
    """Expected root mean square error of pictures that are interpolated for the lights not yet taken. It is a
    share of the bright level of the values (their 99.9 % quantile)."""
    expected_rms_after: float
    """The same error after the next lights are taken."""
    alternatives: tuple[int, ...]
    """Indices of the lights that were rated next after the first."""


def spread_lights(directions: Floats, allowed_lights: NDArray[np.int64], count: int) -> NDArray[np.int64]:
    """Return indices of the first `count` lights among `allowed_lights`. The first is nearest to their middle;
    each further light is as far as possible from the positions before it. `directions` [n, 3] are unit vectors."""
    candidates = directions[allowed_lights]
    middle = int(np.argmax(candidates @ candidates.mean(axis=0)))
    return allowed_lights[[row for row, _ in islice(farthest_first(candidates, middle), count)]]


def left_out_squares(values: Floats, directions: Floats) -> Floats:
    """Return [n] mean squared errors of each light's picture, predicted from the others. `values` [n, sites] are
    the values under lights from `directions` [n, 3]."""
    count = len(directions)
    tail = np.hstack([np.ones((count, 1)), directions])
    apart = np.sqrt(np.maximum(2.0 - 2.0 * directions @ directions.T, 0.0))
    # the small terms let lights stand twice in a direction, or all in one plane
    system = np.block([[_NUGGET * np.eye(count) - apart, tail], [tail.T, -_NUGGET * np.eye(4)]])
    inverse = np.linalg.inv(system)[:count, :count]
    own_terms = np.diag(inverse)
    is_fixed = np.abs(own_terms) < 1e-9 * np.abs(own_terms).max()  # a light that the others do not predict at all
    errors = inverse @ values / np.where(is_fixed, np.inf, own_terms)[:, None]
    squares: Floats = np.mean(errors**2, axis=1)
    squares[is_fixed] = np.mean(values[is_fixed] ** 2, axis=1)
    return squares


def next_lights(
    values: Floats,
    directions: Floats,
    taken_lights: NDArray[np.int64],
    allowed_lights: NDArray[np.int64],
    count: int,
    *,
    coming_lights: NDArray[np.int64] | tuple[()] = (),
) -> NextLights:
    """Return the next `count` lights among `allowed_lights`, or fewer if there are no more.

    `values` [taken, sites] are the values under `taken_lights`, in their order, at places all over the picture.
    `directions` [n, 3] are unit vectors to all lights. A picture is wanted for each of `allowed_lights`.
    `coming_lights` are being taken just now: their values are not known, but they are not wanted again. Expected
    errors count them as taken. Raises ValueError for fewer than `FEWEST_TAKEN` lights that were taken.
    """
    if len(taken_lights) < FEWEST_TAKEN:
        raise ValueError(f"expected at least {FEWEST_TAKEN} lights that were taken, got {len(taken_lights)}")
    coming = np.asarray(coming_lights, np.int64)
    wanted_lights = np.union1d(allowed_lights, np.union1d(taken_lights, coming))
    errors = _Errors(
        _error_covariance(values, directions[wanted_lights], np.searchsorted(wanted_lights, taken_lights))
    )
    is_candidate = np.isin(wanted_lights, allowed_lights) & ~np.isin(wanted_lights, taken_lights)
    for light in np.searchsorted(wanted_lights, coming).tolist():
        errors.take(light)
        is_candidate[light] = False
    bright = float(np.quantile(values, _BRIGHT_QUANTILE)) or 1.0
    rms = errors.rms(is_candidate)
    chosen_rows: list[int] = []
    alternatives: tuple[int, ...] = ()
    for _ in range(min(count, int(np.count_nonzero(is_candidate)))):
        variances = np.where(is_candidate, errors.variances, -1.0)
        order = np.argsort(-variances, kind="stable")
        if not chosen_rows:
            other_lights = [light for light in order[1 : 1 + _ALTERNATIVES] if variances[light] >= 0.0]
            alternatives = tuple(int(wanted_lights[light]) for light in other_lights)
        best = int(order[0])
        chosen_rows.append(best)
        is_candidate[best] = False
        errors.take(best)
    rms_after = errors.rms(is_candidate)
    return NextLights(wanted_lights[chosen_rows], rms / bright, rms_after / bright, alternatives)


class _Errors:
    """Expected errors of pictures, while one light after the other counts as taken: a Cholesky factor of the
    covariance, of which only the columns of these lights are made."""

    def __init__(self, covariance: Floats) -> None:
        """`covariance` [n, n] is the covariance of the errors before any light is taken."""
        self._covariance = covariance
        self._columns: list[Floats] = []
        self.variances: Floats = np.diag(covariance).copy()
        """[n] variances of the errors."""

    def take(self, light: int) -> None:
        """Count a light as taken."""
        column = self._covariance[:, light].copy()
        for earlier in self._columns:
            column -= earlier * earlier[light]
        column /= np.sqrt(max(float(column[light]), 1e-300))
        self._columns.append(column)
        self.variances -= column**2

    def rms(self, is_wanted: NDArray[np.bool_]) -> float:
        """Return the expected root mean square error of the wanted lights' pictures; 0 if there are none."""
        variances = self.variances[is_wanted]
        return float(np.sqrt(max(float(variances.mean()), 0.0))) if len(variances) else 0.0


def _error_covariance(values: Floats, directions: Floats, taken_lights: NDArray[np.int64]) -> Floats:
    """Return the covariance [n, n] of the errors of pictures, given the pictures that were taken."""
    angle = np.arccos(np.clip(directions @ directions.T, -1.0, 1.0))
    plain = np.exp(-angle / _RANGE_RAD)
    among_taken = np.linalg.inv(plain[np.ix_(taken_lights, taken_lights)] + _NUGGET * np.eye(len(taken_lights)))
    left_out_variance = 1.0 / np.diag(among_taken)  # of the unit field, each given the others
    strength = left_out_squares(values, directions[taken_lights]) / left_out_variance
    strength = np.maximum(strength, _LEAST_SHARE * strength.max() + 1e-300)
    between = angle[np.ix_(taken_lights, taken_lights)] + np.pi * np.eye(len(taken_lights))
    spacing = max(float(between.min(axis=1).mean()), _LEAST_SPACING_RAD)
    weights = np.exp(-0.5 * (angle[:, taken_lights] / spacing) ** 2) + 1e-12
    local = np.exp(0.5 * (weights @ np.log(strength)) / weights.sum(axis=1))
    covariance: Floats = plain * np.outer(local, local)
    taken_covariance = covariance[np.ix_(taken_lights, taken_lights)] + _NUGGET * np.diag(local[taken_lights] ** 2)
    return covariance - covariance[:, taken_lights] @ np.linalg.solve(taken_covariance, covariance[taken_lights])
