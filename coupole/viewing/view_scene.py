"""Scene of a plan: the cell, the arm at each view, its paths, and its collisions.

Everything is in the support frame, in mm, and independent of the drawing.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import assert_never

import numpy as np
from numpy.typing import NDArray

from coupole import kinematics
from coupole.geometry import inverse
from coupole.joint_chain import FLANGE
from coupole.motion import singularities
from coupole.motion.bodies import Capsule, capsules_of
from coupole.motion.collisions import CellBodies, Contact
from coupole.motion.itinerary import Itinerary, Visit, arm_of, base_from_flange
from coupole.motion.occlusion import Occlusion, Occlusions, Sight, capsule_axes, sight_of
from coupole.motion.path_planner import Joints
from coupole.plan.light_selection import leds_of_plan
from coupole.plan.rig import KeepOut, KeepOutBox, KeepOutSphere, Rig
from coupole.plan.schedule import ViewPose
from coupole.preflight.job import Job
from coupole.viewing.view_sight import footprint
from coupole.viewing.view_solids import Points, Solid, box, capsule, join_solids, sphere

_WAY_STEP_DEG = 3.0
_CLASH_PLACES = 200


@dataclass(frozen=True)
class Clash:
    """The arm in a collision."""

    contact: Contact
    joints_deg: Joints

    @property
    def words(self) -> str:
        """Both bodies and their distance, as text."""
        apart_mm = self.contact.distance_mm
        how = f"{apart_mm:.0f} mm from" if apart_mm > 0 else f"{-apart_mm:.0f} mm inside"
        return f"{self.contact.body} {how} {self.contact.other_name}"

    @property
    def bodies(self) -> tuple[str, str]:
        """Both bodies, by the names that solids have."""
        return self.contact.body, self.contact.other_name.removeprefix("the arm's ").removeprefix("the ")


@dataclass(frozen=True)
class Stop:
    """One view and the path to it."""

    name: str
    number: int
    """Number in the order of visiting, from 1; refused views come last."""
    joints_deg: Joints | None
    """[6] joint angles at the view; None if the arm cannot reach it."""
    leg_s: float | None
    """Duration of the leg; None if there is none."""
    camera_way_mm: Points
    """[n, 3] path of the projection centre on the leg. Without a leg, it is the path of the straight motion to the
    collision."""
    flange_way_mm: Points
    vias_mm: Points
    """[k, 3] projection centre at the leg's via points."""
    sight: Sight | None
    footprint_mm: Points
    """[n, 3] closed line around the part of object and support that the picture shows."""
    shadow: Occlusion | None
    refusal: str
    """Reason why the plan is refused for this view; empty if it is not."""
    clash: Clash | None


@dataclass(frozen=True)
class Scene:
    """The cell and all views, in the order of their numbers."""

    plan: str
    rig: Rig
    stops: tuple[Stop, ...]
    refusals: tuple[str, ...]
    object_solid: Solid | None
    """The object."""
    patch_of_face: NDArray[np.int64]
    """[faces] number of the object's patch; -1 for none."""
    keep_out: tuple[Solid, ...]
    leds_mm: Points
    led_ids: NDArray[np.int64]
    is_used: NDArray[np.bool_]
    """[leds] True for LEDs that the plan lights."""
    paths_checked: bool
    links: tuple[Capsule, ...]
    """The arm's own bodies, without the tool."""

    @property
    def home_deg(self) -> Joints:
        return np.array(self.rig.motion.home_joints_deg)

    @property
    def tool_names(self) -> frozenset[str]:
        """Names of the bodies on the flange."""
        return frozenset(body.name for body in self.rig.tool)

    @property
    def led_share(self) -> NDArray[np.float64]:
        """[leds] share of the visible surface that each LED reaches, as the mean over the views that can be
        taken."""
        shares = [stop.shadow.share() for stop in self.stops if stop.shadow is not None]
        return np.mean(shares, axis=0) if shares else np.zeros(len(self.leds_mm))

    def light_on(self, stop: Stop) -> list[str]:
        """Text on the plan's LEDs in a view, one string per line."""
        if stop.shadow is None or not self.is_used.any():
            return []
        share, dark_leds = (
            stop.shadow.share()[self.is_used].mean(),
            stop.shadow.occluded_leds()[self.is_used].sum(),
        )
        return [
            f"an LED reaches {share:.0%} of the visible surface",
            f"{dark_leds} of {self.is_used.sum()} LEDs reach none of it",
        ]

    def arm(self, joints_deg: Joints, around: int = 24) -> list[Solid]:
        """Return the arm's and the tool's bodies, each as a solid, at joint angles [6]."""
        capsules = [
            *self.links,
            *(Capsule(b.name, FLANGE, b.from_mm, b.to_mm, b.radius_mm) for b in self.rig.tool),
        ]
        axes_mm, radii_mm = capsule_axes(capsules, _frames(self.rig, joints_deg))
        parts: dict[str, list[Solid]] = {}
        for part, axis_mm, radius_mm in zip(capsules, axes_mm, radii_mm, strict=True):
            parts.setdefault(part.body, []).append(capsule(part.body, axis_mm[0], axis_mm[1], radius_mm, around))
        return [join_solids(name, of) for name, of in parts.items()]


