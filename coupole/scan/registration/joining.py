"""Joins scans to groups by the motions between pairs, and rejects a motion that others contradict.

As in Kruskal's spanning tree, the strongest motion comes first. But there is a vote: all motions between two
groups are compared, and the position that most motions support is used. It is accepted only if no scan of one
group then lies in the space that a scanner of the other saw through.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np

from coupole.scan.registration.pair_matching import MOST_CONTRADICTED, PairMotion, contradiction
from coupole.scan.registration.prepared_scan import PreparedScan
from coupole.scan.registration.small_motions import displacement_mm, inverse_of, moved_points
from coupole.scan.registration.viewpoint import Floats

AGREEMENT_PITCHES = 3.0
"""Two motions agree if their positions of a scan's points differ by at most this number of cells of the coarse
grid."""
_MOST_CROSS_CHECKS, _FEW_CHECKS, _EVERY = 300, 30, 5
"""Limits for the check of two groups against each other. The first is the greatest number of pairs of scans that
are checked. From the second number of pairs on, only some points are checked, in steps of the third number."""


@dataclass
class Groups:
    """Groups of scans with known poses relative to each other, and the motions on which the poses rest."""

    group_from_scan: list[Floats]
    """Transform of each scan, 4x4 mm, to the frame of its group's first scan."""
    members: dict[int, list[int]]
    group_of: list[int]
    accepted_motions: list[PairMotion] = field(default_factory=list)
    rejected_motions: list[PairMotion] = field(default_factory=list)

    def predicted_motion(self, first: int, second: int) -> Floats | None:
        """`first_from_second` of two scans of the same group."""
        if self.group_of[first] != self.group_of[second]:
            return None
        return np.asarray(inverse_of(self.group_from_scan[first]) @ self.group_from_scan[second])

    def agrees(self, scans: Sequence[PreparedScan], motion: PairMotion) -> bool:
        """Tell whether a motion between two scans of one group agrees with the present poses of these scans."""
        predicted_motion = self.predicted_motion(motion.first, motion.second)
        return predicted_motion is not None and _agree(scans, motion, predicted_motion)


def join(scans: Sequence[PreparedScan], motions: Sequence[PairMotion]) -> Groups:
    """Return the groups that the motions, in any order, give."""
    count = len(scans)
    groups = Groups([np.eye(4) for _ in scans], {k: [k] for k in range(count)}, list(range(count)))
    waiting = sorted(motions, key=lambda motion: -motion.fit.places * motion.fit.overlap)
    while waiting:
        strongest = waiting[0]
        first_group, second_group = groups.group_of[strongest.first], groups.group_of[strongest.second]
        pair = {first_group, second_group}
        between = [m for m in waiting if {groups.group_of[m.first], groups.group_of[m.second]} == pair]
        waiting = [m for m in waiting if {groups.group_of[m.first], groups.group_of[m.second]} != pair]
        if first_group == second_group:
            _sort_within(scans, groups, between)
        else:
            _merge(scans, groups, first_group, second_group, between)
    return groups


def _sort_within(scans: Sequence[PreparedScan], groups: Groups, motions: Sequence[PairMotion]) -> None:
    for motion in motions:
        (groups.accepted_motions if groups.agrees(scans, motion) else groups.rejected_motions).append(motion)


def _agree(scans: Sequence[PreparedScan], motion: PairMotion, predicted_motion: Floats) -> bool:
    coarse = scans[motion.second].coarse
    apart_mm = displacement_mm(motion.first_from_second, predicted_motion, coarse.points_mm)
    return apart_mm <= AGREEMENT_PITCHES * coarse.pitch_mm


def _merge(
    scans: Sequence[PreparedScan], groups: Groups, group: int, other_group: int, motions: Sequence[PairMotion]
) -> None:
    """Place one group in the frame of another by the majority of the motions between them, or reject these
    motions."""
    places = [_place(groups, group, motion) for motion in motions]
    supporters = [
        [m for m in motions if _agree(scans, m, _between(groups, group, m, one_from_other))]
        for one_from_other in places
    ]
    order = sorted(range(len(motions)), key=lambda k: -sum(m.fit.places for m in supporters[k]))
    for best in order:
        if not _contradict(scans, groups, group, other_group, places[best]):
            break
    else:
        groups.rejected_motions += motions
        return
    agreeing = {id(m) for m in supporters[best]}
    groups.accepted_motions += [m for m in motions if id(m) in agreeing]
    groups.rejected_motions += [m for m in motions if id(m) not in agreeing]
    for scan in groups.members.pop(other_group):
        groups.group_from_scan[scan] = places[best] @ groups.group_from_scan[scan]
        groups.group_of[scan] = group
        groups.members[group].append(scan)


def _place(groups: Groups, group: int, motion: PairMotion) -> Floats:
    """Return the pose of the other group in the frame of group `group`, from a motion between a scan of each
    group.
    """
    first, second, first_from_second = motion.first, motion.second, motion.first_from_second
    if groups.group_of[first] != group:
        first, second, first_from_second = second, first, inverse_of(first_from_second)
    place = groups.group_from_scan[first] @ first_from_second @ inverse_of(groups.group_from_scan[second])
    return np.asarray(place)


def _between(groups: Groups, group: int, motion: PairMotion, one_from_other: Floats) -> Floats:
    """Return `first_from_second` of a motion's scans if the other group has this pose in group `group`."""
    whole = one_from_other if groups.group_of[motion.first] == group else inverse_of(one_from_other)
    first, second = groups.group_from_scan[motion.first], groups.group_from_scan[motion.second]
    return np.asarray(inverse_of(first) @ whole @ second)


def _contradict(
    scans: Sequence[PreparedScan], groups: Groups, group: int, other_group: int, one_from_other: Floats
) -> bool:
    """True if a scan of one group lies in space that a scanner of the other group found empty."""
    pairs = [(a, b) for a in groups.members[group] for b in groups.members[other_group]]
    if len(pairs) > _MOST_CROSS_CHECKS:
        picks = np.random.default_rng(0).choice(len(pairs), _MOST_CROSS_CHECKS, replace=False)
        pairs = [pairs[k] for k in picks]
    every = 1 if len(pairs) < _FEW_CHECKS else _EVERY
    slack = 1.0 + len(pairs) ** 0.25  # poses of groups that are not adjusted yet have accumulated errors
    for a, b in pairs:
        first_from_second = inverse_of(groups.group_from_scan[a]) @ one_from_other @ groups.group_from_scan[b]
        near_mm = 0.7 * scans[a].coarse.pitch_mm * slack
        if not spheres_meet(scans[a], scans[b], first_from_second):
            continue
        if contradiction(scans[a], scans[b], first_from_second, near_mm, every) > 2 * MOST_CONTRADICTED:
            return True
    return False


def spheres_meet(first_scan: PreparedScan, second_scan: PreparedScan, one_from_other: Floats) -> bool:
    """Tell whether the bounding spheres of two scans meet; only then can the scans overlap."""
    (middle_one, radius_one), (middle_other, radius_other) = first_scan.coarse.sphere, second_scan.coarse.sphere
    apart = np.linalg.norm(moved_points(one_from_other, middle_other[None])[0] - middle_one)
    return bool(apart < radius_one + radius_other)
