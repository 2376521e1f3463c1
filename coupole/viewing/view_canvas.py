"""A small renderer: triangles, lines and dots with a depth buffer, in numpy and numba, for still pictures.

Pictures are drawn at twice their size and then scaled down, which smooths edges.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from coupole.geometry import Transform, apply, inverse
from coupole.kernels import kernel
from coupole.viewing.view_colours import Colour
from coupole.viewing.view_solids import Points, Solid

OVERSAMPLING = 2
_TO_LIGHT = np.array((-0.35, -0.55, -0.76))
"""Direction to the light in the viewer's frame: from above, from the left, from behind."""
_AMBIENT = 0.45
_OUTLINE = 0.55
"""Factor by which pixels at the outline of a body are darkened, if it is in front of another body."""
_LINE_BIAS, _LINE_BIAS_MM = 2e-3, 10.0
"""Depth tolerance for lines on surfaces: as a share of the depth (perspective), or in mm."""
_NEARNESS_PER_MM = 1e-5
"""Nearness per mm of depth, without perspective."""


@dataclass(frozen=True)
class Lookout:
    """Viewpoint of a picture, x to the right, y down, z forward. With perspective, `scale` is the focal length in
    pixels; otherwise it is pixels per mm."""

    world_from_eye: Transform
    scale: float
    width_px: int
    height_px: int
    perspective: bool

    def project(self, points_mm: ArrayLike) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Return pixels [..., 2] and nearness [...] of points [..., 3]. Nearness is larger for nearer points, and
        linear in the picture. It is NaN for points behind the viewpoint."""
        points_eye = apply(inverse(self.world_from_eye), points_mm)
        depth_mm = points_eye[..., 2]
        middle = np.array((self.width_px, self.height_px)) / 2
        if not self.perspective:
            return points_eye[..., :2] * self.scale + middle, -_NEARNESS_PER_MM * depth_mm
        in_front = np.where(depth_mm > 1.0, depth_mm, np.nan)
        return points_eye[..., :2] * (self.scale / in_front)[..., None] + middle, 1.0 / in_front


class Canvas:
    """A picture that is being drawn, from one viewpoint."""

    def __init__(self, lookout: Lookout, background: Colour = (1.0, 1.0, 1.0)) -> None:
        self._lookout = lookout
        size = (OVERSAMPLING * lookout.height_px, OVERSAMPLING * lookout.width_px)
        self._colour = np.tile(np.array(background, np.float32), (*size, 1))
        self._near = np.full(size, -np.inf)

    def fill(
        self,
        solids: Sequence[Solid],
        colours: Sequence[ArrayLike],
        *,
        opacity: float = 1.0,
        has_outline: bool = True,
    ) -> None:
        """Draw solids, each in one colour [3] or one per face [faces, 3]. Transparent solids are drawn as one
        layer: only the nearest of them is visible, and solids that are drawn later shine through."""
        if not solids:
            return
        corners_mm = np.concatenate([solid.corners_mm for solid in solids])
        colour = np.concatenate(
            [
                np.broadcast_to(np.asarray(c, np.float32), (len(s.faces), 3))
                for s, c in zip(solids, colours, strict=True)
            ]
        )
        body = np.repeat(np.arange(len(solids)), [len(solid.faces) for solid in solids])
        pixels, near = self._project(corners_mm)
        layer = self._near.copy() if opacity == 1.0 else np.full_like(self._near, -np.inf)
        face = np.full(layer.shape, -1, np.int32)
        _rasterise(pixels, near, layer, face)
        is_front = (face >= 0) & (layer >= self._near)
        pixel_colours = (colour * _brightness(self._lookout, corners_mm)[:, None])[face[is_front]]
        if has_outline:
            pixel_colours[_edges(np.where(face >= 0, body[face], -1))[is_front]] *= _OUTLINE
        self._colour[is_front] += opacity * (pixel_colours - self._colour[is_front])
        if opacity == 1.0:
            self._near = layer

    def line(self, points_mm: Points, colour: Colour, width_px: float, *, hidden_opacity: float = 0.15) -> None:
        """Draw a line through points [n, 3]. Hidden parts have the opacity `hidden_opacity`."""
        for a, b in pairwise(points_mm):
            (start, end), near = self._project(np.array((a, b)))
            if not np.isfinite(near).all():
                continue
            share = np.linspace(0, 1, int(np.abs(end - start).max()) + 2)
            centers = start + share[:, None] * (end - start)
            self._stamp(centers, near[0] + share * (near[1] - near[0]), colour, width_px / 2, 1.0, hidden_opacity)

    def dots(self, points_mm: Points, colours: ArrayLike, radius_px: float, *, opacity: float = 1.0) -> None:
        """Draw discs of one size round points [n, 3], far ones first, in colours [n, 3] or one [3]."""
        pixels, near = self._project(points_mm)
        every = np.broadcast_to(np.asarray(colours, np.float32), (len(points_mm), 3))
        for k in np.argsort(near):
            if np.isfinite(near[k]):
                self._stamp(pixels[k : k + 1], near[k : k + 1], every[k], radius_px, opacity, 0.0)

    def image(self) -> Any:
        """The picture as a PIL image of the lookout's size."""
        from PIL import Image

        full = Image.fromarray((np.clip(self._colour, 0, 1) * 255 + 0.5).astype(np.uint8))
        return full.resize((self._lookout.width_px, self._lookout.height_px), Image.Resampling.BOX)

    def _project(self, points_mm: Points) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        pixels, near = self._lookout.project(points_mm)
        return pixels * OVERSAMPLING, near

    def _stamp(
        self,
        centers: NDArray[np.float64],
        near: NDArray[np.float64],
        colour: ArrayLike,
        radius_px: float,
        opacity: float,
        hidden_opacity: float,
    ) -> None:
        """Draw overlapping discs [n, 2] as one shape, so that their opacity does not accumulate."""
        radius = radius_px * OVERSAMPLING
        steps = np.arange(-int(radius) - 1, int(radius) + 2)
        offsets = np.stack(np.meshgrid(steps, steps), axis=-1).reshape(-1, 2)
        offsets = offsets[np.linalg.norm(offsets, axis=1) <= radius]
        places = (np.floor(centers)[:, None] + offsets).astype(np.int64).reshape(-1, 2)
        nearness = np.repeat(near, len(offsets))
        height, width = self._near.shape
        inside = ((places >= 0) & (places < (width, height))).all(axis=1)
        flat = places[inside, 1] * width + places[inside, 0]
        bias = _LINE_BIAS * nearness[inside] if self._lookout.perspective else _LINE_BIAS_MM * _NEARNESS_PER_MM
        is_front = nearness[inside] + bias >= self._near.ravel()[flat]
        at, of = np.unique(flat, return_inverse=True)
        strength = np.full((len(at), 1), hidden_opacity, np.float32)
        strength[of[is_front]] = opacity
        pixels = self._colour.reshape(-1, 3)
        pixels[at] += strength * (np.asarray(colour, np.float32) - pixels[at])


