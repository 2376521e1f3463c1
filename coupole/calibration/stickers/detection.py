"""The scanner's stickers in an image: bright disks with black borders, and the images of their centres.

Candidates are bright components of about the right size. The rim of each is then located on rays from its middle,
where the signal is halfway between the levels of disk and border on this ray. So uneven light does not shift the
rim. Rim points are converted to directions before the ellipse is fitted, because without the lens's distortion the
image of a disk is an exact ellipse. The image of the disk's centre is not the ellipse's middle. It follows from
the two disks in space that have this ellipse as their image (`circle_poses`). Several views together show which of
the two disks is real (`calibration.stickers.points`).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from coupole.calibration import optics
from coupole.calibration.multi_view import unproject
from coupole.calibration.optics import Intrinsics
from coupole.calibration.rotations import Floats

LEAST_RADIUS_PX = 4.0
LEAST_AXES_RATIO = 0.25
"""Least ratio of the axes. At more than 75 degrees from its normal, a disk's printed rim cannot be distinguished
from its edge."""
LEAST_CONTRAST = 0.25
"""Least contrast between disk and border, over the disk's signal. A border is black."""
_RAYS = 96
_INSIDE, _OUTSIDE = 0.65, 1.35
"""Radii at which disk and border are sampled, over the disk's radius. The border ends at 1.67."""
_LEAST_RIM = 0.8
"""Least share of the rays that find a rim on the ellipse."""
_FAR_SIGMA, _WORST_RIM = 3.5, 0.06
"""Bound of outliers, and greatest roughness of the rim as a share of the radius. A rougher rim does not belong to
a printed disk."""
_LEAST_SIGMA_PX = 0.02


@dataclass(frozen=True)
class Sticker:
    """One disk in one image."""

    middle: Floats
    """[2] middle of the ellipse in the image, px."""
    centres: Floats
    """[2, 2] image of the disk's centre, for each of the two possible disks."""
    normals: Floats
    """[2, 3] normals of these disks, camera frame, towards the camera."""
    covariance: Floats
    """[2, 2] covariance of the middle, px^2."""
    radius_px: float
    """Longer radius of the ellipse."""
    distance_mm: float
    """Distance of the disk, from its size."""


@dataclass(frozen=True)
class Ellipse:
    """All points x with |shape (x - centre)| = 1."""

    centre: Floats
    shape: Floats
    """[2, 2], symmetric."""
    covariance: Floats
    """[2, 2] covariance of the centre."""
    rms: float
    point_mask: NDArray[np.bool_]


