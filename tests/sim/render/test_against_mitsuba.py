"""Radiance and shadows against Mitsuba 3, an independent renderer: triangle by triangle, without noise.

Mitsuba gets meshes as PLY files, an area light as a rectangle and its own materials; it answers where rays from
triangles' centroids go, what the light sends along them and what its BSDFs make of that. The light's integral is
taken over 8 x 8 Gauss points. Triangles are the renderer's own choice: those that its camera sees.
"""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from lazily import lazily
from numpy.typing import NDArray
from scenes import camera_above, quad, relief, scene_of, sphere

from sim.render.camera_view import Viewer
from sim.render.embree import Obstacles
from sim.render.emitter import square
from sim.render.lens import Lens
from sim.render.radiance import led_radiance
from sim.render.shadows import Shadows
from sim.scene.surface import Material

mi: Any = lazily("mitsuba")

LED_MM, TOWARDS, FLUX_LM = np.array([350.0, -200.0, 700.0]), np.array([-0.4, 0.3, -0.87]), 1800.0
LOW_LED_MM = np.array([450.0, -200.0, 250.0])
CAMERA = camera_above(330.0, 25.0)
DIFFUSE, F0 = (0.6, 0.4, 0.2), (0.9, 0.5, 0.05)
MESHES = {
    "plane": quad((0.0, 0.0, 0.0), 80.0),
    "sphere": sphere(40.0, 3),
    "relief": relief(150.0, 60, 6.0),
}


def ours(
    corners: NDArray[np.float64], material: Material, led_mm: NDArray[np.float64] = LED_MM
) -> tuple[NDArray[np.int64], Any, NDArray[np.float32]]:
    """Triangles seen, the view and the radiance [seen, 3] that the renderer gives them."""
    scene = scene_of(corners, material)
    view = Viewer(scene, Lens(320, 240, 500.0)).look(CAMERA)
    shadows = Shadows(Obstacles(scene.corners_mm), led_mm[None], 1 << 20)
    places = shadows.places(view.sides)
    emitter = square(led_mm, TOWARDS, side_mm=7.0, flux_lm=FLUX_LM)
    radiance = led_radiance(
        view, scene.materials, scene.tables, emitter, "lambertian", places, shadows.reached_bits(0)
    )
    return view.sides >> 1, view, radiance


class Oracle:
    """The same scene in Mitsuba, lengths in mm."""

    def __init__(self, folder: Path, corners: NDArray[np.float64], bsdfs: list[dict[str, Any]]) -> None:
        import trimesh

        mi.set_variant("scalar_rgb")
        path = folder / "mesh.ply"
        trimesh.Trimesh(corners.reshape(-1, 3), np.arange(3 * len(corners)).reshape(-1, 3), process=False).export(
            path
        )
        way = TOWARDS / np.linalg.norm(TOWARDS)
        place = mi.ScalarTransform4f().look_at(origin=LED_MM, target=LED_MM + way, up=[0, 0, 1])
        radiance = FLUX_LM / (np.pi * 49.0)  # lm/(mm^2 sr)
        self.scene = mi.load_dict(
            {
                "type": "scene",
                "mesh": {"type": "ply", "filename": str(path), "face_normals": True},
                "led": {
                    "type": "rectangle",
                    "to_world": place @ mi.ScalarTransform4f().scale(3.5),
                    "emitter": {"type": "area", "radiance": {"type": "rgb", "value": [radiance] * 3}},
                },
            }
        )
        self.bsdfs = [mi.load_dict(b) for b in bsdfs]
        nodes, weights = np.polynomial.legendre.leggauss(8)
        self.points = [
            (np.array(place @ mi.ScalarPoint3f(3.5 * u, 3.5 * v, 0.0)).ravel(), wu * wv * 12.25)
            for u, wu in zip(nodes, weights, strict=True)
            for v, wv in zip(nodes, weights, strict=True)
        ]

    def at(self, centroid: NDArray[np.float64], normal: NDArray[np.float64]) -> Any:
        """Mitsuba's own intersection at a centroid."""
        found = self.scene.ray_intersect(mi.Ray3f(centroid + 0.1 * normal, -normal))
        assert found.is_valid()
        return found

    def reached(self, found: Any, point_mm: NDArray[np.float64]) -> bool:
        return not self.scene.ray_test(found.spawn_ray_to(point_mm))

    def radiance(self, found: Any, eye: NDArray[np.float64]) -> NDArray[np.float64]:
        """lm/(m^2 sr) towards `eye`: the light's integral, nothing in between."""
        context = mi.BSDFContext()
        towards = eye - np.array(found.p)
        found.wi = found.to_local(towards / np.linalg.norm(towards))
        total = np.zeros(3)
        for point, area_mm2 in self.points:
            way = point - np.array(found.p)
            distance_mm = np.linalg.norm(way)
            light = self.scene.ray_intersect(mi.Ray3f(point - 0.5 * way / distance_mm, way / distance_mm))
            sent = np.array(light.emitter(self.scene).eval(light))
            cosine = abs(np.dot(np.array(light.n), way)) / distance_mm
            f_cos = sum(np.array(b.eval(context, found, found.to_local(way / distance_mm))) for b in self.bsdfs)
            total += f_cos * sent * cosine * area_mm2 / distance_mm**2
        return total * 1e6


