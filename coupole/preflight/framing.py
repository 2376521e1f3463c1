"""The object in the cell and in the pictures: its size, its place, how much of it each view sees, and how sharply.

A point is sharp if a thin lens blurs it over at most `SHARP_PX` pixels. A point at distance d from a lens of focal
length f and f-number N, focused at s, has a circle of confusion of (f / N) v |1/s - 1/d|, where v is the image
distance (Ray, Applied Photographic Optics, 2002, chapter 22). Diffraction is not counted.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from coupole.geometry import Transform, inverse
from coupole.kinematics import forward
from coupole.motion.itinerary import Itinerary, arm_of
from coupole.motion.occlusion import RAY_START_MM, Sight, blocked_segments, ray_mesh, sight_of
from coupole.plan.rig import Lens, Rig
from coupole.plan.schedule import Schedule, ViewPose

SHARP_PX = 2.0
"""One cell of the Bayer pattern."""
RESTS_MM = 2.0
"""An object counts as resting on the disk if its distance from the disk, above or below, is at most this. Before
a calibration, meshes and poses are not known better.
"""
_COLUMNS = 64
"""Number of rays in each row of the picture."""
_SAMPLES = 2000
"""Number of points on the object's surface."""
_R2 = (0.7548776662466927, 0.5698402909980532)
"""Steps of an even sequence in the unit square (Roberts, The unreasonable effectiveness of quasirandom sequences,
2018)."""
_NO_HIT_MM = 1e30
_ALL, _MOST = 0.995, 0.9
"""Least shares: of the object in the field, and of its visible part in focus. A view below one of them gets a
warning."""


@dataclass(frozen=True)
class Placement:
    """The object on the support, in the support frame, mm."""

    low_mm: tuple[float, float, float]
    high_mm: tuple[float, float, float]
    reach_mm: float
    """Greatest distance from the disk's centre, seen from above."""
    lowest_over_disk_mm: float | None
    """Lowest height of the part that is above or below the disk; None if all of the object is beside the disk."""


@dataclass(frozen=True)
class Framing:
    """The object in one view's picture."""

    view: str
    in_field: float
    """Share of the surface inside the picture, as a part of the surface that is visible from the camera's
    place."""
    fills: float
    """Share of the picture that shows the object."""
    nearest_mm: float
    farthest_mm: float
    """Nearest and farthest depth along the optical axis of the object's part in the picture; NaN if the picture
    does not show the object."""
    in_focus: float
    """Share of the object's part in the picture that is within the depth of field."""
    px_per_mm: tuple[float, float]
    """Scale of the picture at the farthest and at the nearest point shown; NaN if nothing is shown."""


@dataclass(frozen=True)
class ObjectCheck:
    """Everything about an object with a mesh in the views of a plan."""

    placement: Placement
    sharp_mm: tuple[float, float]
    """Depth of field, from the projection centre along the axis; infinite beyond the hyperfocal distance."""
    views: tuple[Framing, ...]
    refusals: tuple[str, ...]
    warnings: tuple[str, ...]


def check_object(
    name: str, corners_mm: NDArray[np.float64], rig: Rig, schedule: Schedule, itinerary: Itinerary
) -> ObjectCheck | None:
    """Placement and framing of an object [triangles, 3, 3] (support frame); None without triangles."""
    if len(corners_mm) == 0:
        return None
    placement = placement_of(corners_mm, rig.support.diameter_mm / 2)
    mesh, points_mm = ray_mesh(corners_mm), surface_samples(corners_mm)
    sharp_mm = depth_of_field_mm(rig.lens, rig.sensor.pixel_pitch_um)
    framings = []
    for number, view in enumerate(schedule.views):
        pose = _camera_pose(view, number, rig, itinerary)
        framings.append(framing_of(view.name, sight_of(rig, pose), sharp_mm, mesh, points_mm))
    refusals, warnings = _judged_placement(name, placement, rig.support.diameter_mm / 2)
    takes_aim = [
        view.target_mm is not None and any(burst.is_light().any() and not burst.panel for burst in bursts)
        for view, bursts in zip(schedule.views, schedule.bursts, strict=True)
    ]
    more_refusals, more_warnings = _judged_views(name, framings, takes_aim, sharp_mm)
    return ObjectCheck(
        placement, sharp_mm, tuple(framings), (*refusals, *more_refusals), (*warnings, *more_warnings)
    )


