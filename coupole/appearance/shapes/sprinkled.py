"""A drawing of powder on a body: the body's skin is cut into grains, each with the drawing's share."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from coupole.appearance.shapes.skin import skin_of
from coupole.appearance.shapes.triangles import Array

Wrapping = Literal["sides", "above", "around", "uv"]
"""Ways in which a flat drawing lies on the body. `sides`: projected onto each of six sides, by the normal;
`above`: along z; `around`: rolled around z; `uv`: by the mesh's texture coordinates, minus their middle (0.5,
0.5)."""


@dataclass(frozen=True)
class Grains:
    """Triangles of at most a grain's size."""

    corners_mm: Array
    """[n, 3, 3]."""
    share: Array
    """[n], the drawing's share at the middles of the triangles."""


def parts_of(corners_mm: Array, grain_mm: float) -> NDArray[np.int64]:
    """[triangles] number of parts into which the sides of each triangle are cut, so that no part is longer than
    `grain_mm`."""
    longest = np.linalg.norm(corners_mm - corners_mm[:, [1, 2, 0]], axis=2).max(axis=1)
    return np.asarray(np.maximum(1, np.ceil(longest / grain_mm)), dtype=np.int64)


def grains(
    corners_mm: Array,
    uv: Array | None,
    parts: NDArray[np.int64],
    drawing: Callable[[Array], Array],
    *,
    wrapping: Wrapping,
    raised_mm: float,
) -> Grains:
    """Cut each of the body's triangles [m, 3, 3] into grains; their number is the square of the triangle's number
    in `parts` [m]. Grains are raised by `raised_mm` times the drawing's share. `uv` [m, 3, 2] is needed only for
    the wrapping `uv`."""
    skin = skin_of(corners_mm)
    middle = 0.5 * (skin.points_mm.min(axis=0) + skin.points_mm.max(axis=0))
    normals = skin.normals[skin.faces]
    flat = np.zeros((len(corners_mm), 3, 2)) if uv is None else uv - 0.5
    whole = np.concatenate([corners_mm, normals, flat], axis=2)
    small_triangles = np.concatenate(
        [_cut_triangles(whole[parts == count], int(count)) for count in np.unique(parts)]
    )
    places, along = small_triangles[..., :3], small_triangles[..., 3:6]
    along = along / np.maximum(np.linalg.norm(along, axis=2, keepdims=True), 1e-300)

    def share(place: Array, normal: Array, texture: Array) -> Array:
        return drawing(texture if wrapping == "uv" else _project_on_drawing(place - middle, normal, wrapping))

    centres = [small_triangles[..., first:last].mean(axis=1) for first, last in ((0, 3), (3, 6), (6, 8))]
    metal_shares = share(*centres)
    if raised_mm > 0.0:
        at_corners = share(places.reshape(-1, 3), along.reshape(-1, 3), small_triangles[..., 6:].reshape(-1, 2))
        places = places + raised_mm * at_corners.reshape(-1, 3, 1) * along
    return Grains(places, metal_shares)


def _cut_triangles(corners: Array, count: int) -> Array:
    """[m count^2, 3, k] values at the corners of the parts, from values [m, 3, k] at the corners of the
    triangles."""
    i, j = (index.ravel() for index in np.meshgrid(np.arange(count), np.arange(count), indexing="ij"))
    is_upright, is_inverted = i + j < count, i + j < count - 1
    a, b, c = (
        (i[is_upright], j[is_upright]),
        (i[is_upright] + 1, j[is_upright]),
        (i[is_upright], j[is_upright] + 1),
    )
    d, e, f = (
        (i[is_inverted] + 1, j[is_inverted]),
        (i[is_inverted] + 1, j[is_inverted] + 1),
        (i[is_inverted], j[is_inverted] + 1),
    )
    steps = np.concatenate(
        [np.stack([np.stack(p, 1) for p in (a, b, c)], 1), np.stack([np.stack(p, 1) for p in (d, e, f)], 1)]
    )
    shares = np.concatenate([count - steps.sum(axis=2, keepdims=True), steps], axis=2) / count
    return np.asarray(np.einsum("gcs,msk->mgck", shares, corners)).reshape(-1, 3, corners.shape[2])


def _project_on_drawing(place: Array, normal: Array, wrapping: Wrapping) -> Array:
    """[n, 2] places on the drawing in mm; +y is up on walls."""
    x, y, z = place.T
    if wrapping == "above":
        return np.stack([x, y], axis=1)
    if wrapping == "around":
        radius = float(np.hypot(x, y).max())
        return np.stack([radius * np.arctan2(y, x), z], axis=1)
    side = np.argmax(np.abs(normal), axis=1)
    sign = np.sign(np.take_along_axis(normal, side[:, None], axis=1)[:, 0])
    across = np.choose(side, [sign * y, -sign * x, x])
    return np.stack([across, np.where(side == 2, y, z)], axis=1)
