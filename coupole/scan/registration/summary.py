"""Results of a registration, as JSON and in sentences."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import numpy as np

from coupole.scan.registration.merging import Merged
from coupole.scan.registration.registering import Registered
from coupole.scan.registration.small_motions import displacement_mm, inverse_of

_CONSPICUOUS = 3.0
"""Times their uncertainty that targets may be off before a sentence says so."""


def about(found: Registered, merged: Merged | None) -> dict[str, Any]:
    """The content of `registration.json`; lengths in mm, angles in degrees."""
    summary: dict[str, Any] = {
        "frame": found.names[found.placed[0]],
        "poses": {found.names[k]: found.first_from_scan[k].tolist() for k in found.placed},
        "uncertainties": {found.names[k]: _uncertainty(found, k) for k in found.placed},
        "rms_mm": found.fit.rms_mm,
        "median_overlap_mm": found.fit.median_nearest_mm,
        "noise_mm": found.fit.noise_mm,
        "overlapping_pairs": found.pairs,
        "matched_pairs": len(found.motions),
        "loops": [
            {"scans": [found.names[k] for k in loop.scans], "error_mm": loop.error_mm, "error_deg": loop.error_deg}
            for loop in found.loops
        ],
        "loop_factor": found.loop_factor,
        "rejected": [[found.names[m.first], found.names[m.second]] for m in found.rejected],
        "unplaced": [found.names[k] for k in found.unplaced],
        "viewpoints": {scan.name: scan.viewpoint.stand for scan in found.scans},
    }
    if found.fit.sightings:
        summary["targets"] = [
            {
                "scan": found.names[found.placed[sighting.scan]],
                "name": sighting.name,
                "u_mm": sighting.u_mm,
                "off_mm": sighting.left_mm,
            }
            for sighting in found.fit.sightings
        ]
    if found.site_from_first is not None:
        summary["site_from_first"] = found.site_from_first.tolist()
    off_mm = stated_poses_off_mm(found)
    if off_mm:
        summary["stated_poses_off_mm"] = off_mm
    if merged is not None:
        summary["mesh"] = {
            "vertices": merged.vertices,
            "triangles": merged.triangles,
            "points": merged.points,
            "cell_mm": merged.cell_mm,
            "colours": merged.coloured,
        }
        summary["levels"] = merged.levels
    return summary


def _uncertainty(found: Registered, number: int) -> dict[str, Any]:
    covariance = found.covariance[number]
    return {
        "position_mm": np.sqrt(np.diag(covariance)[:3]).tolist(),
        "orientation_deg": np.degrees(np.sqrt(np.diag(covariance)[3:])).tolist(),
        "of_a_point_mm": point_uncertainty_mm(found, number),
        "covariance": covariance.tolist(),
        "about_mm": found.fit.pivots_mm[found.placed.index(number)].tolist(),
    }


def point_uncertainty_mm(found: Registered, number: int) -> float:
    """Root mean square displacement of a scan's points by the uncertainty of its pose (68 %)."""
    covariance, points = found.covariance[number], found.scans[number].coarse.points_mm
    arms = points - points.mean(axis=0)
    turn = found.fit.common_from_scan[found.placed.index(number)][:3, :3]
    arm_moments = (arms @ turn.T).T @ (arms @ turn.T) / len(arms)
    turning = np.trace(arm_moments) * np.eye(3) - arm_moments
    return float(np.sqrt(np.trace(covariance[:3, :3]) + np.sum(turning * covariance[3:, 3:])))


def stated_poses_off_mm(found: Registered) -> dict[str, float]:
    """Root mean square displacement of each scan's points from where the pose that its file states puts them, seen
    from the first placed scan that states one."""
    stated_poses = {k: pose for k in found.placed if (pose := found.scans[k].stated_pose) is not None}
    if len(stated_poses) < 2:
        return {}
    first = min(stated_poses)
    off = {}
    for k, pose in stated_poses.items():
        by_file = inverse_of(stated_poses[first]) @ pose
        by_us = inverse_of(found.first_from_scan[first]) @ found.first_from_scan[k]
        off[found.names[k]] = displacement_mm(by_file, by_us, found.scans[k].coarse.points_mm)
    return off


def worst_loop_mm(found: Registered) -> float:
    """0 where there is no loop."""
    return found.loops[0].error_mm if found.loops else 0.0


def remarks(found: Registered) -> Iterator[str]:
    """Yield remarks that the reader must know, one sentence each."""
    names = found.names
    yield (
        f"{len(found.placed)} of {len(names)} scans placed by {found.pairs} overlapping pairs; surfaces lie on "
        f"each other within {found.fit.rms_mm:.3g} mm (root mean square along their normals)"
    )
    if found.loops:
        middle = float(np.median([loop.error_mm for loop in found.loops]))
        yield (
            f"{len(found.loops)} loops of pairs close within {middle:.3g} mm in the median, "
            f"{worst_loop_mm(found):.3g} mm at worst"
        )
    else:
        yield "no loop closes: a wrong pair would not be noticed, and uncertainties are those of noise alone"
    if found.loop_factor > 1.05:
        yield (
            f"loops close {found.loop_factor:.1f} times worse than noise explains; all uncertainties are enlarged "
            "by that"
        )
    if found.unplaced:
        yield "not placed, as they overlap no other enough: " + ", ".join(names[k] for k in found.unplaced)
    if found.rejected:
        yield f"{len(found.rejected)} pairs were rejected, as others contradict them"
    if off_mm := stated_poses_off_mm(found):
        worst = max(off_mm, key=lambda name: off_mm[name])
        yield (
            f"poses stated by the files put points {np.median(list(off_mm.values())):.3g} mm in the median from "
            f"where they are found, {off_mm[worst]:.3g} mm at worst ({worst})"
        )
    blind = [scan.name for scan in found.scans if scan.viewpoint.stand == "none"]
    if blind:
        yield (
            "seen from nowhere that is known, so that empty space before them proves nothing (see --seen-from): "
            + ", ".join(blind)
        )
    for sighting in found.fit.sightings:
        if sighting.left_mm > _CONSPICUOUS * np.sqrt(3) * sighting.u_mm:
            yield (
                f"target {sighting.name} of {names[found.placed[sighting.scan]]} is {sighting.left_mm:.3g} mm "
                f"off, stated are {sighting.u_mm:.2g} mm"
            )
