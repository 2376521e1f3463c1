"""Coverage: how much of an object's surface the views of a run show, from its mesh and the measured poses."""

from __future__ import annotations

import io
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from coupole.errors import InputError
from coupole.geometry import Transform, inverse
from coupole.motion.occlusion import RAY_START_MM, blocked_segments, ray_mesh, sight_of
from coupole.plan.reading import read_plan
from coupole.plan.rig import Rig
from coupole.preflight.framing import (
    Framing,
    Placement,
    depth_of_field_mm,
    framing_of,
    placement_of,
    points_shown,
    surface_samples,
)
from coupole.preflight.object_shape import read_object
from coupole.storage.run import Run
from coupole.viewing.run_sample import SampledView
from coupole.viewing.view_colours import of_share

MOST = 4
"""Largest number of views of a point that the pictures distinguish. A point in more views has the same colour."""
FROM = {"from above": (-90.0, 90.0), "from azimuth -60": (-60.0, 25.0), "from azimuth 120": (120.0, 25.0)}
"""Directions of the drawings: azimuth and elevation from which the object is seen, degrees."""
_DIRECTIONS = 128
_LOWEST_DEG = 5.0
_DRAWN_PX = 150
_BACKGROUND = 255


@dataclass(frozen=True)
class Coverage:
    """Coverage of the reachable part of the surface, which is the part that can be seen from some place above the
    disk."""

    placement: Placement
    sharp_mm: tuple[float, float]
    views: tuple[Framing, ...]
    """Framings of the views that have proven shots."""
    shares: tuple[float, ...]
    """[n] share of the reachable part that at least n + 1 views show. The tuple ends at `MOST` views, or at the
    number of views if that is smaller."""
    reachable: float
    """Reachable part, as a share of the whole surface."""
    drawings: dict[str, bytes]
    """PNGs by the direction from which the object is seen; the colour is `of_share(views / MOST)`."""


def coverage_of(run: Run, views: Sequence[SampledView]) -> Coverage | None:
    """Return the coverage of a run; None for an object without mesh, or if no view has a measured pose. Raises
    InputError if the run's plan, rig or mesh cannot be read."""
    files = read_plan(run.plan_path, run.rig_path)
    poses = {view.name: view.base_from_camera for view in views if view.base_from_camera is not None}
    if files.mesh_path is None or not poses:
        return None
    rig, corners_mm = files.cell.rig, read_object(files).corners_mm
    return coverage(rig, corners_mm, poses)


def coverage(rig: Rig, corners_mm: NDArray[np.float64], poses: dict[str, Transform]) -> Coverage:
    """Return the coverage of an object [triangles, 3, 3] (support frame) by views with these `base_from_camera`.
    Raises InputError for a mesh of which nothing can be seen."""
    support_from_base = inverse(rig.support.base_from_support.matrix())
    sights = [sight_of(rig, support_from_base @ pose) for pose in poses.values()]
    mesh, points_mm = ray_mesh(corners_mm), surface_samples(corners_mm)
    sharp_mm = depth_of_field_mm(rig.lens, rig.sensor.pixel_pitch_um)
    framings = [
        framing_of(name, sight, sharp_mm, mesh, points_mm) for name, sight in zip(poses, sights, strict=True)
    ]

    def views_of(asked_mm: NDArray[np.float64]) -> NDArray[np.int64]:
        counts = np.zeros(len(asked_mm), np.int64)
        for sight in sights:
            counts += points_shown(sight, mesh, asked_mm)[1]
        return counts

    reachable = _seen_from_above(mesh, points_mm)
    if not reachable.any():
        raise InputError("nothing of the object's mesh can be seen from above the disk")
    counts = views_of(points_mm[reachable])
    return Coverage(
        placement_of(corners_mm, rig.support.diameter_mm / 2),
        sharp_mm,
        tuple(framings),
        tuple(float(np.mean(counts > n)) for n in range(min(MOST, len(sights)))),
        float(reachable.mean()),
        {name: _drawing_png(mesh, corners_mm, views_of, *where) for name, where in FROM.items()},
    )


def _seen_from_above(mesh: Any, points_mm: NDArray[np.float64]) -> NDArray[np.bool_]:
    """Return [n], True if the line of sight from the point is free in some direction above the disk."""
    number = np.arange(_DIRECTIONS) + 0.5
    lowest = np.sin(np.deg2rad(_LOWEST_DEG))
    z = lowest + (1 - lowest) * number / _DIRECTIONS
    turn = np.pi * (1 + np.sqrt(5.0)) * number
    directions = np.stack([np.sqrt(1 - z * z) * np.cos(turn), np.sqrt(1 - z * z) * np.sin(turn), z], axis=1)
    far_mm = 4 * float(np.ptp(points_mm, axis=0).max()) + 1.0
    is_open = np.zeros(len(points_mm), np.bool_)
    for direction in directions:
        rows = np.flatnonzero(~is_open)
        starts_mm = points_mm[rows] + RAY_START_MM * direction
        is_open[rows] = ~blocked_segments(mesh, starts_mm, starts_mm + far_mm * direction)
    return is_open


def _drawing_png(
    mesh: Any, corners_mm: NDArray[np.float64], views_of: Any, azimuth_deg: float, elevation_deg: float
) -> bytes:
    """Return a parallel projection as PNG. The colour shows the number of views, the shade shows the slope."""
    from PIL import Image

    azimuth, elevation = np.deg2rad((azimuth_deg, elevation_deg))
    to_eye = np.array(
        [np.cos(elevation) * np.cos(azimuth), np.cos(elevation) * np.sin(azimuth), np.sin(elevation)]
    )
    right = np.array([-np.sin(azimuth), np.cos(azimuth), 0.0])
    up = np.cross(to_eye, right)
    low, high = corners_mm.min(axis=(0, 1)), corners_mm.max(axis=(0, 1))
    middle_mm, reach_mm = (low + high) / 2, 0.52 * float(np.linalg.norm(high - low))
    at_mm = ((np.arange(_DRAWN_PX) + 0.5) / _DRAWN_PX * 2 - 1) * reach_mm
    across, down = np.meshgrid(at_mm, -at_mm)
    starts_mm = middle_mm + 2 * reach_mm * to_eye + across[..., None] * right + down[..., None] * up
    ways = np.tile(-to_eye, (starts_mm.size // 3, 1)).astype(np.float32)
    depth_mm = np.asarray(
        mesh.run(starts_mm.reshape(-1, 3).astype(np.float32), ways, query="DISTANCE"), np.float64
    )
    is_object = (depth_mm < 1e29).reshape(_DRAWN_PX, _DRAWN_PX)
    depth_mm = np.where(is_object, depth_mm.reshape(_DRAWN_PX, _DRAWN_PX), 4 * reach_mm)
    counts = views_of((starts_mm - depth_mm[..., None] * to_eye)[is_object])
    steps = np.hypot(*np.gradient(depth_mm, 2 * reach_mm / _DRAWN_PX))
    shade = (0.65 + 0.35 / np.sqrt(1 + steps**2))[is_object]
    pixels = np.full((_DRAWN_PX, _DRAWN_PX, 4), _BACKGROUND, np.uint8)
    pixels[~is_object, 3] = 0
    pixels[is_object, :3] = np.rint(255 * of_share(counts / MOST) * shade[:, None])
    buffer = io.BytesIO()
    Image.fromarray(pixels).save(buffer, "PNG")
    return buffer.getvalue()