CASES = {
    "diffuse": (Material("", DIFFUSE), [{"type": "diffuse", "reflectance": {"type": "rgb", "value": DIFFUSE}}]),
    "glossy": (
        Material("", (0, 0, 0), (1, 1, 1), 0.15),
        [{"type": "roughconductor", "material": "none", "distribution": "ggx", "alpha": 0.15}],
    ),
    "both": (
        Material("", DIFFUSE, F0, 0.36),
        [
            {"type": "diffuse", "reflectance": {"type": "rgb", "value": DIFFUSE}},
            {
                "type": "principled",
                "base_color": {"type": "rgb", "value": F0},
                "metallic": 1.0,
                "roughness": 0.6,  # alpha is its square
            },
        ],
    ),
}


@pytest.mark.parametrize("shape", MESHES)
@pytest.mark.parametrize("kind", CASES)
def test_radiance_is_mitsubas_where_light_falls(
    shape: str, kind: str, tmp_path: Path, scale: Callable[[int, int], int]
) -> None:
    material, bsdfs = CASES[kind]
    triangles, view, radiance = ours(MESHES[shape], material)
    lit = np.flatnonzero(radiance[:, 0] > 0)
    chosen = np.random.default_rng(1).permutation(lit)[: scale(30, 1000)]
    oracle = Oracle(tmp_path, MESHES[shape], bsdfs)
    differences = []
    for i in chosen:
        found = oracle.at(MESHES[shape][triangles[i]].mean(axis=0), view.normals[i].astype(float))
        expected = oracle.radiance(found, CAMERA[:3, 3])
        differences.append(np.abs(radiance[i] / expected - 1.0)[expected > 0])
    assert np.median(np.concatenate(differences)) < 1e-4
    assert np.quantile(np.concatenate(differences), 0.9) < 1e-3


@pytest.mark.parametrize("shape", ["sphere", "relief"])
def test_shadows_are_mitsubas(shape: str, tmp_path: Path, scale: Callable[[int, int], int]) -> None:
    corners = np.concatenate([MESHES[shape], relief(400.0, 100, 0.0) - [0.0, 0.0, 40.0]])
    triangles, view, radiance = ours(corners, Material("", DIFFUSE), LOW_LED_MM)
    facing = np.flatnonzero(np.einsum("ij,ij->i", view.normals, LOW_LED_MM - view.points_mm) > 0)
    chosen = np.random.default_rng(1).permutation(facing)[: scale(500, 20_000)]
    oracle = Oracle(tmp_path, corners, [])
    theirs = np.array(
        [
            oracle.reached(
                oracle.at(corners[triangles[i]].mean(axis=0), view.normals[i].astype(float)), LOW_LED_MM
            )
            for i in chosen
        ]
    )
    assert 0.1 < theirs.mean() < 0.9
    assert (theirs == (radiance[chosen, 0] > 0)).mean() > 0.98
