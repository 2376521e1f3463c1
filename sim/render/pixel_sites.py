"""Sites at which the rays of each pixel meet the surface: one for each pixel and triangle that it sees.

The rays of a pixel (k x k) that meet one triangle share a site, which is the mean of their points on it. Light on
a triangle varies little within a pixel, and all rays resolve the triangle's edges.

Sites are numbered block by block of 4 x 4 pixels, in rows of blocks. So the shadow rays of 16 neighbours in both
directions take nearly the same way through the tree (a quarter faster than along rows).
"""

from __future__ import annotations

import numba
import numpy as np
from numpy.typing import NDArray

from coupole.geometry import Transform
from coupole.kernels import kernel
from sim.render.lens import Sight, rook_shifts_px

_LEAST_SLOPE = 1e-6
_BLOCK = 4


def pixel_sites(
    triangle: NDArray[np.int32],
    centroids_mm: NDArray[np.float32],
    normals: NDArray[np.float32],
    sight: Sight,
    base_from_camera: Transform,
) -> tuple[NDArray[np.float32], NDArray[np.int32]]:
    """Return points [sites, 3] in the base frame, mm, and the row of the triangle of each point [sites].

    `triangle` [h k, w k] has the row of the triangle that each ray sees, or -1. It is overwritten with the rows of
    the sites. `centroids_mm` and `normals` [seen, 3] give the triangles' planes.
    """
    lens = sight.lens
    k = lens.samples
    first = np.zeros(-(-lens.height_px // (_BLOCK * k)) + 1, np.int64)
    _count(triangle, k, first)
    first = np.cumsum(first)
    points, of_triangle = np.empty((int(first[-1]), 3), np.float32), np.empty(int(first[-1]), np.int32)
    rooks = rook_shifts_px(k, max(lens.width_px, lens.height_px)) / lens.focal_px
    centre = np.array([*lens.centre_px, 1.0 / lens.focal_px])
    _fill(
        triangle,
        k,
        first,
        centroids_mm,
        normals,
        base_from_camera,
        centre,
        rooks,
        sight.shift,
        points,
        of_triangle,
    )
    return points, of_triangle


@kernel
def _is_first(triangle, k, row, col):  # type: ignore[no-untyped-def]
    """True if no earlier ray of the same pixel met the triangle."""
    top, first_column = row - row % k, col - col % k
    for y in range(top, row + 1):
        for x in range(first_column, first_column + k if y < row else col):
            if triangle[y, x] == triangle[row, col]:
                return False
    return True


@kernel(parallel=True)
def _count(triangle, k, counts):  # type: ignore[no-untyped-def]
    """Count the sites of each row of blocks; the number is written to the place after the row's own."""
    height, width = triangle.shape
    for line in numba.prange(len(counts) - 1):
        count = 0
        for row in range(line * _BLOCK * k, min(height, (line + 1) * _BLOCK * k)):
            for col in range(width):
                if triangle[row, col] >= 0 and (k == 1 or _is_first(triangle, k, row, col)):
                    count += 1
        counts[line + 1] = count


@kernel(parallel=True)
def _fill(  # type: ignore[no-untyped-def]
    triangle, k, first, centroids, normals, pose, centre, rooks, shift, points, of_triangle
):
    height, width = triangle.shape
    for line in numba.prange(len(first) - 1):
        site, rays, hits = first[line], np.empty((k * k, 3)), np.empty(k * k, np.int64)
        for block in range(0, width, _BLOCK * k):
            for top in range(line * _BLOCK * k, min(height, (line + 1) * _BLOCK * k), k):
                for first_column in range(block, min(width, block + _BLOCK * k), k):
                    _look_through(triangle, k, top, first_column, pose, centre, rooks, shift, rays, hits)
                    for part in range(k * k):
                        if hits[part] >= 0:
                            hit_triangle = hits[part]
                            _mean_point(rays, hits, hit_triangle, centroids, normals, pose, points[site])
                            of_triangle[site] = hit_triangle
                            for other_part in range(part, k * k):
                                if hits[other_part] == hit_triangle:
                                    triangle[top + other_part // k, first_column + other_part % k] = site
                                    hits[other_part] = -1
                            site += 1


@kernel
def _look_through(triangle, k, top, left_px, pose, centre, rooks, shift, rays, hit_triangles):  # type: ignore[no-untyped-def]
    """Fill `rays` [k k, 3] with a pixel's rays in the base frame, of length 1 along the axis, and `hit_triangles`
    [k k] with the triangles that they meet."""
    for part in range(k * k):
        row, col = top + part // k, left_px + part % k
        hit_triangles[part] = triangle[row, col]
        x, y = (col - centre[0]) * centre[2], (row - centre[1]) * centre[2]
        if shift is not None:
            x, y = x + shift[0, row, col], y + shift[1, row, col]
        else:
            x, y = x + rooks[row], y - rooks[col]
        for i in range(3):
            rays[part, i] = pose[i, 0] * x + pose[i, 1] * y + pose[i, 2]


@kernel
def _mean_point(rays, hit_triangles, site_triangle, centroids, normals, pose, point):  # type: ignore[no-untyped-def]
    """Fill `point` [3] with the mean of the points where rays meet the plane of the triangle `site_triangle`."""
    height, depth, x, y, z, count = 0.0, 0.0, 0.0, 0.0, 0.0, 0
    for i in range(3):
        way = np.float64(centroids[site_triangle, i]) - pose[i, 3]
        height, depth = height + normals[site_triangle, i] * way, depth + pose[i, 2] * way
    for part in range(len(hit_triangles)):
        if hit_triangles[part] == site_triangle:
            ray = rays[part]
            slope = (
                normals[site_triangle, 0] * ray[0]
                + normals[site_triangle, 1] * ray[1]
                + normals[site_triangle, 2] * ray[2]
            )
            # A ray within the plane, by rounding, is given the centroid's depth.
            along = height / slope if abs(slope) > _LEAST_SLOPE else depth
            x, y, z, count = x + along * ray[0], y + along * ray[1], z + along * ray[2], count + 1
    point[0], point[1], point[2] = pose[0, 3] + x / count, pose[1, 3] + y / count, pose[2, 3] + z / count
