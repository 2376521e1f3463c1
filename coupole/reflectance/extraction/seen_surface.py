"""Which triangle each pixel of a view sees, and which pixels must not be used.

A ray through the centre of each pixel, by the lens of the camera's record, to the first triangle that it meets
(Embree). Left out: pixels at a silhouette, where a neighbour sees another surface or none, and what is out of
focus.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from coupole.calibration.multi_view import unproject
from coupole.calibration.optics import Intrinsics

Floats = NDArray[np.float64]

_GRID_PX = 8
"""Directions are computed for every eighth pixel, and interpolated: distortion bends them by less than 0.01 px."""
_ROWS = 256
"""Traced together."""
_MOST_STEP = 5.0
"""Of the surface from pixel to pixel, over that of the plane that the pixel sees: beyond it is a silhouette."""
_LEAST_COSINE = 0.1
"""Between view and normal: 84 degrees."""


@dataclass(frozen=True)
class SeenSurface:
    """Pixels of one view that show the object, in the order of rows."""

    rows: NDArray[np.int32]
    columns: NDArray[np.int32]
    triangle: NDArray[np.int32]
    """[pixels] place in `triangles`."""
    triangles: NDArray[np.int64]
    """Rising numbers of the triangles that the pixels see."""


def seen_surface(
    scene: Any,
    corners_mm: Floats,
    lens: Intrinsics,
    base_from_camera: Floats,
    size_px: tuple[int, int],
    *,
    blur: tuple[float, float, float, float] | None = None,
) -> SeenSurface:
    """Pixels and triangles [n, 3, 3] of a view; `scene` is their `ray_mesh`.

    `blur` is focal length and focus distance in mm, f-number, and the largest circle of confusion in px; None
    leaves out nothing for its focus.
    """
    width, height = size_px
    hit = np.full((height, width), -1, np.int64)
    places = np.full((height, width, 3), np.nan, np.float32)
    for first in range(0, height, _ROWS):
        rows = slice(first, min(first + _ROWS, height))
        hit[rows], places[rows] = _trace(scene, lens, base_from_camera, width, rows.start, rows.stop)
    normals = _normals(corners_mm)
    away = base_from_camera[:3, 3] - places
    distance_mm = np.linalg.norm(away, axis=-1)
    cosine = np.einsum("hwk,hwk->hw", away, normals[hit].astype(np.float32)) / distance_mm
    depth_mm = -(away @ base_from_camera[:3, 2].astype(np.float32))
    used = (hit >= 0) & (cosine > _LEAST_COSINE) & _inside(places, depth_mm / lens.fx / np.maximum(cosine, 0.1))
    if blur is not None:
        focal_mm, focus_mm, f_number, most_px = blur
        pitch_mm = focal_mm * focus_mm / (focus_mm - focal_mm) / lens.fx
        circle_mm = focal_mm**2 / (f_number * (focus_mm - focal_mm)) * np.abs(depth_mm - focus_mm) / depth_mm
        used &= circle_mm <= most_px * pitch_mm
    row, column = np.nonzero(used)
    triangles, triangle = np.unique(hit[used], return_inverse=True)
    return SeenSurface(row.astype(np.int32), column.astype(np.int32), triangle.astype(np.int32), triangles)


def _trace(
    scene: Any, lens: Intrinsics, base_from_camera: Floats, width: int, first: int, end: int
) -> tuple[NDArray[np.int64], NDArray[np.float32]]:
    """[rows, width] numbers of the triangles that rows of pixels see, -1 for none; [rows, width, 3] where, mm."""
    directions = directions_of_rows(lens, width, first, end) @ base_from_camera[:3, :3].T
    directions /= np.linalg.norm(directions, axis=-1, keepdims=True)
    ways = directions.reshape(-1, 3).astype(np.float32)
    starts = np.broadcast_to(base_from_camera[:3, 3].astype(np.float32), ways.shape)
    met = scene.run(np.ascontiguousarray(starts), ways, query="INTERSECT", output=1)
    shape = directions.shape[:2]
    number = np.asarray(met["primID"], dtype=np.int64).reshape(shape)
    distance = np.where(number >= 0, np.asarray(met["tfar"]).reshape(shape), np.nan)
    return number, (base_from_camera[:3, 3] + distance[..., None] * directions).astype(np.float32)


def directions_of_rows(lens: Intrinsics, width: int, first: int, end: int) -> Floats:
    """[end - first, width, 3] directions in the camera frame, z = 1, of the centres of rows of pixels."""
    rows = np.unique(np.append(np.arange(first, end, _GRID_PX), end - 1))
    columns = np.unique(np.append(np.arange(0, width, _GRID_PX), width - 1))
    grid = np.stack(np.meshgrid(columns, rows), axis=-1).reshape(-1, 2).astype(float)
    found = unproject(grid, lens)
    coarse = (found[:, :2] / found[:, 2:]).reshape(len(rows), len(columns), 2)
    across = np.stack(
        [[np.interp(np.arange(width), columns, line[:, k]) for line in coarse] for k in range(2)], axis=-1
    )
    at = np.interp(np.arange(first, end), rows, np.arange(len(rows)))
    low = np.minimum(at.astype(int), max(len(rows) - 2, 0))
    share = (at - low)[:, None, None]
    high = np.minimum(low + 1, len(rows) - 1)
    xy = across[low] * (1 - share) + across[high] * share
    return np.concatenate([xy, np.ones((*xy.shape[:2], 1))], axis=-1)


def _normals(corners_mm: Floats) -> Floats:
    normals = np.cross(corners_mm[:, 1] - corners_mm[:, 0], corners_mm[:, 2] - corners_mm[:, 0])
    result: Floats = normals / np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-300)
    return result


def _inside(places: NDArray[np.float32], step_mm: NDArray[np.float32]) -> NDArray[np.bool_]:
    """[h, w] True where all four neighbours see a place [h, w, 3] within `_MOST_STEP` of the expected step."""
    inside = np.ones(step_mm.shape, np.bool_)
    inside[[0, -1]] = inside[:, [0, -1]] = False
    for axis in (0, 1):
        far = np.linalg.norm(np.diff(places, axis=axis), axis=-1)
        ahead = [slice(None)] * 2
        behind = [slice(None)] * 2
        ahead[axis], behind[axis] = slice(None, -1), slice(1, None)
        with np.errstate(invalid="ignore"):
            inside[tuple(ahead)] &= far <= _MOST_STEP * step_mm[tuple(ahead)]
            inside[tuple(behind)] &= far <= _MOST_STEP * step_mm[tuple(behind)]
    return inside