def find_stickers(
    image: Floats,
    lens: Intrinsics,
    *,
    diameter_mm: float = 6.0,
    depth_mm: tuple[float, float] = (200.0, 900.0),
) -> list[Sticker]:
    """Find stickers in one colour's plane [H, W] (`grey_image.plane`), with dark subtracted. Their disks have
    `diameter_mm` and lie within this range of depth."""
    import cv2

    largest = lens.fx * diameter_mm / depth_mm[0] / 2
    smallest = max(LEAST_RADIUS_PX, lens.fx * diameter_mm / depth_mm[1] / 2 * LEAST_AXES_RATIO)
    smooth = cv2.GaussianBlur(image.astype(np.float32), (0, 0), 1.0)
    # The window holds a disk with its border and about as much else, so that its mean is between their levels.
    window = min(int(4 * largest) | 1, (min(image.shape) // 2) | 1)
    local = cv2.boxFilter(smooth, -1, (window, window), borderType=cv2.BORDER_REFLECT)
    contours, _ = cv2.findContours((smooth > local).astype(np.uint8), cv2.RETR_LIST, cv2.CHAIN_APPROX_NONE)
    stickers: list[Sticker] = []
    for contour in contours:
        if len(contour) < 2 * np.pi * smallest * 0.5 or len(contour) > 16 * largest:
            continue
        (x, y), axes, turn_deg = cv2.fitEllipse(contour)
        radii = np.array(axes) / 2
        if not (radii.min() > LEAST_RADIUS_PX * LEAST_AXES_RATIO * 2 and radii.max() < 1.3 * largest):
            continue
        if radii.max() < smallest or radii.min() < LEAST_AXES_RATIO * radii.max():
            continue
        sticker = _sticker(image, np.array([x, y]), radii, np.radians(turn_deg), lens, diameter_mm)
        if sticker is not None and all(
            np.linalg.norm(sticker.middle - s.middle) > s.radius_px / 2 for s in stickers
        ):
            stickers.append(sticker)
    return stickers


def circle_poses(ellipse: Ellipse, radius_mm: float) -> tuple[Floats, Floats]:
    """Return centres [2, 3] (mm) and normals [2, 3] of the two circles in space whose image is an ellipse in
    normalised coordinates. The circles are in front of the camera and face it.

    The source is Chen, Wu, Wada, "Camera calibration with two arbitrary coplanar circles", ECCV 2004, eq. 5 to 10.
    """
    square = ellipse.shape @ ellipse.shape
    cone = np.empty((3, 3))
    cone[:2, :2] = square
    cone[:2, 2] = cone[2, :2] = -square @ ellipse.centre
    cone[2, 2] = ellipse.centre @ square @ ellipse.centre - 1
    values, axes = np.linalg.eigh(cone)
    values, axes = values[::-1], axes[:, ::-1]  # positive, positive, negative
    across = np.sqrt(max(values[0] - values[1], 0.0) / (values[0] - values[2]))
    along = np.sqrt((values[1] - values[2]) / (values[0] - values[2]))
    distance = values[1] * radius_mm / np.sqrt(-values[0] * values[2])
    centres, normals = [], []
    for sign in (1.0, -1.0):
        centre = distance * axes @ [sign * values[2] / values[1] * across, 0.0, -values[0] / values[1] * along]
        normal = axes @ [sign * across, 0.0, -along]
        centre = centre if centre[2] > 0 else -centre
        centres.append(centre)
        normals.append(normal if normal @ centre < 0 else -normal)
    return np.array(centres), np.array(normals)


def fit_ellipse(points: Floats, floor: float = 0.0) -> Ellipse | None:
    """Fit the ellipse nearest to points [n, 2], by Gauss-Newton on distances to first order, without outliers.
    None if the points fit no ellipse. `floor` is a lower bound of the noise."""
    keep = np.ones(len(points), np.bool_)
    centre = points.mean(axis=0)
    scatter = np.cov((points - centre).T)
    values, axes = np.linalg.eigh(scatter)
    if values[0] <= 0:
        return None
    shape = axes @ np.diag(1 / np.sqrt(2 * values)) @ axes.T
    for _ in range(20):
        off = points - centre
        on_circle = off @ shape
        rho = np.linalg.norm(on_circle, axis=1)
        slope = np.linalg.norm(on_circle @ shape, axis=1) / rho
        residual = (rho - 1) / slope
        by_centre = -(on_circle @ shape) / (rho * slope)[:, None]
        by_shape = np.stack(
            [
                on_circle[:, 0] * off[:, 0],
                on_circle[:, 0] * off[:, 1] + on_circle[:, 1] * off[:, 0],
                on_circle[:, 1] * off[:, 1],
            ],
            axis=1,
        )
        jacobian = np.column_stack([by_centre, by_shape / (rho * slope)[:, None]])[keep]
        step, _, rank, _ = np.linalg.lstsq(jacobian, -residual[keep], rcond=None)
        sigma = max(1.4826 * float(np.median(np.abs(residual[keep]))), floor)
        if rank < 5 or not np.isfinite(step).all():
            return None
        centre = centre + step[:2]
        shape = shape + np.array([[step[2], step[3]], [step[3], step[4]]])
        if np.linalg.eigvalsh(shape)[0] <= 0:
            return None
        keep = np.abs(residual) < _FAR_SIGMA * sigma + 1e-15
        if keep.sum() < 12:
            return None
        if np.linalg.norm(shape @ step[:2]) < 1e-9:
            break
    rms = float(np.sqrt(np.sum(residual[keep] ** 2) / max(int(keep.sum()) - 5, 1)))
    covariance = max(rms, floor) ** 2 * np.linalg.inv(jacobian.T @ jacobian)[:2, :2]
    return Ellipse(centre, shape, covariance, rms, keep)


def _sticker(
    image: Floats, middle: Floats, radii: Floats, turn: float, lens: Intrinsics, diameter_mm: float
) -> Sticker | None:
    """Locate the rim of a candidate and fit it. None if it is not a disk with a black border."""
    rim = _rim(image, middle, radii, turn)
    if rim is None:
        return None
    rays = unproject(rim, lens)
    flat = rays[:, :2] / rays[:, 2:]
    ellipse = fit_ellipse(flat, _LEAST_SIGMA_PX / lens.fx)
    if ellipse is None or ellipse.point_mask.sum() < _LEAST_RIM * _RAYS:
        return None
    widths = 1 / np.linalg.eigvalsh(ellipse.shape)
    if ellipse.rms > _WORST_RIM * widths.min() or widths.min() < LEAST_AXES_RATIO * widths.max():
        return None
    centres, normals = circle_poses(ellipse, diameter_mm / 2)
    points = np.vstack([np.append(ellipse.centre, 1.0), centres])
    projection = optics.project(points, lens.vector())
    by_flat = projection.by_point[0, :, :2]  # at depth 1
    return Sticker(
        projection.pixels[0],
        projection.pixels[1:],
        normals,
        by_flat @ ellipse.covariance @ by_flat.T,
        float(widths.max() * lens.fx),
        float(np.linalg.norm(centres[0])),
    )


def _rim(image: Floats, middle: Floats, radii: Floats, turn: float) -> Floats | None:
    """Return rim points [n, 2] along rays from the middle, where the signal is halfway between disk and border.
    None if too many rays find no rim."""
    from scipy.ndimage import map_coordinates

    angle = 2 * np.pi * np.arange(_RAYS) / _RAYS
    circle = np.stack([radii[0] * np.cos(angle), radii[1] * np.sin(angle)], axis=1)
    axes = np.array([[np.cos(turn), np.sin(turn)], [-np.sin(turn), np.cos(turn)]])
    spokes = circle @ axes
    steps = np.linspace(_INSIDE - 0.1, _OUTSIDE + 0.1, max(24, int(3 * radii.max())))
    places = middle + steps[:, None, None] * spokes[None]
    low, high = places.min(axis=(0, 1)), places.max(axis=(0, 1))
    if (low < 1).any() or high[0] > image.shape[1] - 2 or high[1] > image.shape[0] - 2:
        return None
    signal = map_coordinates(image, [places[..., 1], places[..., 0]], order=1)
    disk = signal[np.abs(steps - _INSIDE) < 0.1].mean(axis=0)
    border = signal[np.abs(steps - _OUTSIDE) < 0.1].mean(axis=0)
    contrast = disk - border
    level = (disk + border) / 2
    above = signal > level
    falls = above[:-1] & ~above[1:]
    good = (contrast > LEAST_CONTRAST * np.median(disk)) & (np.median(disk) > 0) & falls.any(axis=0)
    if good.mean() < _LEAST_RIM:
        return None
    at = len(steps) - 2 - np.argmax(falls[::-1], axis=0)
    ray = np.arange(_RAYS)
    before, after = signal[at, ray], signal[at + 1, ray]
    share = (before - level) / np.where(before > after, before - after, 1.0)
    where = steps[at] + np.clip(share, 0, 1) * (steps[1] - steps[0])
    return np.asarray((middle + where[:, None] * spokes)[good])
