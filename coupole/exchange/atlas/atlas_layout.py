"""The place of each triangle of a mesh in a texture, and the triangle that each texel shows."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import distance_transform_edt
from scipy.spatial import ConvexHull, QhullError

from coupole.errors import InputError
from coupole.exchange.atlas.charts import (
    Floats,
    Integers,
    chart_axes,
    cut_charts,
    double_areas,
    neighbours_of,
    parts_of,
    split_off,
)
from coupole.kernels import kernel

PADDING_PX = 4
"""Number of texels by which a chart is continued on all sides, so that three levels of mipmaps contain nothing of
other charts."""
_SAME_PLACE, _MOST_SHARED = 1e-6, 0.01
"""Step in which given places are compared, and greatest share of the surface whose places may coincide with
others."""
_MOST_ROUNDS = 12
_FILL = 0.85
"""Share of a texture that rectangles are expected to fill. If they do not fit, the side grows."""


@dataclass(frozen=True)
class MapSize:
    """Wanted width of texels, and greatest width of a texture."""

    texel_mm: float
    most_side_px: int
    may_be_coarser: bool = False
    """True if texels may become larger until the texture is narrow enough."""


@dataclass(frozen=True)
class Atlas:
    """A texture of n triangles. Places in it are in px, to the right and down from its top left corner; so the
    first texel's centre is at (0.5, 0.5)."""

    side_px: int
    texel_mm: float
    """Width of a texel on a surface that is parallel to its chart's plane, mm."""
    chart: Integers
    """[n] chart of each triangle."""
    corners_px: Floats
    """[n, 3, 2] places of the corners, px."""
    triangle_of_texel: Integers
    """[side, side] triangle that each texel shows; -1 for none. In the padding it is the nearest triangle."""
    is_inside: NDArray[np.bool_]
    """[side, side] True if the texel's centre is on a triangle; False in the padding."""

    def places_mm(self, corners_mm: Floats, texels: NDArray[np.int64]) -> Floats:
        """[k, 3] places, on triangles [n, 3, 3], that texels [k] show. Texels are counted row by row."""
        places = np.empty((len(texels), 3))
        _places(texels, self.triangle_of_texel, self.corners_px, corners_mm, places)
        return places

    @cached_property
    def handedness(self) -> Floats:
        """[n] 1 if a triangle's outer side is up in the texture, -1 if it is mirrored."""
        return np.where(_double_areas_in_map(self.corners_px) > 0.0, -1.0, 1.0)

    def barycentric(self, texels: NDArray[np.int64]) -> Floats:
        """[k, 3] weights of the corners of the triangles that texels [k] show. Texels are counted row by row."""
        return self.places_mm(np.broadcast_to(np.eye(3), (len(self.chart), 3, 3)), texels)


def lay_out(corners_mm: Floats, triangles: NDArray[np.integer], size: MapSize) -> Atlas:
    """Lay out triangles [n, 3, 3], whose corners are rows of vertices [n, 3]. No texel shows two places of the
    surface.

    Raises InputError if the texture would be wider than allowed.
    """
    neighbours = neighbours_of(triangles)
    chart = cut_charts(corners_mm, neighbours)
    for round_number in range(_MOST_ROUNDS):
        texel_mm, corners_px, side_px = _pack_charts(corners_mm, chart, size)
        size = replace(size, texel_mm=texel_mm)
        triangle_of_texel = np.full((side_px, side_px), -1, np.int32)
        is_expelled = np.zeros(len(chart), np.bool_)
        _rasterise(corners_px, triangle_of_texel, is_expelled)
        if not is_expelled.any() or round_number == _MOST_ROUNDS - 1:
            break
        chart = split_off(neighbours, chart, is_expelled)
    is_inside = triangle_of_texel >= 0
    return Atlas(side_px, texel_mm, chart, corners_px, _pad(triangle_of_texel), is_inside)


