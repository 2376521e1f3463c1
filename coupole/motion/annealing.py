"""Simulated annealing over the order of groups and the place that is visited in each group. It is compiled, for
`motion.ordering`."""

from __future__ import annotations

import numpy as np

from coupole.kernels import kernel


@kernel
def anneal(seconds, posture_cost_s, first, order, tour_places, rolls, hottest_s, coldest_s):  # type: ignore[no-untyped-def]
    """Return the best order of groups [n] that random changes find, and the chosen places [n].

    `seconds` [places, places] are the times between places, symmetric. Place 0 is the start; the places of group g
    are `first[g]` to `first[g + 1] - 1`. `posture_cost_s` [places] is added for each place that is used. `rolls`
    [changes, 5] are random numbers from 0 to 1.

    A change reverses a section of the tour, or moves a visit to another position and to any place of its group, or
    changes only the place of a visit. A worse tour is accepted with the Metropolis probability at a temperature
    that falls geometrically.
    """
    n = len(order)
    # visit i, from 1 to n, is at tour[i], of group order[i - 1]
    order, tour = order.copy(), np.zeros(n + 1, np.int64)
    tour[1:] = tour_places
    best_order, best_tour = order.copy(), tour.copy()
    gained_s, best_gained_s = 0.0, 0.0
    heat_s, cooling = hottest_s, (coldest_s / hottest_s) ** (1.0 / len(rolls))
    for roll in range(len(rolls)):
        heat_s *= cooling
        kind, i, j = int(3 * rolls[roll, 0]), 1 + int(n * rolls[roll, 1]), 1 + int(n * rolls[roll, 2])
        group = order[i - 1]
        place = first[group] + int((first[group + 1] - first[group]) * rolls[roll, 3])
        if kind == 0:
            i, j = min(i, j), max(i, j)
            change_s = _reversed_s(seconds, tour, i, j)
        else:
            j = i if kind == 1 else j
            change_s = posture_cost_s[place] - posture_cost_s[tour[i]] + _moved_s(seconds, tour, i, j, place)
        if change_s > 0.0 and rolls[roll, 4] >= np.exp(-change_s / heat_s):
            continue
        gained_s -= change_s
        if kind == 0:
            order[i - 1 : j] = order[i - 1 : j][::-1].copy()
            tour[i : j + 1] = tour[i : j + 1][::-1].copy()
        else:
            step = 1 if j > i else -1
            for k in range(i, j, step):
                order[k - 1], tour[k] = order[k - 1 + step], tour[k + step]
            order[j - 1], tour[j] = group, place
        if gained_s > best_gained_s + 1e-9:
            best_gained_s = gained_s
            best_order[:], best_tour[:] = order, tour
    return best_order, best_tour[1:]


@kernel
def _reversed_s(seconds, tour, i, j):  # type: ignore[no-untyped-def]
    """Return the additional cost of visits i to j in reversed order."""
    change_s = seconds[tour[i - 1], tour[j]] - seconds[tour[i - 1], tour[i]]
    if j + 1 < len(tour):
        change_s += seconds[tour[i], tour[j + 1]] - seconds[tour[j], tour[j + 1]]
    return change_s


@kernel
def _moved_s(seconds, tour, i, j, place):  # type: ignore[no-untyped-def]
    """Return the additional cost if visit i becomes the j-th visit, at another place."""
    after_i, after_j = i + 1, j if j < i else j + 1
    before_j = tour[j] if j > i else tour[j - 1]
    change_s = seconds[before_j, place] - seconds[tour[i - 1], tour[i]]
    if after_j < len(tour):
        change_s += seconds[place, tour[after_j]]
    if after_i < len(tour):
        change_s -= seconds[tour[i], tour[after_i]]
    if j != i and after_i < len(tour):
        change_s += seconds[tour[i - 1], tour[after_i]]
    if j != i and after_j < len(tour):
        change_s -= seconds[before_j, tour[after_j]]
    return change_s
