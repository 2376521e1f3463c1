"""The order of views and their postures with the least total time.

Order and choice of postures are one problem: a travelling salesman visits one place of each group (a generalised
TSP; Noon, Bean 1993), on an open tour from the arm's posture. The true time of a leg is expensive to compute. The
time of the straight motion is cheap and a lower bound. So a tour is optimised with the times of straight motions.
Then its legs are checked, blocked legs are planned, and their true times replace the straight ones. This is
repeated until the best tour consists of known legs.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import Any

import numpy as np
from numpy.typing import NDArray

from coupole.motion.path_planner import Joints, Leg, PathPlanner

Floats = NDArray[np.float64]

_RESTARTS, _ROUNDS = 3, 200
_CHANGES_PER_PLACE, _MOST_CHANGES = 2_000, 600_000
_AGAIN = 0.03
"""Share of the changes, and of the first temperature, when a tour is optimised again after some legs have become
known."""
_COLDEST_S = 1e-3
_DETOUR_S = 0.5
"""Typical least cost of a detour, which is one more stop. It is added to a blocked leg until its true time is
known."""


@dataclass(frozen=True)
class Tour:
    """Groups in the order of the visits, the chosen place in each group, and the leg to it."""

    order: tuple[int, ...]
    places: tuple[Joints, ...]
    legs: tuple[Leg, ...]


@dataclass(frozen=True)
class _Groups:
    """Places as numbers: 0 is the start, the places of group g are `first[g]` to `first[g + 1] - 1`."""

    places: Floats
    first: NDArray[np.int64]
    posture_cost_s: Floats
    """[places] cost added to the time of a tour that uses a place."""


def shortest_tour(
    planner: PathPlanner,
    start: Joints,
    choices: Sequence[NDArray[np.float64]],
    posture_cost_s: Sequence[Floats],
    *,
    as_written: bool = False,
) -> Tour:
    """Return one place of each group (`choices` [k, 6] each) and the legs between them, with the least total time
    from `start`.

    `posture_cost_s` [k] of each group is added to the times of its places. So the tour with better postures is
    chosen among nearly equal tours. With `as_written` the order of the groups is kept. The same arguments give the
    same tour.
    """
    if not choices:
        return Tour((), (), ())
    groups = _Groups(
        np.concatenate([start[None], *choices]),
        np.cumsum([1, *(len(c) for c in choices)]),
        np.concatenate([[0.0], *posture_cost_s]),
    )
    times = _Times(planner, groups.places)
    order = np.arange(len(choices))
    best, best_s = (order, order), np.inf
    for seed in range(1 if as_written else _RESTARTS):
        order, place_indices = _settled_order(times, groups, order, seed, as_written=as_written)
        total_s = _way_s(times.seconds, groups, place_indices)
        if total_s < best_s:
            best, best_s = (order, place_indices), total_s
    order, place_indices = best
    places = [start, *groups.places[place_indices]]
    return Tour(tuple(order.tolist()), tuple(places[1:]), tuple(planner.leg(a, b) for a, b in pairwise(places)))


def _settled_order(
    times: _Times, groups: _Groups, order: NDArray[np.int64], seed: int, *, as_written: bool
) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Return an order and its places that are still the best when all legs of the tour are known."""
    place_indices = _best_places(times.seconds, groups, order)
    for count in range(_ROUNDS):
        if not as_written and len(order) > 1:
            order, place_indices = _best_order(times.seconds, groups, order, place_indices, seed, again=count > 0)
        place_indices = _best_places(times.seconds, groups, order)
        news = False
        while times.learn_blocked(place_indices):
            news, place_indices = True, _best_places(times.seconds, groups, order)
        if not news and not times.learn_detours(place_indices):
            break
    times.learn_detours(place_indices)
    return order, place_indices


class _Times:
    """Times `seconds` [places, places] of legs. These are times of straight motions until the true times are
    known."""

    def __init__(self, planner: PathPlanner, places: Floats) -> None:
        self._planner, self._places = planner, places
        self.seconds = planner.straight_s(places)
        self._looked_at = np.zeros(self.seconds.shape, dtype=bool)
        self._to_find: set[tuple[int, int]] = set()

    def learn_blocked(self, place_indices: NDArray[np.int64]) -> bool:
        """Check the straight motions of a tour; return True if one is blocked. The time of a blocked motion is
        then increased by a detour."""
        is_blocked = False
        for a, b in self._legs(place_indices):
            if not self._looked_at[a, b]:
                self._looked_at[a, b] = self._looked_at[b, a] = True
                if not self._planner.is_straight(self._places[a], self._places[b]):
                    is_blocked = True
                    self._to_find.add((a, b))
                    self._set(a, b, self.seconds[a, b] + _DETOUR_S)
        return is_blocked

    def learn_detours(self, place_indices: NDArray[np.int64]) -> bool:
        """Plan the legs of a tour that are not straight; return True if there was one to plan."""
        detours = self._to_find.intersection(self._legs(place_indices))
        for a, b in sorted(detours):
            self._set(a, b, self._planner.leg(self._places[a], self._places[b]).duration_s)
        self._to_find -= detours
        return bool(detours)

    def _legs(self, place_indices: NDArray[np.int64]) -> list[tuple[int, int]]:
        return [(min(a, b), max(a, b)) for a, b in pairwise([0, *place_indices.tolist()])]

    def _set(self, a: int, b: int, seconds: float) -> None:
        self.seconds[a, b] = self.seconds[b, a] = seconds


def _way_s(seconds: Floats, groups: _Groups, place_indices: NDArray[np.int64]) -> float:
    way = np.concatenate([[0], place_indices])
    return float(seconds[way[:-1], way[1:]].sum() + groups.posture_cost_s[place_indices].sum())


def _best_places(seconds: Floats, groups: _Groups, order: NDArray[np.int64]) -> NDArray[np.int64]:
    """Return the place of each group that gives the shortest tour in a given order, by dynamic programming."""
    before, total_s = slice(0, 1), np.zeros(1)
    came_from = []
    for group in order:
        here = slice(groups.first[group], groups.first[group + 1])
        costs_s = total_s[:, None] + seconds[before, here]
        came_from.append(costs_s.argmin(axis=0))
        before, total_s = here, costs_s.min(axis=0) + groups.posture_cost_s[here]
    k = int(total_s.argmin())
    place_indices = []
    for group, back in zip(order[::-1], came_from[::-1], strict=True):
        place_indices.append(groups.first[group] + k)
        k = int(back[k])
    return np.array(place_indices[::-1])


def _best_order(
    seconds: Floats,
    groups: _Groups,
    order: NDArray[np.int64],
    place_indices: NDArray[np.int64],
    seed: int,
    *,
    again: bool,
) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Return a better order, found by simulated annealing from the given one. If `again`, it starts at a lower
    temperature."""
    from coupole.motion.annealing import anneal

    share = _AGAIN if again else 1.0
    changes = int(share * min(_CHANGES_PER_PLACE * len(groups.places), _MOST_CHANGES))
    hottest_s = max(share * float(np.median(seconds[0, 1:])), 2 * _COLDEST_S)
    rolls = np.random.default_rng(seed).random((changes, 5))
    order_and_places: tuple[Any, Any] = anneal(
        seconds, groups.posture_cost_s, groups.first, order, place_indices, rolls, hottest_s, _COLDEST_S
    )
    return order_and_places
