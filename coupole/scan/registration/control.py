"""Targets in scans (spheres, stickers, a station of a traverse) and control points: read, matched, weighed.

A table of targets has a line for each sighting: the scan, the target's name, x, y and z in that scan's frame,
and the standard uncertainty of each in mm. A table of control points has name, x, y, z and uncertainty in the
site's frame. A station of a traverse is a target at the place of the scanner in its own scan, mostly 0, 0, 0.
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
from coupole.scan.registration.small_motions import applied, motion_of_points
from coupole.scan.registration.viewpoint import Floats
from coupole.scan.scanner_export import MM_PER_UNIT

_TARGET_COLUMNS = ("scan", "name", "x", "y", "z", "u_mm")
_CONTROL_COLUMNS = ("name", "x", "y", "z", "u_mm")
LEAST_TARGETS = 3
_THINNEST = 0.02
"""Least extent of targets across their line, over that along it: they must not lie on a line."""
_SIGMAS = 6.0
"""Beyond so many standard uncertainties two sightings are not of the same target."""


@dataclass(frozen=True)
class Sighting:
    """A target in a scan."""

    scan: int
    name: str
    point_mm: Floats
    """[3] in the scan's frame."""
    u_mm: float
    """Standard uncertainty of each coordinate."""
    left_mm: float = float("nan")
    """Distance from the adjusted place of the target."""


@dataclass(frozen=True)
class ControlPoint:
    """A target whose place in the site's frame is known."""

    point_mm: Floats
    u_mm: float


@dataclass(frozen=True)
class Sightings:
    """All targets in all scans, and the control points among them."""

    seen: tuple[Sighting, ...] = ()
    control: dict[str, ControlPoint] | None = None

    @property
    def anchored(self) -> bool:
        """True if control points determine where the scans are."""
        return self.control is not None

    def of_scans(self, scans: Sequence[int]) -> Sightings:
        """Return the sightings of some scans, which are numbered anew in this order."""
        place = {scan: k for k, scan in enumerate(scans)}
        kept = tuple(replace(one, scan=place[one.scan]) for one in self.seen if one.scan in place)
        known = {one.name for one in kept} & set(self.control or {})
        enough = known and not _on_a_line(np.array([(self.control or {})[name].point_mm for name in known]))
        return Sightings(kept, self.control if enough else None)

    def by_name(self) -> dict[str, list[Sighting]]:
        found = defaultdict(list)
        for one in self.seen:
            found[one.name].append(one)
        return found

    def site_from_common(self, poses: Sequence[Floats]) -> Floats:
        """4x4 that brings sightings of control points onto these, by least squares."""
        assert self.control is not None
        known = [one for one in self.seen if one.name in self.control]
        return motion_of_points(
            np.array([applied(poses[one.scan], one.point_mm[None])[0] for one in known]),
            np.array([self.control[one.name].point_mm for one in known]),
        )

    def normal_equations(self, poses: Sequence[Floats], pivots: Floats) -> tuple[Floats, Floats]:
        """Return the targets' part of the equations: [6 n, 6 n] and [6 n] of steps about pivots; the targets' own
        places are eliminated."""
        normal, gradient = np.zeros((6 * len(poses),) * 2), np.zeros(6 * len(poses))
        for name, several in self.by_name().items():
            known = (self.control or {}).get(name)
            if known is None and len(several) < 2:
                continue
            weights = np.array([one.u_mm**-2 for one in several])
            places = np.array([applied(poses[one.scan], one.point_mm[None])[0] for one in several])
            total = float(weights.sum() + (0 if known is None else known.u_mm**-2))
            middle = weights @ places + (0 if known is None else known.u_mm**-2 * known.point_mm)
            middle = middle / total
            summed = np.zeros((3, 6 * len(poses)))
            for one, weight, place in zip(several, weights, places, strict=True):
                at = slice(6 * one.scan, 6 * one.scan + 6)
                rows = _rows(place - pivots[one.scan])
                normal[at, at] += weight * rows.T @ rows
                gradient[at] += weight * rows.T @ (place - middle)
                summed[:, at] += weight * rows
            normal -= summed.T @ summed / total
        return normal, gradient

    def left(self, poses: Sequence[Floats]) -> tuple[Sighting, ...]:
        """All sightings with their distances from the targets' adjusted places."""
        found = []
        for name, several in self.by_name().items():
            known = (self.control or {}).get(name)
            weights = [one.u_mm**-2 for one in several] + ([] if known is None else [known.u_mm**-2])
            places = [applied(poses[one.scan], one.point_mm[None])[0] for one in several]
            middle = np.average(places + ([] if known is None else [known.point_mm]), axis=0, weights=weights)
            for one, place in zip(several, places, strict=True):
                found.append(replace(one, left_mm=float(np.linalg.norm(place - middle))))
        return tuple(found)


