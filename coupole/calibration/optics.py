"""The camera model of the processing: a pinhole with Brown-Conrady distortion, and its derivatives.

The camera frame has z forward, x to the right and y down; the centre of the first pixel is (0, 0) (OpenCV's
convention). The simulator has its own implementation, so that the two check each other.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from coupole.calibration.rotations import Floats

NAMES = ("fx", "fy", "cx", "cy", "k1", "k2", "p1", "p2", "k3")
MODELS = {
    "pinhole": ("fx", "fy", "cx", "cy"),
    "radial": ("fx", "fy", "cx", "cy", "k1"),
    "brown4": ("fx", "fy", "cx", "cy", "k1", "k2", "p1", "p2"),
    "brown5": NAMES,
}
"""Models, with the parameters that a calibration estimates. All other parameters are 0."""


@dataclass(frozen=True)
class Intrinsics:
    """Focal lengths and principal point in px, distortion as factors of normalised coordinates."""

    fx: float
    fy: float
    cx: float
    cy: float
    k1: float = 0.0
    k2: float = 0.0
    p1: float = 0.0
    p2: float = 0.0
    k3: float = 0.0

    def vector(self) -> Floats:
        """All nine parameters [9], in the order of `NAMES`."""
        return np.array([getattr(self, name) for name in NAMES])

    def matrix(self) -> Floats:
        """The camera matrix [3, 3], px."""
        return np.array([[self.fx, 0.0, self.cx], [0.0, self.fy, self.cy], [0.0, 0.0, 1.0]])

    def distortion(self) -> Floats:
        """k1, k2, p1, p2, k3 [5], in OpenCV's order."""
        return self.vector()[4:]


@dataclass(frozen=True)
class Projected:
    """Pixels [n, 2] of points, and their derivatives."""

    pixels: Floats
    by_intrinsics: Floats
    """[n, 2, 9], derivatives in the order of `NAMES`."""
    by_point: Floats
    """[n, 2, 3], px per mm in the camera frame."""


def project(points_camera_mm: ArrayLike, intrinsics: ArrayLike) -> Projected:
    """Project points [n, 3] of the camera frame with intrinsics [9].

    The source is Brown, Close-range camera calibration, Photogrammetric Engineering 37(8), 1971. With x = X/Z, y =
    Y/Z, r^2 = x^2 + y^2 and g = 1 + k1 r^2 + k2 r^4 + k3 r^6: u = fx (x g + 2 p1 x y + p2 (r^2 + 2 x^2)) + cx, v =
    fy (y g + p1 (r^2 + 2 y^2) + 2 p2 x y) + cy.
    """
    points = np.asarray(points_camera_mm, dtype=np.float64)
    fx, fy, cx, cy, k1, k2, p1, p2, k3 = np.asarray(intrinsics, dtype=np.float64)
    depth = points[:, 2]
    x, y = points[:, 0] / depth, points[:, 1] / depth
    r2 = x * x + y * y
    g = 1 + r2 * (k1 + r2 * (k2 + r2 * k3))
    slope = k1 + r2 * (2 * k2 + r2 * 3 * k3)  # dg / d(r^2)
    xd = x * g + 2 * p1 * x * y + p2 * (r2 + 2 * x * x)
    yd = y * g + p1 * (r2 + 2 * y * y) + 2 * p2 * x * y
    ones, zeros = np.ones_like(x), np.zeros_like(x)
    by_intrinsics = np.empty((len(points), 2, 9))
    by_intrinsics[:, 0] = np.stack(
        [
            xd,
            zeros,
            ones,
            zeros,
            fx * x * r2,
            fx * x * r2**2,
            fx * 2 * x * y,
            fx * (r2 + 2 * x * x),
            fx * x * r2**3,
        ],
        axis=-1,
    )
    by_intrinsics[:, 1] = np.stack(
        [
            zeros,
            yd,
            zeros,
            ones,
            fy * y * r2,
            fy * y * r2**2,
            fy * (r2 + 2 * y * y),
            fy * 2 * x * y,
            fy * y * r2**3,
        ],
        axis=-1,
    )
    cross_term = 2 * x * y * slope + 2 * p1 * x + 2 * p2 * y  # dxd/dy = dyd/dx
    by_x = np.stack([fx * (g + 2 * x * x * slope + 2 * p1 * y + 6 * p2 * x), fy * cross_term], axis=-1)
    by_y = np.stack([fx * cross_term, fy * (g + 2 * y * y * slope + 6 * p1 * y + 2 * p2 * x)], axis=-1)
    by_point = np.stack([by_x, by_y, -(by_x * x[:, None] + by_y * y[:, None])], axis=-1) / depth[:, None, None]
    return Projected(np.stack([fx * xd + cx, fy * yd + cy], axis=-1), by_intrinsics, by_point)
