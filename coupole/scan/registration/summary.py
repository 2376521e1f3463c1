"""Results of a registration, as JSON and in sentences."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import numpy as np

from coupole.scan.registration.merging import Merged
from coupole.scan.registration.registering import Registration
from coupole.scan.registration.small_motions import displacement_mm, inverse_of

_CONSPICUOUS = 3.0
"""A target is reported if its error divided by its uncertainty is above this ratio."""


def about(registration: Registration, merged_mesh: Merged | None) -> dict[str, Any]:
    """The content of `registration.json`; lengths in mm, angles in degrees."""
    summary: dict[str, Any] = {
        "frame": registration.names[registration.placed_numbers[0]],
        "poses": {
            registration.names[k]: registration.first_from_scan[k].tolist() for k in registration.placed_numbers
        },
        "uncertainties": {
            registration.names[k]: _uncertainty(registration, k) for k in registration.placed_numbers
        },
        "rms_mm": registration.fit.rms_mm,
        "median_overlap_mm": registration.fit.median_nearest_mm,
        "noise_mm": registration.fit.noise_mm,
        "overlapping_pairs": registration.pairs,
        "matched_pairs": len(registration.motions),
        "loops": [
            {
                "scans": [registration.names[k] for k in loop.scans],
                "error_mm": loop.error_mm,
                "error_deg": loop.error_deg,
            }
            for loop in registration.loops
        ],
        "loop_factor": registration.loop_factor,
        "sliding_pairs": [[registration.names[k] for k in pair] for pair in registration.sliding_pairs],
        "rejected": [
            [registration.names[m.first], registration.names[m.second]] for m in registration.rejected_motions
        ],
        "unplaced": [registration.names[k] for k in registration.unplaced_numbers],
        "viewpoints": {scan.name: scan.viewpoint.stand for scan in registration.scans},
    }
    if registration.fit.sightings:
        summary["targets"] = [
            {
                "scan": registration.names[registration.placed_numbers[sighting.scan]],
                "name": sighting.name,
                "u_mm": sighting.u_mm,
                "off_mm": sighting.left_mm,
            }
            for sighting in registration.fit.sightings
        ]
    if registration.site_from_first is not None:
        summary["site_from_first"] = registration.site_from_first.tolist()
    off_mm = stated_poses_off_mm(registration)
    if off_mm:
        summary["stated_poses_off_mm"] = off_mm
    if merged_mesh is not None:
        summary["mesh"] = {
            "frame": frame_of_mesh(registration, merged_mesh),
            "vertices": merged_mesh.vertices,
            "triangles": merged_mesh.triangles,
            "points": merged_mesh.points,
            "cell_mm": merged_mesh.cell_mm,
            "colours": merged_mesh.has_colours,
        }
        summary["levels"] = merged_mesh.levels
    return summary


def frame_of_mesh(registration: Registration, merged_mesh: Merged) -> str:
    """Return `site` for the frame of the control points, otherwise the first placed scan's name."""
    is_on_site = registration.is_merged_on_site(merged_mesh.cell_mm)
    return "site" if is_on_site else registration.names[registration.placed_numbers[0]]


def _uncertainty(registration: Registration, number: int) -> dict[str, Any]:
    covariance = registration.covariance[number]
    return {
        "position_mm": np.sqrt(np.diag(covariance)[:3]).tolist(),
        "orientation_deg": np.degrees(np.sqrt(np.diag(covariance)[3:])).tolist(),
        "of_a_point_mm": point_uncertainty_mm(registration, number),
        "covariance": covariance.tolist(),
        "about_mm": registration.fit.pivots_mm[registration.placed_numbers.index(number)].tolist(),
    }


def point_uncertainty_mm(registration: Registration, number: int) -> float:
    """Return the root mean square displacement of a scan's points from the uncertainty of its pose (68 %)."""
    covariance, points = registration.covariance[number], registration.scans[number].coarse.points_mm
    arms = points - points.mean(axis=0)
    turn = registration.fit.common_from_scan[registration.placed_numbers.index(number)][:3, :3]
    arm_moments = (arms @ turn.T).T @ (arms @ turn.T) / len(arms)
    turning = np.trace(arm_moments) * np.eye(3) - arm_moments
    return float(np.sqrt(np.trace(covariance[:3, :3]) + np.sum(turning * covariance[3:, 3:])))


