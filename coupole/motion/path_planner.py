"""Collision-free paths of the arm between postures.

A *leg* is the path from one view to the next. It is straight in joint space if that is clear. Otherwise it leads
through via points. If these fail too, RRT-Connect finds paths to and from a resting posture (Kuffner, LaValle
2000: two trees that grow towards each other), which are shortened afterwards.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from coupole.kinematics import Arm, move_durations_s
from coupole.motion.collisions import CellBodies, Contact

Joints = NDArray[np.float64]

_RRT_STEP_DEG = 15.0
_RRT_TRIES = 300
_SHORTCUTS = 40
NO_WAY_S = 1e6


@dataclass(frozen=True)
class Leg:
    """One motion: `waypoints` [k, 6] in degrees after the start, the last of which is the goal; empty if there is
    no path."""

    waypoints: tuple[Joints, ...]
    duration_s: float
    contact: Contact | None = None
    """Contact that blocks the path, if there is no path."""


class PathPlanner:
    """Legs among the cell's bodies, cached. Without bodies every straight motion counts as clear.

    The return path is the reversed path. Results do not depend on earlier queries.
    """

    def __init__(
        self, arm: Arm, bodies: CellBodies | None, vias_deg: Sequence[Sequence[float]], seed: int = 1
    ) -> None:
        self._arm, self._bodies, self._seed = arm, bodies, seed
        self._vias = [np.asarray(via, dtype=np.float64) for via in vias_deg]
        self._straight: dict[tuple[bytes, bytes], bool] = {}
        self._chains: dict[tuple[bytes, bytes], list[Joints] | Contact] = {}
        self._from_via: dict[tuple[int, bytes], list[Joints] | None] = {}

    def straight_s(self, places_deg: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return times [n, n] of straight motions between postures [n, 6], clear or not. These times are lower
        bounds of the legs' times.
        """
        from coupole.motion.straight_times import pairwise_s

        arm = self._arm
        limits = (np.asarray(limit) for limit in (arm.velocity_deg_s, arm.acceleration_deg_s2, arm.jerk_deg_s3))
        seconds: NDArray[np.float64] = pairwise_s(np.ascontiguousarray(places_deg), *limits)
        return seconds

    def is_straight(self, start: Joints, goal: Joints) -> bool:
        """True if the straight motion is clear."""
        a, b = _sorted_pair(start, goal)
        key = (a.tobytes(), b.tobytes())
        if key not in self._straight:
            self._straight[key] = self._clear(a, b)
        return self._straight[key]

    def leg(self, start: Joints, goal: Joints) -> Leg:
        """Return the leg from one posture to another."""
        a, b = _sorted_pair(start, goal)
        key = (a.tobytes(), b.tobytes())
        if key not in self._chains:
            self._chains[key] = self._find(a, b)
        chain_or_contact = self._chains[key]
        if isinstance(chain_or_contact, Contact):
            return Leg((), NO_WAY_S, chain_or_contact)
        chain = chain_or_contact if a is start else chain_or_contact[::-1]
        return Leg(tuple(chain[1:]), self._chain_s(chain))

    def _find(self, start: Joints, goal: Joints) -> list[Joints] | Contact:
        """Return postures [k] from start to goal with clear straight motions between them, or the contact that
        blocks the path."""
        if self.is_straight(start, goal):
            return [start, goal]
        for place in (start, goal):
            if self._bodies is not None and (contacts := self._bodies.contacts(place)):
                return contacts[0]
        chain = self._over_vias(start, goal) or self._over_resting_place(start, goal)
        if chain is None and self._is_cut_off(start) == self._is_cut_off(goal):
            chain = self._rrt_connect(start, goal)
        if chain is not None:
            return self._shortened_chain(chain)
        assert self._bodies is not None
        contact = self._bodies.contact_on_the_way(start, goal)
        assert contact is not None
        return contact

    def _over_vias(self, start: Joints, goal: Joints) -> list[Joints] | None:
        for vias in self._via_chains(start, goal):
            chain = [start, *vias, goal]
            if all(self._clear(a, b) for a, b in pairwise(chain)):
                return chain
        return None

    def _over_resting_place(self, start: Joints, goal: Joints) -> list[Joints] | None:
        for number in range(len(self._vias)):
            there, on = (self._way_from_via(number, place) for place in (start, goal))
            if there is not None and on is not None:
                return there[::-1] + on[1:]
        return None

    def _is_cut_off(self, place: Joints) -> bool:
        """Tell whether no path to the posture was found from any resting posture."""
        return all(self._way_from_via(number, place) is None for number in range(len(self._vias)))

    def _way_from_via(self, number: int, place: Joints) -> list[Joints] | None:
        """Return the path from a resting posture to another posture. It is searched only once."""
        key = (number, place.tobytes())
        if key not in self._from_via:
            via = self._vias[number]
            straight = [via, place] if self._clear(via, place) else None
            self._from_via[key] = straight or self._rrt_connect(via, place)
        return self._from_via[key]

    def _clear(self, a: Joints, b: Joints) -> bool:
        return self._bodies is None or self._bodies.is_clear(a, b)

    def _chain_s(self, chain: Sequence[Joints]) -> float:
        return float(move_durations_s(self._arm, chain[:-1], chain[1:]).sum())

    def _via_chains(self, start: Joints, goal: Joints) -> list[list[Joints]]:
        """Return via points to try. They are a resting posture of the arm, with axis 1 first as at the start and
        then as at the goal. So the arm first retracts, then turns, then extends."""
        chains = []
        for via in self._vias:
            drawn_back, before_goal = via.copy(), via.copy()
            drawn_back[0], before_goal[0] = start[0], goal[0]
            chains += [[drawn_back, before_goal], [via]]
        return chains

    # -- RRT-Connect --------------------------------------------------------------------------------------

    def _rrt_connect(self, start: Joints, goal: Joints) -> list[Joints] | None:
        random = np.random.default_rng([self._seed, *np.frombuffer(np.concatenate([start, goal]), np.uint32)])
        low, high = np.array(self._arm.limits_deg).T
        low, high = np.maximum(low, np.minimum(start, goal) - 120), np.minimum(high, np.maximum(start, goal) + 120)
        trees: tuple[list[Joints], list[Joints]] = ([start], [goal])
        parents: tuple[list[int], list[int]] = ([-1], [-1])
        grow = 0
        for _ in range(_RRT_TRIES):
            target = random.uniform(low, high)
            new_node = self._extend(trees[grow], parents[grow], target, greedy=False)
            if new_node is not None:
                place = trees[grow][new_node]
                meeting_node = self._extend(trees[1 - grow], parents[1 - grow], place, greedy=True)
                if meeting_node is not None and np.array_equal(trees[1 - grow][meeting_node], place):
                    branches = [
                        _branch(trees[k], parents[k], n) for k, n in ((grow, new_node), (1 - grow, meeting_node))
                    ]
                    start_branch, goal_branch = branches if grow == 0 else branches[::-1]
                    return start_branch + goal_branch[::-1][1:]
            grow = 1 - grow
        return None

    def _extend(self, tree: list[Joints], parents: list[int], target: Joints, *, greedy: bool) -> int | None:
        """Grow a tree towards `target` by one step, or, if `greedy`, until it is blocked. Returns the last node
        reached."""
        node = int(np.argmin(np.abs(np.array(tree) - target).max(axis=1)))
        last_node: int | None = None
        while True:
            away = target - tree[node]
            distance = float(np.abs(away).max())
            if distance == 0.0:
                return node
            there = target if distance <= _RRT_STEP_DEG else tree[node] + away * (_RRT_STEP_DEG / distance)
            if not self._clear(tree[node], there):
                return last_node
            tree.append(there)
            parents.append(node)
            node = last_node = len(tree) - 1
            if not greedy:
                return last_node

    def _shortened_chain(self, chain: list[Joints]) -> list[Joints]:
        """Leave out via points that are not needed, then shorten the corners at random."""
        random = np.random.default_rng(self._seed)
        chain = list(chain)
        i = 0
        while i + 2 < len(chain):
            for j in range(len(chain) - 1, i + 1, -1):
                if self._clear(chain[i], chain[j]):
                    del chain[i + 1 : j]
                    break
            i += 1
        for _ in range(_SHORTCUTS if len(chain) > 2 else 0):
            i = int(random.integers(1, len(chain) - 1))
            before, here, after = chain[i - 1 : i + 2]
            a, b = random.uniform(0.2, 0.9, 2)
            corner = [before + a * (here - before), here + (1 - b) * (after - here)]
            if self._chain_s([before, *corner, after]) < self._chain_s([before, here, after]) and all(
                self._clear(p, q) for p, q in pairwise([before, *corner, after])
            ):
                chain[i : i + 1] = corner
        return chain


def _sorted_pair(a: Joints, b: Joints) -> tuple[Joints, Joints]:
    """The two postures in an order that does not depend on the order of the arguments."""
    return (b, a) if a.tobytes() > b.tobytes() else (a, b)


def _branch(tree: list[Joints], parents: list[int], node: int) -> list[Joints]:
    """Return the branch from the root to a node."""
    places = []
    while node >= 0:
        places.append(tree[node])
        node = parents[node]
    return places[::-1]
