"""The triangle that each pixel sees: a z-buffer over all triangles of the scene, once per camera pose.

A pixel's ray d = (x, y, 1) meets the triangle of camera coordinates v0 v1 v2 where d (v1 x v2), d (v2 x v0) and d
(v0 x v1) have the sign of v0 (v1 x v2). Then 1/z is the sum of these three products, divided by v0 (v1 x v2)
(Olano and Greer 1997). So triangles that extend behind the camera need no clipping, and two triangles with a
common edge leave no crack: the edge's products are the same numbers with opposite signs.

The image is divided into bands of rows. Each band processes the triangles that reach it in order, and keeps the
nearest, or the first of equally near ones. So the result does not depend on the number of threads. Nearness and
triangle number are packed into one integer, so that the nearest triangle is a maximum. A loop without branches
tests eight pixels of a row at once.
"""

from __future__ import annotations

import numba
import numpy as np
from numpy.typing import NDArray

from coupole.geometry import Transform, inverse
from coupole.kernels import kernel
from sim.render.lens import LANES, Sight, bend, rook_shifts_px

NEAR_MM = 1.0
"""Points nearer to the projection centre than this are not seen."""
_BAND_ROWS = 32
_LAST = np.int64(0xFFFFFFFF)
_CHUNK = 16384
_WIDE = 32
"""Number of columns above which it is faster to find first the part of a row that is between the edges."""
_SMALL = 8
"""Size limit of small triangles (columns and rows). If the lens distorts, the corners of small triangles are
moved; for larger triangles, each pixel's ray is moved.
"""
_STRIDE = 8
"""Stride in which bands are processed, so that every thread's part is spread over the image."""


