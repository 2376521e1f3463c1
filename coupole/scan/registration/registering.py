"""Registers scans with unknown poses, in any order: finds motions of pairs, joins them, adjusts all poses
together, and tests them by loops."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from itertools import combinations
from pathlib import Path

import numpy as np

from coupole.errors import InputError
from coupole.scan.registration.control import (
    NO_TARGETS,
    Sightings,
    TargetTables,
    motions_by_targets,
    read_sightings,
)
from coupole.scan.registration.joining import Groups, join, spheres_meet
from coupole.scan.registration.joint_fit import JointFit, adjust
from coupole.scan.registration.loop_errors import Loop, find_loops, pairs_alone, sliding_pairs, with_loops
from coupole.scan.registration.pair_matching import LEAST_OVERLAP, PairMotion, fit_of
from coupole.scan.registration.pair_search import Search, Task, search_of
from coupole.scan.registration.prepared_scan import PLACE_SPACINGS, PreparedScan, Survey, prepare, survey
from coupole.scan.registration.scan_content import ScanSource
from coupole.scan.registration.scan_files import expect_different, sources_of
from coupole.scan.registration.small_motions import inverse_of
from coupole.scan.registration.viewpoint import Floats, Stand, Viewpoint, choose_viewpoints

Say = Callable[[str, int, int], None]
ALL_PAIRS = 20
"""Greatest number of scans for which all pairs are tried. With more scans, pairs are tried until all scans are
connected."""
_FINE_PLACES, _COARSE_PLACES = (20_000, 2_500), (8_000, 1_600)
"""Number of points of a scan's fine and coarse cloud: for few scans, and for many."""
_PARTNERS = 6
"""Greatest number of pairs of each scan in a round, for more than `ALL_PAIRS` scans."""
_ODD_SIZE = 200.0
"""A scan that is larger or smaller than most by this factor has another unit."""
_ROUNDED_CELLS = 0.01
"""Largest rounding error of a coordinate of the merged mesh, in its cells."""
_LEAST_JOINT_OVERLAP = 0.04
"""Least share of the smaller scan that must overlap for a pair to count in the joint fit."""


@dataclass(frozen=True)
class Registration:
    """Scans with their poses. Scans are numbered in the given order."""

    names: tuple[str, ...]
    """Names of the scans."""
    scans: tuple[PreparedScan, ...]
    """Points and normals of each scan in its own frame, mm."""
    placed_numbers: tuple[int, ...]
    """Numbers of the connected scans; the frame of the first one is the common frame."""
    first_from_scan: dict[int, Floats]
    """Transforms to the first placed scan's frame, 4x4 mm."""
    covariance: dict[int, Floats]
    """[6, 6] covariance of each pose: a step (mm, rad) about the scan's middle, in the common frame; in the
    control points' frame if there are control points."""
    site_from_first: Floats | None
    """Transform of the first placed scan's frame into the control points' frame."""
    unplaced_numbers: tuple[int, ...]
    """Numbers of the scans that overlap no other scan enough."""
    motions: tuple[PairMotion, ...]
    """Motions between pairs from which the poses were found."""
    rejected_motions: tuple[PairMotion, ...]
    """Motions between pairs that contradict the others."""
    pairs: int
    """Number of pairs that overlap."""
    loops: tuple[Loop, ...]
    """Closed chains of pairs, with the error of each."""
    loop_factor: float
    """Factor by which the loops enlarged the uncertainties from overlaps."""
    sliding_pairs: tuple[tuple[int, int], ...]
    """Pairs of scans whose motion would differ if they were adjusted separately."""
    fit: JointFit
    """The joint adjustment of all poses."""

    def is_merged_on_site(self, cell_mm: float) -> bool:
        """True if mesh and clouds are in the control points' frame. This is so if there are control points,
        and if numbers of 32 bits resolve the coordinates there to a hundredth of a cell."""
        if self.site_from_first is None:
            return False
        farthest_mm = max(
            float(np.abs((self.site_from_first @ pose)[:3, 3]).max() + self.scans[k].survey.size_mm)
            for k, pose in self.first_from_scan.items()
        )
        return farthest_mm * float(np.finfo(np.float32).eps) < _ROUNDED_CELLS * cell_mm

    def merged_from_scan(self, cell_mm: float) -> list[Floats]:
        """Transform of each placed scan to the frame of mesh and clouds, 4x4 mm."""
        poses = [self.first_from_scan[k] for k in self.placed_numbers]
        if self.site_from_first is None or not self.is_merged_on_site(cell_mm):
            return poses
        return [self.site_from_first @ pose for pose in poses]


