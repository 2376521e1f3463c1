"""Motions for views: a posture of the arm for each view, and collision-free paths between them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Literal, TypeAlias, assert_never

import numpy as np
from numpy.typing import NDArray

from coupole import kinematics
from coupole.errors import InputError
from coupole.geometry import Transform, inverse
from coupole.intake.input_files import InputFiles
from coupole.motion import singularities
from coupole.motion.bodies import Capsule
from coupole.motion.collisions import CellBodies, Clearances, Surroundings
from coupole.motion.ordering import shortest_tour
from coupole.motion.path_deviation import PATH_TOLERANCE_MM
from coupole.motion.path_planner import Joints, Leg, PathPlanner
from coupole.motion.sphere_tree import surface_points
from coupole.plan.led_table import LedTable
from coupole.plan.rig import KeepOutBox, KeepOutSphere, Rig
from coupole.plan.rig_devices import described_arm, planning_arm
from coupole.plan.schedule import ViewPose

Vector: TypeAlias = tuple[float, float, float]
KeptOutSphere: TypeAlias = tuple[str, Vector, float]
KeptOutBox: TypeAlias = tuple[str, Vector, Vector]

POSTURE_COST_S = 0.3
"""Longest additional time that is accepted for a posture that is farther from limits and singularities."""


@dataclass(frozen=True)
class Visit:
    """One visited view: its joint angles [6] and the leg to it."""

    joints_deg: Joints
    leg: Leg


@dataclass(frozen=True)
class Itinerary:
    """Visits, one for each view. It is None if a view cannot be visited; the reasons are in `refusals`."""

    visits: tuple[Visit | None, ...]
    refusals: tuple[str, ...]
    order: tuple[int, ...]
    """Indices of the views in the order of the visits; each leg begins at the previous visit. Refused views are
    left out."""
    is_from_home: bool = False
    """True if each leg begins at home instead, because the order of the visits is not known beforehand."""


def arm_of(rig: Rig) -> kinematics.Arm:
    """Return the rig's arm with the speeds and limits for plans. These are the driver's, within the posture limits
    of the arm's description. Raises InputError if the arm has no description."""
    arm, description = planning_arm(rig), described_arm(rig)
    if arm is None or description is None:
        raise undescribed_arm_error(rig)
    limits_deg = zip(arm.limits_deg, description.posture_limits_deg, strict=True)
    return replace(arm, limits_deg=tuple((max(a[0], b[0]), min(a[1], b[1])) for a, b in limits_deg))


def undescribed_arm_error(rig: Rig) -> InputError:
    """Return the error for a rig whose arm has no description."""
    return InputError(f"nothing describes the arm that `{rig.robot.driver}` moves: name its file under `arm:`")


def bodies_of(
    rig: Rig,
    leds: LedTable,
    object_corners_support_mm: NDArray[np.float64],
    link_meshes: Path | None = None,
    files: InputFiles | None = None,
) -> CellBodies:
    """Return the rig's arm, tool and obstacles, with the object's mesh ([triangles, 3, 3], support frame).

    `link_meshes` is a folder of meshes that replace the capsules of the arm's links, read from `files` if they are
    given. Raises InputError if they cannot be read, or if the arm has no description.
    """
    arm = described_arm(rig)
    if arm is None:
        raise undescribed_arm_error(rig)
    base_from_support = rig.support.base_from_support.matrix()
    support_from_base = inverse(base_from_support)
    leds_mm = leds.positions_mm @ support_from_base[:3, :3].T + support_from_base[:3, 3]
    radius_mm = np.linalg.norm(leds_mm, axis=1)
    elevation_deg = np.degrees(np.arcsin(leds_mm[:, 2] / radius_mm))
    keep = rig.clearances
    return CellBodies(
        arm,
        Surroundings(
            base_from_support,
            rig.support.diameter_mm / 2,
            float(radius_mm.min()),
            float(elevation_deg.max()),
            surface_points(object_corners_support_mm),
            *_keep_outs(rig),
        ),
        [Capsule(body.name, 7, body.from_mm, body.to_mm, body.radius_mm) for body in rig.tool],
        Clearances(
            keep.object_mm, keep.support_mm, keep.dome_mm, keep.self_mm, keep.keep_out_mm, PATH_TOLERANCE_MM
        ),
        link_meshes,
        files,
    )