def visible_triangles(
    corners_mm: NDArray[np.float32], sight: Sight, base_from_camera: Transform
) -> tuple[NDArray[np.int32], NDArray[np.int32]]:
    """Return for each pixel's centre [h, w] the visible triangle, as a row of the second array or -1; and the
    visible triangles [seen].

    `corners_mm` [n, 3, 3] are in the base frame. The result is exact in float64 without distortion, and for large
    triangles with distortion; edges of small ones are right to 3e-4 pixel. Both sides are visible. Triangles are
    listed in the order of their first pixel by rows and columns. Neighbours in the image are then close together
    in every table of visible triangles, which makes gathers three times faster.
    """
    lens = sight.lens
    height, width = lens.height_px, lens.width_px
    camera_from_base = inverse(base_from_camera)
    lens_terms = np.array(
        [
            lens.focal_px,
            *lens.centre_px,
            sight.shift_slope,
            sight.bend_slope,
            *sight.reach,
            1.0 / lens.focal_px,
            0.0 if lens.samples == 1 else 0.5,
            *lens.terms,
        ]
    )
    rooks = None if lens.samples == 1 else rook_shifts_px(lens.samples, max(width, height) + LANES)
    bands = -(-height // _BAND_ROWS)
    boxes = np.empty((len(corners_mm), 4), np.int16)
    counts = np.zeros((-(-len(corners_mm) // _CHUNK), bands), np.int64)
    _find_bands(corners_mm, camera_from_base, lens_terms, width, height, boxes, counts)
    before = np.concatenate([[0], np.cumsum(counts.T.ravel())])
    # contiguous in both cases
    bounds = before[:: len(counts)].copy() if len(counts) else np.zeros(bands + 1, np.int64)
    members = np.empty(int(before[-1]), np.int32)
    _list_bands(boxes, before[:-1].reshape(bands, -1).T.copy(), members)
    pixels, firsts = np.empty((height, width), np.int32), np.empty(len(members), np.int32)
    firsts_in_band = np.zeros(bands, np.int64)
    order = np.concatenate([np.arange(bands)[first::_STRIDE] for first in range(_STRIDE)])
    _fill_bands(
        corners_mm,
        boxes,
        camera_from_base,
        lens_terms,
        sight.shift,
        rooks,
        members,
        bounds,
        order,
        pixels,
        firsts,
        firsts_in_band,
    )
    triangles = _merge(firsts, bounds, firsts_in_band, np.zeros(len(corners_mm), np.int32))
    _renumber(pixels, firsts, bounds)
    return pixels, triangles


@kernel
def _to_camera(corners, t, m, v):  # type: ignore[no-untyped-def]
    """Fill `v` [3, 3] with a triangle's corners in camera coordinates."""
    for k in range(3):
        x, y, z = np.float64(corners[t, k, 0]), np.float64(corners[t, k, 1]), np.float64(corners[t, k, 2])
        for i in range(3):
            v[k, i] = m[i, 0] * x + m[i, 1] * y + m[i, 2] * z + m[i, 3]


@kernel
def _box(v, lens, width, height):  # type: ignore[no-untyped-def]
    """Return first and last column and row of the distorted image that a triangle may reach. The triangle's
    corners are in the camera frame.
    """
    x0, x1, y0, y1 = np.inf, -np.inf, np.inf, -np.inf
    for k in range(3):
        n = (k + 1) % 3
        if v[k, 2] >= NEAR_MM:
            inverse_z = 1.0 / v[k, 2]
            x, y = v[k, 0] * inverse_z, v[k, 1] * inverse_z
            x0, x1, y0, y1 = min(x0, x), max(x1, x), min(y0, y), max(y1, y)
        if (v[k, 2] >= NEAR_MM) != (v[n, 2] >= NEAR_MM):
            share = (NEAR_MM - v[k, 2]) / (v[n, 2] - v[k, 2])
            x = (v[k, 0] + share * (v[n, 0] - v[k, 0])) / NEAR_MM
            y = (v[k, 1] + share * (v[n, 1] - v[k, 1])) / NEAR_MM
            x0, x1, y0, y1 = min(x0, x), max(x1, x), min(y0, y), max(y1, y)
    focal, centre_x, centre_y, slope = lens[0], lens[1], lens[2], lens[4]
    if slope > 0.0:
        # Distortion moves the visible part of the box by the shift of its middle, within the bound `slope`.
        x0, x1, y0, y1 = max(x0, -lens[5]), min(x1, lens[5]), max(y0, -lens[6]), min(y1, lens[6])
        if x0 > x1 or y0 > y1:
            return 0, -1, 0, -1
        by_x, by_y = bend(0.5 * (x0 + x1), 0.5 * (y0 + y1), lens[9:])
        spare = slope * 0.5 * (x1 - x0 + y1 - y0)
        x0, x1, y0, y1 = x0 + by_x - spare, x1 + by_x + spare, y0 + by_y - spare, y1 + by_y + spare
    # A thousandth of a pixel for rounding: the box may be too large, but must not miss a pixel.
    spare = lens[8] + 1e-3
    first_col = np.ceil(max(x0 * focal + centre_x - spare, 0.0))
    last_col = np.floor(min(x1 * focal + centre_x + spare, width - 1.0))
    first_row = np.ceil(max(y0 * focal + centre_y - spare, 0.0))
    last_row = np.floor(min(y1 * focal + centre_y + spare, height - 1.0))
    if not (first_col <= last_col and first_row <= last_row):
        return 0, -1, 0, -1
    return int(first_col), int(last_col), int(first_row), int(last_row)


@kernel(parallel=True)
def _find_bands(corners, camera_from_base, lens, width, height, boxes, counts):  # type: ignore[no-untyped-def]
    """Columns and rows that each triangle may reach (last before first for none), and the number of each chunk's
    triangles in each band."""
    for chunk in numba.prange(len(counts)):
        v = np.empty((3, 3))
        for t in range(chunk * _CHUNK, min(len(corners), (chunk + 1) * _CHUNK)):
            _to_camera(corners, t, camera_from_base, v)
            first_col, last_col, first_row, last_row = _box(v, lens, width, height)
            boxes[t, 0], boxes[t, 1], boxes[t, 2], boxes[t, 3] = first_col, last_col, first_row, last_row
            if first_row <= last_row:
                for band in range(first_row // _BAND_ROWS, last_row // _BAND_ROWS + 1):
                    counts[chunk, band] += 1


@kernel(parallel=True)
def _list_bands(boxes, starts, members):  # type: ignore[no-untyped-def]
    """Fill `members` with the triangles of each band, in their order."""
    for chunk in numba.prange(len(starts)):
        place = starts[chunk].copy()
        for t in range(chunk * _CHUNK, min(len(boxes), (chunk + 1) * _CHUNK)):
            if boxes[t, 2] <= boxes[t, 3]:
                for band in range(boxes[t, 2] // _BAND_ROWS, boxes[t, 3] // _BAND_ROWS + 1):
                    members[place[band]] = t
                    place[band] += 1


@kernel(parallel=True)
def _fill_bands(  # type: ignore[no-untyped-def]
    corners, boxes, camera_from_base, lens, shift, rooks, members, bounds, order, pixels, firsts, firsts_in_band
):
    """Z-buffer every band. Pixels get numbers of triangles within the band, in the order in which they are first
    seen. `firsts`, from the band's bound on, are the triangles of these numbers."""
    height, width = pixels.shape
    for place in numba.prange(len(order)):
        band = order[place]
        v = np.empty((3, 3))
        top, bottom = band * _BAND_ROWS, min(height, (band + 1) * _BAND_ROWS)
        nearest = np.zeros((bottom - top, width + LANES), np.int64)
        start, count = bounds[band], bounds[band + 1] - bounds[band]
        for member in range(count):
            t = members[start + member]
            _to_camera(corners, t, camera_from_base, v)
            if shift is not None and _is_small(v, boxes[t]):
                _move_corners(v, lens)
                _fill_triangle(v, boxes[t], member, lens, None, rooks, top, nearest)
            else:
                _fill_triangle(v, boxes[t], member, lens, shift, rooks, top, nearest)
        number_of_member = np.full(count, -1, np.int32)
        first_count, last, number = 0, -1, -1
        for row in range(np.uint64(len(nearest))):
            for col in range(np.uint64(width)):
                key = nearest[row, col]
                member = int(_LAST - (key & _LAST)) if key else -1
                if member != last:
                    last, number = member, -1
                    if member >= 0:
                        number = number_of_member[member]
                        if number < 0:
                            number = number_of_member[member] = first_count
                            firsts[start + first_count] = members[start + member]
                            first_count += 1
                pixels[top + row, col] = number
        firsts_in_band[band] = first_count


@kernel
def _merge(firsts, bounds, firsts_in_band, number_of_triangle):  # type: ignore[no-untyped-def]
    """Return all visible triangles, once each, in the order of bands. `firsts` gets their numbers in this list
    instead."""
    triangles = np.empty(firsts_in_band.sum(), np.int32)
    count = 0
    for band in range(len(firsts_in_band)):
        for place in range(bounds[band], bounds[band] + firsts_in_band[band]):
            triangle = firsts[place]
            if number_of_triangle[triangle] == 0:  # numbers start at 1 here, because zeroed memory is cheap
                triangles[count] = triangle
                count += 1
                number_of_triangle[triangle] = count
            firsts[place] = number_of_triangle[triangle] - 1
    return triangles[:count].copy()


@kernel(parallel=True)
def _renumber(pixels, numbers, bounds):  # type: ignore[no-untyped-def]
    """Replace numbers within bands by numbers within the image."""
    for row in numba.prange(len(pixels)):
        start = bounds[row // _BAND_ROWS]
        for col in range(pixels.shape[1]):
            if pixels[row, col] >= 0:
                pixels[row, col] = numbers[start + pixels[row, col]]


@kernel
def _is_small(v, box):  # type: ignore[no-untyped-def]
    """True if the image of a triangle's edges is straight to 3e-4 pixel in any usual lens."""
    near = v[0, 2] < NEAR_MM or v[1, 2] < NEAR_MM or v[2, 2] < NEAR_MM
    return box[1] - box[0] < _SMALL and box[3] - box[2] < _SMALL and not near


@kernel
def _move_corners(v, lens):  # type: ignore[no-untyped-def]
    """Move the corners, at the same depth, to where a lens without distortion would give the same image."""
    for k in range(3):
        inverse_z = 1.0 / v[k, 2]
        by_x, by_y = bend(v[k, 0] * inverse_z, v[k, 1] * inverse_z, lens[9:])
        v[k, 0] += by_x * v[k, 2]
        v[k, 1] += by_y * v[k, 2]


@kernel
def _fill_triangle(v, box, member, lens, shift, rooks, top, nearest):  # type: ignore[no-untyped-def]
    """Z-buffer one triangle of camera coordinates, which lies within `box`, into a band of rows from `top` on. The
    high bits of a pixel's value are its nearness, a positive float32 whose bits increase with it. The low bits are
    the member's number, counted down, so that the first of equals is the greatest."""
    first_col, last_col = np.int64(box[0]), np.int64(box[1])
    first_row, last_row = max(np.int64(box[2]), top), min(np.int64(box[3]), top + len(nearest) - 1)
    a0, b0, c0 = _cross(v, 1, 2)
    a1, b1, c1 = _cross(v, 2, 0)
    a2, b2, c2 = _cross(v, 0, 1)
    volume = v[0, 0] * a0 + v[0, 1] * b0 + v[0, 2] * c0
    if volume == 0.0:
        return
    if volume < 0.0:
        a0, b0, c0, a1, b1, c1, a2, b2, c2 = -a0, -b0, -c0, -a1, -b1, -c1, -a2, -b2, -c2
    per_volume = 1.0 / abs(volume)
    z0, z1, z2 = (a0 + a1 + a2) * per_volume, (b0 + b1 + b2) * per_volume, (c0 + c1 + c2) * per_volume
    centre_x, centre_y, scale = lens[1], lens[2], lens[7]
    edges = (a0, b0, c0, a1, b1, c1, a2, b2, c2)
    below, nothing, too_near = _LAST - member, np.float32(0.0), np.float32(1.0 / NEAR_MM)
    for row in range(first_row, last_row + 1):
        # Unsigned, since signed indices cost a test for negative values each.
        line, image_row = np.uint64(row - top), np.uint64(row)
        middle_y = (row - centre_y) * scale
        rest0, rest1, rest2, rest_z = (
            b0 * middle_y + c0,
            b1 * middle_y + c1,
            b2 * middle_y + c2,
            z1 * middle_y + z2,
        )
        start, stop = first_col, last_col + 1
        if stop - start > _WIDE:
            start, stop = _span(row, start, stop, edges, lens, shift)
        shift_x = 0.0
        if rooks is not None:
            shift_x = rooks[image_row]
        # Whole groups of lanes, without a branch; pixels beyond `stop` are tested without effect.
        first = np.uint64(start)
        for lane in range(np.uint64((stop - start + LANES - 1) & -LANES)):
            col = first + lane
            x, y = (np.float64(np.int64(col)) - centre_x) * scale, 0.0
            if shift is not None:
                x, y = x + np.float64(shift[0, image_row, col]), np.float64(shift[1, image_row, col])
            elif rooks is not None:
                x, y = x + shift_x * scale, -rooks[col] * scale
            e0, e1, e2, e_z = a0 * x + rest0, a1 * x + rest1, a2 * x + rest2, z0 * x + rest_z
            if shift is not None or rooks is not None:
                e0, e1, e2, e_z = e0 + b0 * y, e1 + b1 * y, e2 + b2 * y, e_z + z1 * y
            nearness = np.float32(e_z)
            sees = (min(e0, e1, e2) >= 0.0) & (nearness > nothing) & (nearness <= too_near)
            key = (np.int64(nearness.view(np.int32)) << 32) | below
            nearest[line, col] = max(nearest[line, col], key if sees else np.int64(0))


@kernel
def _span(row, start, stop, edges, lens, shift):  # type: ignore[no-untyped-def]
    """Reduce a row's columns, `start` to before `stop`, to the columns between a triangle's edges."""
    a0, b0, c0, a1, b1, c1, a2, b2, c2 = edges
    focal, centre_x, centre_y = lens[0], lens[1], lens[2]
    y, shift_x, spare = (row - centre_y) / focal, 0.0, lens[8] / focal
    if shift is not None:
        # The shift in the middle of the row; towards the ends it changes by at most `spare`.
        middle = (start + stop) >> 1
        shift_x, y = np.float64(shift[0, row, middle]), y + shift[1, row, middle]
        spare = 0.5 * (stop - start + 2) * lens[3] + 2.0 * spare
    low, high = _between(a0, b0 * y + c0 + abs(b0) * spare, -1e30, 1e30)
    low, high = _between(a1, b1 * y + c1 + abs(b1) * spare, low, high)
    low, high = _between(a2, b2 * y + c2 + abs(b2) * spare, low, high)
    first = max((low - shift_x - spare) * focal + centre_x - 1e-3, np.float64(start))
    last = min((high - shift_x + spare) * focal + centre_x + 1e-3, np.float64(stop - 1))
    if first > last:
        return start, start
    return int(np.ceil(first)), int(np.floor(last)) + 1


@kernel
def _between(a, rest, low, high):  # type: ignore[no-untyped-def]
    """Reduce the range [low, high] of x to where a x + rest >= 0."""
    if a > 0.0:
        return max(low, -rest / a), high
    if a < 0.0:
        return low, min(high, -rest / a)
    return low, high if rest >= 0.0 else -1e30


@kernel
def _cross(v, a, b):  # type: ignore[no-untyped-def]
    """Cross product of two corners; with the corners exchanged it is exactly the negative."""
    return (
        v[a, 1] * v[b, 2] - v[a, 2] * v[b, 1],
        v[a, 2] * v[b, 0] - v[a, 0] * v[b, 2],
        v[a, 0] * v[b, 1] - v[a, 1] * v[b, 0],
    )