def _rows(arm_mm: Floats) -> Floats:
    """[3, 6] derivative of a place by a step about a pivot that is `arm_mm` away."""
    x, y, z = arm_mm
    return np.array([[1, 0, 0, 0, z, -y], [0, 1, 0, -z, 0, x], [0, 0, 1, y, -x, 0]], dtype=np.float64)


def motions_by_targets(sightings: Sightings) -> list[PairMotion]:
    """Motions between scans that share three targets or more that are not on a line. Raises InputError if names
    that two scans share cannot be of the same targets."""
    of_scan: dict[int, dict[str, Sighting]] = defaultdict(dict)
    for sighting in sightings.seen:
        of_scan[sighting.scan][sighting.name] = sighting
    found = []
    for first, second in combinations(sorted(of_scan), 2):
        shared = sorted(of_scan[first].keys() & of_scan[second].keys())
        if len(shared) < LEAST_TARGETS:
            continue
        one = np.array([of_scan[first][name].point_mm for name in shared])
        other = np.array([of_scan[second][name].point_mm for name in shared])
        if _on_a_line(one):
            continue
        motion = motion_of_points(other, one)
        off_mm = np.linalg.norm(applied(motion, other) - one, axis=1)
        u_mm = np.array([np.hypot(of_scan[first][n].u_mm, of_scan[second][n].u_mm) for n in shared])
        worst = int(np.argmax(off_mm / u_mm))
        if off_mm[worst] > _SIGMAS * u_mm[worst] * np.sqrt(3):
            raise InputError(
                f"targets: `{shared[worst]}` is {off_mm[worst]:.3g} mm away from where the other "
                f"{len(shared) - 1} targets of two scans put it, which state {u_mm[worst]:.2g} mm: another "
                "target of that name, another unit, or an uncertainty that is too small"
            )
        fit = Fit(1.0, 0.0, float(np.sqrt(np.mean(off_mm**2))), 1_000_000)
        found.append(PairMotion(first, second, motion, fit, "targets"))
    return found


def _on_a_line(points_mm: Floats) -> bool:
    if len(points_mm) < LEAST_TARGETS:
        return True
    extents = np.linalg.svd(points_mm - points_mm.mean(axis=0), compute_uv=False)
    return bool(extents[1] < _THINNEST * extents[0])


def read_sightings(targets: Path | None, control: Path | None, names: Sequence[str], unit: str) -> Sightings:
    """Tables of targets and control points; `names` are the scans', in order. Raises InputError with the line."""
    if control is not None and targets is None:
        raise InputError(f"--control {control}: needs --targets, which say where the scans see these points")
    if targets is None:
        return Sightings()
    numbers = {name: k for k, name in enumerate(names)} | {Path(name).stem: k for k, name in enumerate(names)}
    mm = MM_PER_UNIT[unit]
    seen: list[Sighting] = []
    for line, words in _rows_of(targets, _TARGET_COLUMNS):
        if words[0] not in numbers:
            raise InputError(f"{targets}:{line}: there is no scan `{words[0]}`; there are {', '.join(names[:8])}")
        point, u_mm = _place(targets, line, words[2:], mm)
        if any(one.scan == numbers[words[0]] and one.name == words[1] for one in seen):
            raise InputError(f"{targets}:{line}: target `{words[1]}` stands twice for scan `{words[0]}`")
        seen.append(Sighting(numbers[words[0]], words[1], point, u_mm))
    if control is None:
        return Sightings(tuple(seen))
    known: dict[str, ControlPoint] = {}
    for line, words in _rows_of(control, _CONTROL_COLUMNS):
        if words[0] in known:
            raise InputError(f"{control}:{line}: control point `{words[0]}` stands twice")
        known[words[0]] = ControlPoint(*_place(control, line, words[1:], mm))
    used = np.array([known[name].point_mm for name in sorted({one.name for one in seen} & known.keys())])
    if _on_a_line(used.reshape(-1, 3)):
        raise InputError(
            f"{control}: {len(used)} of its points are among the targets of the scans; expected "
            f"{LEAST_TARGETS} or more that are not on a line"
        )
    return Sightings(tuple(seen), known)


def _rows_of(path: Path, columns: Sequence[str]) -> list[tuple[int, list[str]]]:
    try:
        text = path.read_text(encoding="utf-8-sig")
    except (OSError, UnicodeDecodeError) as error:
        raise InputError(f"{path}: expected a table as text (UTF-8); {reason(error)}") from error
    rows = []
    separator = next((mark for mark in ";\t," if mark in text), " ")
    for number, words in enumerate(csv.reader(text.splitlines(), delimiter=separator, skipinitialspace=True), 1):
        kept = [word.strip() for word in words if word.strip()]
        if not kept or kept[0].startswith("#") or [word.lower() for word in kept] == list(columns):
            continue
        if len(kept) != len(columns):
            raise InputError(f"{path}:{number}: expected {', '.join(columns)}; found {len(kept)} columns")
        rows.append((number, kept))
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