def scene_of(job: Job, itinerary: Itinerary, bodies: CellBodies | None, refusals: Sequence[str]) -> Scene:
    """Return the scene of a job. Without `bodies`, collisions are not checked."""
    rig, views = job.cell.rig, job.schedule.views
    shadows, corners_mm = job.motion.occlusions, job.shape.corners_mm
    refused_indices = [index for index in range(len(views)) if index not in itinerary.order]
    home_deg = place_deg = np.array(rig.motion.home_joints_deg)
    stops = []
    for number, index in enumerate([*itinerary.order, *refused_indices], start=1):
        view, visit = views[index], itinerary.visits[index]
        if visit is not None:
            stops.append(_visited_stop(number, view, place_deg, visit, rig, shadows))
            place_deg = visit.joints_deg
        else:
            why = _refusal(view, itinerary.refusals)
            stops.append(_refused_stop(number, view, why, (place_deg, home_deg), rig, bodies, shadows))
    is_lit = np.zeros(len(job.cell.leds.ids), np.bool_)
    is_lit[leds_of_plan(job.plan, job.cell.leds, rig.support.base_from_support.matrix())] = True
    return Scene(
        job.plan.name,
        rig,
        tuple(stops),
        tuple(refusals),
        measured_solid(job) if len(corners_mm) else None,
        shadows.patches.of_triangles(len(corners_mm)),
        tuple(map(_keep_out_solid, rig.keep_out)),
        shadows.leds_mm,
        job.cell.leds.ids,
        is_lit,
        bodies is not None,
        capsules_of(shadows.arm),
    )


def measured_solid(job: Job) -> Solid:
    """The object's mesh, in the support frame."""
    vertices, faces = np.unique(job.shape.corners_mm.reshape(-1, 3), axis=0, return_inverse=True)
    return Solid("object", vertices, faces.reshape(-1, 3))


def _refusal(view: ViewPose, refusals: Sequence[str]) -> str:
    start = f"view {view.name}: "
    return next((text.removeprefix(start) for text in refusals if text.startswith(start)), "")


def _visited_stop(
    number: int, view: ViewPose, from_deg: Joints, visit: Visit, rig: Rig, shadows: Occlusions
) -> Stop:
    way_deg = [from_deg, *visit.leg.waypoints]
    sight = _sight(view, visit.joints_deg, rig)
    return Stop(
        view.name,
        number,
        visit.joints_deg,
        visit.leg.duration_s,
        *_ways_mm(way_deg, rig),
        sight,
        _footprint(sight, rig, shadows),
        shadows.at(visit.joints_deg),
        refusal="",
        clash=None,
    )


def _refused_stop(
    number: int,
    view: ViewPose,
    why: str,
    starts_deg: Sequence[Joints],
    rig: Rig,
    bodies: CellBodies | None,
    shadows: Occlusions,
) -> Stop:
    clash, from_deg = None, starts_deg[0]
    if bodies is not None:
        clash, from_deg = _clash(view, starts_deg, rig, bodies)
    way_deg = [from_deg] if clash is None else [from_deg, clash.joints_deg]
    sight = _sight(view, None if view.joints_deg is None else np.array(view.joints_deg), rig)
    return Stop(
        view.name,
        number,
        None,
        None,
        *_ways_mm(way_deg, rig),
        sight,
        _footprint(sight, rig, shadows),
        None,
        why,
        clash,
    )


