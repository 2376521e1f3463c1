"""Field of view of a camera: its edges, and its footprint."""

from __future__ import annotations

from itertools import pairwise
from typing import Any

import numpy as np

from coupole.geometry import apply
from coupole.motion.occlusion import Sight
from coupole.viewing.view_solids import Points

_BORDER_POINTS = 16
"""Number of points on each side of the picture; their rays give the footprint."""
_FAR_MM = 1e4


def picture_border(sight: Sight) -> Points:
    """Return points [4 n, 3] in the camera frame, 1 mm in front of it, along the border of its picture. Every n-th
    point is a corner."""
    half = np.array((sight.width_px, sight.height_px)) / 2 / sight.focal_px
    corners = half * np.array([(-1, -1), (1, -1), (1, 1), (-1, 1), (-1, -1)])
    share = np.arange(_BORDER_POINTS)[:, None] / _BORDER_POINTS
    border = np.concatenate([a + share * (b - a) for a, b in pairwise(corners)])
    return np.concatenate([border, np.ones((len(border), 1))], axis=1)


def sight_lines(sight: Sight, length_mm: float = 120.0) -> list[Points]:
    """The edges of a camera's field of view: four rays [2, 3], and the closed line [5, 3] through their ends."""
    corners = length_mm * picture_border(sight)[::_BORDER_POINTS]
    far_mm = apply(sight.support_from_camera, np.concatenate([corners, corners[:1]]))
    eye_mm = sight.support_from_camera[:3, 3]
    return [*(np.array((eye_mm, corner)) for corner in far_mm[:4]), far_mm]


def footprint(sight: Sight, mesh: Any, support_radius_mm: float) -> Points:
    """Return a closed line [n, 3]: the border of a camera's picture, projected onto the object, or otherwise onto
    the support. Points that are on neither are left out."""
    eye_mm = sight.support_from_camera[:3, 3]
    rays = picture_border(sight) @ sight.support_from_camera[:3, :3].T
    with np.errstate(divide="ignore"):
        reach = np.where(rays[:, 2] < 0, -eye_mm[2] / rays[:, 2], np.inf)
    if mesh is not None:
        distances_mm = mesh.run(
            np.tile(eye_mm, (len(rays), 1)).astype(np.float32),
            rays.astype(np.float32),
            dists=np.full(len(rays), _FAR_MM, np.float32),
            query="DISTANCE",
        )
        reach = np.where(distances_mm < _FAR_MM, np.minimum(distances_mm, reach), reach)
    hit = np.isfinite(reach) & (reach > 0)
    points = eye_mm + reach[hit, None] * rays[hit]
    points = points[np.linalg.norm(points[:, :2], axis=1) <= support_radius_mm]
    return np.concatenate([points, points[:1]])
