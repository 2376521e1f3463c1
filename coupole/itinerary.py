"""From views to motions: a posture of the arm for each view, and ways between them that touch nothing."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from coupole import kinematics
from coupole.collisions import Capsule, CellBodies, Clearances, Surroundings, surface_points
from coupole.dome import LedTable
from coupole.geometry import Transform, inverse
from coupole.paths import Joints, Leg, PathPlanner, choose_postures
from coupole.rig import KeepOutBox, KeepOutSphere, Rig
from coupole.shots import ViewPose


@dataclass(frozen=True)
class Visit:
    """One view on the way: the joint angles there [6] and the leg that leads to them."""

    joints_deg: Joints
    leg: Leg


@dataclass(frozen=True)
class Itinerary:
    """Visits in the order of the views, None where a view cannot be visited; why not is in `refusals`."""

    visits: tuple[Visit | None, ...]
    refusals: tuple[str, ...]


def arm_of(rig: Rig) -> kinematics.Arm:
    """The rig's arm with the speeds that plans are run at."""
    return kinematics.slowed(
        kinematics.KR10_R1100_SIXX,
        speed_fraction=rig.motion.speed_fraction,
        acceleration_deg_s2=rig.motion.acceleration_deg_s2,
        jerk_deg_s3=rig.motion.jerk_deg_s3,
    )


def bodies_of(rig: Rig, leds: LedTable, object_corners_support_mm: NDArray[np.float64]) -> CellBodies:
    """The rig's arm, tool and surroundings, with the object's mesh ([triangles, 3, 3], support frame)."""
    base_from_support = rig.support.base_from_support.matrix()
    support_from_base = inverse(base_from_support)
    leds_mm = leds.positions_mm @ support_from_base[:3, :3].T + support_from_base[:3, 3]
    radius_mm = np.linalg.norm(leds_mm, axis=1)
    elevation_deg = np.degrees(np.arcsin(leds_mm[:, 2] / radius_mm))
    keep = rig.clearances
    return CellBodies(
        kinematics.KR10_R1100_SIXX,
        Surroundings(
            base_from_support,
            rig.support.diameter_mm / 2,
            float(radius_mm.min()),
            float(elevation_deg.max()),
            surface_points(object_corners_support_mm),
            tuple((k.name, k.center_mm, k.radius_mm) for k in rig.keep_out if isinstance(k, KeepOutSphere)),
            tuple((k.name, k.min_mm, k.max_mm) for k in rig.keep_out if isinstance(k, KeepOutBox)),
        ),
        [Capsule(body.name, 7, body.from_mm, body.to_mm, body.radius_mm) for body in rig.tool],
        Clearances(keep.object_mm, keep.support_mm, keep.dome_mm, keep.self_mm, keep.keep_out_mm),
    )


def base_from_flange(view: ViewPose, rig: Rig) -> Transform:
    """Where the flange must be for a view that is given as a camera pose."""
    assert view.support_from_camera is not None
    base_from_camera = rig.support.base_from_support.matrix() @ view.support_from_camera
    flange: Transform = base_from_camera @ inverse(rig.flange_from_camera.matrix())
    return flange


def plan_itinerary(
    views: Sequence[ViewPose], rig: Rig, bodies: CellBodies | None, start_deg: Sequence[float]
) -> Itinerary:
    """Postures and legs for views in their order, from where the arm stands.

    Without `bodies` nothing is in the way: postures and times of straight motions only.
    """
    planner = PathPlanner(arm_of(rig), bodies, [rig.motion.home_joints_deg])
    refusals: list[str] = []
    choices: dict[int, NDArray[np.float64]] = {}
    for index, view in enumerate(views):
        postures, why_not = _postures(view, rig, bodies)
        if why_not:
            refusals.append(f"view {view.name}: {why_not}")
        else:
            choices[index] = postures
    start = np.asarray(start_deg, dtype=np.float64)
    visits: list[Visit | None] = [None] * len(views)
    before = "where the arm stands"
    chosen = choose_postures(planner, start, list(choices.values()))
    for index, (joints, leg) in zip(choices, chosen, strict=True):
        visits[index] = Visit(joints, leg)
        if leg.contact is not None:
            refusals.append(f"view {views[index].name}: no way to it was found from {before}: {leg.contact}")
        before = f"view {views[index].name}"
    return Itinerary(tuple(visits), tuple(refusals))


def _postures(view: ViewPose, rig: Rig, bodies: CellBodies | None) -> tuple[NDArray[np.float64], str]:
    """Joint angles [k, 6] that give a view and touch nothing, or why there are none."""
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
    if bodies is None:
        return postures, ""
    tightest = np.min(list(bodies.margins(postures).values()), axis=0)
    if tightest.max() >= 0:
        return postures[tightest >= 0], ""
    return postures, str(bodies.contacts(postures[int(np.argmax(tightest))])[0])
