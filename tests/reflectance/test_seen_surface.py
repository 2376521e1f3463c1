"""Which triangle a pixel sees, held against OpenCV's projection of the triangles' corners."""

from __future__ import annotations

import cv2
import numpy as np
import pytest

from coupole.calibration.optics import Intrinsics
from coupole.geometry import look_at
from coupole.motion.packet_rays import PacketMesh
from coupole.reflectance.extraction.seen_surface import SeenSurface, directions_of_rows, seen_surface

SIZE_PX = (160, 120)
LENS = Intrinsics(fx=260.0, fy=261.0, cx=81.0, cy=58.0, k1=-0.12, k2=0.05, p1=1e-3, p2=-2e-3)


def sheet(cells: int, size_mm: float) -> np.ndarray:
    """[triangles, 3, 3] of a wavy sheet that looks up."""
    line = np.linspace(-size_mm / 2, size_mm / 2, cells + 1)
    x, y = np.meshgrid(line, line, indexing="ij")
    points = np.stack([x, y, 4.0 * np.sin(x / 15.0)], axis=-1)
    a, b, c, d = points[:-1, :-1], points[1:, :-1], points[1:, 1:], points[:-1, 1:]
    return np.concatenate([np.stack([a, b, c], axis=2), np.stack([a, c, d], axis=2)]).reshape(-1, 3, 3)


def pixels_of(corners_mm: np.ndarray, base_from_camera: np.ndarray) -> np.ndarray:
    """[..., 2] by OpenCV."""
    camera_from_base = np.linalg.inv(base_from_camera)
    turn, _ = cv2.Rodrigues(camera_from_base[:3, :3])
    flat = corners_mm.reshape(-1, 1, 3)
    found, _ = cv2.projectPoints(flat, turn, camera_from_base[:3, 3], LENS.matrix(), LENS.distortion())
    return found.reshape(*corners_mm.shape[:-1], 2)


def surface_of(
    corners_mm: np.ndarray, base_from_camera: np.ndarray, blur: tuple[float, float, float, float] | None = None
) -> SeenSurface:
    normals = np.cross(corners_mm[:, 1] - corners_mm[:, 0], corners_mm[:, 2] - corners_mm[:, 0])
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    return seen_surface(PacketMesh(corners_mm), normals, LENS, base_from_camera, SIZE_PX, blur=blur)


def test_each_pixel_lies_in_the_picture_of_the_triangle_that_it_sees() -> None:
    corners, base_from_camera = sheet(24, 90.0), look_at([0, 0, 0], 250.0, 30.0, 60.0)
    seen = surface_of(corners, base_from_camera)
    rows, columns = np.nonzero(seen.places >= 0)
    assert seen.pixels == len(rows) > 2000
    polygons = pixels_of(corners[seen.triangles[seen.places[rows, columns]]], base_from_camera)
    away = np.stack([columns, rows], axis=-1)[:, None] - polygons
    sides = np.roll(polygons, -1, axis=1) - polygons
    length = np.linalg.norm(sides, axis=-1)
    inside_px = (sides[..., 0] * away[..., 1] - sides[..., 1] * away[..., 0]) / length
    turned = np.sign(np.median(inside_px))
    assert (turned * inside_px).min() > -0.02


def test_silhouettes_are_left_out() -> None:
    corners = sheet(24, 90.0)
    above = sheet(4, 20.0) + np.array([0.0, 0.0, 40.0])
    raised = np.concatenate([corners, above])
    base_from_camera = look_at([0, 0, 0], 250.0, 0.0, 80.0)
    seen = surface_of(raised, base_from_camera)
    upper = seen.triangles[seen.places] >= len(corners)
    picture = np.where(seen.places >= 0, 1 + upper, 0)
    assert (picture == 2).sum() > 100
    assert not (picture[:, :-1] * picture[:, 1:] == 2).any(), "both sheets side by side"


def test_what_is_out_of_focus_is_left_out() -> None:
    corners, base_from_camera = sheet(24, 90.0), look_at([0, 0, 0], 250.0, 0.0, 80.0)
    sharp = surface_of(corners, base_from_camera, (35.0, 250.0, 8.0, 2.0))
    assert sharp.pixels > 2000
    near = surface_of(corners, base_from_camera, (35.0, 120.0, 1.4, 2.0))
    assert near.pixels == 0


@pytest.mark.parametrize("rows", [(0, 120), (40, 57), (119, 120)])
def test_directions_between_the_grid_are_those_of_the_lens(rows: tuple[int, int]) -> None:
    found = directions_of_rows(LENS, SIZE_PX[0], *rows)
    columns, lines = np.meshgrid(np.arange(SIZE_PX[0]), np.arange(*rows))
    pixels, _ = cv2.projectPoints(
        found.reshape(-1, 1, 3), np.zeros(3), np.zeros(3), LENS.matrix(), LENS.distortion()
    )
    off_px = pixels.reshape(*columns.shape, 2) - np.stack([columns, lines], axis=-1)
    assert np.abs(off_px).max() < 0.02