def _keep_outs(rig: Rig) -> tuple[tuple[KeptOutSphere, ...], tuple[KeptOutBox, ...]]:
    """Return the rig's keep-out volumes by shape. Spheres have name, centre and radius; boxes have name, lowest
    and highest corner; mm."""
    spheres: list[KeptOutSphere] = []
    boxes: list[KeptOutBox] = []
    for volume in rig.keep_out:
        match volume:
            case KeepOutSphere():
                spheres.append((volume.name, volume.center_mm, volume.radius_mm))
            case KeepOutBox():
                boxes.append((volume.name, volume.min_mm, volume.max_mm))
            case _:
                assert_never(volume)
    return tuple(spheres), tuple(boxes)


def base_from_flange(view: ViewPose, rig: Rig) -> Transform:
    """Return the flange's pose for a view that is given as a camera pose."""
    assert view.support_from_camera is not None
    base_from_camera = rig.support.base_from_support.matrix() @ view.support_from_camera
    flange: Transform = base_from_camera @ inverse(rig.flange_from_camera.matrix())
    return flange


def plan_itinerary(
    views: Sequence[ViewPose],
    rig: Rig,
    bodies: CellBodies | None,
    start_deg: Sequence[float],
    order: Literal["fastest", "as_written"] = "fastest",
) -> Itinerary:
    """Return order, postures and legs of views with the least total time from the arm's posture, or in the given
    order.

    Without `bodies` collisions are ignored: straight motions only.
    """
    arm = arm_of(rig)
    planner = PathPlanner(arm, bodies, [rig.motion.home_joints_deg])
    refusals = rig_refusals(rig)
    choices: dict[int, NDArray[np.float64]] = {}
    for index, view in enumerate(views):
        postures, why_not = postures_of(view, rig, bodies)
        if why_not:
            refusals.append(f"view {view.name}: {why_not}")
        else:
            choices[index] = postures
    start = np.asarray(start_deg, dtype=np.float64)
    while True:
        posture_cost_s = [
            POSTURE_COST_S * singularities.posture_cost(arm, postures) for postures in choices.values()
        ]
        tour = shortest_tour(
            planner, start, list(choices.values()), posture_cost_s, as_written=order == "as_written"
        )
        visit_indices = [list(choices)[group] for group in tour.order]
        contacts = [leg.contact for leg in tour.legs]
        cut_off = next((k for k, contact in enumerate(contacts) if contact is not None), None)
        if cut_off is None:
            break
        before = f"view {views[visit_indices[cut_off - 1]].name}" if cut_off else "where the arm stands"
        name = views[visit_indices[cut_off]].name
        refusals.append(f"view {name}: no path to it was found from {before}: {contacts[cut_off]}")
        del choices[visit_indices[cut_off]]  # later views may still be reachable without it
    visits: list[Visit | None] = [None] * len(views)
    for index, joints, leg in zip(visit_indices, tour.places, tour.legs, strict=True):
        visits[index] = Visit(joints, leg)
    return Itinerary(tuple(visits), tuple(refusals), tuple(visit_indices))


def rig_refusals(rig: Rig) -> list[str]:
    """Refusals that concern the rig and not the plan."""
    refusals = []
    if violation := kinematics.limit_violations(arm_of(rig), rig.motion.home_joints_deg):
        refusals.append(f"rig: at home {violation}")
    return refusals


def postures_of(view: ViewPose, rig: Rig, bodies: CellBodies | None) -> tuple[NDArray[np.float64], str]:
    """Return joint angles [k, 6] of a view without contacts and singularities, or the reason why there are
    none."""
    arm = arm_of(rig)
    if view.joints_deg is not None:
        postures = np.array([view.joints_deg], dtype=np.float64)
        if violation := kinematics.limit_violations(arm, view.joints_deg):
            return postures, violation
    else:
        pose = base_from_flange(view, rig)
        postures = kinematics.inverse(arm, pose)
        if len(postures) == 0:
            return postures, kinematics.unreachable_reason(arm, pose)
    tightest_mm = bodies.tightest_mm(postures) if bodies is not None else np.zeros(len(postures))
    if bodies is not None and tightest_mm.max() < 0:
        return postures, str(bodies.contacts(postures[int(np.argmax(tightest_mm))])[0])
    postures = postures[tightest_mm >= 0]
    margin = singularities.margin(arm, postures)
    if margin.max() < 1.0:
        return postures, singularities.reason(arm, postures[int(np.argmax(margin))])
    return postures[margin >= 1.0], ""
