"""The order of views: never far from what a long, independent search finds, and always the same."""

from __future__ import annotations

from collections.abc import Callable
from functools import cache
from itertools import pairwise, permutations

import numpy as np
import pytest
from numpy.typing import NDArray
from places import REPO

from coupole.geometry import look_at
from coupole.kinematics import inverse
from coupole.motion.collisions import CellBodies
from coupole.motion.itinerary import arm_of, base_from_flange, bodies_of
from coupole.motion.ordering import shortest_tour
from coupole.motion.path_planner import PathPlanner
from coupole.motion.singularities import margin
from coupole.plan.rig import Rig
from coupole.plan.schedule import ViewPose
from coupole.preflight.job import Job, read_job

Floats = NDArray[np.float64]
ROOT = REPO


@cache
def job() -> Job:
    """The demo."""
    return read_job(ROOT / "configs/plans/demo.yaml")


def rig() -> Rig:
    return job().cell.rig


def home() -> Floats:
    return np.array(rig().motion.home_joints_deg)


@cache
def cell() -> CellBodies:
    """The simulated cell with the demo's relief."""
    return bodies_of(rig(), job().cell.leds, job().shape.corners_mm)


def planner() -> PathPlanner:
    return PathPlanner(arm_of(rig()), cell(), [rig().motion.home_joints_deg])


def random_views(count: int, seed: int) -> list[Floats]:
    """Postures [k, 6] that touch nothing, of random views all round the object."""
    random = np.random.default_rng(seed)
    views: list[Floats] = []
    while len(views) < count:
        pose = look_at((0, 0, 30), random.uniform(280, 400), random.uniform(-180, 180), random.uniform(40, 85))
        arm = arm_of(rig())
        postures = inverse(arm, base_from_flange(ViewPose("v", pose, None, (0, 0, 30)), rig()))
        if len(postures):
            postures = postures[(cell().tightest_mm(postures) >= 0) & (margin(arm, postures) >= 1.0)]
        if len(postures):
            views.append(postures)
    return views


def seconds_of(found: PathPlanner, views: list[Floats]) -> float:
    tour = shortest_tour(found, home(), views, [np.zeros(len(view)) for view in views])
    return sum(leg.duration_s for leg in tour.legs)


class Search:
    """A long search under the same legs: times are straight motions' until a best way uses a leg; then its own.
    So what it settles on is best among ways whose other legs are underestimated."""

    def __init__(self, views: list[Floats]) -> None:
        self.planner = planner()
        self.places = np.concatenate([home()[None], *views])
        self.groups = np.split(np.arange(1, len(self.places)), np.cumsum([len(view) for view in views])[:-1])
        self.seconds = self.planner.straight_s(self.places)
        self.known = np.eye(len(self.places), dtype=bool)

    def settle(self, best: Callable[[], list[int]]) -> float:
        """The time of the way that `best` still names when all of its legs are known."""
        while self.learn(way := best()):
            pass
        return self.seconds_along(way)

    def learn(self, way: list[int]) -> bool:
        """Find the legs of a way that are not known; True if there were any."""
        unknown = [(a, b) for a, b in pairwise([0, *way]) if not self.known[a, b]]
        for a, b in unknown:
            duration_s = self.planner.leg(self.places[a], self.places[b]).duration_s
            self.seconds[a, b] = self.seconds[b, a] = duration_s
            self.known[a, b] = self.known[b, a] = True
        return bool(unknown)

    def seconds_along(self, way: list[int]) -> float:
        return float(self.seconds[[0, *way[:-1]], way].sum())

    def exact(self) -> list[int]:
        """The best way of all: dynamic programming over which views were visited and where the last visit was
        (Held, Karp 1962)."""
        best: dict[tuple[int, int], tuple[float, list[int]]] = {(0, 0): (0.0, [])}
        everything = (1 << len(self.groups)) - 1
        for _ in self.groups:
            longer: dict[tuple[int, int], tuple[float, list[int]]] = {}
            for (done, last), (total_s, way) in best.items():
                for group in (g for g in range(len(self.groups)) if not done >> g & 1):
                    for place in self.groups[group].tolist():
                        key, reached_s = (done | 1 << group, place), total_s + float(self.seconds[last, place])
                        if reached_s < longer.get(key, (np.inf, []))[0]:
                            longer[key] = (reached_s, [*way, place])
            best = longer
        assert all(done == everything for done, _ in best)
        return min(best.values())[1]

    def restarted(self, restarts: int, seed: int) -> float:
        """The least time found from many random orders, each improved by exchanging stretches and moving visits
        until nothing helps, with the places chosen anew by dynamic programming for each order that is tried."""
        random = np.random.default_rng(seed)
        orders = [self.improved(random.permutation(len(self.groups)).tolist(), random) for _ in range(restarts)]
        while True:
            k = int(np.argmin([self.along(order)[0] for order in orders]))
            if self.learn(self.along(orders[k])[1]):
                continue
            before_s = self.along(orders[k])[0]
            orders[k] = self.improved(orders[k], random)
            if self.along(orders[k])[0] == before_s:
                return before_s

    def improved(self, order: list[int], random: np.random.Generator) -> list[int]:
        """The order after all exchanges that help."""
        best_s = self.along(order)[0]
        while True:
            for candidate in neighbours(order, random):
                trial_s = self.along(candidate)[0]
                if trial_s < best_s - 1e-9:
                    order, best_s = candidate, trial_s
                    break
            else:
                return order

    def along(self, order: list[int]) -> tuple[float, list[int]]:
        """Time and places of the best way in one order."""
        before, total_s, back = np.zeros(1, dtype=int), np.zeros(1), []
        for group in order:
            costs_s = total_s[:, None] + self.seconds[np.ix_(before, self.groups[group])]
            back.append((self.groups[group], costs_s.argmin(axis=0)))
            before, total_s = self.groups[group], costs_s.min(axis=0)
        k, way = int(total_s.argmin()), []
        for places, came_from in back[::-1]:
            way.append(int(places[k]))
            k = int(came_from[k])
        return float(total_s.min()), way[::-1]


