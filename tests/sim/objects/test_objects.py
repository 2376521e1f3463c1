"""Virtual objects: closed where they are bodies, outwards, of the size and the number of triangles asked for."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
import trimesh
from hypothesis import given, settings
from hypothesis import strategies as st

from coupole.appearance.matter import nashiji
from coupole.appearance.shapes.triangles import cells_for, flat_normals, rectangle, weld_corners
from coupole.errors import InputError
from sim.objects import appearance, colour_chart, fabric, shapes, standards, urushi, wedges
from sim.objects.charuco import Charuco, charuco_board
from sim.objects.surfaces import of_material
from sim.scene.surface import Surface

SMALL_SLAB = nashiji.Slab(size_mm=(5.0, 5.0), seed=2)
BODIES: dict[str, Callable[[], Surface]] = {
    "sphere": lambda: shapes.sphere(20.0, triangles=500),
    "relief": lambda: shapes.sculpted_relief(triangles=5_000),
    "Spectralon": standards.spectralon_tile,
    "grey card": standards.grey_card,
    "colour chart": colour_chart.colour_chart,
    "chrome ball": lambda: standards.chrome_ball(triangles=500),
    "glossy sphere": lambda: shapes.glossy_sphere(20.0, triangles=500),
    "gilt wedge": wedges.gilt_step_wedge,
    "paint wedge": wedges.paint_wedge,
    "makie": lambda: urushi.makie_tile(triangles=2_000),
    "nashiji": lambda: urushi.nashiji_slab(SMALL_SLAB),
    "board": lambda: charuco_board(Charuco(5, 4)),
}
SHEETS: dict[str, Callable[[], Surface]] = {
    "fabric": lambda: fabric.fabric(triangles=5_000),
    "sticker": standards.sticker,
}


def as_trimesh(surface: Surface) -> Any:
    points, faces = weld_corners(surface.corners_mm)
    return trimesh.Trimesh(points, faces, process=False)


def well_formed(surface: Surface) -> bool:
    count = len(surface.corners_mm)
    lengths = [len(part) for part in (surface.material, surface.tint, surface.normals) if part is not None]
    unit = surface.normals is None or np.allclose(np.linalg.norm(surface.normals, axis=1), 1.0)
    named = set(np.unique(surface.material)) <= set(range(len(surface.materials)))
    return bool(set(lengths) == {count} and unit and named and np.isfinite(surface.corners_mm).all())


@pytest.mark.parametrize("name", BODIES | SHEETS)
def test_every_object_is_well_formed(name: str) -> None:
    assert well_formed((BODIES | SHEETS)[name]())


@pytest.mark.parametrize("name", BODIES | SHEETS)
def test_no_material_reflects_more_than_it_gets(name: str) -> None:
    for material in (BODIES | SHEETS)[name]().materials:
        values = np.array([material.diffuse, material.f0])
        assert np.all(values >= 0.0)
        assert np.all(values.sum(axis=0) <= 1.0)


@pytest.mark.parametrize("name", BODIES)
def test_bodies_are_closed_face_outwards_and_stand_on_the_ground(name: str) -> None:
    body = as_trimesh(BODIES[name]())
    assert body.is_watertight
    assert body.is_winding_consistent
    assert body.volume > 0.0
    assert body.bounds[0, 2] == pytest.approx(0.0, abs=1e-9)


@pytest.mark.parametrize("name", SHEETS)
def test_sheets_lie_in_the_ground_and_face_up(name: str) -> None:
    surface = SHEETS[name]()
    assert np.all(surface.corners_mm[:, :, 2] == 0.0)
    assert np.allclose(flat_normals(surface.corners_mm), [0.0, 0.0, 1.0])


@given(st.integers(20, 4_000), st.floats(0.5, 200.0))
@settings(max_examples=20)
def test_a_sphere_has_its_corners_on_the_sphere_and_about_the_triangles_asked_for(
    triangles: int, radius_mm: float
) -> None:
    surface = shapes.sphere(radius_mm, triangles=triangles)
    from_middle = np.linalg.norm(surface.corners_mm - [0.0, 0.0, radius_mm], axis=2)
    assert np.allclose(from_middle, radius_mm, rtol=1e-12)
    n = np.sqrt(len(surface.corners_mm) / 20)
    assert abs(n - np.sqrt(triangles / 20)) <= 0.5


def test_a_spheres_area_tends_to_the_true_one() -> None:
    missing = [1.0 - as_trimesh(shapes.sphere(1.0, triangles=20 * n * n)).area / (4 * np.pi) for n in (8, 16, 32)]
    assert missing[2] < 2e-3
    assert missing[1] / missing[2] == pytest.approx(4.0, rel=0.05)


@given(st.integers(2, 5_000), st.floats(1.0, 500.0), st.floats(1.0, 500.0))
@settings(max_examples=30)
def test_a_rectangle_keeps_its_area_and_never_has_many_more_triangles_than_asked_for(
    triangles: int, width_mm: float, depth_mm: float
) -> None:
    cells = cells_for(triangles, width_mm, depth_mm)
    sheet = as_trimesh(of_material(rectangle(width_mm, depth_mm, *cells), appearance.SPECTRALON))
    assert sheet.area == pytest.approx(width_mm * depth_mm, rel=1e-6)
    assert len(sheet.faces) <= 2 * max(1, round(np.sqrt(triangles / 2 * width_mm / depth_mm))) + triangles


def test_the_relief_has_about_the_triangles_asked_for_and_another_seed_carves_another_one() -> None:
    first, again, other = (shapes.sculpted_relief(triangles=20_000, seed=seed) for seed in (1, 1, 2))
    assert len(first.corners_mm) == pytest.approx(20_000, rel=0.07)
    assert np.array_equal(first.corners_mm, again.corners_mm)
    assert np.abs(first.corners_mm - other.corners_mm).max() > 0.5


def test_too_few_triangles_are_refused() -> None:
    with pytest.raises(InputError, match="at least 20"):
        shapes.sphere(10.0, triangles=19)


def test_a_gilt_step_wedge_goes_from_bole_to_gold() -> None:
    materials = wedges.gilt_step_wedge().materials[: len(wedges.GILT_NM)]
    bole, leaf = materials[0], materials[-1]
    assert bole.diffuse[0] > 0.15
    assert bole.f0[0] < 0.05
    assert max(leaf.diffuse) < 1e-3
    assert leaf.f0[0] > leaf.f0[1] > leaf.f0[2] > 0.35
    assert np.all(np.diff([m.f0[0] for m in materials[:5]]) > 0.0)


def test_a_thick_paint_hides_black_and_white_and_a_thin_one_does_not() -> None:
    steps = len(wedges.PAINT_MM)
    materials = wedges.paint_wedge(thicknesses_mm=(*wedges.PAINT_MM, 3.0)).materials
    over_black, over_white = materials[: steps + 1], materials[steps + 1 : 2 * steps + 2]
    contrast = [w.diffuse[2] - b.diffuse[2] for b, w in zip(over_black, over_white, strict=True)]
    assert contrast[0] > 0.2
    assert np.all(np.diff(contrast) < 0.0)
    assert contrast[-1] < 1e-6


def test_makie_has_gold_in_its_flower_and_lacquer_around_it() -> None:
    surface = urushi.makie_tile(triangles=20_000)
    gold = surface.material == 0
    radius_mm = np.linalg.norm(surface.corners_mm.mean(axis=1)[:, :2], axis=1)
    up = flat_normals(surface.corners_mm)[:, 2] > 0.5
    assert gold[up & (radius_mm > 6) & (radius_mm < 12)].mean() > 0.85
    assert gold[up & (radius_mm > 25) & (radius_mm < 27)].mean() < 0.05


def test_flakes_of_nashiji_lie_in_the_lacquer_and_look_redder_the_deeper_they_lie() -> None:
    surface = urushi.nashiji_slab(SMALL_SLAB)
    flakes = surface.material > 0
    heights = surface.corners_mm[flakes][:, :, 2]
    assert heights.min() > 6.0 - 1e-9
    assert heights.max() < 6.0 + SMALL_SLAB.depth_mm + 1e-9
    redness = [m.f0[0] / m.f0[2] for m in surface.materials[1:]]
    assert np.all(np.diff(redness) > 0.0)


def test_the_threads_of_cloth_lie_flat_on_the_whole() -> None:
    normals, shade = fabric.weave(np.random.default_rng(1).uniform(-30.0, 30.0, (200_000, 2)), 1.2)
    assert np.abs(normals[:, :2].mean(axis=0)).max() < 0.01
    assert 0.5 < np.abs(normals[:, :2]).max() < 0.9
    assert shade.min() >= 0.5


def test_warp_and_weft_change_places_from_thread_to_thread() -> None:
    at_the_edge = np.array([[0.59, 0.5], [0.59 + 0.6, 0.5]])
    normals, _ = fabric.weave(at_the_edge, 0.6)
    assert normals[0, 0] > 0.5
    assert abs(normals[1, 0]) < 0.5
