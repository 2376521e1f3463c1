"""Which triangle each pixel sees: a z-buffer that is exact under lens distortion.

A pixel's ray d = (x, y, 1) comes from the lens (`lens.rays`), so distortion needs no approximation: with a triangle's
corners P0 P1 P2 in the camera's frame, d . (P1 x P2), d . (P2 x P0) and d . (P0 x P1) have one sign if the ray hits it,
at depth P0 . (P1 x P2) over their sum (homogeneous rasterisation, Olano and Greer 1997). No corner is projected for this,
so triangles that reach behind the camera need no cutting. Where to look for a triangle does: bounds come from its
distorted corners and the greatest curvature of its edges.

The image is cut into bands of rows. Each band takes its triangles in the order of their numbers, so the result is the
same for any number of threads, and of triangles at the same depth the first wins.
"""

from __future__ import annotations

import numba
import numpy as np
from numpy.typing import NDArray

from coupole.geometry import Transform
from sim.render.lens import Lens, project, rays

NOTHING = -1
_NEAR_MM = 1.0
_ROWS_PER_BAND = 16
_CHUNK = 16_384
_PAD_PX = 0.002
"""Bounds are widened by more than the rounding of a direction to float32."""
_BEYOND_PX = 2.0
"""So far outside the image the distortion is still followed."""


def rasterise(
    corners_mm: NDArray[np.float32], lens: Lens, camera_from_base: Transform
) -> tuple[NDArray[np.int32], NDArray[np.float32]]:
    """Triangle [h, w] that each pixel's centre sees (-1 for none) and its depth [h, w], mm along the optical axis.

    `corners_mm` [triangles, 3, 3] are in the base frame; both sides of a triangle are seen.
    """
    direction = rays(lens)
    triangle = np.empty(direction.shape[:2], np.int32)
    depth_mm = np.empty(direction.shape[:2], np.float32)
    pose, numbers, frustum = np.ascontiguousarray(camera_from_base), lens.numbers(), _frustum(lens, direction)
    spans, counts = _find_rows(corners_mm, pose, numbers, frustum, lens.height_px)
    starts = np.zeros(counts.size + 1, np.int64)
    np.cumsum(counts.T.ravel(), out=starts[1:])  # band by band, and in a band chunk by chunk
    listed = _list_by_band(spans, starts, counts.shape[1])
    first_of_band = starts[:: counts.shape[0]]
    with numba.parallel_chunksize(1):
        _draw(triangle, depth_mm, direction, corners_mm, pose, numbers, frustum, listed, first_of_band)
    return triangle, depth_mm


def _frustum(lens: Lens, direction: NDArray[np.float32]) -> NDArray[np.float64]:
    """[5] least and greatest x, least and greatest y of what the image sees, and the edges' curvature there."""
    beyond = _BEYOND_PX / lens.focal_px
    edge = [direction[0], direction[-1], direction[:, 0], direction[:, -1]]
    least, greatest = (
        np.array([pick(part, axis=0) for part in edge]) for pick in (np.min, np.max)
    )
    (x0, y0), (x1, y1) = least.min(axis=0) - beyond, greatest.max(axis=0) + beyond
    radius = float(np.hypot(max(-x0, x1), max(-y0, y1)))
    return np.array([x0, x1, y0, y1, lens.curvature_px(radius)])


@numba.njit(cache=True, nogil=True, inline="always")
def _to_camera(p, pose, point):  # type: ignore[no-untyped-def]
    x, y, z = np.float64(point[0]), np.float64(point[1]), np.float64(point[2])
    for axis in range(3):
        p[axis] = pose[axis, 0] * x + pose[axis, 1] * y + pose[axis, 2] * z + pose[axis, 3]


@numba.njit(cache=True, nogil=True)
def _cut(polygon, count, spare, axis, sign, limit):  # type: ignore[no-untyped-def]
    """Cut a polygon at the plane sign * (p[axis] - limit * z) = 0, or z = near for axis 2 (Sutherland and Hodgman
    1974). Returns the number of corners kept, in `spare`."""
    kept = 0
    for k in range(count):
        a, b = polygon[k], polygon[(k + 1) % count]
        da = a[2] - limit if axis == 2 else sign * (a[axis] - limit * a[2])
        db = b[2] - limit if axis == 2 else sign * (b[axis] - limit * b[2])
        if da >= 0.0:
            spare[kept, :] = a
            kept += 1
        if (da >= 0.0) != (db >= 0.0):
            share = da / (da - db)
            for i in range(3):
                spare[kept, i] = a[i] + share * (b[i] - a[i])
            kept += 1
    return kept


