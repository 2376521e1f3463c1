"""Targets in scans (spheres, stickers, a station of a traverse) and control points: read, matched, weighted.

A table of targets has a line for each sighting: the scan, the target's name, x, y and z in that scan's frame, and
the standard uncertainty of each in mm. A table of control points has name, x, y, z and uncertainty in the site's
frame. A station of a traverse is a target at the position of the scanner in its own scan, usually 0, 0, 0.
"""

from __future__ import annotations

import csv
from collections import defaultdict
from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import combinations
from pathlib import Path

import numpy as np

from coupole.errors import InputError, reason
from coupole.scan.registration.pair_matching import Fit, PairMotion
from coupole.scan.registration.small_motions import motion_of_points, moved_points
from coupole.scan.registration.viewpoint import Floats
from coupole.scan.scanner_export import MM_PER_UNIT

_TARGET_COLUMNS = ("scan", "name", "x", "y", "z", "u_mm")
_CONTROL_COLUMNS = ("name", "x", "y", "z", "u_mm")
LEAST_TARGETS = 3
_THINNEST = 0.02
"""Least extent of targets across a line through them, relative to the extent along it; targets must not lie on a
line."""
_SIGMAS = 6.0
"""Greatest difference, in standard uncertainties, between two sightings of the same target."""


@dataclass(frozen=True)
class Sighting:
    """A target in a scan."""

    scan: int
    name: str
    point_mm: Floats
    """[3] place in the scan's frame."""
    u_mm: float
    """Standard uncertainty of each coordinate."""
    left_mm: float = float("nan")
    """Distance from the adjusted place of the target."""


@dataclass(frozen=True)
class ControlPoint:
    """A target with a known position in the site's frame."""

    point_mm: Floats
    u_mm: float


@dataclass(frozen=True)
class Sightings:
    """All targets in all scans, and the control points among them."""

    sightings: tuple[Sighting, ...] = ()
    control: dict[str, ControlPoint] | None = None

    @property
    def is_anchored(self) -> bool:
        """True if control points determine the positions of the scans."""
        return self.control is not None

    def of_scans(self, scans: Sequence[int]) -> Sightings:
        """Return the sightings of some scans, renumbered in this order."""
        place = {scan: k for k, scan in enumerate(scans)}
        sightings = tuple(
            replace(sighting, scan=place[sighting.scan]) for sighting in self.sightings if sighting.scan in place
        )
        names = {sighting.name for sighting in sightings} & set(self.control or {})
        enough = names and not _on_a_line(np.array([(self.control or {})[name].point_mm for name in names]))
        return Sightings(sightings, self.control if enough else None)

    def by_name(self) -> dict[str, list[Sighting]]:
        sightings_of = defaultdict(list)
        for sighting in self.sightings:
            sightings_of[sighting.name].append(sighting)
        return sightings_of

    def site_from_common(self, poses: Sequence[Floats]) -> Floats:
        """Return the 4x4 transform that maps sightings of control points to these points, by least squares."""
        assert self.control is not None
        control_sightings = [sighting for sighting in self.sightings if sighting.name in self.control]
        return motion_of_points(
            np.array(
                [moved_points(poses[sighting.scan], sighting.point_mm[None])[0] for sighting in control_sightings]
            ),
            np.array([self.control[sighting.name].point_mm for sighting in control_sightings]),
        )

    def normal_equations(self, poses: Sequence[Floats], pivots: Floats) -> tuple[Floats, Floats]:
        """Return the targets' part of the equations: [6 n, 6 n] and [6 n] for steps about pivots. The targets' own
        positions are eliminated."""
        normal, gradient = np.zeros((6 * len(poses),) * 2), np.zeros(6 * len(poses))
        for name, several in self.by_name().items():
            control = (self.control or {}).get(name)
            if control is None and len(several) < 2:
                continue
            weights = np.array([sighting.u_mm**-2 for sighting in several])
            places = np.array(
                [moved_points(poses[sighting.scan], sighting.point_mm[None])[0] for sighting in several]
            )
            total = float(weights.sum() + (0 if control is None else control.u_mm**-2))
            middle = weights @ places + (0 if control is None else control.u_mm**-2 * control.point_mm)
            middle = middle / total
            summed_rows = np.zeros((3, 6 * len(poses)))
            for sighting, weight, place in zip(several, weights, places, strict=True):
                at = slice(6 * sighting.scan, 6 * sighting.scan + 6)
                rows = _rows(place - pivots[sighting.scan])
                normal[at, at] += weight * rows.T @ rows
                gradient[at] += weight * rows.T @ (place - middle)
                summed_rows[:, at] += weight * rows
            normal -= summed_rows.T @ summed_rows / total
        return normal, gradient

    def with_distances(self, poses: Sequence[Floats]) -> tuple[Sighting, ...]:
        """Return all sightings with their distances from the targets' adjusted positions."""
        sightings = []
        for name, several in self.by_name().items():
            control = (self.control or {}).get(name)
            weights = [sighting.u_mm**-2 for sighting in several] + ([] if control is None else [control.u_mm**-2])
            places = [moved_points(poses[sighting.scan], sighting.point_mm[None])[0] for sighting in several]
            middle = np.average(places + ([] if control is None else [control.point_mm]), axis=0, weights=weights)
            for sighting, place in zip(several, places, strict=True):
                sightings.append(replace(sighting, left_mm=float(np.linalg.norm(place - middle))))
        return tuple(sightings)


