"""Light from surface to surface, against closed forms."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest
from numpy.typing import NDArray

from coupole.appearance.shapes.solids import unit_sphere
from coupole.appearance.shapes.triangles import flat_normals, rectangle
from sim.render.emitter import irradiance, square
from sim.render.interreflection import indirect_radiance, prepare
from sim.scene.scene import Scene, build_scene
from sim.scene.surface import Material, Surface

Scale = Callable[[int, int], int]


def scene_of(corners: NDArray[np.float64], material: Material, tint: NDArray[np.float32] | None = None) -> Scene:
    surface = Surface(corners, (material,), np.zeros(len(corners), np.int32), tint)
    return build_scene([(surface, np.eye(4))])


def inside_out(radius_mm: float) -> NDArray[np.float64]:
    return radius_mm * unit_sphere(6)[:, ::-1]


def test_a_closed_diffuse_sphere_gathers_rho_over_one_minus_rho_of_its_mean_light(scale: Scale) -> None:
    corners, rho, flux_lm = inside_out(100.0), 0.5, 1000.0
    scene = scene_of(corners, Material("white", (rho, rho, rho)))
    seen = np.arange(0, len(corners), 3)
    towards = flat_normals(corners)[seen]
    bounces = 12
    emitter = square([0.0, 0.0, 30.0], [0.0, 0.0, 1.0], side_mm=1.0, flux_lm=flux_lm)
    prepared = prepare(scene, seen, towards)
    radiance = indirect_radiance(prepared, emitter, bounces=bounces, samples=scale(256, 4096))
    # Each point of a sphere sees all of it alike: E after k surfaces is rho^k flux/area, wherever light began.
    area_m2 = flat_area(corners) * 1e-6
    gathered = sum(rho**k for k in range(1, bounces)) * flux_lm / area_m2
    assert radiance.mean() == pytest.approx(rho / np.pi * gathered, rel=0.02)
    assert np.ptp(radiance.mean(axis=1)) < 0.5 * radiance.mean()


def flat_area(corners: NDArray[np.float64]) -> float:
    cross = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    return float(0.5 * np.linalg.norm(cross, axis=1).sum())


def test_a_lit_square_lights_the_facing_one_by_their_form_factor(scale: Scale) -> None:
    side_mm, cells = 100.0, scale(6, 24)
    low = rectangle(side_mm, side_mm, cells, cells)
    high = low[:, ::-1] + [0.0, 0.0, side_mm]
    scene = scene_of(np.concatenate([low, high]), Material("red", (0.8, 0.4, 0.0)))
    # Far away and above both: it lights the lower one's face and the upper one's back.
    emitter = square([0.0, -15_000.0, 3000.0], [0.0, 0.98, -0.196], side_mm=7.0, flux_lm=1e7)
    facing = np.arange(len(low), 2 * len(low))
    towards = np.tile([0.0, 0.0, -1.0], (len(facing), 1))
    radiance = indirect_radiance(prepare(scene, facing, towards), emitter, bounces=2, samples=scale(1024, 4096))
    lit_lux = float(irradiance(emitter, [[0.0, 0.0, 0.0]], [[0.0, 0.0, 1.0]])[0])
    # Equal squares at the distance of their side (Siegel and Howell, Thermal Radiation, configuration 13).
    factor = 2 / np.pi * (np.log(2 / np.sqrt(3)) + 2 * np.sqrt(2) * np.arctan(1 / np.sqrt(2)) - np.pi / 2)
    expected = np.array([0.8, 0.4, 0.0]) ** 2 / np.pi * lit_lux * factor
    assert radiance.mean(axis=0) == pytest.approx(expected, rel=0.02)


def test_an_open_plane_has_no_light_but_the_direct_one() -> None:
    corners = 50.0 * np.array([[[-1, -1, 0], [1, -1, 0], [1, 1, 0]], [[-1, -1, 0], [1, 1, 0], [-1, 1, 0]]], float)
    tint = np.full((2, 3), 0.5, np.float32)
    scene = scene_of(corners, Material("glossy", (0.4, 0.4, 0.4), (0.04, 0.04, 0.04), 0.2), tint)
    emitter = square([100.0, 0.0, 400.0], [-0.2, 0.0, -1.0], side_mm=7.0, flux_lm=1800.0)
    prepared = prepare(scene, np.array([0, 1]), np.array([[0.0, 0.0, 1.0]] * 2))
    radiance = indirect_radiance(prepared, emitter, samples=256)
    direct = 0.2 / np.pi * 1800.0 / np.pi / 0.41**2
    assert np.abs(radiance).max() < 1e-3 * direct


def test_a_dark_floor_is_lit_by_its_wall_from_strip_to_strip_as_by_a_lambertian_strip() -> None:
    """A wall in x = 0 that a far light meets squarely, and small floor triangles at several distances from it."""
    wall = 100.0 * np.array([[[0, -5, 0], [0, 5, 0], [0, 5, 1]], [[0, -5, 0], [0, 5, 1], [0, -5, 1]]], float)
    distances_mm = np.array([60.0, 10.0, 200.0, 30.0, 120.0])
    small = 0.5 * np.array([[-1.0, -1.0, 0.0], [2.0, -1.0, 0.0], [-1.0, 2.0, 0.0]])
    floor = small + distances_mm[:, None, None] * [1.0, 0.0, 0.0]
    scene = scene_of(np.concatenate([wall, floor]), Material("grey", (0.5, 0.5, 0.5)))
    # Below the floor's horizon: only the wall is lit.
    emitter = square([20_000.0, 0.0, -500.0], [-1.0, 0.0, 0.025], side_mm=7.0, flux_lm=1e7)
    towards = np.tile([0.0, 0.0, 1.0], (len(floor), 1))
    seen = np.arange(len(wall), len(wall) + len(floor))
    radiance = indirect_radiance(prepare(scene, seen, towards), emitter, bounces=2, samples=20_000)
    lit_lux = float(irradiance(emitter, [[0.0, 0.0, 50.0]], [[1.0, 0.0, 0.0]])[0])
    # A point sees a wide wall of height h from the distance d under (1 - d/sqrt(d^2 + h^2))/2 of its hemisphere,
    # but for what the wall's ends, 500 mm to either side, cut off.
    factor = 0.5 * (1.0 - distances_mm / np.hypot(distances_mm, 100.0))
    assert radiance[:, 1] == pytest.approx(0.5**2 / np.pi * lit_lux * factor, rel=0.06)