@numba.njit(cache=True, nogil=True)
def _bounds(p0, p1, p2, frustum, lens, polygon, spare):  # type: ignore[no-untyped-def]
    """First and last column and row, as floats, between which a triangle in the camera's frame is seen; the first
    exceeds the last if it is not."""
    x0, x1, y0, y1 = frustum[0], frustum[1], frustum[2], frustum[3]
    outside_all, outside_any = 31, 0
    for k in range(3):
        p = p0 if k == 0 else (p1 if k == 1 else p2)
        code = 0
        if p[2] < _NEAR_MM:
            code |= 1
        if p[0] < x0 * p[2]:
            code |= 2
        if p[0] > x1 * p[2]:
            code |= 4
        if p[1] < y0 * p[2]:
            code |= 8
        if p[1] > y1 * p[2]:
            code |= 16
        outside_all &= code
        outside_any |= code
    if outside_all:
        return 1.0, 0.0, 1.0, 0.0
    polygon[0, :], polygon[1, :], polygon[2, :] = p0, p1, p2
    count = 3
    if outside_any:
        count = _cut(polygon, count, spare, 2, 1.0, _NEAR_MM)
        count = _cut(spare, count, polygon, 0, 1.0, x0)
        count = _cut(polygon, count, spare, 0, -1.0, x1)
        count = _cut(spare, count, polygon, 1, 1.0, y0)
        count = _cut(polygon, count, spare, 1, -1.0, y1)
        if count == 0:
            return 1.0, 0.0, 1.0, 0.0
        polygon[:count] = spare[:count]
    first_col, last_col, first_row, last_row, edge2 = np.inf, -np.inf, np.inf, -np.inf, 0.0
    before_x = polygon[count - 1, 0] / polygon[count - 1, 2]
    before_y = polygon[count - 1, 1] / polygon[count - 1, 2]
    for k in range(count):
        x, y = polygon[k, 0] / polygon[k, 2], polygon[k, 1] / polygon[k, 2]
        col, row = project(x, y, lens)
        first_col, last_col = min(first_col, col), max(last_col, col)
        first_row, last_row = min(first_row, row), max(last_row, row)
        edge2 = max(edge2, (x - before_x) ** 2 + (y - before_y) ** 2)
        before_x, before_y = x, y
    pad = _PAD_PX + edge2 * frustum[4] / 8.0  # a curve leaves its chord by at most L^2 |f''| / 8
    return first_col - pad, last_col + pad, first_row - pad, last_row + pad


