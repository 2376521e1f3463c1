"""Cells, boards and corners made without any code of the product: what calibrations are tested against.

Projection goes straight through Brown's formulas; robot and pixel noise are drawn from normal
distributions. Rotations are scipy's.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from scipy.ndimage import gaussian_filter
from scipy.spatial.transform import Rotation

from coupole.calibration.lens.board import Sighting

PSF_PX = 0.6
Array = np.ndarray[tuple[int, ...], np.dtype[np.float64]]


@dataclass(frozen=True)
class TrueLens:
    focal_px: tuple[float, float]
    centre_px: tuple[float, float]
    distortion: tuple[float, float, float, float, float]

    def vector(self) -> Array:
        return np.array([*self.focal_px, *self.centre_px, *self.distortion])

    def see(self, points: Array) -> Array:
        """Pixels [..., 2] of points [..., 3] in the camera's frame."""
        k1, k2, p1, p2, k3 = self.distortion
        a, b = points[..., 0] / points[..., 2], points[..., 1] / points[..., 2]
        r = np.hypot(a, b)
        radial = 1 + k1 * r**2 + k2 * r**4 + k3 * r**6
        bent_a = a * radial + 2 * p1 * a * b + p2 * (r**2 + 2 * a**2)
        bent_b = b * radial + p1 * (r**2 + 2 * b**2) + 2 * p2 * a * b
        return np.stack([bent_a, bent_b], axis=-1) * self.focal_px + self.centre_px


def frame(translation_mm: Array, turn_deg: Array) -> Array:
    """4x4 from a translation and a rotation vector in degrees."""
    t = np.eye(4)
    t[:3, :3] = Rotation.from_rotvec(np.radians(turn_deg)).as_matrix()
    t[:3, 3] = translation_mm
    return t


@dataclass(frozen=True)
class Cell:
    """A true cell and what is seen of it."""

    lens: TrueLens
    size_px: tuple[int, int]
    flange_from_camera: Array
    base_from_board: Array
    base_from_flange: Array
    """[n, 4, 4] as the robot reports them."""
    sightings: tuple[Sighting, ...]
    pixel_px: float
    robot_mm: float
    robot_deg: float


def board_points(columns: int = 11, rows: int = 8, square_mm: float = 16.0) -> Array:
    grid = np.array([(x, y, 0) for y in range(rows) for x in range(columns)], float)
    return grid * square_mm


def looking_at_board(random: np.random.Generator, size_mm: Array, distance_mm: float) -> Array:
    """`board_from_camera` of a camera that looks at some point of the board, tilted up to 40 degrees, turned."""
    target = size_mm * random.uniform(0.25, 0.75, 2)
    tilt, azimuth = random.uniform(8, 40), random.uniform(0, 360)
    turned = Rotation.from_euler("ZYZ", [azimuth, tilt, random.uniform(-180, 180)], degrees=True)
    t = np.eye(4)
    t[:3, :3] = turned.as_matrix() @ np.diag([1.0, -1.0, -1.0])  # looks down on the board, whose z comes up
    away = -t[:3, 2] * distance_mm * random.uniform(0.85, 1.15)
    t[:3, 3] = np.array([*target, 0.0]) + away
    return t


