"""Loops of pairs: how well the separate motions of pairs close, and what this shows about all poses."""

from __future__ import annotations

from collections import deque
from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import pairwise

import numpy as np
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import minimum_spanning_tree
from scipy.special import chdtri  # scipy.stats takes half a second to import

from coupole.scan.registration.control import Sightings
from coupole.scan.registration.joint_fit import JointFit, Say, adjust
from coupole.scan.registration.prepared_scan import PreparedScan
from coupole.scan.registration.small_motions import displacement_mm, inverse_of, step_between
from coupole.scan.registration.viewpoint import Floats

_CHANCE = 1e-6


@dataclass(frozen=True)
class PairAlone:
    """The motion between two scans from their own overlap only."""

    first: int
    second: int
    first_from_second: Floats
    surprise: float
    """Squared difference from the joint fit, divided by its covariance. With many loops it is chi-squared with 6
    degrees of freedom, if noise explains it."""


@dataclass(frozen=True)
class Loop:
    """Scans in a ring, and the closure error of the motions of its pairs."""

    scans: tuple[int, ...]
    error_mm: float
    """Root mean square displacement of the first scan's points after one turn around the ring."""
    error_deg: float


def pairs_alone(
    scans: Sequence[PreparedScan], pairs: Sequence[tuple[int, int]], fit: JointFit, say: Say
) -> list[PairAlone]:
    """Return each pair, adjusted separately from its pose in the joint fit."""
    adjusted_pairs = []
    for number, (first, second) in enumerate(pairs):
        say("closing loops", number + 1, len(pairs))
        joint = inverse_of(fit.common_from_scan[first]) @ fit.common_from_scan[second]
        pair_scans = [scans[first], scans[second]]
        alone = adjust(pair_scans, [(0, 1)], [np.eye(4), joint], 0, Sightings(), lambda *_: None)
        step = step_between(joint, alone.common_from_scan[1], alone.pivots_mm[1])
        surprise = float(step @ np.linalg.solve(alone.covariance[6:, 6:], step))
        adjusted_pairs.append(PairAlone(first, second, alone.common_from_scan[1], surprise))
    return adjusted_pairs


def with_loops(fit: JointFit, pairs: Sequence[PairAlone], count: int) -> tuple[JointFit, float]:
    """Return the fit with a covariance that is not smaller than the loops show, and the factor for uncertainties
    from overlaps.

    The factor is that of the median pair. Some pairs have an overlap that does not determine their motion, so
    that they slide when adjusted separately. Such a pair says nothing about the joint fit, because there the
    other pairs keep it in place.
    """
    loops = len(pairs) - (count - 1)
    if loops < 1:
        return fit, 1.0
    usual_surprise = chdtri(6, 0.5) * loops / len(pairs)
    factor = max(1.0, float(np.sqrt(np.median([pair.surprise for pair in pairs]) / usual_surprise)))
    more = (factor**2 - 1.0) * fit.overlap_covariance
    return replace(fit, covariance=fit.covariance + more, overlap_covariance=fit.overlap_covariance + more), factor


def sliding_pairs(pairs: Sequence[PairAlone], factor: float) -> list[PairAlone]:
    """Return the pairs whose separate motion differs from the joint fit by more than chance explains once in a
    million."""
    return [pair for pair in pairs if pair.surprise > factor**2 * chdtri(6, _CHANCE)]


def find_loops(scans: Sequence[PreparedScan], pairs: Sequence[PairAlone]) -> list[Loop]:
    """Return a ring for each pair beyond a spanning tree, the worst first."""
    count = len(scans)
    costs = np.array([1.0 + pair.surprise for pair in pairs])
    rows, columns = np.array([[p.first, p.second] for p in pairs]).reshape(-1, 2).T
    tree = minimum_spanning_tree(coo_matrix((costs, (rows, columns)), (count, count))).tocoo()
    in_tree = {frozenset(edge) for edge in zip(tree.row.tolist(), tree.col.tolist(), strict=True)}
    motions = {(p.first, p.second): p.first_from_second for p in pairs}
    motions |= {(p.second, p.first): inverse_of(p.first_from_second) for p in pairs}
    near: dict[int, list[int]] = {k: [] for k in range(count)}
    for first, second in map(tuple, in_tree):
        near[first].append(second)
        near[second].append(first)
    loops = []
    for pair in pairs:
        if frozenset((pair.first, pair.second)) not in in_tree:
            ring = _path(near, pair.second, pair.first)
            around = pair.first_from_second
            for first, second in pairwise(ring):
                around = around @ motions[first, second]
            points = scans[pair.first].coarse.points_mm
            angle = np.degrees(np.arccos(np.clip((np.trace(around[:3, :3]) - 1) / 2, -1, 1)))
            loops.append(Loop((pair.first, *ring[:-1]), displacement_mm(around, np.eye(4), points), float(angle)))
    return sorted(loops, key=lambda loop: -loop.error_mm)


def _path(near: dict[int, list[int]], start: int, end: int) -> list[int]:
    before = {start: start}
    waiting = deque([start])
    while end not in before:
        at = waiting.popleft()
        for neighbour in near[at]:
            if neighbour not in before:
                before[neighbour] = at
                waiting.append(neighbour)
    path = [end]
    while path[-1] != start:
        path.append(before[path[-1]])
    return path[::-1]
