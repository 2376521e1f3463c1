"""Ways of the arm between views that touch nothing, and the postures that make them short.

A *leg* brings the arm from one view to the next: straight in joint space where that is clear, else over via
points, else along a path that RRT-Connect finds (Kuffner, LaValle 2000: two trees that grow towards each
other), shortened afterwards. Postures (which of the arm's solutions) are chosen for all views together, by
dynamic programming over the time of the legs.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from coupole.collisions import CellBodies, Contact
from coupole.kinematics import Arm, move_duration_s

Joints = NDArray[np.float64]

_RRT_STEP_DEG = 15.0
_RRT_NODES = 600
_SHORTCUTS = 40
_SETTLED_ROUNDS = 12
_NO_WAY_S = 1e6


@dataclass(frozen=True)
class Leg:
    """One motion: `waypoints` [k, 6] in degrees after the start, the last is the goal; empty if there is none."""

    waypoints: tuple[Joints, ...]
    duration_s: float
    contact: Contact | None = None
    """Where there is no way: what stands in it."""


class PathPlanner:
    """Legs among the cell's bodies, remembered; without bodies every straight motion is taken as clear."""

    def __init__(
        self, arm: Arm, bodies: CellBodies | None, vias_deg: Sequence[Sequence[float]], seed: int = 1
    ) -> None:
        self._arm, self._bodies = arm, bodies
        self._vias = [np.asarray(via, dtype=np.float64) for via in vias_deg]
        self._random = np.random.default_rng(seed)
        self._legs: dict[tuple[bytes, bytes], Leg] = {}

    def free(self, joints_deg: Joints) -> bool:
        """True if the arm touches nothing there."""
        return self._bodies is None or not self._bodies.contacts(joints_deg)

    def contact(self, joints_deg: Joints) -> Contact | None:
        """What is nearest of what comes too close there."""
        contacts = self._bodies.contacts(joints_deg) if self._bodies else []
        return contacts[0] if contacts else None

    def straight_s(self, start: Joints, goal: Joints) -> float:
        """Time of the straight motion, clear or not; a lower bound of the leg's."""
        return move_duration_s(self._arm, start, goal)

    def leg(self, start: Joints, goal: Joints) -> Leg:
        """The way from one place to another."""
        key = (start.tobytes(), goal.tobytes())
        if key not in self._legs:
            self._legs[key] = self._find(start, goal)
        return self._legs[key]

    def _find(self, start: Joints, goal: Joints) -> Leg:
        contact = self._blocked(start, goal)
        if contact is None:
            return Leg((goal,), self.straight_s(start, goal))
        for place in (start, goal):
            if (at := self.contact(place)) is not None:
                return Leg((), _NO_WAY_S, at)
        best: list[Joints] | None = None
        for vias in self._via_chains(start, goal):
            chain = [start, *vias, goal]
            if all(self._blocked(a, b) is None for a, b in pairwise(chain)):
                best = chain
                break
        best = best or self._rrt_connect(start, goal)
        if best is None:
            return Leg((), _NO_WAY_S, contact)
        short = self._shortened(best)
        return Leg(tuple(short[1:]), self._chain_s(short))

    def _blocked(self, a: Joints, b: Joints) -> Contact | None:
        return self._bodies.contact_on_the_way(a, b) if self._bodies else None

    def _chain_s(self, chain: Sequence[Joints]) -> float:
        return sum(self.straight_s(a, b) for a, b in pairwise(chain))

    def _via_chains(self, start: Joints, goal: Joints) -> list[list[Joints]]:
        """Via points to try: a resting place of the arm, reached and left with axis 1 where start and goal have
        it, so that the arm first draws back, then turns, then reaches out."""
        chains = []
        for via in self._vias:
            drawn_back, before_goal = via.copy(), via.copy()
            drawn_back[0], before_goal[0] = start[0], goal[0]
            chains += [[drawn_back, before_goal], [via]]
        return chains

    # -- RRT-Connect --------------------------------------------------------------------------------------

    def _rrt_connect(self, start: Joints, goal: Joints) -> list[Joints] | None:
        low, high = np.array(self._arm.limits_deg).T
        low, high = np.maximum(low, np.minimum(start, goal) - 120), np.minimum(high, np.maximum(start, goal) + 120)
        trees: tuple[list[Joints], list[Joints]] = ([start], [goal])
        parents: tuple[list[int], list[int]] = ([-1], [-1])
        grow = 0
        while len(trees[0]) + len(trees[1]) < _RRT_NODES:
            target = self._random.uniform(low, high)
            reached = self._extend(trees[grow], parents[grow], target, greedy=False)
            if reached is not None:
                place = trees[grow][reached]
                met = self._extend(trees[1 - grow], parents[1 - grow], place, greedy=True)
                if met is not None and np.array_equal(trees[1 - grow][met], place):
                    branches = [_branch(trees[k], parents[k], n) for k, n in ((grow, reached), (1 - grow, met))]
                    ours, theirs = branches if grow == 0 else branches[::-1]
                    return ours + theirs[::-1][1:]
            grow = 1 - grow
        return None

    def _extend(self, tree: list[Joints], parents: list[int], target: Joints, *, greedy: bool) -> int | None:
        """Grow a tree towards `target` by one step, or until something is in the way; the last node reached."""
        node = int(np.argmin(np.abs(np.array(tree) - target).max(axis=1)))
        reached: int | None = None
        while True:
            away = target - tree[node]
            distance = float(np.abs(away).max())
            if distance == 0.0:
                return node
            there = target if distance <= _RRT_STEP_DEG else tree[node] + away * (_RRT_STEP_DEG / distance)
            if self._blocked(tree[node], there) is not None:
                return reached
            tree.append(there)
            parents.append(node)
            node = reached = len(tree) - 1
            if not greedy:
                return reached

    def _shortened(self, chain: list[Joints]) -> list[Joints]:
        """Leave out via points that are not needed, then cut corners at random."""
        chain = list(chain)
        i = 0
        while i + 2 < len(chain):
            for j in range(len(chain) - 1, i + 1, -1):
                if self._blocked(chain[i], chain[j]) is None:
                    del chain[i + 1 : j]
                    break
            i += 1
        for _ in range(_SHORTCUTS if len(chain) > 2 else 0):
            i = int(self._random.integers(1, len(chain) - 1))
            before, here, after = chain[i - 1 : i + 2]
            a, b = self._random.uniform(0.2, 0.9, 2)
            corner = [before + a * (here - before), here + (1 - b) * (after - here)]
            if self._chain_s([before, *corner, after]) < self._chain_s([before, here, after]) and all(
                self._blocked(p, q) is None for p, q in pairwise([before, *corner, after])
            ):
                chain[i : i + 1] = corner
        return chain