def _rows(arm_mm: Floats) -> Floats:
    """[3, 6] derivative of a position with respect to a step about a pivot that is `arm_mm` away."""
    x, y, z = arm_mm
    return np.array([[1, 0, 0, 0, z, -y], [0, 1, 0, -z, 0, x], [0, 0, 1, y, -x, 0]], dtype=np.float64)


def motions_by_targets(sightings: Sightings) -> list[PairMotion]:
    """Return motions between scans that share at least three targets not on a line. Raises InputError if targets
    with the same name in two scans cannot be the same target."""
    of_scan: dict[int, dict[str, Sighting]] = defaultdict(dict)
    for sighting in sightings.sightings:
        of_scan[sighting.scan][sighting.name] = sighting
    motions = []
    for first, second in combinations(sorted(of_scan), 2):
        shared_names = sorted(of_scan[first].keys() & of_scan[second].keys())
        if len(shared_names) < LEAST_TARGETS:
            continue
        first_mm = np.array([of_scan[first][name].point_mm for name in shared_names])
        second_mm = np.array([of_scan[second][name].point_mm for name in shared_names])
        if _on_a_line(first_mm):
            continue
        motion = motion_of_points(second_mm, first_mm)
        off_mm = np.linalg.norm(moved_points(motion, second_mm) - first_mm, axis=1)
        u_mm = np.array([np.hypot(of_scan[first][n].u_mm, of_scan[second][n].u_mm) for n in shared_names])
        worst = int(np.argmax(off_mm / u_mm))
        if off_mm[worst] > _SIGMAS * u_mm[worst] * np.sqrt(3):
            raise InputError(
                f"targets: `{shared_names[worst]}` is {off_mm[worst]:.3g} mm away from the place where the other "
                f"{len(shared_names) - 1} targets of two scans put it; the scans state {u_mm[worst]:.2g} mm: "
                f"another target of that name, another unit, or an uncertainty that is too small"
            )
        fit = Fit(1.0, 0.0, float(np.sqrt(np.mean(off_mm**2))), 1_000_000)
        motions.append(PairMotion(first, second, motion, fit, "targets"))
    return motions


def _on_a_line(points_mm: Floats) -> bool:
    if len(points_mm) < LEAST_TARGETS:
        return True
    extents = np.linalg.svd(points_mm - points_mm.mean(axis=0), compute_uv=False)
    return bool(extents[1] < _THINNEST * extents[0])