def stated_poses_off_mm(registration: Registration) -> dict[str, float]:
    """Return the root mean square displacement of each scan's points from the pose that its file states, relative
    to the first placed scan with a stated pose."""
    stated_poses = {
        k: pose for k in registration.placed_numbers if (pose := registration.scans[k].stated_pose) is not None
    }
    if len(stated_poses) < 2:
        return {}
    first = min(stated_poses)
    off = {}
    for k, pose in stated_poses.items():
        by_file = inverse_of(stated_poses[first]) @ pose
        by_us = inverse_of(registration.first_from_scan[first]) @ registration.first_from_scan[k]
        off[registration.names[k]] = displacement_mm(by_file, by_us, registration.scans[k].coarse.points_mm)
    return off


def worst_loop_mm(registration: Registration) -> float:
    """Return the worst closure error of a loop, mm; 0 without loops."""
    return registration.loops[0].error_mm if registration.loops else 0.0


def _sliding(registration: Registration) -> str:
    count, names = len(registration.sliding_pairs), registration.names
    some = ", ".join(f"{names[a]} on {names[b]}" for a, b in registration.sliding_pairs[:3])
    pairs_do = "1 pair does" if count == 1 else f"{count} pairs do"
    more = ", ..." if count > 3 else ""
    return f"{pairs_do} not determine a pose by overlap alone ({some}{more}): the other pairs place these scans"


def remarks(registration: Registration) -> Iterator[str]:
    """Yield important remarks, one sentence each."""
    names = registration.names
    yield (
        f"{len(registration.placed_numbers)} of {len(names)} scans placed by {registration.pairs} overlapping "
        f"pairs; surfaces agree within {registration.fit.rms_mm:.3g} mm (root mean square along their normals)"
    )
    if registration.loops:
        middle = float(np.median([loop.error_mm for loop in registration.loops]))
        worst_mm = worst_loop_mm(registration)
        if len(registration.loops) == 1:
            yield f"the one loop of pairs closes within {worst_mm:.3g} mm"
        else:
            yield (
                f"{len(registration.loops)} loops of pairs close within {middle:.3g} mm in the median, "
                f"{worst_mm:.3g} mm at worst"
            )
    else:
        yield "no loop closes: a wrong pair would not be noticed, and uncertainties are from noise alone"
    if registration.loop_factor > 1.05:
        yield (
            f"pairs adjusted alone differ {registration.loop_factor:.1f} times more than noise explains; all "
            "uncertainties from overlaps are multiplied by this factor"
        )
    if registration.sliding_pairs:
        yield _sliding(registration)
    if registration.unplaced_numbers:
        yield "not placed, because they overlap no other scan enough: " + ", ".join(
            names[k] for k in registration.unplaced_numbers
        )
    if registration.rejected_motions:
        yield f"{len(registration.rejected_motions)} pairs were rejected, because others contradict them"
    if off_mm := stated_poses_off_mm(registration):
        worst = max(off_mm, key=lambda name: off_mm[name])
        yield (
            f"poses stated by the files put points {np.median(list(off_mm.values())):.3g} mm in the median from "
            f"where they are found, {off_mm[worst]:.3g} mm at worst ({worst})"
        )
    blind = [scan.name for scan in registration.scans if scan.viewpoint.stand == "none"]
    if blind:
        yield (
            "the scanner's place is not known for these scans, so the empty space in front of them was not used "
            "as a test (see --seen-from): " + ", ".join(blind)
        )
    for sighting in registration.fit.sightings:
        if sighting.left_mm > _CONSPICUOUS * np.sqrt(3) * sighting.u_mm:
            yield (
                f"target {sighting.name} of {names[registration.placed_numbers[sighting.scan]]} is "
                f"{sighting.left_mm:.3g} mm off, with a stated uncertainty of {sighting.u_mm:.2g} mm"
            )