def neighbours(order: list[int], random: np.random.Generator) -> list[list[int]]:
    """Orders one exchange away, shuffled."""
    n = len(order)
    found = [order[:i] + order[i:j][::-1] + order[j:] for i in range(n) for j in range(i + 2, n + 1)]
    for length in (1, 2):
        for i in range(n - length + 1):
            rest, moved = order[:i] + order[i + length :], order[i : i + length]
            found += [rest[:k] + moved + rest[k:] for k in range(len(rest) + 1) if k != i]
    random.shuffle(found)  # type: ignore[arg-type]
    return found


@pytest.mark.parametrize("seed", range(2))
def test_few_views_are_visited_on_the_best_way_there_is(seed: int) -> None:
    views = [view[:4] for view in random_views(6, seed)]
    search = Search(views)
    assert seconds_of(search.planner, views) <= 1.02 * search.settle(search.exact)


def test_dynamic_programming_agrees_with_trying_all_orders() -> None:
    search = Search([view[:2] for view in random_views(5, 7)])
    tried = min(search.along(list(order)) for order in permutations(range(5)))
    assert search.seconds_along(search.exact()) == pytest.approx(tried[0])


@pytest.mark.timeout(3600)
def test_many_views_take_at_most_a_quarter_more_than_a_long_search_finds(
    scale: Callable[[int, int], int],
) -> None:
    for seed in range(100, 100 + scale(1, 10)):
        views = random_views(scale(12, 30), seed)
        search = Search(views)
        assert seconds_of(search.planner, views) <= 1.25 * search.restarted(scale(2, 8), seed)


def test_the_same_views_give_the_same_tour() -> None:
    views = random_views(8, 3)
    posture_cost_s = [np.zeros(len(view)) for view in views]
    first, second = (shortest_tour(planner(), home(), views, posture_cost_s) for _ in range(2))
    assert first.order == second.order
    assert np.array_equal(first.places, second.places)


def test_each_view_is_visited_once_at_one_of_its_places() -> None:
    views = random_views(8, 4)
    tour = shortest_tour(planner(), home(), views, [np.zeros(len(view)) for view in views])
    assert sorted(tour.order) == list(range(8))
    for group, place in zip(tour.order, tour.places, strict=True):
        assert (views[group] == place).all(axis=1).any()


def test_of_nearly_equal_ways_the_easier_is_taken() -> None:
    near, easy = home() + np.array((5, 0, 0, 0, 0, 0)), home() - np.array((5.5, 0, 0, 0, 0, 0))
    free = PathPlanner(arm_of(rig()), None, [])
    for uneasy_s, expected in ((0.0, near), (0.3, easy)):
        tour = shortest_tour(free, home(), [np.array([near, easy])], [np.array([uneasy_s, 0.0])])
        assert np.array_equal(tour.places[0], expected)


def test_without_views_there_is_no_tour() -> None:
    assert shortest_tour(planner(), home(), [], []).order == ()


def test_a_view_where_the_arm_stands_already_takes_no_time() -> None:
    tour = shortest_tour(PathPlanner(arm_of(rig()), None, []), home(), [home()[None]], [np.zeros(1)])
    assert tour.legs[0].duration_s == 0.0
