"""Triangles that a rehearsal draws: their own sizes, and pixels that a wrong pose moves to a neighbour."""

from __future__ import annotations

import math
from functools import cache

import numpy as np
import pytest
from numpy.typing import NDArray

from coupole.reflectance.suggestion.drawn_triangles import DrawnTriangles, MeshParts
from coupole.reflectance.suggestion.rehearsal import PlannedFrames, rehearse
from coupole.reflectance.suggestion.supposed_materials import SUPPOSED
from coupole.reflectance.suggestion.supposed_signal import CameraNoise, SeenParts, Surface

CAMERA_MM = np.array([0.0, 0.0, 300.0])
PIXELS_PER_MM2 = 9.0


def roof(steps: int = 60, side_mm: float = 1.0, tilt_deg: float = 10.0) -> NDArray[np.float64]:
    """Squares of two triangles, in columns of width `side_mm` that lean to the left and to the right in turn."""
    rise_mm = side_mm * math.tan(math.radians(tilt_deg))
    height_mm = [rise_mm * (column % 2) for column in range(steps + 1)]
    corners = []
    for column in range(steps):
        for row in range(steps):
            x0, x1 = (column - steps / 2) * side_mm, (column + 1 - steps / 2) * side_mm
            y0, y1 = (row - steps / 2) * side_mm, (row + 1 - steps / 2) * side_mm
            a, b = (x0, y0, height_mm[column]), (x1, y0, height_mm[column + 1])
            c, d = (x1, y1, height_mm[column + 1]), (x0, y1, height_mm[column])
            corners += [(a, b, c), (a, c, d)]
    return np.array(corners)


def one_part(corners_mm: NDArray[np.float64]) -> MeshParts:
    return MeshParts(corners_mm, np.zeros(len(corners_mm), np.int64))


@cache
def lamps() -> NDArray[np.float64]:
    random = np.random.default_rng(5)
    ways = random.standard_normal((120, 3))
    ways[:, 2] = np.abs(ways[:, 2]) + 0.2
    return 1500.0 * ways / np.linalg.norm(ways, axis=1)[:, None]


def surface(area_mm2: float, u_pose_mm: float = 0.0) -> Surface:
    """One level part under 120 LEDs, and a camera of one channel that has 1 % of noise in a pixel."""
    leds_mm, one = lamps(), np.ones(1)
    noise = CameraNoise(np.array([100.0]), np.array([0.09]), 0.0, 1e9, one)
    return Surface(
        np.zeros((1, 3)), np.array([[0.0, 0.0, 1.0]]), np.array([area_mm2]), np.array([1.0]), leds_mm,
        np.full((1, len(leds_mm), 1), 1e6), np.zeros(len(leds_mm)), 0.0, 0.1, noise, u_pose_mm,
    )  # fmt: skip


def view(area_mm2: float, camera_mm: NDArray[np.float64] = CAMERA_MM) -> SeenParts:
    cosine = camera_mm[2] / np.linalg.norm(camera_mm)
    pixels = np.array([area_mm2 * cosine * PIXELS_PER_MM2])
    return SeenParts(camera_mm, pixels, np.ones((1, len(lamps())), np.bool_))


def of_middle(mesh: MeshParts) -> DrawnTriangles:
    return DrawnTriangles(mesh, np.flatnonzero(np.abs(mesh.centres_mm[:, :2]).max(axis=1) < 15.0))


@pytest.mark.parametrize("shift_mm", [0.0, 0.1, 0.25])
def test_a_wrong_pose_moves_pixels_to_the_neighbour(shift_mm: float) -> None:
    """On columns of 1 mm, a shift across them by s mm moves a share s of the pixels to another column."""
    mesh = one_part(roof())
    triangles = of_middle(mesh)
    pixels = np.full(len(triangles.numbers), 4)
    shares = []
    for shift in shift_mm * np.eye(2):  # along the two axes of the picture
        seen = triangles.seen_normals(
            view(0.5), pixels, np.tile(shift, (len(pixels), 1)), np.random.default_rng(1)
        )
        shares.append(np.mean(np.sum(seen * triangles.normals[:, None], axis=2) < 0.999))
    assert math.hypot(*shares) == pytest.approx(shift_mm, abs=0.03)


def test_one_pixel_sees_one_place() -> None:
    triangles = of_middle(one_part(roof()))
    count = len(triangles.numbers)
    seen = triangles.seen_normals(
        view(0.5), np.ones(count, np.int64), np.full((count, 2), 0.3), np.random.default_rng(1)
    )
    assert np.ptp(seen, axis=1).max() == 0.0


def test_triangles_have_the_pixels_of_their_own_size() -> None:
    """One part of 100 small triangles and 100 of 16 times their area: by the mean, all would be seen alike."""
    small, large = roof(10, 0.5, 0.0)[:100], roof(10, 2.0, 0.0)[:100]
    mesh = one_part(np.concatenate([small, large]))
    mean_mm2 = float(mesh.areas_mm2.mean())
    pixels = mesh.drawn(1000, np.random.default_rng(1)).pixels(surface(mean_mm2), view(mean_mm2))
    np.testing.assert_allclose(pixels, mesh.areas_mm2 * PIXELS_PER_MM2, rtol=0.02)


def test_the_share_that_is_known_is_that_of_triangles_with_pixels() -> None:
    small, large = roof(10, 0.1, 0.0), roof(10, 2.0, 0.0)[:100]
    mesh = one_part(np.concatenate([small, large]))
    mean_mm2 = float(mesh.areas_mm2.mean())
    cameras_mm = [CAMERA_MM, CAMERA_MM + np.array((150.0, 0.0, 0.0))]
    views = [view(mean_mm2, camera_mm) for camera_mm in cameras_mm]
    rows = np.arange(len(lamps()))
    rehearsal = rehearse(surface(mean_mm2), mesh, PlannedFrames(views, (1000,), rows), SUPPOSED["glossy"], 30.0)
    seen_once = 1.0 - (1.0 - 0.005 * PIXELS_PER_MM2) ** 2
    assert rehearsal.known_share == pytest.approx((100 + 200 * seen_once) / 300, abs=0.05)


def test_a_pose_with_noise_makes_materials_of_a_rough_mesh_less_certain() -> None:
    mesh = one_part(roof(30, 1.0, 12.0))
    cameras_mm = [CAMERA_MM, CAMERA_MM + np.array((150.0, 0.0, 0.0)), CAMERA_MM + np.array((0.0, 150.0, 0.0))]
    views = [view(0.5, camera_mm) for camera_mm in cameras_mm]
    rows, medians = np.arange(len(lamps())), []
    for u_pose_mm in (0.0, 0.3):
        of_rough = surface(0.5, u_pose_mm)
        rehearsal = rehearse(of_rough, mesh, PlannedFrames(views, (1000,), rows), SUPPOSED["metal"], 30.0)
        medians.append(float(np.nanmedian(rehearsal.uncertainty["alpha_percent"])))
    assert medians[1] > 1.5 * medians[0]