@dataclass(frozen=True)
class TargetTables:
    """Files with the places of targets."""

    targets: Path | None = None
    """Places in the scans."""
    control: Path | None = None
    """Places on the site, of targets whose places are known."""


NO_TARGETS = TargetTables()


def read_sightings(tables: TargetTables, names: Sequence[str], unit: str) -> Sightings:
    """Read both tables; `names` are the names of the scans, in order. Raises InputError with the line."""
    targets, control = tables.targets, tables.control
    if control is not None and targets is None:
        raise InputError(
            f"--control {control}: needs --targets, which give the places of these points in the scans"
        )
    if targets is None:
        return Sightings()
    numbers = {name: k for k, name in enumerate(names)} | {Path(name).stem: k for k, name in enumerate(names)}
    mm = MM_PER_UNIT[unit]
    sightings: list[Sighting] = []
    for line, words in _rows_of(targets, _TARGET_COLUMNS):
        if words[0] not in numbers:
            raise InputError(f"{targets}:{line}: there is no scan `{words[0]}`; there are {', '.join(names[:8])}")
        point, u_mm = _place(targets, line, words[2:], mm)
        if any(sighting.scan == numbers[words[0]] and sighting.name == words[1] for sighting in sightings):
            raise InputError(f"{targets}:{line}: target `{words[1]}` stands twice for scan `{words[0]}`")
        sightings.append(Sighting(numbers[words[0]], words[1], point, u_mm))
    if control is None:
        return Sightings(tuple(sightings))
    control_points: dict[str, ControlPoint] = {}
    for line, words in _rows_of(control, _CONTROL_COLUMNS):
        if words[0] in control_points:
            raise InputError(f"{control}:{line}: control point `{words[0]}` stands twice")
        control_points[words[0]] = ControlPoint(*_place(control, line, words[1:], mm))
    common_mm = np.array(
        [
            control_points[name].point_mm
            for name in sorted({sighting.name for sighting in sightings} & control_points.keys())
        ]
    )
    if _on_a_line(common_mm.reshape(-1, 3)):
        raise InputError(
            f"{control}: {len(common_mm)} of its points are among the targets of the scans; expected "
            f"{LEAST_TARGETS} or more that are not on a line"
        )
    return Sightings(tuple(sightings), control_points)


def _rows_of(path: Path, columns: Sequence[str]) -> list[tuple[int, list[str]]]:
    try:
        text = path.read_text(encoding="utf-8-sig")
    except (OSError, UnicodeDecodeError) as error:
        raise InputError(f"{path}: expected a table as text (UTF-8); {reason(error)}") from error
    rows = []
    separator = next((mark for mark in ";\t," if mark in text), " ")
    for number, words in enumerate(csv.reader(text.splitlines(), delimiter=separator, skipinitialspace=True), 1):
        fields = [word.strip() for word in words if word.strip()]
        if not fields or fields[0].startswith("#") or [word.lower() for word in fields] == list(columns):
            continue
        if len(fields) != len(columns):
            raise InputError(f"{path}:{number}: expected {', '.join(columns)}; found {len(fields)} columns")
        rows.append((number, fields))
    if not rows:
        raise InputError(f"{path}: expected lines with {', '.join(columns)}; there is none")
    return rows


def _place(path: Path, line: int, words: Sequence[str], mm: float) -> tuple[Floats, float]:
    try:
        numbers = np.array([float(word) for word in words])
    except ValueError:
        raise InputError(f"{path}:{line}: expected numbers, found {', '.join(words)}") from None
    if not np.all(np.isfinite(numbers)) or numbers[3] <= 0:
        raise InputError(f"{path}:{line}: expected finite coordinates and an uncertainty above 0, found {words}")
    return numbers[:3] * mm, float(numbers[3])