def lay_out_given(places: Floats, corners_mm: Floats, triangles: NDArray[np.integer], size: MapSize) -> Atlas:
    """The same for given places [n, 3, 2] of the corners in the texture: 0 to 1, to the right and down. Half of
    the surface has texels smaller than the wanted width.

    Raises InputError if the texture would be wider than allowed, or if triangles overlap in it.
    """
    area_mm2 = np.linalg.norm(double_areas(corners_mm), axis=1)
    area = np.abs(_double_areas_in_map(places))
    px_by_mm = np.sqrt(area / np.maximum(area_mm2, 1e-300))
    side = 1.0 / max(size.texel_mm * _median_by(px_by_mm, area_mm2), 1e-300)
    side_px = 4 * max(math.ceil(min(side, 1e9) / 4.0), 1)
    if side_px > size.most_side_px and not size.may_be_coarser:
        raise InputError(_too_large(size.texel_mm, side_px, size.most_side_px))
    side_px = min(side_px, size.most_side_px)
    corners_px = places * side_px
    triangle_of_texel = np.full((side_px, side_px), -1, np.int32)
    is_expelled = np.zeros(len(corners_px), np.bool_)
    _rasterise(corners_px, triangle_of_texel, is_expelled)
    if area_mm2[is_expelled].sum() > _MOST_SHARED * area_mm2.sum():
        share = area_mm2[is_expelled].sum() / area_mm2.sum()
        raise InputError(
            f"{100.0 * share:.3g} % of the surface shares texels with other parts in the given texture (mirrored "
            "or stacked charts); unwrap the mesh so that each place has a texel of its own"
        )
    is_inside = triangle_of_texel >= 0
    own_texel_mm = 1.0 / (side_px * _median_by(px_by_mm, area_mm2))
    chart = _charts_by(places, triangles)
    return Atlas(side_px, own_texel_mm, chart, corners_px, _pad(triangle_of_texel), is_inside)


def _double_areas_in_map(places: Floats) -> Floats:
    """[n] twice the signed area of triangles with places [n, 3, 2], in which y goes down; below 0 if the outer
    side is up."""
    ab, ac = places[:, 1] - places[:, 0], places[:, 2] - places[:, 0]
    return np.asarray(ab[:, 0] * ac[:, 1] - ab[:, 1] * ac[:, 0])


def _median_by(values: Floats, weights: Floats) -> float:
    order = np.argsort(values)
    running = np.cumsum(weights[order])
    return float(values[order][np.searchsorted(running, 0.5 * running[-1])])


def _charts_by(places: Floats, triangles: NDArray[np.integer]) -> Integers:
    """[n] chart of each triangle. A chart is connected both on the surface and in the texture, and one side of it
    is up."""
    keys = np.concatenate([triangles.reshape(-1, 1), np.rint(places.reshape(-1, 2) / _SAME_PLACE)], axis=1)
    _, number = np.unique(keys.astype(np.int64), axis=0, return_inverse=True)
    is_mirrored = _double_areas_in_map(places) > 0.0
    return parts_of(neighbours_of(number.reshape(-1, 3)), is_mirrored.astype(np.int32))


def _pack_charts(corners_mm: Floats, chart: Integers, size: MapSize) -> tuple[float, Floats, int]:
    """Width of a texel, mm; places of the corners [n, 3, 2], px; side of the texture, px."""
    coarsest_mm, texel_mm = float(np.ptp(corners_mm.reshape(-1, 3), axis=0).max()), size.texel_mm
    while True:
        flat_px, sizes_px = _flatten(corners_mm, chart, texel_mm)
        side_px, origins_px = _pack(sizes_px)
        if side_px <= size.most_side_px:
            return texel_mm, flat_px + origins_px[chart][:, None, :], side_px
        if not size.may_be_coarser:
            raise InputError(_too_large(texel_mm, side_px, size.most_side_px))
        if texel_mm > coarsest_mm:
            raise InputError(f"{len(sizes_px):,} charts need a map {side_px:,} px wide; give --map-px {side_px}")
        texel_mm *= 1.02 * side_px / size.most_side_px