def placement_of(corners_mm: NDArray[np.float64], disk_radius_mm: float) -> Placement:
    """Return where an object [triangles, 3, 3] is on the support."""
    points = corners_mm.reshape(-1, 3)
    away_mm = np.hypot(points[:, 0], points[:, 1])
    over = points[away_mm <= disk_radius_mm, 2]
    low, high = points.min(axis=0).tolist(), points.max(axis=0).tolist()
    return Placement(
        (low[0], low[1], low[2]),
        (high[0], high[1], high[2]),
        float(away_mm.max()),
        float(over.min()) if len(over) else None,
    )


def depth_of_field_mm(lens: Lens, pixel_pitch_um: float) -> tuple[float, float]:
    """Nearest and farthest distance from the projection centre that is sharp; the farthest may be infinite."""
    image_mm = 1 / (1 / lens.focal_length_mm - 1 / lens.focus_distance_mm)
    slack = SHARP_PX * pixel_pitch_um * 1e-3 * lens.f_number / (lens.focal_length_mm * image_mm)
    focus_per_mm = 1 / lens.focus_distance_mm
    return 1 / (focus_per_mm + slack), 1 / (focus_per_mm - slack) if focus_per_mm > slack else np.inf


def surface_samples(corners_mm: NDArray[np.float64]) -> NDArray[np.float64]:
    """[n, 3] points spread evenly over the surface of a mesh [triangles, 3, 3]; always the same."""
    edges = corners_mm[:, 1:] - corners_mm[:, :1]
    areas = np.linalg.norm(np.cross(edges[:, 0], edges[:, 1]), axis=1)
    if not areas.sum() > 0.0:
        return np.asarray(corners_mm.mean(axis=1)[:_SAMPLES])
    at = np.cumsum(areas) / areas.sum()
    triangles = np.minimum(np.searchsorted(at, (np.arange(_SAMPLES) + 0.5) / _SAMPLES), len(at) - 1)
    number = np.arange(_SAMPLES) + 0.5
    u, v = np.sqrt(number * _R2[0] % 1.0), number * _R2[1] % 1.0
    weights = np.stack([1 - u, u * (1 - v), u * v], axis=1)
    points: NDArray[np.float64] = np.einsum("nk,nkj->nj", weights, corners_mm[triangles])
    return points


def framing_of(
    view: str, sight: Sight, sharp_mm: tuple[float, float], mesh: Any, points_mm: NDArray[np.float64]
) -> Framing:
    """Return what a camera sees of an object, given as a `ray_mesh` and points [n, 3] on its surface."""
    depth_mm = seen_depths_mm(sight, mesh)
    visible, inside, depth_of_points_mm = points_shown(sight, mesh, points_mm)
    near_mm, far_mm = sharp_mm
    visible_depths_mm = depth_mm[np.isfinite(depth_mm)]
    if len(visible_depths_mm) == 0:  # too small for the raster, or nothing
        visible_depths_mm = depth_of_points_mm[inside]
    nothing = len(visible_depths_mm) == 0
    nearest, farthest = (
        (np.nan, np.nan) if nothing else (float(visible_depths_mm.min()), float(visible_depths_mm.max()))
    )
    return Framing(
        view,
        float(inside.sum() / max(1, visible.sum())),
        float(np.isfinite(depth_mm).mean()),
        nearest,
        farthest,
        0.0 if nothing else float(np.mean((visible_depths_mm >= near_mm) & (visible_depths_mm <= far_mm))),
        (sight.focal_px / farthest, sight.focal_px / nearest),
    )


def seen_depths_mm(sight: Sight, mesh: Any) -> NDArray[np.float64]:
    """Return [rows, columns] depths along the optical axis, for the middles of a coarse raster of the picture: the
    depth of the first surface that each of them shows. A depth is infinite where there is no surface."""
    columns = min(_COLUMNS, sight.width_px)
    rows = max(1, round(columns * sight.height_px / sight.width_px))
    x = ((np.arange(columns) + 0.5) / columns - 0.5) * sight.width_px / sight.focal_px
    y = ((np.arange(rows) + 0.5) / rows - 0.5) * sight.height_px / sight.focal_px
    ways = np.stack([*np.meshgrid(x, y), np.ones((rows, columns))], axis=-1).reshape(-1, 3)
    towards = (ways @ sight.support_from_camera[:3, :3].T).astype(np.float32)
    eyes = np.tile(sight.support_from_camera[:3, 3], (len(ways), 1)).astype(np.float32)
    depth = np.asarray(mesh.run(eyes, towards, query="DISTANCE"), np.float64)
    depths_mm: NDArray[np.float64] = np.where(depth < _NO_HIT_MM, depth, np.inf).reshape(rows, columns)
    return depths_mm


