"""Part of the object that each pixel of a camera shows, found by a ray through the pixel's middle."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from coupole.appearance.render.pieces import Ball, Piece
from coupole.appearance.render.scene_file import Camera
from coupole.appearance.shapes.solids import unit_sphere
from coupole.heritage.restoration.painted_mesh import Floats

NOTHING = -1
_BALL = 12
"""Number of parts n into which edges of a ball are divided; the ball has 20 n^2 triangles."""


class SeenParts:
    """Parts of an object among other things of a scene."""

    def __init__(
        self, corners_mm: Floats, labels: NDArray[np.int16], other_pieces: Sequence[Piece | Ball]
    ) -> None:
        from embreex import rtcore_scene
        from embreex.mesh_construction import TriangleMesh

        around = [
            body.centre_mm + body.radius_mm * unit_sphere(_BALL) if isinstance(body, Ball) else body.corners_mm
            for body in other_pieces
        ]
        corners = np.concatenate([corners_mm, *around])
        self._labels = np.full(len(corners) + 1, NOTHING, np.int16)
        self._labels[: len(labels)] = labels
        self._tree: Any = rtcore_scene.EmbreeScene()
        self._mesh = TriangleMesh(self._tree, corners.astype(np.float32))

    def part_of_pixel(self, camera: Camera) -> NDArray[np.int16]:
        """[h, w] number of the part that each pixel sees; `NOTHING` where the object is not seen."""
        ways = rays(camera).reshape(-1, 3)
        starts = np.broadcast_to(np.asarray(camera.position_mm, float), ways.shape)
        hit_rows = self._tree.run(starts.astype(np.float32), ways.astype(np.float32))
        labels: NDArray[np.int16] = self._labels[hit_rows].reshape(camera.height_px, camera.width_px)
        return labels


def rays(camera: Camera) -> Floats:
    """[h, w, 3] unit vectors through the middles of the pixels, row by row from the top left."""
    ahead = np.subtract(camera.target_mm, camera.position_mm)
    ahead = ahead / np.linalg.norm(ahead)
    right = np.cross(ahead, camera.up)
    right = right / np.linalg.norm(right)
    up = np.cross(right, ahead)
    wide = np.tan(np.radians(camera.field_deg() / 2))
    x = (2.0 * (np.arange(camera.width_px) + 0.5) / camera.width_px - 1.0) * wide
    y = (
        (1.0 - 2.0 * (np.arange(camera.height_px) + 0.5) / camera.height_px)
        * wide
        * (camera.height_px / camera.width_px)
    )
    ways = ahead + x[None, :, None] * right + y[:, None, None] * up
    return np.asarray(ways / np.linalg.norm(ways, axis=-1, keepdims=True))
