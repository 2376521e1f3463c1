"""Candidate views of a suggestion: directions around targets on the object that the arm can reach."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from coupole.geometry import direction, farthest_first
from coupole.motion.itinerary import postures_of
from coupole.plan.plan import LookAt
from coupole.plan.rig import Rig
from coupole.plan.schedule import expand_view
from coupole.preflight.job import Job
from coupole.reflectance.suggestion.supposed_signal import SeenParts, SupposedCell, Surface

Floats = NDArray[np.float64]

ELEVATIONS_DEG = {85: 1, 65: 6, 45: 8, 25: 8}
"""Elevations of candidates, and the number of azimuths for each."""
_FIRST_AZIMUTH_DEG = -90.0
_FIELD_SHARE = 0.45
"""Distance from a target, as a share of the shorter side of the field, within which a view shows the surface."""
_LEAST_FACING = 0.25
"""Least cosine between a target's normal and the direction of a view, if there are several targets."""
_MOST_TARGETS = 40


@dataclass(frozen=True)
class Candidate:
    """A possible view, and the parts of the surface that it would see."""

    view: LookAt
    seen_parts: SeenParts


def candidates_of(job: Job, cell: SupposedCell, say: Callable[[str, int, int], None]) -> list[Candidate]:
    """Return all views that the arm can reach without contact and that see something in focus; empty if there is
    no such view."""
    wanted_views = list(_directions(cell.surface, cell.rig))
    candidates = []
    for number, view in enumerate(wanted_views, start=1):
        say("views that the arm can take", number, len(wanted_views))
        pose = expand_view(view)[0]
        postures, why_not = postures_of(pose, cell.rig, job.motion.bodies)
        if why_not or pose.support_from_camera is None:
            continue
        seen_parts = cell.seen_by(postures[0], pose.support_from_camera)
        if (seen_parts.pixels > 0.0).any():
            candidates.append(Candidate(view, seen_parts))
    return candidates


def field_mm(rig: Rig) -> float:
    """Return the shorter side of the field of view at the focus distance."""
    image_mm = 1.0 / (1.0 / rig.lens.focal_length_mm - 1.0 / rig.lens.focus_distance_mm)
    sensor_mm = min(rig.sensor.width_px, rig.sensor.height_px) * rig.sensor.pixel_pitch_um * 1e-3
    return sensor_mm * rig.lens.focus_distance_mm / image_mm


def _directions(surface: Surface, rig: Rig) -> Iterator[LookAt]:
    targets = _targets(surface, _FIELD_SHARE * field_mm(rig))
    for number, (target_mm, normal) in enumerate(targets, start=1):
        for elevation_deg, azimuths in ELEVATIONS_DEG.items():
            for k in range(azimuths):
                azimuth_deg = (_FIRST_AZIMUTH_DEG + 360.0 * k / azimuths + 180.0) % 360.0 - 180.0
                if normal is not None and direction(azimuth_deg, elevation_deg) @ normal < _LEAST_FACING:
                    continue
                place = f"t{number:02d}-" if len(targets) > 1 else ""
                yield LookAt(
                    kind="look_at",
                    name=f"{place}az{round(azimuth_deg) % 360:03d}-el{elevation_deg:02d}",
                    target_mm=(target_mm[0], target_mm[1], target_mm[2]),
                    distance_mm=rig.lens.focus_distance_mm,
                    azimuth_deg=azimuth_deg,
                    elevation_deg=elevation_deg,
                )


def _targets(surface: Surface, reach_mm: float) -> list[tuple[list[float], Floats | None]]:
    """Return points to look at, with the normals there. If views of the object's middle show all of it, return the
    middle alone, without a normal."""
    points_mm = surface.points_mm
    middle_mm = (points_mm.min(axis=0) + points_mm.max(axis=0)) / 2.0
    if np.linalg.norm(points_mm - middle_mm, axis=1).max() <= reach_mm:
        return [(_round_to_tenths(middle_mm), None)]
    targets: list[tuple[list[float], Floats | None]] = []
    for part, distance_mm in farthest_first(points_mm, int(np.argmax(points_mm[:, 2]))):
        if distance_mm <= reach_mm or len(targets) == _MOST_TARGETS:
            break
        targets.append((_round_to_tenths(points_mm[part]), surface.normals[part]))
    return targets


def _round_to_tenths(point_mm: Floats) -> list[float]:
    return [round(float(value), 1) + 0.0 for value in point_mm]