def points_shown(
    sight: Sight, mesh: Any, points_mm: NDArray[np.float64]
) -> tuple[NDArray[np.bool_], NDArray[np.bool_], NDArray[np.float64]]:
    """Tell which points [n, 3] on the surface of a `ray_mesh` are not hidden by it from the camera's place, and
    which of these are inside the picture. Also return the depths of all points along the axis; [n] each."""
    eye_mm = sight.support_from_camera[:3, 3]
    away_mm = np.linalg.norm(eye_mm - points_mm, axis=1)
    starts_mm = points_mm + (eye_mm - points_mm) * (RAY_START_MM / np.maximum(away_mm, RAY_START_MM))[:, None]
    visible = ~blocked_segments(mesh, starts_mm, np.tile(eye_mm, (len(starts_mm), 1)))
    pixels, depth_mm = sight.project(points_mm)
    inside = (pixels >= -0.5) & (pixels <= np.array((sight.width_px, sight.height_px)) - 0.5)
    return visible, inside.all(axis=1) & (depth_mm > 0) & visible, depth_mm


def _camera_pose(view: ViewPose, number: int, rig: Rig, itinerary: Itinerary) -> Transform:
    """Return `support_from_camera` of a view."""
    if view.support_from_camera is not None:
        return view.support_from_camera
    visit = itinerary.visits[number]
    return camera_at(visit.joints_deg if visit is not None else np.array(view.joints_deg), rig)


def camera_at(joints_deg: NDArray[np.float64], rig: Rig) -> Transform:
    """Return `support_from_camera` at these angles of the arm."""
    base_from_camera = forward(arm_of(rig), joints_deg) @ rig.flange_from_camera.matrix()
    pose: Transform = inverse(rig.support.base_from_support.matrix()) @ base_from_camera
    return pose


# -- verdicts -----------------------------------------------------------------------------------------------


def _judged_placement(name: str, placement: Placement, disk_radius_mm: float) -> tuple[list[str], list[str]]:
    """Refusals and warnings about the object's place."""
    lowest = placement.lowest_over_disk_mm
    if lowest is None:
        return [f"object {name}: it is beside the disk; correct `support_from_object`"], []
    refusals: list[str] = []
    warnings: list[str] = []
    if lowest < -RESTS_MM:
        refusals.append(
            f"object {name}: it reaches {-lowest:.1f} mm into the disk; correct `support_from_object`, "
            "`mesh_unit`, or turn a mesh whose y axis points up"
        )
    elif lowest > RESTS_MM:
        warnings.append(f"object {name}: it begins {lowest:.1f} mm above the disk; is it on a stand?")
    if placement.reach_mm > disk_radius_mm:
        over_mm = placement.reach_mm - disk_radius_mm
        warnings.append(f"object {name}: it reaches {over_mm:.0f} mm beyond the disk's rim")
    return refusals, warnings


def _judged_views(
    name: str, framings: Sequence[Framing], are_aimed: Sequence[bool], sharp_mm: tuple[float, float]
) -> tuple[list[str], list[str]]:
    """Return refusals and warnings about what the views see. Views that light nothing, or that have no target, get
    only warnings."""
    refusals: list[str] = []
    warnings: list[str] = []
    partly, blurred_framings = [], []
    sharp = f"{sharp_mm[0]:.0f} to {sharp_mm[1]:.0f} mm"
    for framing, is_aimed in zip(framings, are_aimed, strict=True):
        problem = ""
        if not framing.fills and not framing.in_field:
            problem = f"view {framing.view}: object {name} is out of its field"
        elif not framing.in_focus:
            problem = (
                f"view {framing.view}: nothing of object {name} is in focus: the visible part is "
                f"{framing.nearest_mm:.0f} to {framing.farthest_mm:.0f} mm away, the sharp range is {sharp}"
            )
        if problem:
            (refusals if is_aimed else warnings).append(problem)
            continue
        partly += [framing] if framing.in_field < _ALL else []
        blurred_framings += [framing] if framing.in_focus < _MOST else []
    if partly:
        least = min(partly, key=lambda entry: entry.in_field)
        warnings.append(
            f"object {name}: {_count(partly, framings)} part of it out of the field; in view {least.view}, "
            f"{least.in_field:.0%} of the visible surface is in the field"
        )
    if blurred_framings:
        least = min(blurred_framings, key=lambda entry: entry.in_focus)
        warnings.append(
            f"object {name}: {_count(blurred_framings, framings)} part of it out of focus; in view {least.view} "
            f"{least.in_focus:.0%} is sharp ({sharp}; it is {least.nearest_mm:.0f} to "
            f"{least.farthest_mm:.0f} mm away)"
        )
    return refusals, warnings


def _count(some: Sequence[Framing], framings: Sequence[Framing]) -> str:
    return f"{len(some)} of {len(framings)} views {'has' if len(some) == 1 else 'have'}"