def make_cell(
    seed: int,
    *,
    images: int = 30,
    pixel_px: float = 0.1,
    robot_mm: float = 0.05,
    robot_deg: float = 0.005,
    distorted: bool = True,
) -> Cell:
    """A random cell: a camera of the dome's kind at a twelfth of its pixels, board of 11 x 8 corners of 16 mm."""
    random = np.random.default_rng(seed)
    width, height = 1024, 768
    focal = 35.0 / 22e-3 * random.uniform(0.95, 1.15)
    bent = random.normal(0, 1, 5) * (0.08, 0.1, 1e-3, 1e-3, 0.1) if distorted else np.zeros(5)
    lens = TrueLens(
        (focal, focal * random.uniform(0.998, 1.002)),
        (width / 2 + random.normal(0, 8), height / 2 + random.normal(0, 8)),
        tuple(bent),  # type: ignore[arg-type]
    )
    points = board_points()
    flange_from_camera = frame(random.uniform(-80, 80, 3), random.uniform(-70, 70, 3))
    base_from_board = frame(random.uniform(-200, 200, 3) + np.array([600, 0, 0]), random.uniform(-20, 20, 3))
    reported, sightings = [], []
    while len(sightings) < images:
        board_from_camera = looking_at_board(random, points.max(axis=0)[:2], 335.0)
        seen = lens.see((points - board_from_camera[:3, 3]) @ board_from_camera[:3, :3])
        inside = np.all((seen > 4) & (seen < (width - 4, height - 4)), axis=1)
        if inside.sum() < 25:
            continue
        true_flange = base_from_board @ board_from_camera @ np.linalg.inv(flange_from_camera)
        error = frame(random.normal(0, robot_mm, 3), random.normal(0, robot_deg, 3))
        reported.append(true_flange @ np.linalg.inv(error))
        noisy = seen + random.normal(0, pixel_px, seen.shape)
        ids = np.flatnonzero(inside)
        sightings.append(Sighting(f"image {len(sightings)}", ids, points[ids], noisy[ids]))
    return Cell(
        lens,
        (width, height),
        flange_from_camera,
        base_from_board,
        np.stack(reported),
        tuple(sightings),
        pixel_px,
        robot_mm,
        robot_deg,
    )


def render(
    lens: TrueLens, size_px: tuple[int, int], camera_from_board: Array, texture: Array, mm_per_texel: float
) -> Array:
    """A picture [H, W] of a texture [h, w] that lies on the board's plane, its outer corner the origin.

    Each pixel is the mean of 2 x 2 looks through the lens, whose distortion is undone by fixed-point iteration;
    the lens spreads a point over 0.6 px (one sigma). Beside the board all is grey.
    """
    offsets = (-0.25, 0.25)
    total = np.zeros(size_px[::-1])
    normal, origin = camera_from_board[:3, 2], camera_from_board[:3, 3]
    for dy in offsets:
        for dx in offsets:
            rays = _rays(lens, size_px, dx, dy)
            points = rays * ((normal @ origin) / (rays @ normal))[..., None]
            on_board = (points - origin) @ camera_from_board[:3, :3]
            total += _sampled(
                texture, on_board[..., 0] / mm_per_texel - 0.5, on_board[..., 1] / mm_per_texel - 0.5
            )
    blurred: Array = gaussian_filter(total / 4, PSF_PX)
    return blurred


@lru_cache(maxsize=8)
def _rays(lens: TrueLens, size_px: tuple[int, int], dx: float, dy: float) -> Array:
    """[H, W, 3] of all pixels, shifted by an offset: the same for every picture through a lens."""
    width, height = size_px
    x, y = np.meshgrid(np.arange(width) + dx, np.arange(height) + dy)
    a, b = _undistorted(lens, x, y)
    return np.stack([a, b, np.ones_like(a)], axis=-1)


def _undistorted(lens: TrueLens, x: Array, y: Array) -> tuple[Array, Array]:
    k1, k2, p1, p2, k3 = lens.distortion
    u, v = (x - lens.centre_px[0]) / lens.focal_px[0], (y - lens.centre_px[1]) / lens.focal_px[1]
    a, b = u, v
    for _ in range(10):
        r2 = a**2 + b**2
        radial = 1 + k1 * r2 + k2 * r2**2 + k3 * r2**3
        a, b = (
            (u - 2 * p1 * a * b - p2 * (r2 + 2 * a**2)) / radial,
            (v - p1 * (r2 + 2 * b**2) - 2 * p2 * a * b) / radial,
        )
    return a, b


def _sampled(texture: Array, column: Array, row: Array) -> Array:
    """Bilinear; 0.5 outside."""
    height, width = texture.shape
    inside = (column >= 0) & (row >= 0) & (column <= width - 1.001) & (row <= height - 1.001)
    c, r = np.where(inside, column, 0.0), np.where(inside, row, 0.0)
    c0, r0 = c.astype(int), r.astype(int)
    fc, fr = c - c0, r - r0
    values = (
        texture[r0, c0] * (1 - fc) * (1 - fr)
        + texture[r0, c0 + 1] * fc * (1 - fr)
        + texture[r0 + 1, c0] * (1 - fc) * fr
        + texture[r0 + 1, c0 + 1] * fc * fr
    )
    return np.where(inside, values, 0.5)