def _too_large(texel_mm: float, side_px: int, most_side_px: int) -> str:
    enough_mm = texel_mm * side_px / most_side_px * 1.05
    return (
        f"texels of {texel_mm:.3g} mm need a texture {side_px:,} px wide, and {most_side_px:,} is the most; "
        f"give --texel-mm {enough_mm:.2g} or more"
    )


def _flatten(corners_mm: Floats, chart: Integers, texel_mm: float) -> tuple[Floats, NDArray[np.int64]]:
    """[n, 3, 2] places of the corners in their charts' rectangles, px, and [charts, 2] widths and heights of
    these, px."""
    axes = chart_axes(corners_mm, chart)
    helper = np.where(np.abs(axes[:, 2:]) < 0.9, [[0.0, 0.0, 1.0]], [[1.0, 0.0, 0.0]])
    right = np.cross(helper, axes)
    right /= np.linalg.norm(right, axis=1, keepdims=True)
    up = np.cross(axes, right)
    flat = np.stack([np.einsum("nck,nk->nc", corners_mm, way[chart]) for way in (right, -up)], axis=2) / texel_mm
    order = np.argsort(chart, kind="stable")
    bounds = np.searchsorted(chart[order], np.arange(len(axes) + 1))
    sizes = np.empty((len(axes), 2), np.int64)
    for number in range(len(axes)):
        rows = order[bounds[number] : bounds[number + 1]]
        flat[rows], sizes[number] = _turn_to_fit(flat[rows])
    return flat, sizes


def _turn_to_fit(corners_px: Floats) -> tuple[Floats, tuple[int, int]]:
    """Turn a chart [n, 3, 2] so that its rectangle is small and wider than high; return also its size with
    padding."""
    fitted_px = corners_px @ _lying(corners_px.reshape(-1, 2))
    fitted_px += PADDING_PX - fitted_px.reshape(-1, 2).min(axis=0)
    width, height = np.ceil(fitted_px.reshape(-1, 2).max(axis=0)).astype(int) + PADDING_PX
    return fitted_px, (int(width), int(height))


def _lying(points_px: Floats) -> Floats:
    """[2, 2] rotation `t` for which `points_px @ t`, of points [n, 2], have the smallest bounding rectangle, wider
    than high.

    One of its sides lies along an edge of the convex hull (Freeman and Shapira 1975).
    """
    try:
        hull = points_px[ConvexHull(points_px).vertices]
    except QhullError:  # all points are on a line
        hull = points_px[np.lexsort(points_px.T)[[0, -1]]]
    edges = np.roll(hull, -1, axis=0) - hull
    angles = np.arctan2(edges[:, 1], edges[:, 0])
    across, along = np.stack([np.cos(angles), np.sin(angles)]), np.stack([-np.sin(angles), np.cos(angles)])
    widths, heights = np.ptp(hull @ across, axis=0), np.ptp(hull @ along, axis=0)
    best = int(np.argmin(widths * heights))
    angle = angles[best] + (0.0 if widths[best] >= heights[best] else 0.5 * math.pi)
    return np.array([[math.cos(angle), -math.sin(angle)], [math.sin(angle), math.cos(angle)]])


