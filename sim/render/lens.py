"""Where a pixel looks: a pinhole with the distortion of Brown and Conrady.

Camera frame: x to the right, y down, z along the optical axis. A direction is written (x, y) for (x, y, 1).
Pixel centres have integer coordinates; (0, 0) is the centre of the first one.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache

import numba
import numpy as np
from numpy.typing import NDArray

from coupole.errors import InputError

_NEWTON_STEPS = 30
_CONVERGED = 1e-13


@dataclass(frozen=True)
class Lens:
    """Focal length and principal point in pixels, distortion k1 k2 p1 p2 k3 (OpenCV's order and meaning)."""

    width_px: int
    height_px: int
    focal_px: float
    centre_px: tuple[float, float]
    """Column and row of the principal point."""
    distortion: tuple[float, float, float, float, float] = (0.0, 0.0, 0.0, 0.0, 0.0)

    @staticmethod
    def focused(
        width_px: int,
        height_px: int,
        *,
        pixel_pitch_um: float,
        focal_length_mm: float,
        focus_distance_mm: float,
        distortion: tuple[float, float, float, float, float] = (0.0, 0.0, 0.0, 0.0, 0.0),
    ) -> Lens:
        """Focused at `focus_distance_mm` the image stands at 1/(1/f - 1/focus) behind the lens; the principal
        point is the image's centre."""
        image_distance_mm = 1.0 / (1.0 / focal_length_mm - 1.0 / focus_distance_mm)
        focal_px = image_distance_mm * 1e3 / pixel_pitch_um
        return Lens(width_px, height_px, focal_px, ((width_px - 1) / 2, (height_px - 1) / 2), distortion)

    def finer(self, k: int) -> Lens:
        """The same lens on pixels divided into k x k."""
        column, row = ((c + 0.5) * k - 0.5 for c in self.centre_px)
        return Lens(self.width_px * k, self.height_px * k, self.focal_px * k, (column, row), self.distortion)

    def numbers(self) -> NDArray[np.float64]:
        """[8] focal length, principal point, distortion: the form that the kernels take."""
        return np.array([self.focal_px, *self.centre_px, *self.distortion])

    def curvature_px(self, radius: float) -> float:
        """Upper bound of the distortion's second derivative, pixels per squared tangent, out to `radius`.

        x r^(2n) has a second derivative of at most 2n (2n + 1) r^(2n - 1), the tangential terms one of 9 (p1 + p2).
        """
        k1, k2, p1, p2, k3 = map(abs, self.distortion)
        radial = 6 * k1 * radius + 20 * k2 * radius**3 + 42 * k3 * radius**5
        return self.focal_px * (radial + 9 * (p1 + p2))


def rays(lens: Lens) -> NDArray[np.float32]:
    """[h, w, 2] direction (x, y) of each pixel's centre: the distortion inverted by Newton's method.

    Raises:
        InputError: The distortion folds inside the image.
    """
    return _rays(lens)


@lru_cache(maxsize=2)
def _rays(lens: Lens) -> NDArray[np.float32]:
    out = np.empty((lens.height_px, lens.width_px, 2), np.float32)
    if not _undistort(out, lens.numbers()):
        raise InputError(
            f"lens: the distortion {lens.distortion} folds inside the image of {lens.width_px} x {lens.height_px} "
            f"pixels at a focal length of {lens.focal_px:.0f} pixels; expected a distortion that can be inverted "
            "everywhere; check the order k1 k2 p1 p2 k3 and the signs"
        )
    out.flags.writeable = False
    return out


def falloff(lens: Lens) -> NDArray[np.float32]:
    """[h, w] natural vignetting, cos^4 of the angle to the optical axis."""
    x, y = np.moveaxis(rays(lens), 2, 0)
    share: NDArray[np.float32] = (1.0 + x * x + y * y) ** -2
    return share


@numba.njit(cache=True, nogil=True, inline="always")
def project(x, y, lens):  # type: ignore[no-untyped-def]
    """Column and row at which a direction (x, y) is seen."""
    r2 = x * x + y * y
    radial = 1.0 + r2 * (lens[3] + r2 * (lens[4] + r2 * lens[7]))
    u = x * radial + 2.0 * lens[5] * x * y + lens[6] * (r2 + 2.0 * x * x)
    v = y * radial + lens[5] * (r2 + 2.0 * y * y) + 2.0 * lens[6] * x * y
    return lens[1] + lens[0] * u, lens[2] + lens[0] * v


@numba.njit(cache=True, nogil=True, parallel=True)
def _undistort(out, lens):  # type: ignore[no-untyped-def]
    """Fill `out`; false if some pixel has no direction. Each row begins at its first pixel, whatever the threads."""
    height, width, _ = out.shape
    k1, k2, p1, p2, k3 = lens[3], lens[4], lens[5], lens[6], lens[7]
    failed = np.zeros(height, np.uint8)
    for row in numba.prange(height):
        v = (row - lens[2]) / lens[0]
        x, y = -lens[1] / lens[0], v
        for col in range(width):
            u = (col - lens[1]) / lens[0]
            converged = False
            for _ in range(_NEWTON_STEPS):
                r2 = x * x + y * y
                radial = 1.0 + r2 * (k1 + r2 * (k2 + r2 * k3))
                slope = 2.0 * (k1 + r2 * (2.0 * k2 + r2 * 3.0 * k3))
                fx = x * radial + 2.0 * p1 * x * y + p2 * (r2 + 2.0 * x * x) - u
                fy = y * radial + p1 * (r2 + 2.0 * y * y) + 2.0 * p2 * x * y - v
                xx = radial + x * x * slope + 2.0 * p1 * y + 6.0 * p2 * x
                xy = x * y * slope + 2.0 * p1 * x + 2.0 * p2 * y
                yy = radial + y * y * slope + 6.0 * p1 * y + 2.0 * p2 * x
                determinant = xx * yy - xy * xy
                if determinant <= 0.0 or xx <= 0.0:
                    break
                dx = (yy * fx - xy * fy) / determinant
                dy = (xx * fy - xy * fx) / determinant
                x -= dx
                y -= dy
                if abs(dx) + abs(dy) < _CONVERGED:
                    converged = True
                    break
            if not converged:
                failed[row] = 1
                x, y = u, v
            out[row, col, 0] = x
            out[row, col, 1] = y
    return not failed.any()
