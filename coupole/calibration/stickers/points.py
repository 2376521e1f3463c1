"""Decides which of two possible disks an ellipse shows: the disk with the normal on which all views of a sticker
agree.

In a single view a disk may be tilted to either side, and the images of the two centres differ by up to a fifth of
a pixel for 6 mm at 0.35 m. If there are views from two sides, only one normal agrees in all of them.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from coupole.calibration.multi_view import CameraView, SeenPoint
from coupole.calibration.rotations import Floats
from coupole.calibration.stickers.detection import Sticker


def views_of(
    names: Sequence[str], base_from_camera: Floats, stickers: Sequence[Sequence[Sticker]]
) -> list[CameraView]:
    """Return views [v] with the middles of ellipses. These are exact enough to match detections between views."""
    return [
        CameraView(name, pose, np.array([sticker.middle for sticker in view_stickers]).reshape(-1, 2))
        for name, pose, view_stickers in zip(names, base_from_camera, stickers, strict=True)
    ]


def corrected_views(
    views: Sequence[CameraView], stickers: Sequence[Sequence[Sticker]], points: Sequence[SeenPoint]
) -> list[CameraView]:
    """Return the views with all detections moved from the ellipses' middles to the images of the disks'
    centres."""
    pixels = [view.pixels.copy() for view in views]
    for point in points:
        normals = np.array(
            [
                stickers[v][p].normals @ views[v].base_from_camera[:3, :3].T
                for v, p in zip(point.views, point.places, strict=True)
            ]
        )
        normal_numbers = _agreeing_normals(normals)
        for v, p, w in zip(point.views, point.places, normal_numbers.tolist(), strict=True):
            pixels[v][p] = stickers[v][p].centres[w]
    return [replace(view, pixels=view_pixels) for view, view_pixels in zip(views, pixels, strict=True)]


def _agreeing_normals(normals: Floats) -> np.ndarray[tuple[int], np.dtype[np.intp]]:
    """Choose which of two normals [views, 2, 3] each view shows, so that the chosen normals agree best."""
    candidates = normals.reshape(-1, 3)
    cosines = np.einsum("ci,vki->cvk", candidates, normals)
    best = int(np.argmax(cosines.max(axis=2).sum(axis=1)))
    mean = normals[np.arange(len(normals)), cosines[best].argmax(axis=1)].mean(axis=0)
    return np.asarray((normals @ mean).argmax(axis=1))
