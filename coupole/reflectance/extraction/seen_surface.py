"""Triangle that each pixel of a view sees, and pixels that must not be used.

A ray goes through the centre of each pixel, by the lens of the camera's record, to the first triangle that it
meets (Embree). Pixels out of focus are left out, and pixels at a silhouette, where a neighbour sees another
surface or none.
"""

from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from coupole.calibration.multi_view import unproject
from coupole.calibration.optics import Intrinsics
from coupole.kernels import kernel
from coupole.motion.packet_rays import PacketMesh
from coupole.reflectance.parts_in_threads import first_alone

Floats = NDArray[np.float64]

_GRID_PX = 8
"""Directions are computed for every eighth pixel and interpolated, because distortion bends them by less than 0.01
px between these."""
_ROWS = 128
"""Number of rows of pixels that are traced together."""
_MOST_STEP = 5.0
"""Largest step of the surface from pixel to pixel, over the step of the plane that the pixel sees. A larger step
is a silhouette."""
_LEAST_COSINE = 0.1
"""Least cosine between view and normal: 84 degrees."""


@dataclass(frozen=True)
class SeenSurface:
    """Triangles of the object that the pixels of one view see."""

    places: NDArray[np.int32]
    """[h, w] place in `triangles` of the triangle that a pixel sees, -1 where the pixel is not used."""
    triangles: NDArray[np.int64]
    """Numbers of the triangles that the pixels see, in rising order."""

    @property
    def pixels(self) -> int:
        return int(np.count_nonzero(self.places >= 0))


def seen_surface(
    mesh: PacketMesh,
    normals: Floats,
    lens: Intrinsics,
    base_from_camera: Floats,
    size_px: tuple[int, int],
    *,
    blur: tuple[float, float, float, float] | None = None,
    threads: int = 1,
) -> SeenSurface:
    """Return the pixels and triangles of a view; `normals` [n, 3] are those of the mesh.

    `blur` is focal length and focus distance in mm, f-number, and the largest circle of confusion in px; with
    None no pixel is left out because it is out of focus.
    """
    width, height = size_px
    hit = np.full((height, width), -1, np.int32)
    far = np.full((height, width), np.nan, np.float32)
    ways = np.empty((height, width, 3), np.float32)
    eye_mm, axis = base_from_camera[:3, 3], base_from_camera[:3, 2]

    def trace(first: int) -> None:
        rows = slice(first, min(first + _ROWS, height))
        _turn_directions(directions_of_rows(lens, width, rows.start, rows.stop), base_from_camera, ways[rows])
        triangle, distance = mesh.first_met(eye_mm, ways[rows].reshape(-1, 3))
        hit[rows], far[rows] = triangle.reshape(-1, width), distance.reshape(-1, width)

    infinite_mm, focus_mm, most_mm = _circle(lens, *blur) if blur is not None else (0.0, 1.0, np.inf)
    pixel_in_use = np.zeros((height, width), np.bool_)

    def judge(row: int) -> None:
        _judge(hit, far, ways, normals, axis, lens.fx, infinite_mm, focus_mm, most_mm, row, pixel_in_use)

    with ThreadPoolExecutor(threads) as pool:
        list(pool.map(first_alone(trace), range(0, height, _ROWS)))
        bands = range(1, height - 1, _ROWS)
        list(pool.map(first_alone(judge), bands))
    triangle_in_view = np.zeros(len(normals), np.bool_)
    triangle_in_view[hit[pixel_in_use]] = True
    place = np.cumsum(triangle_in_view, dtype=np.int32) - 1
    hit[~pixel_in_use] = -1
    hit[pixel_in_use] = place[hit[pixel_in_use]]
    return SeenSurface(hit, np.flatnonzero(triangle_in_view))


def _circle(
    lens: Intrinsics, focal_mm: float, focus_mm: float, f_number: float, most_px: float
) -> tuple[float, float, float]:
    """Return, in mm, the diameter of the circle of confusion of an infinitely distant point, the distance in
    focus, and the largest diameter that is used."""
    pitch_mm = focal_mm * focus_mm / (focus_mm - focal_mm) / lens.fx
    return focal_mm**2 / (f_number * (focus_mm - focal_mm)), focus_mm, most_px * pitch_mm


@kernel
def _turn_directions(directions, base_from_camera, ways):  # type: ignore[no-untyped-def]
    """Fill `ways` [rows, width, 3] with the directions as unit vectors of the base frame."""
    for row in range(ways.shape[0]):
        for column in range(ways.shape[1]):
            x, y, z = directions[row, column]
            length = np.sqrt(x * x + y * y + z * z)
            for k in range(3):
                component = base_from_camera[k, 0] * x + base_from_camera[k, 1] * y + base_from_camera[k, 2] * z
                ways[row, column, k] = component / length


@kernel
def _judge(hit, far, ways, normals, axis, fx, infinite_mm, focus_mm, most_mm, first, pixel_in_use):  # type: ignore[no-untyped-def]
    """Mark the usable pixels of a band of rows: in focus, not at a silhouette, and not at a grazing angle."""
    for row in range(first, min(first + _ROWS, hit.shape[0] - 1)):
        for column in range(1, hit.shape[1] - 1):
            if hit[row, column] < 0:
                continue
            way, normal, distance = ways[row, column], normals[hit[row, column]], far[row, column]
            cosine = -(way[0] * normal[0] + way[1] * normal[1] + way[2] * normal[2])
            depth_mm = distance * (way[0] * axis[0] + way[1] * axis[1] + way[2] * axis[2])
            circle_mm = infinite_mm * abs(depth_mm - focus_mm) / depth_mm
            if not cosine > _LEAST_COSINE or circle_mm > most_mm:
                continue
            most_step_mm = _MOST_STEP * depth_mm / fx / cosine
            alone = False
            for down, right in ((-1, 0), (1, 0), (0, -1), (0, 1)):
                beside, away = ways[row + down, column + right], far[row + down, column + right]
                square = 0.0
                for k in range(3):
                    square += (distance * way[k] - away * beside[k]) ** 2
                alone |= not square <= most_step_mm * most_step_mm  # also if the ray beside it met nothing
            pixel_in_use[row, column] = not alone


def directions_of_rows(lens: Intrinsics, width: int, first: int, end: int) -> Floats:
    """[end - first, width, 3] directions in the camera frame, z = 1, of the centres of the pixels in some rows."""
    rows = np.unique(np.append(np.arange(first, end, _GRID_PX), end - 1))
    columns = np.unique(np.append(np.arange(0, width, _GRID_PX), width - 1))
    grid = np.stack(np.meshgrid(columns, rows), axis=-1).reshape(-1, 2).astype(float)
    directions = unproject(grid, lens)
    coarse = (directions[:, :2] / directions[:, 2:]).reshape(len(rows), len(columns), 2)
    across = np.stack(
        [[np.interp(np.arange(width), columns, line[:, k]) for line in coarse] for k in range(2)], axis=-1
    )
    at = np.interp(np.arange(first, end), rows, np.arange(len(rows)))
    low = np.minimum(at.astype(int), max(len(rows) - 2, 0))
    share = (at - low)[:, None, None]
    high = np.minimum(low + 1, len(rows) - 1)
    xy = across[low] * (1 - share) + across[high] * share
    return np.concatenate([xy, np.ones((*xy.shape[:2], 1))], axis=-1)
