"""Light from one part of an object to another, against closed forms."""

from __future__ import annotations

import numpy as np
import pytest
import trimesh

from coupole.reflectance.inter_reflection import direct_irradiance, points_of, radiosity, scene_of, seen_from

LED_MM = np.array([[0.0, 0.0, 60.0]])
DOWN = np.array([[0.0, 0.0, -1.0]])


def inside_out(mesh: trimesh.Trimesh) -> np.ndarray:
    corners: np.ndarray = mesh.triangles[:, ::-1].astype(float)
    return corners


def test_a_closed_sphere_multiplies_light_by_its_reflectance_over_what_is_absorbed() -> None:
    """An integrating sphere: whatever the LED lights first, rho / (1 - rho) of the mean arrives everywhere."""
    scene = scene_of(inside_out(trimesh.creation.icosphere(subdivisions=4, radius=100.0)))
    points = points_of(scene)
    seen = sum(seen_from(scene, at, seed) for seed, at in enumerate(points)) * (1 / len(points))
    np.testing.assert_allclose(np.asarray(seen.sum(axis=1)), 1.0, atol=1e-5)
    direct = direct_irradiance(scene, LED_MM, DOWN, paper=False)
    areas = np.bincount(scene.patch, scene.areas_mm2)
    mean = float(areas @ direct[:, 0] / areas.sum())
    assert mean * areas.sum() * 1e-6 == pytest.approx(1.0, rel=0.02)  # all its light
    for reflectance in (0.2, 0.5):
        shown = np.full((scene.patches, 1), reflectance)
        indirect = seen @ radiosity(seen, direct, shown, passes=1)[0]
        expected = mean * reflectance / (1 - reflectance)
        np.testing.assert_allclose(np.median(indirect), expected, rtol=0.03)


def test_a_wall_sees_the_floor_as_its_form_factor_tells() -> None:
    """Two equal squares with an edge in common see 0.20004 of each other (Howell, C-14)."""
    square = np.array([[[0, 0, 0], [1, 0, 0], [1, 1, 0]], [[0, 0, 0], [1, 1, 0], [0, 1, 0]]], float) * 100
    floor = np.concatenate([_split(triangle, 4) for triangle in square])
    wall = floor[:, :, [2, 1, 0]][:, ::-1]
    scene = scene_of(np.concatenate([floor, wall]))
    assert (scene.normals[: len(floor), 2] > 0.99).all()
    assert (scene.normals[len(floor) :, 0] > 0.99).all()
    seen = seen_from(scene, np.arange(len(floor)), 1)
    of_wall = np.asarray(seen[:, np.unique(scene.patch[len(floor) :])].sum(axis=1))
    assert of_wall.mean() == pytest.approx(0.20004, rel=0.02)


def _split(triangle: np.ndarray, times: int) -> np.ndarray:
    parts = triangle[None]
    for _ in range(times):
        a, b, c = parts[:, 0], parts[:, 1], parts[:, 2]
        ab, bc, ca = (a + b) / 2, (b + c) / 2, (c + a) / 2
        parts = np.concatenate(
            [np.stack(t, axis=1) for t in ((a, ab, ca), (ab, b, bc), (ca, bc, c), (ab, bc, ca))]
        )
    return parts