@numba.njit(cache=True, nogil=True, parallel=True)
def _find_rows(corners, pose, lens, frustum, height):  # type: ignore[no-untyped-def]
    """First and last row of each triangle ([triangles, 2], the first exceeds the last if it is not seen), and how many
    triangles each chunk of them has in each band, [chunks, bands]."""
    n = len(corners)
    chunks, bands = (n + _CHUNK - 1) // _CHUNK, (height + _ROWS_PER_BAND - 1) // _ROWS_PER_BAND
    spans, counts = np.empty((n, 2), np.int16), np.zeros((chunks, bands), np.int64)
    for chunk in numba.prange(chunks):
        p, polygon, spare = np.empty((3, 3)), np.empty((8, 3)), np.empty((8, 3))
        for t in range(chunk * _CHUNK, min(n, (chunk + 1) * _CHUNK)):
            for k in range(3):
                _to_camera(p[k], pose, corners[t, k])
            col0, col1, row0, row1 = _bounds(p[0], p[1], p[2], frustum, lens, polygon, spare)
            first, last = max(0, int(np.ceil(row0))), min(height - 1, int(np.floor(row1)))
            if np.floor(col1) < np.ceil(col0) or last < first:
                first, last = 1, 0
            spans[t, 0], spans[t, 1] = first, last
            for band in range(first // _ROWS_PER_BAND, last // _ROWS_PER_BAND + 1 if last >= first else 0):
                counts[chunk, band] += 1
    return spans, counts


@numba.njit(cache=True, nogil=True, parallel=True)
def _list_by_band(spans, starts, bands):  # type: ignore[no-untyped-def]
    """Numbers of the triangles of all bands, one band after the other; those of band b and chunk c begin at
    `starts[b * chunks + c]`."""
    n = len(spans)
    chunks = (n + _CHUNK - 1) // _CHUNK
    listed = np.empty(starts[-1], np.int32)
    for chunk in numba.prange(chunks):
        place = np.empty(bands, np.int64)
        for band in range(bands):
            place[band] = starts[band * chunks + chunk]
        for t in range(chunk * _CHUNK, min(n, (chunk + 1) * _CHUNK)):
            first, last = spans[t, 0], spans[t, 1]
            if first <= last:
                for band in range(first // _ROWS_PER_BAND, last // _ROWS_PER_BAND + 1):
                    listed[place[band]] = t
                    place[band] += 1
    return listed


@numba.njit(cache=True, nogil=True, parallel=True)
def _draw(triangle, depth, direction, corners, pose, lens, frustum, listed, first_of_band):  # type: ignore[no-untyped-def]
    height, width = triangle.shape
    for band in numba.prange(len(first_of_band) - 1):
        top, bottom = band * _ROWS_PER_BAND, min(height, (band + 1) * _ROWS_PER_BAND) - 1
        triangle[top : bottom + 1, :] = NOTHING
        depth[top : bottom + 1, :] = np.inf
        p, polygon, spare = np.empty((3, 3)), np.empty((8, 3)), np.empty((8, 3))
        for i in range(first_of_band[band], first_of_band[band + 1]):
            t = listed[i]
            for k in range(3):
                _to_camera(p[k], pose, corners[t, k])
            col0, col1, row0, row1 = _bounds(p[0], p[1], p[2], frustum, lens, polygon, spare)
            first_col, last_col = max(0, int(np.ceil(col0))), min(width - 1, int(np.floor(col1)))
            first_row, last_row = max(top, int(np.ceil(row0))), min(bottom, int(np.floor(row1)))
            # Both triangles of an edge compute its cross product from the same products: no ray slips between them.
            ax = p[1, 1] * p[2, 2] - p[1, 2] * p[2, 1]
            ay = p[1, 2] * p[2, 0] - p[1, 0] * p[2, 2]
            az = p[1, 0] * p[2, 1] - p[1, 1] * p[2, 0]
            bx = p[2, 1] * p[0, 2] - p[2, 2] * p[0, 1]
            by = p[2, 2] * p[0, 0] - p[2, 0] * p[0, 2]
            bz = p[2, 0] * p[0, 1] - p[2, 1] * p[0, 0]
            cx = p[0, 1] * p[1, 2] - p[0, 2] * p[1, 1]
            cy = p[0, 2] * p[1, 0] - p[0, 0] * p[1, 2]
            cz = p[0, 0] * p[1, 1] - p[0, 1] * p[1, 0]
            volume = p[0, 0] * ax + p[0, 1] * ay + p[0, 2] * az
            if volume == 0.0:  # seen edge on
                continue
            if volume < 0.0:
                volume = -volume
                ax, ay, az, bx, by, bz, cx, cy, cz = -ax, -ay, -az, -bx, -by, -bz, -cx, -cy, -cz
            for row in range(first_row, last_row + 1):
                for col in range(first_col, last_col + 1):
                    x, y = np.float64(direction[row, col, 0]), np.float64(direction[row, col, 1])
                    a = ax * x + ay * y + az
                    b = bx * x + by * y + bz
                    c = cx * x + cy * y + cz
                    if a >= 0.0 and b >= 0.0 and c >= 0.0:
                        total = a + b + c
                        if total > 0.0:
                            z = np.float32(volume / total)
                            if z >= _NEAR_MM and z < depth[row, col]:
                                depth[row, col] = z
                                triangle[row, col] = t
