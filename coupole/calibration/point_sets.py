"""Assigns found points to known points, even if some are missing and some are false.

Three neighbouring points form a triangle whose sides a rigid motion does not change. Triangles of the found points
are looked up among the distances of the known points. Each matching pair gives a motion. The result is the motion
that brings most found points onto known ones. If another motion is nearly as good, the layout is ambiguous, which
is an error.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from itertools import combinations

import numpy as np
from scipy.spatial import cKDTree

from coupole.calibration.rotations import Floats, nearest_rotation
from coupole.errors import InputError

NEIGHBOURS = 7
"""Triangles are made of each point and two of this number of nearest points. This is enough if a third of them is
missing."""
LEAST_MATCHED, LEAST_SHARE = 4, 0.4
"""Least number of points that agree, and least share of the smaller set. Fewer points may agree by chance."""
_TRIES = 20_000
_AMBIGUOUS_SHARE = 0.8
_THINNEST = 0.1
"""Least height of a triangle, relative to its longest side. Thinner triangles determine the motion too poorly."""


Indices = np.ndarray[tuple[int], np.dtype[np.intp]]
Pairs = tuple[Indices, Indices]


@dataclass(frozen=True)
class Matched:
    """Pairs of points, and the motion between them from least squares."""

    found_rows: Indices
    known_rows: Indices
    found_from_known: Floats
    """4x4 transform, mm."""
    rms_mm: float
    rivals: int
    """Number of points that the next best motion brings together."""


def rigid_motion(from_points: Floats, to_points: Floats) -> Floats:
    """Return the 4x4 transform that brings points [n, 3] onto others by least squares (Arun, Huang, Blostein, PAMI
    9(5), 1987)."""
    middle_from, middle_to = from_points.mean(axis=0), to_points.mean(axis=0)
    turn = nearest_rotation((to_points - middle_to).T @ (from_points - middle_from))
    motion = np.eye(4)
    motion[:3, :3], motion[:3, 3] = turn, middle_to - turn @ middle_from
    return motion


def match_points(found_mm: Floats, known_mm: Floats, tolerance_mm: float) -> Matched:
    """Match found points [n, 3] with known points [m, 3]. Points that belong together lie within the tolerance.

    Raises InputError if too few points agree, or if two motions fit.
    """
    if len(found_mm) < LEAST_MATCHED or len(known_mm) < LEAST_MATCHED:
        raise InputError(
            f"targets: expected {LEAST_MATCHED} or more on each side; {len(found_mm)} were found in the images, "
            f"{len(known_mm)} are in the table"
        )
    tree = cKDTree(found_mm)
    best: list[tuple[int, float, Floats]] = []
    least = max(LEAST_MATCHED, int(np.ceil(LEAST_SHARE * min(len(found_mm), len(known_mm)))))
    for rough in _motions(found_mm, known_mm, tolerance_mm):
        motion, pairs = rough, _pairs(tree, rough, known_mm, 2 * tolerance_mm)
        for _ in range(3):  # with all pairs the motion is more accurate, and more points may agree
            if len(pairs[0]) >= least:
                motion = rigid_motion(known_mm[pairs[1]], found_mm[pairs[0]])
                pairs = _pairs(tree, motion, known_mm, tolerance_mm)
        if len(pairs[0]) >= least:
            best.append((len(pairs[0]), _rms(motion, found_mm, known_mm, pairs), motion))
    if not best:
        raise InputError(
            f"targets: no motion brings {least} of the {len(found_mm)} targets found onto "
            f"the targets of the table "
            f"({len(known_mm)}) within {tolerance_mm:g} mm. Is it another object, is the unit wrong, or did "
            "targets move?"
        )
    best.sort(key=lambda entry: (-entry[0], entry[1]))
    count, rms_mm, motion = best[0]
    rivals = max(
        (n for n, _, other_motion in best[1:] if _differ(motion, other_motion, known_mm, tolerance_mm)), default=0
    )
    if rivals > _AMBIGUOUS_SHARE * count:
        raise InputError(
            f"targets: two motions fit: one brings {count} targets together, the other {rivals}. The stickers "
            "are placed too regularly, or too few were seen; add some, or take more views."
        )
    pairs = _pairs(tree, motion, known_mm, tolerance_mm)
    return Matched(*pairs, motion, rms_mm, rivals)


def _triangles(points: Floats) -> tuple[np.ndarray[tuple[int, int], np.dtype[np.intp]], Floats]:
    """Return corners [t, 3], ordered by the opposite side, with the longest side last, and these sides [t, 3]."""
    neighbours = min(NEIGHBOURS, len(points) - 1)
    near = cKDTree(points).query(points, neighbours + 1)[1]
    triples = {tuple(sorted((row[0], a, b))) for row in near for a, b in combinations(row[1:], 2)}
    corners = np.array(sorted(triples))
    across = np.stack(
        [points[corners[:, (k + 1) % 3]] - points[corners[:, (k + 2) % 3]] for k in range(3)], axis=1
    )
    sides = np.linalg.norm(across, axis=2)
    order = np.argsort(sides, axis=1)
    corners, sides = np.take_along_axis(corners, order, axis=1), np.take_along_axis(sides, order, axis=1)
    height = np.linalg.norm(np.cross(across[:, 0], across[:, 1]), axis=1) / sides[:, 2]
    stout = height > _THINNEST * sides[:, 2]
    return corners[stout], sides[stout]


def _motions(found_mm: Floats, known_mm: Floats, tolerance_mm: float) -> Iterator[Floats]:
    """Yield motions known -> found of pairs of triangles with the same sides, the closest pairs first."""
    found_triangles, found_sides = _triangles(found_mm)
    known_triangles, known_sides = _triangles(known_mm)
    if not len(found_triangles) or not len(known_triangles):
        return
    similar = cKDTree(known_sides).query_ball_point(found_sides, 2 * tolerance_mm)
    pairs = [(f, k) for f, ks in enumerate(similar) for k in ks]
    off = [float(np.abs(found_sides[f] - known_sides[k]).max()) for f, k in pairs]
    for place in np.argsort(off, kind="stable")[:_TRIES]:
        f, k = pairs[place]
        yield rigid_motion(known_mm[known_triangles[k]], found_mm[found_triangles[f]])


def _pairs(tree: cKDTree, motion: Floats, known_mm: Floats, tolerance_mm: float) -> Pairs:
    """Return each found point with the nearest known one, one to one."""
    off_mm, nearest = tree.query(known_mm @ motion[:3, :3].T + motion[:3, 3], distance_upper_bound=tolerance_mm)
    known_of_found: dict[int, int] = {}
    for known_row in np.argsort(off_mm):
        if np.isfinite(off_mm[known_row]):
            known_of_found.setdefault(int(nearest[known_row]), int(known_row))
    keys = np.array(sorted(known_of_found), dtype=np.intp)
    return keys, np.array([known_of_found[int(key)] for key in keys], dtype=np.intp)


def _rms(motion: Floats, found_mm: Floats, known_mm: Floats, pairs: Pairs) -> float:
    brought = known_mm[pairs[1]] @ motion[:3, :3].T + motion[:3, 3]
    return float(np.sqrt(np.mean(np.sum((brought - found_mm[pairs[0]]) ** 2, axis=1))))


def _differ(motion: Floats, other_motion: Floats, known_mm: Floats, tolerance_mm: float) -> bool:
    """True if two motions bring the known points to different places."""
    apart = known_mm @ (motion[:3, :3] - other_motion[:3, :3]).T + motion[:3, 3] - other_motion[:3, 3]
    return bool(np.linalg.norm(apart, axis=1).max() > 5 * tolerance_mm)
