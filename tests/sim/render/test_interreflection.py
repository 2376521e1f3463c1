"""Light from surface to surface, against closed forms."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray
from scenes import relief

from coupole.appearance.shapes.solids import unit_sphere
from coupole.appearance.shapes.triangles import flat_normals, rectangle
from sim.devices.arm_bodies import NONE
from sim.render.embree import Obstacles
from sim.render.emitter import Emitter, irradiance, square
from sim.render.interreflection import add_indirect, exchange, indirect_lux, neighbourhood
from sim.scene.scene import Scene, build_scene
from sim.scene.surface import Material, Surface

Scale = Callable[[int, int], int]


def scene_of(corners: NDArray[np.float64], material: Material, tint: NDArray[np.float32] | None = None) -> Scene:
    surface = Surface(corners, (material,), np.zeros(len(corners), np.int32), tint)
    return build_scene([(surface, np.eye(4))])


def reflected(
    scene: Scene, seen: NDArray[np.integer], emitter: Emitter, *, bounces: int, rays: int
) -> NDArray[np.float32]:
    """[seen, 3] radiance of triangles' fronts by light that met 2 to `bounces` surfaces."""
    obstacles = Obstacles(scene.corners_mm)
    between = exchange(scene, obstacles, rays)
    normals = flat_normals(scene.corners_mm.astype(float))[seen].astype(np.float32)
    around = neighbourhood(between, scene.corners_mm, 2 * seen.astype(np.int64), normals)
    lux = indirect_lux(between, obstacles, emitter, "lambertian", NONE, bounces)
    material = scene.material[seen]
    albedo = (scene.materials[material, :3] + scene.materials[material, 3:6]).astype(np.float32)
    radiance = np.zeros((len(seen), 3), np.float32)
    add_indirect(radiance, lux, around, albedo, np.arange(len(seen), dtype=np.int32))
    return radiance


def inside_out(radius_mm: float) -> NDArray[np.float64]:
    return radius_mm * unit_sphere(6)[:, ::-1]


def test_a_closed_diffuse_sphere_gathers_rho_over_one_minus_rho_of_its_mean_light(scale: Scale) -> None:
    corners, rho, flux_lm = inside_out(100.0), 0.5, 1000.0
    scene = scene_of(corners, Material("white", (rho, rho, rho)))
    seen = np.arange(0, len(corners), 3)
    bounces = 12
    emitter = square([0.0, 0.0, 30.0], [0.0, 0.0, 1.0], side_mm=1.0, flux_lm=flux_lm)
    radiance = reflected(scene, seen, emitter, bounces=bounces, rays=scale(128, 4096))
    # Each point of a sphere sees all of it alike: E after k surfaces is rho^k flux/area, wherever light began.
    area_m2 = flat_area(corners) * 1e-6
    gathered = sum(rho**k for k in range(1, bounces)) * flux_lm / area_m2
    assert radiance.mean() == pytest.approx(rho / np.pi * gathered, rel=0.02)
    assert np.ptp(radiance.mean(axis=1)) < 0.2 * radiance.mean()


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
    radiance = reflected(scene, facing, emitter, bounces=2, rays=scale(1024, 4096))
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
    radiance = reflected(scene, np.array([0, 1]), emitter, bounces=4, rays=256)
    assert not radiance.any()


def test_light_on_a_sheet_does_not_reach_what_is_behind_it() -> None:
    floor, sheet = rectangle(50.0, 50.0, 4, 4), rectangle(500.0, 500.0, 20, 20, z_mm=50.0)
    scene = scene_of(np.concatenate([floor, sheet]), Material("white", (0.9, 0.9, 0.9)))
    emitter = square([0.0, 0.0, 900.0], [0.0, 0.0, -1.0], side_mm=7.0, flux_lm=1800.0)
    assert not reflected(scene, np.arange(len(floor)), emitter, bounces=4, rays=128).any()