def _pack(sizes_px: NDArray[np.int64]) -> tuple[int, NDArray[np.int64]]:
    """Side of a square for rectangles [charts, 2], and their upper left corners [charts, 2]: in rows, the highest
    first."""
    order = np.argsort(-sizes_px[:, 1], kind="stable")
    side = max(int(math.sqrt(sizes_px.prod(axis=1).sum() / _FILL)), int(sizes_px.max()))
    while True:
        side = -(-side // 4) * 4
        origins = _shelves(sizes_px[order], side)
        if len(origins):
            places = np.empty_like(origins)
            places[order] = origins
            return side, places
        side += max(side // 64, 4)


@kernel
def _shelves(sizes_px, side_px):  # type: ignore[no-untyped-def]
    """Upper left corners of rectangles in rows; None if they do not fit."""
    origins = np.empty((len(sizes_px), 2), np.int64)
    at_px, top_px, height_px = 0, 0, 0
    for number in range(len(sizes_px)):
        if at_px + sizes_px[number, 0] > side_px:
            at_px, top_px, height_px = 0, top_px + height_px, 0
        height_px = max(height_px, sizes_px[number, 1])
        if top_px + height_px > side_px:
            return origins[:0]
        origins[number, 0], origins[number, 1] = at_px, top_px
        at_px += sizes_px[number, 0]
    return origins


@kernel(error_model="numpy")
def _rasterise(corners_px, triangle_of_texel, is_expelled):  # type: ignore[no-untyped-def]
    """Write each triangle into the texels whose centres it contains; mark triangles that overlap others there."""
    side = len(triangle_of_texel)
    for triangle in range(len(corners_px)):
        a, b, c = corners_px[triangle, 0], corners_px[triangle, 1], corners_px[triangle, 2]
        area = (b[0] - a[0]) * (c[1] - a[1]) - (b[1] - a[1]) * (c[0] - a[0])
        if area == 0.0:
            continue
        low, high = min(a[1], b[1], c[1]), max(a[1], b[1], c[1])
        for row in range(max(math.ceil(low - 0.5), 0), min(math.floor(high - 0.5) + 1, side)):
            least_px, most_px = min(a[0], b[0], c[0]), max(a[0], b[0], c[0])
            for column in range(max(math.ceil(least_px - 0.5), 0), min(math.floor(most_px - 0.5) + 1, side)):
                x, y = column + 0.5 - a[0], row + 0.5 - a[1]
                v = (x * (c[1] - a[1]) - y * (c[0] - a[0])) / area
                w = (y * (b[0] - a[0]) - x * (b[1] - a[1])) / area
                if v < 0.0 or w < 0.0 or v + w > 1.0:
                    continue
                if triangle_of_texel[row, column] < 0:
                    triangle_of_texel[row, column] = triangle
                elif min(v, w, 1.0 - v - w) > 1e-6:
                    is_expelled[triangle] = True


def _pad(triangle_of_texel: Integers) -> Integers:
    """Return the map with the nearest triangle in the texels around charts."""
    nearest, distance_px = nearest_known(triangle_of_texel)
    return np.where(distance_px <= PADDING_PX, nearest, -1).astype(np.int32)


def nearest_known(numbers: Integers) -> tuple[Integers, NDArray[np.float32]]:
    """[h, w] the number of the nearest known place of a map (unknown ones are -1), and its distance, px."""
    is_unknown = numbers < 0
    if is_unknown.all() or not is_unknown.any():
        return numbers, np.zeros(numbers.shape, np.float32)
    rows, columns = distance_transform_edt(is_unknown, return_distances=False, return_indices=True)
    nearest, distance_px = np.empty_like(numbers), np.empty(numbers.shape, np.float32)
    for row in range(len(numbers)):
        nearest[row] = numbers[rows[row], columns[row]]
        distance_px[row] = np.hypot(rows[row] - row, columns[row] - np.arange(numbers.shape[1]))
    return nearest, distance_px


@kernel(error_model="numpy")
def _places(texels, triangle_of_texel, corners_px, corners_mm, places_mm):  # type: ignore[no-untyped-def]
    side = triangle_of_texel.shape[1]
    for number in range(len(texels)):
        row, column = texels[number] // side, texels[number] % side
        triangle = triangle_of_texel[row, column]
        a, b, c = corners_px[triangle, 0], corners_px[triangle, 1], corners_px[triangle, 2]
        area = (b[0] - a[0]) * (c[1] - a[1]) - (b[1] - a[1]) * (c[0] - a[0])
        x, y = column + 0.5 - a[0], row + 0.5 - a[1]
        v = (x * (c[1] - a[1]) - y * (c[0] - a[0])) / area
        w = (y * (b[0] - a[0]) - x * (b[1] - a[1])) / area
        for k in range(3):
            places_mm[number, k] = (
                (1.0 - v - w) * corners_mm[triangle, 0, k]
                + v * corners_mm[triangle, 1, k]
                + w * corners_mm[triangle, 2, k]
            )