def register(
    paths: Sequence[Path],
    unit: str,
    *,
    stand: Stand | None = None,
    tables: TargetTables = NO_TARGETS,
    trust_poses: bool = False,
    processes: int | None = None,
    say: Say,
) -> Registration:
    """Find the poses of scans in files. With `trust_poses`, the search starts from the poses that PTX and E57
    state.

    Raises InputError for invalid files, and if no two scans overlap; ExtraMissing.
    """
    expect_different(paths)
    sources = sources_of(paths)
    if len(sources) < 2:
        raise InputError(f"expected two scans or more, found {len(sources)}")
    names = [source.name for source in sources]
    sightings = read_sightings(tables, names, unit)
    scans = _prepared_scans(sources, unit, stand, say)
    if trust_poses and not any(scan.stated_pose is not None for scan in scans):
        raise InputError("--trust-poses: no scan states a pose; only PTX and E57 can")
    with search_of(scans, processes) as search:
        motions = motions_by_targets(sightings)
        if trust_poses:
            motions += search.run("testing stated poses", list(_stated_tasks(scans)), say)
        groups = _groups_by_search(scans, search, motions, say, every=not trust_poses)
        main = max(groups.members.values(), key=lambda members: (len(members), -min(members)))
        if len(main) < 2:
            raise InputError(
                f"no two of the {len(scans)} scans overlap by {100 * LEAST_OVERLAP:.0f} % or more with enough "
                f"shape in common: {', '.join(names[:10])}. Take more scans between these, or name shared "
                "targets with --targets"
            )
        scan_numbers = sorted(main)
        _grow(scans, search, groups, scan_numbers, say)
    return _adjusted_registration(names, scans, groups, scan_numbers, sightings, say)


def _prepared_scans(sources: Sequence[ScanSource], unit: str, stand: Stand | None, say: Say) -> list[PreparedScan]:
    surveys = []
    for number, source in enumerate(sources):
        say("reading", number, len(sources))
        surveys.append(survey(source, unit))
    say("reading", len(sources), len(sources))
    _expect_one_unit(sources, surveys)
    if stand is None:
        viewpoints = choose_viewpoints([each_survey.folded_shares for each_survey in surveys])
    else:
        viewpoints = [Viewpoint(stand)] * len(sources)
    fine_mm, coarse_mm = pitches(surveys)
    scans = []
    for number, (source, scan_survey, viewpoint) in enumerate(zip(sources, surveys, viewpoints, strict=True)):
        say("preparing", number, len(sources))
        scans.append(prepare(source, unit, scan_survey, viewpoint, fine_mm, coarse_mm))
    say("preparing", len(sources), len(sources))
    return scans


def _expect_one_unit(sources: Sequence[ScanSource], surveys: Sequence[Survey]) -> None:
    usual_mm = float(np.median([scan_survey.size_mm for scan_survey in surveys]))
    for source, scan_survey in zip(sources, surveys, strict=True):
        if not 1 / _ODD_SIZE < scan_survey.size_mm / usual_mm < _ODD_SIZE:
            raise InputError(
                f"{source}: mixed units? The scan is {scan_survey.size_mm:.3g} mm in size, most are about "
                f"{usual_mm:.3g} mm"
            )


def pitches(surveys: Sequence[Survey]) -> tuple[float, float]:
    """Pitches of the fine and the coarse clouds, mm: the same for all scans."""
    many = len(surveys) > ALL_PAIRS
    spacing_mm = PLACE_SPACINGS * float(np.median([scan_survey.spacing_mm for scan_survey in surveys]))
    places = float(
        np.median(
            [
                scan_survey.places * (PLACE_SPACINGS * scan_survey.spacing_mm / spacing_mm) ** 2
                for scan_survey in surveys
            ]
        )
    )
    fine_mm = spacing_mm * max(1.0, float(np.sqrt(places / _FINE_PLACES[many])))
    coarse_mm = spacing_mm * max(2.0, float(np.sqrt(places / _COARSE_PLACES[many])))
    return fine_mm, coarse_mm


def _stated_tasks(scans: Sequence[PreparedScan]) -> Iterator[Task]:
    """Return the pairs that overlap by the poses of their files, with their motions."""
    for first, second in combinations(range(len(scans)), 2):
        first_pose, second_pose = scans[first].stated_pose, scans[second].stated_pose
        if first_pose is not None and second_pose is not None:
            motion = inverse_of(first_pose) @ second_pose
            if _may_overlap(scans, (first, second), motion):
                yield first, second, motion


def _groups_by_search(
    scans: Sequence[PreparedScan], search: Search, by_targets: Sequence[PairMotion], say: Say, *, every: bool
) -> Groups:
    """Return groups from motions by features and from known motions. With `every`, all pairs are tried; otherwise
    only pairs of different groups."""
    known_pairs = {(m.first, m.second) for m in by_targets}
    untried_pairs = [pair for pair in combinations(range(len(scans)), 2) if pair not in known_pairs]
    motions = list(by_targets)
    groups = join(scans, motions)
    if not every:
        untried_pairs = [(a, b) for a, b in untried_pairs if groups.group_of[a] != groups.group_of[b]]
    round_number = 0
    while untried_pairs:
        round_number += 1
        if len(scans) <= ALL_PAIRS:
            batch, untried_pairs = untried_pairs, []
        else:
            batch, untried_pairs = _some(untried_pairs, groups, round_number)
        label = "matching pairs" + (f", round {round_number}" if len(scans) > ALL_PAIRS else "")
        motions += search.run(label, [(*pair, None) for pair in batch], say)
        groups = join(scans, motions)
        untried_pairs = [(a, b) for a, b in untried_pairs if groups.group_of[a] != groups.group_of[b]]
    return groups