def test_a_dark_floor_is_lit_by_its_wall_from_strip_to_strip_as_by_a_lambertian_strip() -> None:
    """A wall in x = 0 that a far light meets squarely, and small floor triangles at several distances from it."""
    wall = 100.0 * np.array([[[0, -5, 0], [0, 5, 0], [0, 5, 1]], [[0, -5, 0], [0, 5, 1], [0, -5, 1]]], float)
    distances_mm = np.array([60.0, 10.0, 200.0, 30.0, 120.0])
    small = 0.5 * np.array([[-1.0, -1.0, 0.0], [2.0, -1.0, 0.0], [-1.0, 2.0, 0.0]])
    floor = small + distances_mm[:, None, None] * [1.0, 0.0, 0.0]
    scene = scene_of(np.concatenate([wall, floor]), Material("grey", (0.5, 0.5, 0.5)))
    # Below the floor's horizon: only the wall is lit.
    emitter = square([20_000.0, 0.0, -500.0], [-1.0, 0.0, 0.025], side_mm=7.0, flux_lm=1e7)
    seen = np.arange(len(wall), len(wall) + len(floor))
    radiance = reflected(scene, seen, emitter, bounces=2, rays=20_000)
    lit_lux = float(irradiance(emitter, [[0.0, 0.0, 50.0]], [[1.0, 0.0, 0.0]])[0])
    # A point sees a wide wall of height h from the distance d under (1 - d/sqrt(d^2 + h^2))/2 of its hemisphere,
    # but for what the wall's ends, 500 mm to either side, cut off.
    factor = 0.5 * (1.0 - distances_mm / np.hypot(distances_mm, 100.0))
    assert radiance[:, 1] == pytest.approx(0.5**2 / np.pi * lit_lux * factor, rel=0.03)


def test_a_deep_relief_gathers_what_mitsubas_paths_bring(tmp_path: Path, scale: Scale) -> None:
    corners, rho = relief(120.0, 60, 20.0), 0.7
    scene = scene_of(corners, Material("white", (rho, rho, rho)))
    emitter = square([300.0, -250.0, 600.0], [-0.43, 0.36, -0.83], side_mm=7.0, flux_lm=1800.0)
    seen = np.random.default_rng(1).permutation(len(corners))[: scale(300, 3000)]
    ours = reflected(scene, seen, emitter, bounces=4, rays=128)[:, 0]
    theirs = by_paths(tmp_path, corners, rho, emitter, seen, scale(64, 512))
    assert theirs.mean() > 0.05 * rho / np.pi * irradiance(emitter, [[0.0, 0.0, 0.0]], [[0.0, 0.0, 1.0]])[0]
    assert ours.mean() == pytest.approx(theirs.mean(), rel=0.03)
    assert np.corrcoef(ours, theirs)[0, 1] > 0.85


def by_paths(
    folder: Path, corners: NDArray[np.float64], rho: float, emitter: Emitter, seen: NDArray[np.integer], paths: int
) -> NDArray[np.float64]:
    """Mitsuba's radiance of triangles along their normals: paths of up to 4 surfaces less those of one."""
    import mitsuba as mi
    import trimesh

    mi.set_variant("scalar_rgb")
    path = folder / "relief.ply"
    faces = np.arange(3 * len(corners)).reshape(-1, 3)
    trimesh.Trimesh(corners.reshape(-1, 3), faces, process=False).export(path)
    place = np.eye(4)
    for column, vector in enumerate((emitter.half_u_mm, emitter.half_v_mm, emitter.normal, emitter.centre_mm)):
        place[:3, column] = vector
    normals = flat_normals(corners)[seen]
    starts = corners[seen].mean(axis=1) + 0.05 * normals
    pixel = {"type": "hdrfilm", "width": 1, "height": 1, "rfilter": {"type": "box"}}
    meters = {
        f"meter{i:05d}": {"type": "radiancemeter", "origin": start, "direction": way, "film": pixel}
        for i, (start, way) in enumerate(zip(starts.tolist(), (-normals).tolist(), strict=True))
    }
    film = {**pixel, "width": len(seen), "component_format": "float32"}
    sensor = mi.load_dict({"type": "batch", "film": film, **meters}, parallel=False, optimize=False)
    body = {"type": "diffuse", "reflectance": {"type": "rgb", "value": rho}}
    brightness = 1800.0 / (np.pi * 49e-6)
    parts = {
        "relief": {
            "type": "ply",
            "filename": str(path),
            "face_normals": True,
            "bsdf": {"type": "twosided", "body": body},
        },
        "light": {
            "type": "rectangle",
            "to_world": mi.ScalarTransform4f(place),
            "emitter": {"type": "area", "radiance": {"type": "rgb", "value": brightness}},
        },
    }
    found = []
    for surfaces in (4, 1):
        integrator = {"type": "path", "max_depth": surfaces + 1, "rr_depth": surfaces + 2}
        scene = mi.load_dict({"type": "scene", "integrator": integrator, **parts})
        found.append(np.array(mi.render(scene, sensor=sensor, spp=paths, seed=3), np.float64)[0, :, 0])
    return np.asarray(found[0] - found[1])
