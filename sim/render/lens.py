"""Rays of the simulated camera's pixels: a pinhole with lens distortion.

Distortion is the Brown-Conrady model in OpenCV's order and sign (k1, k2, p1, p2, k3): x = X/Z and y = Y/Z go to

    x (1 + k1 r^2 + k2 r^4 + k3 r^6) + 2 p1 x y + p2 (r^2 + 2 x^2)
    y (1 + k1 r^2 + k2 r^4 + k3 r^6) + p1 (r^2 + 2 y^2) + 2 p2 x y

Lenses that are strangers to calibration (`sim.strangers`) have OpenCV's seven further terms: k4, k5 and k6 divide
the radial factor by 1 + k4 r^2 + k5 r^4 + k6 r^6; s1 to s4 add s1 r^2 + s2 r^4 to x and s3 r^2 + s4 r^4 to y.

The renderer needs the inverse, once per lens and for every pixel. It tests triangles along the true ray of each
pixel. So edges of long triangles are curved in the picture, as they should be.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numba
import numpy as np
from numpy.typing import NDArray

from coupole.errors import InputError
from coupole.kernels import kernel

Distortion = tuple[float, ...]
"""k1, k2, p1, p2, k3, or these and k4, k5, k6, s1, s2, s3, s4."""
NO_DISTORTION: Distortion = (0.0, 0.0, 0.0, 0.0, 0.0)
LANES = 8
"""Number of pixels of a row that the rasteriser tests at once. Tables by column are longer than the image by this
number."""
_PROBES = 65
_MARGIN = 1.25
"""Safety factor on the steepest slope found between probes."""


@dataclass(frozen=True)
class Lens:
    """Focal length in pixels, and distortion; pixels' centres have integer coordinates. The principal point is the
    image's centre unless it is `off_axis`."""

    width_px: int
    height_px: int
    focal_px: float
    distortion: Distortion = NO_DISTORTION
    samples: int = 1
    """Subdivision of a sensor pixel along each side: 1, except for a lens `with_supersampling`."""
    off_axis: tuple[float, float] = (0.0, 0.0)
    """Principal point less image centre, over the focal length; distortion stays centred on the image."""

    @staticmethod
    def at_focus(
        width_px: int,
        height_px: int,
        *,
        pixel_pitch_um: float,
        focal_length_mm: float,
        focus_distance_mm: float,
        distortion: Distortion = NO_DISTORTION,
    ) -> Lens:
        """Focused at `focus_distance_mm`: the image distance is 1/(1/f - 1/focus)."""
        image_distance_mm = 1.0 / (1.0 / focal_length_mm - 1.0 / focus_distance_mm)
        return Lens(width_px, height_px, image_distance_mm * 1e3 / pixel_pitch_um, distortion)

    @property
    def centre_px(self) -> tuple[float, float]:
        x, y = self.off_axis
        return 0.5 * self.width_px - 0.5 + x * self.focal_px, 0.5 * self.height_px - 0.5 + y * self.focal_px

    @property
    def terms(self) -> NDArray[np.float64]:
        """Terms of the distortion, for `bend` and `distorted_points`. A lens with more terms than Brown's
        model also has the centre of distortion.
        """
        if len(self.distortion) == 5 and not any(self.off_axis):
            return np.array(self.distortion)
        more = (0.0,) * (12 - len(self.distortion))
        return np.array([*self.distortion, *more, -self.off_axis[0], -self.off_axis[1]])

    def with_supersampling(self, factor: int) -> Lens:
        """The lens with sensor pixels divided into `factor` x `factor`; see `rook_shifts_px`."""
        return replace(
            self,
            width_px=self.width_px * factor,
            height_px=self.height_px * factor,
            focal_px=self.focal_px * factor,
            samples=factor,
        )


def rook_shifts_px(samples: int, count: int) -> NDArray[np.float64]:
    """Return [count] shifts of the rays of a supersampled pixel. Rays of row r move by the r-th value to the
    right, rays of column c by the c-th value upwards. So the grid of a pixel's rays is rotated, and no two rays
    share a row or column. An edge along the rows is then resolved in `samples`^2 steps instead of `samples`. The
    shifts are zeros for one sample.
    """
    return (np.arange(count) % samples + 0.5) / samples - 0.5


@dataclass(frozen=True)
class Sight:
    """A lens with its inverse, as used by the rasteriser."""

    lens: Lens
    shift: NDArray[np.float32] | None
    """[2, h, w + LANES] correction of x and y of a pixel's position that undoes distortion, in units of the focal
    length (beyond the image: any number); None without distortion."""
    shift_slope: float
    """Upper bound of the change of `shift` by distortion from one pixel to the next in its row."""
    reach: tuple[float, float]
    """Upper bound of a pixel's distance from the axis, in x and y, in units of the focal length."""
    bend_slope: float
    """Upper bound of the change of distortion over a change of position, in any direction within the image."""


