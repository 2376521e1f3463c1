"""Lamps in the picture: the image of a lit LED or panel itself.

Every lamp is a rectangle that radiates by the cosine law, so its luminance is the same in all directions in front
of it. It is behind everything else: where anything else is seen, the lamp is hidden. Out of focus, its rectangle
is convolved with the disk of confusion of its own distance.
"""

from __future__ import annotations

from dataclasses import dataclass

import numba
import numpy as np
from numpy.typing import NDArray

from coupole.geometry import Transform, inverse
from coupole.kernels import kernel
from sim.optics.objective import Objective, defocus_px
from sim.render.emitter import Emitter
from sim.render.lens import Sight, distorted_points

_NEAR_MM = 1.0
_LEAST_DISK_PX = 0.25


@dataclass(frozen=True)
class Glow:
    """The part of a picture that a lamp covers."""

    rows: slice
    columns: slice
    radiance: NDArray[np.float32]
    """[rows, columns] lm/(m^2 sr), mean over the pixel."""


def glow(
    emitter: Emitter,
    emission: str,
    through: Sight,
    base_from_camera: Transform,
    empty: NDArray[np.float32],
    blur: tuple[Objective, float] | None,
    unevenness: float = 0.0,
) -> Glow | None:
    """The image of a lamp, or None if the camera does not see it.

    `empty` [h, w] is the fraction of each pixel that sees nothing else. `blur` is objective and pixel pitch in um;
    None for a picture that is sharp at all distances. `unevenness` is that of `sim.optics.panels.Panel`.
    """
    towards = base_from_camera[:3, 3] - emitter.centre_mm
    distance_mm = float(np.linalg.norm(towards))
    cosine = float(towards @ emitter.normal) / distance_mm
    if cosine <= 0.0:
        return None
    u, v = emitter.half_u_mm, emitter.half_v_mm
    corners = emitter.centre_mm + np.array([u + v, -u + v, -u - v, u - v])
    camera_from_base = inverse(base_from_camera)
    corners_in_camera = corners @ camera_from_base[:3, :3].T + camera_from_base[:3, 3]
    if (corners_in_camera[:, 2] < _NEAR_MM).all():
        return None
    depth_mm = float(corners_in_camera[:, 2].mean())
    disk_px = float(defocus_px(blur[0], depth_mm, blur[1])) if blur is not None and depth_mm > _NEAR_MM else 0.0
    box = _box(corners_in_camera, through, margin_px=2.0 + 0.5 * disk_px)
    if box is None:
        return None
    rows, columns = box
    coverage = np.zeros((rows.stop - rows.start, columns.stop - columns.start), np.float32)
    edges = np.cross(corners_in_camera, np.roll(corners_in_camera, -1, axis=0))
    if edges[0] @ corners_in_camera[2] < 0.0:
        edges = -edges
    shift = np.zeros((2, 1, 1), np.float32)
    if through.shift is not None:
        shift = through.shift[:, :, : through.lens.width_px]
    focal_px, (centre_x, centre_y) = through.lens.focal_px, through.lens.centre_px
    _cover(coverage, edges, rows.start, columns.start, focal_px, centre_x, centre_y, shift)
    if unevenness > 0.0:
        coverage *= _evenness(unevenness, corners_in_camera, rows, columns, through)
    if disk_px > _LEAST_DISK_PX:
        coverage = _spread_over_disk(coverage, disk_px)
    if not coverage.any():
        return None
    area_m2 = 4e-6 * float(np.linalg.norm(np.cross(u, v)))
    luminance = emitter.flux_lm / (np.pi * area_m2) * (cosine if emission == "paper" else 1.0)
    return Glow(rows, columns, coverage * empty[rows, columns] * np.float32(luminance))


def _box(seen_mm: NDArray[np.float64], through: Sight, margin_px: float) -> tuple[slice, slice] | None:
    """Return the pixels that a polygon in the camera frame may cover; all pixels if part of it is behind the
    camera."""
    lens = through.lens
    height, width = lens.height_px, lens.width_px
    if (seen_mm[:, 2] < _NEAR_MM).any():
        return slice(0, height), slice(0, width)
    at = distorted_points(seen_mm[:, :2] / seen_mm[:, 2:], lens.terms) * lens.focal_px + lens.centre_px
    # Distortion bends the edges outwards by less than it moves the corners.
    straight = seen_mm[:, :2] / seen_mm[:, 2:] * lens.focal_px + lens.centre_px
    points = np.concatenate([at, straight])
    left_px, top = np.floor(points.min(axis=0) - margin_px).astype(int)
    right, bottom = np.ceil(points.max(axis=0) + margin_px).astype(int) + 1
    left_px, top, right, bottom = max(left_px, 0), max(top, 0), min(right, width), min(bottom, height)
    if left_px >= right or top >= bottom:
        return None
    return slice(int(top), int(bottom)), slice(int(left_px), int(right))