def _sight(view: ViewPose, joints_deg: Joints | None, rig: Rig) -> Sight | None:
    if view.support_from_camera is not None:
        return sight_of(rig, view.support_from_camera)
    if joints_deg is None:
        return None
    return sight_of(rig, _frames(rig, joints_deg)[FLANGE] @ rig.flange_from_camera.matrix())


def _footprint(sight: Sight | None, rig: Rig, shadows: Occlusions) -> Points:
    return np.zeros((0, 3)) if sight is None else footprint(sight, shadows.mesh, rig.support.diameter_mm / 2)


def _ways_mm(way_deg: Sequence[Joints], rig: Rig) -> tuple[Points, Points, Points]:
    """Paths [n, 3] of camera and flange, and the camera's via points [k, 3]."""
    along, vias = (_frames(rig, np.array(places))[..., FLANGE, :, :] for places in (_along(way_deg), way_deg))
    camera_mm = rig.flange_from_camera.matrix()[:3, 3]
    return (
        along[:, :3, :3] @ camera_mm + along[:, :3, 3],
        along[:, :3, 3],
        (vias[:, :3, :3] @ camera_mm + vias[:, :3, 3])[1:-1],
    )


def _frames(rig: Rig, joints_deg: Joints) -> NDArray[np.float64]:
    """`support_from_link` [..., 8, 4, 4]."""
    frames: NDArray[np.float64] = inverse(rig.support.base_from_support.matrix()) @ kinematics.link_frames(
        arm_of(rig), joints_deg
    )
    return frames


def _along(way_deg: Sequence[Joints]) -> Joints:
    """Joint angles [n, 6] at small intervals on straight motions."""
    places = [way_deg[0][None]]
    for a, b in pairwise(way_deg):
        steps = max(1, int(np.ceil(np.abs(b - a).max() / _WAY_STEP_DEG)))
        places.append(a + np.linspace(0, 1, steps + 1)[1:, None] * (b - a))
    return np.concatenate(places)


def _clash(
    view: ViewPose, starts_deg: Sequence[Joints], rig: Rig, bodies: CellBodies
) -> tuple[Clash | None, Joints]:
    """Return the collision of a refused view, or of the straight motion to it, and the start of that motion.

    If all postures of the view collide, the one with the least penetration is used.
    """
    arm = arm_of(rig)
    postures = (
        kinematics.inverse(arm, base_from_flange(view, rig)) if view.joints_deg is None else [view.joints_deg]
    )
    postures = np.array(postures, np.float64).reshape(-1, 6)
    postures = postures[singularities.margin(arm, postures) >= 1.0]
    if len(postures) == 0:
        return None, starts_deg[0]
    tightest_mm = bodies.tightest_mm(postures)
    if tightest_mm.max() < 0:
        least_bad = postures[int(np.argmax(tightest_mm))]
        return Clash(bodies.contacts(least_bad)[0], least_bad), least_bad
    for goal_deg in postures[tightest_mm >= 0]:
        for start_deg in starts_deg:
            if clash := _clash_on_the_way(start_deg, goal_deg, bodies):
                return clash, start_deg
    return None, starts_deg[0]


def _clash_on_the_way(from_deg: Joints, to_deg: Joints, bodies: CellBodies) -> Clash | None:
    """First collision of the straight motion between two postures."""
    places = from_deg + np.linspace(0, 1, _CLASH_PLACES)[:, None] * (to_deg - from_deg)
    touches = bodies.tightest_mm(places) < 0
    if not touches.any():
        return None
    first = places[int(np.argmax(touches))]
    return Clash(bodies.contacts(first)[0], first)


def _keep_out_solid(volume: KeepOut) -> Solid:
    match volume:
        case KeepOutSphere():
            return sphere(volume.name, volume.center_mm, volume.radius_mm)
        case KeepOutBox():
            return box(volume.name, volume.min_mm, volume.max_mm)
        case _:
            assert_never(volume)