def sight(lens: Lens) -> Sight:
    """The inverse of a lens. Raises InputError if distortion folds the image."""
    sizes = lens.width_px, lens.height_px
    half_x, half_y = (
        (max(centre, size - 1 - centre) + 1.5) / lens.focal_px
        for centre, size in zip(lens.centre_px, sizes, strict=True)
    )
    if not any(lens.distortion):
        return Sight(lens, None, 0.0, (half_x, half_y), 0.0)
    shift = np.zeros((2, lens.height_px, lens.width_px + LANES), np.float32)
    terms = lens.terms
    rooks = rook_shifts_px(lens.samples, max(lens.width_px, lens.height_px))
    if not _undistort(lens.focal_px, *lens.centre_px, terms, rooks, shift):
        raise InputError(
            f"simulated lens: distortion {lens.distortion} folds the image of {lens.width_px} x {lens.height_px} "
            f"pixels at a focal length of {lens.focal_px:.0f} pixels, so that a pixel would see two directions; "
            "expected coefficients (k1, k2, p1, p2, k3) of a calibrated lens"
        )
    most = float(np.abs(shift).max())
    reach = half_x + most, half_y + most
    slope = _bend_slope(lens, reach)
    undone = slope / max(1.0 - slope, 1e-3)  # of the inverse (Banach)
    return Sight(lens, shift, undone / lens.focal_px, reach, slope)


def _bend_slope(lens: Lens, reach: tuple[float, float]) -> float:
    """Upper bound of |d(a) - d(b)| / |a - b| of the displacement d by distortion, over the visible field."""
    grid = np.stack(np.meshgrid(*(np.linspace(-far, far, _PROBES) for far in reach)), axis=-1)
    step = 1e-6
    columns = [
        (distorted_points(grid + np.array(direction) * step, lens.terms) - distorted_points(grid, lens.terms))
        / step
        for direction in ((1, 0), (0, 1))
    ]
    jacobian = np.stack(columns, axis=-1) - np.eye(2)
    return float(np.linalg.norm(jacobian, ord=2, axis=(-2, -1)).max()) * _MARGIN


def distorted_points(xy: NDArray[np.float64], distortion: Distortion | NDArray[np.float64]) -> NDArray[np.float64]:
    """The model on normalised image coordinates [..., 2]; `distortion` may also be `Lens.terms`."""
    terms = np.zeros(14)
    terms[: len(distortion)] = distortion
    k1, k2, p1, p2, k3, k4, k5, k6, s1, s2, s3, s4 = terms[:12]
    x, y = xy[..., 0] - terms[12], xy[..., 1] - terms[13]
    r2 = x * x + y * y
    radial = (1.0 + r2 * (k1 + r2 * (k2 + r2 * k3))) / (1.0 + r2 * (k4 + r2 * (k5 + r2 * k6)))
    return np.stack(
        [
            x * radial + 2 * p1 * x * y + p2 * (r2 + 2 * x * x) + r2 * (s1 + r2 * s2) + terms[12],
            y * radial + p1 * (r2 + 2 * y * y) + 2 * p2 * x * y + r2 * (s3 + r2 * s4) + terms[13],
        ],
        axis=-1,
    )


@kernel
def bend(x, y, terms):  # type: ignore[no-untyped-def]
    """Displacement of a normalised position (x, y) by distortion; `terms` as of `Lens.terms`."""
    more = len(terms) > 5
    if more:
        x, y = x - terms[12], y - terms[13]
    r2 = x * x + y * y
    radial = r2 * (terms[0] + r2 * (terms[1] + r2 * terms[4]))
    by_x, by_y = 0.0, 0.0
    if more:
        below = r2 * (terms[5] + r2 * (terms[6] + r2 * terms[7]))
        radial = (radial - below) / (1.0 + below)
        by_x, by_y = r2 * (terms[8] + r2 * terms[9]), r2 * (terms[10] + r2 * terms[11])
    return (
        x * radial + 2.0 * terms[2] * x * y + terms[3] * (r2 + 2.0 * x * x) + by_x,
        y * radial + terms[2] * (r2 + 2.0 * y * y) + 2.0 * terms[3] * x * y + by_y,
    )


@kernel(parallel=True)
def _undistort(focal, centre_x, centre_y, terms, rooks, shift):  # type: ignore[no-untyped-def]
    """Fill `shift` by fixed-point iteration, to 1e-7 pixel; False if it does not converge."""
    height, width = shift.shape[1], shift.shape[2] - LANES
    row_is_settled = np.ones(height, np.bool_)
    for row in numba.prange(height):
        for col in range(width):
            goal_x, goal_y = (col + rooks[row] - centre_x) / focal, (row - rooks[col] - centre_y) / focal
            x, y = goal_x, goal_y
            change = 1.0
            for _ in range(60):
                bend_x, bend_y = bend(x, y, terms)
                change = abs(goal_x - bend_x - x) + abs(goal_y - bend_y - y)
                x, y = goal_x - bend_x, goal_y - bend_y
                if change * focal < 1e-7:
                    break
            if not change * focal < 1e-7:
                row_is_settled[row] = False
            shift[0, row, col] = x - (col - centre_x) / focal
            shift[1, row, col] = y - (row - centre_y) / focal
    return row_is_settled.all()