@kernel(parallel=True)
def _cover(coverage, edges, top, left_px, focal, centre_x, centre_y, shift):  # type: ignore[no-untyped-def]
    """Compute the fraction of each pixel whose rays are on the inner side of all planes through camera centre and
    edge.

    Within a pixel rays are linear in position, so the fraction is the area of a square cut by straight lines.
    """
    height, width = coverage.shape
    has_distortion = shift.shape[1] > 1
    for row in numba.prange(height):
        at, lines = np.empty((3, 3)), np.empty((4, 3))
        square, clip_buffer = np.empty((8, 2)), np.empty((8, 2))
        for col in range(width):
            # The ray at the pixel's centre, and its change to the next pixel along the row and down the column.
            at[:] = 0.0
            at[0, 0], at[0, 1], at[0, 2] = (left_px + col - centre_x) / focal, (top + row - centre_y) / focal, 1.0
            at[1, 0] = at[2, 1] = 1.0 / focal
            if has_distortion:
                _bend(at, shift, top + row, left_px + col)
            for k in range(4):
                for i in range(3):
                    lines[k, i] = edges[k, 0] * at[i, 0] + edges[k, 1] * at[i, 1] + edges[k, 2] * at[i, 2]
            inside, outside = True, False
            for k in range(4):
                reach = 0.5 * (abs(lines[k, 1]) + abs(lines[k, 2]))
                inside = inside and lines[k, 0] > reach
                outside = outside or lines[k, 0] < -reach
            if inside:
                coverage[row, col] = 1.0
            elif not outside:
                coverage[row, col] = _area_within(lines, square, clip_buffer)


@kernel
def _bend(at, shift, row, col):  # type: ignore[no-untyped-def]
    """Add the lens's shift and its derivatives to a pixel's ray."""
    above, below = max(row - 1, 0), min(row + 1, shift.shape[1] - 1)
    before, after = max(col - 1, 0), min(col + 1, shift.shape[2] - 1)
    for k in range(2):
        at[0, k] += shift[k, row, col]
        at[1, k] += (shift[k, row, after] - shift[k, row, before]) / (after - before)
        at[2, k] += (shift[k, below, col] - shift[k, above, col]) / (below - above)


@kernel
def _area_within(lines, square, cut_corners):  # type: ignore[no-untyped-def]
    """Area of the part of the unit square about 0 where a + b x + c y > 0 for all `lines` [4, 3] (a, b, c).

    Sutherland and Hodgman, Comm. ACM 17, 32 (1974).
    """
    count = 4
    for k in range(4):
        square[k, 0], square[k, 1] = (-0.5, 0.5, 0.5, -0.5)[k], (-0.5, -0.5, 0.5, 0.5)[k]
    for line in range(4):
        a, b, c = lines[line]
        corner_count = 0
        for k in range(count):
            x, y = square[k]
            to_x, to_y = square[(k + 1) % count]
            here, there = a + b * x + c * y, a + b * to_x + c * to_y
            if here > 0.0:
                cut_corners[corner_count, 0], cut_corners[corner_count, 1] = x, y
                corner_count += 1
            if (here > 0.0) != (there > 0.0):
                share = here / (here - there)
                cut_corners[corner_count, 0], cut_corners[corner_count, 1] = (
                    x + share * (to_x - x),
                    y + share * (to_y - y),
                )
                corner_count += 1
        count = corner_count
        square[:count] = cut_corners[:count]
    twice = 0.0
    for k in range(count):
        x, y = square[k]
        to_x, to_y = square[(k + 1) % count]
        twice += x * to_y - to_x * y
    return 0.5 * abs(twice)


def _evenness(
    unevenness: float, seen_mm: NDArray[np.float64], rows: slice, columns: slice, through: Sight
) -> NDArray[np.float32]:
    """Luminance relative to the panel's centre, where each pixel's ray meets its plane."""
    x = (np.arange(columns.start, columns.stop)[None, :] - through.lens.centre_px[0]) / through.lens.focal_px
    y = (np.arange(rows.start, rows.stop)[:, None] - through.lens.centre_px[1]) / through.lens.focal_px
    if through.shift is not None:
        x, y = x + through.shift[0, rows, columns], y + through.shift[1, rows, columns]
    x, y = np.broadcast_arrays(x, y)
    rays = np.stack([x, y, np.ones_like(x)], axis=-1)
    centre = seen_mm.mean(axis=0)
    u, v = 0.5 * (seen_mm[0] - seen_mm[1]), 0.5 * (seen_mm[0] - seen_mm[3])
    normal = np.cross(u, v)
    with np.errstate(divide="ignore", invalid="ignore"):
        meets = rays * (centre @ normal / (rays @ normal))[..., None] - centre
        squares = (meets @ u / (u @ u)) ** 2 + (meets @ v / (v @ v)) ** 2
    even: NDArray[np.float32] = (1.0 - unevenness * np.clip(np.nan_to_num(squares), 0.0, 2.0)).astype(np.float32)
    return even


def _spread_over_disk(coverage: NDArray[np.float32], disk_px: float) -> NDArray[np.float32]:
    """The image convolved with a uniform disk of diameter `disk_px`, its edge softened over a pixel."""
    from scipy.signal import fftconvolve

    reach = int(np.ceil(0.5 * disk_px + 1.0))
    y, x = np.mgrid[-reach : reach + 1, -reach : reach + 1]
    disk = np.clip(0.5 * disk_px + 0.5 - np.hypot(x, y), 0.0, 1.0)
    blurred_coverage = fftconvolve(coverage, disk / disk.sum(), mode="same")
    # The FFT leaves rounding errors where there is no light, which a bright lamp would make visible.
    blurred_coverage[blurred_coverage < 1e-6] = 0.0
    return np.asarray(blurred_coverage, np.float32)