def _brightness(lookout: Lookout, corners_mm: Points) -> NDArray[np.float32]:
    """Brightness [faces]: Lambert's law, on both sides of a face."""
    normals = np.cross(corners_mm[:, 1] - corners_mm[:, 0], corners_mm[:, 2] - corners_mm[:, 0])
    length = np.linalg.norm(normals, axis=1)
    normals /= np.where(length > 0, length, 1.0)[:, None]
    eye = lookout.world_from_eye
    away = np.einsum("nk,nk->n", normals, corners_mm[:, 0] - eye[:3, 3]) > 0
    if not lookout.perspective:
        away = normals @ eye[:3, 2] > 0
    normals[away] *= -1
    lambert = np.clip(normals @ eye[:3, :3] @ (_TO_LIGHT / np.linalg.norm(_TO_LIGHT)), 0, None)
    shade: NDArray[np.float32] = (_AMBIENT + (1 - _AMBIENT) * lambert).astype(np.float32)
    return shade


def seen_faces(lookout: Lookout, solid: Solid) -> tuple[NDArray[np.int32], NDArray[np.float32]]:
    """Return the face at each pixel [h, w], -1 if there is none, and the brightness of all faces [faces]."""
    pixels, near = lookout.project(solid.corners_mm)
    nearest = np.full((lookout.height_px, lookout.width_px), -np.inf)
    face = np.full(nearest.shape, -1, np.int32)
    _rasterise(pixels, near, nearest, face)
    return face, _brightness(lookout, solid.corners_mm)


def _edges(body: NDArray[np.int64]) -> NDArray[np.bool_]:
    """Return a mask [height, width]: True for pixels next to a pixel of another body."""
    edge = np.zeros(body.shape, np.bool_)
    across, down = body[:, 1:] != body[:, :-1], body[1:] != body[:-1]
    edge[:, 1:] |= across
    edge[:, :-1] |= across
    edge[1:] |= down
    edge[:-1] |= down
    return edge


@kernel
def _rasterise(pixels, near, nearest, face):  # type: ignore[no-untyped-def]
    """Write the nearest triangle of each pixel (pixels [n, 3, 2], nearness [n, 3]) into `nearest` and `face`."""
    height, width = nearest.shape
    for k in range(len(pixels)):
        ax, ay = pixels[k, 0]
        bx, by = pixels[k, 1]
        cx, cy = pixels[k, 2]
        twice = (bx - ax) * (cy - ay) - (by - ay) * (cx - ax)
        if twice == 0.0 or np.isnan(twice) or np.isnan(near[k].sum()):
            continue
        left_px, right = max(0, int(np.ceil(min(ax, bx, cx) - 0.5))), min(width - 1, int(max(ax, bx, cx) - 0.5))
        top, bottom = max(0, int(np.ceil(min(ay, by, cy) - 0.5))), min(height - 1, int(max(ay, by, cy) - 0.5))
        for row in range(top, bottom + 1):
            y = row + 0.5
            for column in range(left_px, right + 1):
                x = column + 0.5
                wb = ((x - ax) * (cy - ay) - (y - ay) * (cx - ax)) / twice
                wc = ((bx - ax) * (y - ay) - (by - ay) * (x - ax)) / twice
                wa = 1.0 - wb - wc
                if wa < 0.0 or wb < 0.0 or wc < 0.0:
                    continue
                here = wa * near[k, 0] + wb * near[k, 1] + wc * near[k, 2]
                if here > nearest[row, column]:
                    nearest[row, column] = here
                    face[row, column] = k