def _branch(tree: list[Joints], parents: list[int], node: int) -> list[Joints]:
    """From the root to a node."""
    places = []
    while node >= 0:
        places.append(tree[node])
        node = parents[node]
    return places[::-1]


# -- postures and order -----------------------------------------------------------------------------------


def choose_postures(
    planner: PathPlanner, start: Joints, choices: Sequence[NDArray[np.float64]]
) -> list[tuple[Joints, Leg]]:
    """One posture for each view (from `choices` [k, 6] each) and the legs between, shortest in all.

    Legs are taken as straight until one is used; then its true time counts, and the choice is made again, until
    nothing changes. Where no way is found the leg says so.
    """
    if not choices:
        return []
    true_s: dict[tuple[int, int, int], float] = {}
    straight = _straight_times(planner, start, choices)
    picked: list[int] = []
    for _ in range(_SETTLED_ROUNDS):
        picked = _shortest_chain(straight, true_s, choices)
        places = [start] + [choices[v][k] for v, k in enumerate(picked)]
        news = False
        for view, (a, b) in enumerate(pairwise(places)):
            key = (view, picked[view - 1] if view else 0, picked[view])
            leg = planner.leg(a, b)
            news |= key not in true_s and leg.duration_s > straight[view][key[1], key[2]] + 1e-9
            true_s[key] = leg.duration_s
        if not news:
            break
    places = [start] + [choices[v][k] for v, k in enumerate(picked)]
    return [(b, planner.leg(a, b)) for a, b in pairwise(places)]


def _straight_times(
    planner: PathPlanner, start: Joints, choices: Sequence[NDArray[np.float64]]
) -> list[NDArray[np.float64]]:
    """For each view times [postures before, postures] of straight motions."""
    before: NDArray[np.float64] = start[None]
    times = []
    for postures in choices:
        times.append(np.array([[planner.straight_s(a, b) for b in postures] for a in before]))
        before = postures
    return times


def _shortest_chain(
    straight: Sequence[NDArray[np.float64]],
    true_s: dict[tuple[int, int, int], float],
    choices: Sequence[NDArray[np.float64]],
) -> list[int]:
    total = np.zeros(1)
    came_from: list[NDArray[np.int64]] = []
    for view, straight_s in enumerate(straight):
        times = straight_s.copy()
        for (v, a, b), seconds in true_s.items():
            if v == view:
                times[a, b] = seconds
        costs = total[:, None] + times
        came_from.append(np.argmin(costs, axis=0))
        total = costs.min(axis=0)
    picked = [int(np.argmin(total))]
    for back in came_from[:0:-1]:
        picked.append(int(back[picked[-1]]))
    return picked[::-1]