def _some(
    untried_pairs: Sequence[tuple[int, int]], groups: Groups, round_number: int
) -> tuple[list[tuple[int, int]], list[tuple[int, int]]]:
    """Return pairs for a round, a few for each scan, drawn from the pairs of different groups; and the remaining
    pairs."""
    order = np.random.default_rng(round_number).permutation(len(untried_pairs))
    partner_counts: dict[int, int] = {}
    batch, later = [], []
    for k in order:
        first, second = untried_pairs[k]
        smaller = min((first, second), key=lambda scan: len(groups.members[groups.group_of[scan]]))
        if partner_counts.get(smaller, 0) < _PARTNERS:
            partner_counts[smaller] = partner_counts.get(smaller, 0) + 1
            batch.append(untried_pairs[k])
        else:
            later.append(untried_pairs[k])
    return sorted(batch), later


def _grow(
    scans: Sequence[PreparedScan], search: Search, groups: Groups, placed_numbers: Sequence[int], say: Say
) -> None:
    """Return motions of the pairs that overlap by the found poses and were not matched yet."""
    matched_pairs = {(m.first, m.second) for m in groups.accepted_motions}
    tasks = []
    every = list(combinations(placed_numbers, 2))
    for number, pair in enumerate(every):
        say("looking for neighbours", number + 1, len(every))
        motion = groups.predicted_motion(*pair)
        if motion is not None and pair not in matched_pairs and _may_overlap(scans, pair, motion):
            tasks.append((*pair, motion))
    motions = search.run("matching neighbours", tasks, say)
    groups.accepted_motions += [m for m in motions if groups.agrees(scans, m)]
    groups.rejected_motions += [m for m in motions if not groups.agrees(scans, m)]


def _may_overlap(scans: Sequence[PreparedScan], pair: tuple[int, int], predicted_motion: Floats) -> bool:
    first, second = scans[pair[0]], scans[pair[1]]
    if not spheres_meet(first, second, predicted_motion):
        return False
    return fit_of(first, second, predicted_motion, 1.5 * first.coarse.pitch_mm).overlap >= LEAST_OVERLAP


def _overlapping(
    scans: Sequence[PreparedScan], placed_numbers: Sequence[int], poses: Sequence[Floats]
) -> Iterator[tuple[int, int, float]]:
    """Return pairs of the placed scans, by their places in `placed_numbers`, with the overlapping share."""
    for first_place, second_place in combinations(range(len(placed_numbers)), 2):
        first, second = scans[placed_numbers[first_place]], scans[placed_numbers[second_place]]
        first_from_second = inverse_of(poses[first_place]) @ poses[second_place]
        if spheres_meet(first, second, first_from_second):
            overlap = fit_of(first, second, first_from_second, 0.7 * first.coarse.pitch_mm).overlap
            if overlap >= _LEAST_JOINT_OVERLAP:
                yield first_place, second_place, overlap


def _adjusted_registration(
    names: Sequence[str],
    scans: Sequence[PreparedScan],
    groups: Groups,
    placed_numbers: Sequence[int],
    sightings: Sightings,
    say: Say,
) -> Registration:
    placed_scans = [scans[k] for k in placed_numbers]
    into_first = inverse_of(groups.group_from_scan[placed_numbers[0]])
    poses = [into_first @ groups.group_from_scan[k] for k in placed_numbers]
    overlapping = list(_overlapping(scans, placed_numbers, poses))
    placed_sightings = sightings.of_scans(placed_numbers)
    fit = adjust(placed_scans, [pair[:2] for pair in overlapping], poses, 0, placed_sightings, say)
    strong = [(first, second) for first, second, overlap in overlapping if overlap >= LEAST_OVERLAP]
    alone = pairs_alone(placed_scans, strong, fit, say)
    fit, factor = with_loops(fit, alone, len(placed_numbers))
    loops = [
        Loop(tuple(placed_numbers[k] for k in loop.scans), loop.error_mm, loop.error_deg)
        for loop in find_loops(placed_scans, alone)
    ]
    to_first = inverse_of(fit.common_from_scan[0])
    return Registration(
        tuple(names),
        tuple(scans),
        tuple(placed_numbers),
        {number: to_first @ fit.common_from_scan[k] for k, number in enumerate(placed_numbers)},
        {number: fit.covariance[6 * k : 6 * k + 6, 6 * k : 6 * k + 6] for k, number in enumerate(placed_numbers)},
        fit.common_from_scan[0] if placed_sightings.is_anchored else None,
        tuple(k for k in range(len(scans)) if k not in placed_numbers),
        tuple(groups.accepted_motions),
        tuple(groups.rejected_motions),
        len(overlapping),
        tuple(loops),
        factor,
        tuple((placed_numbers[pair.first], placed_numbers[pair.second]) for pair in sliding_pairs(alone, factor)),
        fit,
    )
