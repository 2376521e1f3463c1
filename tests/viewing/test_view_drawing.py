"""What pictures of the cell are drawn with: shapes, hidden surfaces, and where a camera's picture falls."""

from __future__ import annotations

import numpy as np
import pytest
import trimesh

from coupole.geometry import look_at
from coupole.motion.occlusion import Sight, ray_mesh
from coupole.viewing.view_canvas import Canvas, Lookout
from coupole.viewing.view_colours import of_share
from coupole.viewing.view_sight import footprint
from coupole.viewing.view_solids import Solid, box, capsule, disk, join_solids, sphere, with_fewer_faces

BLUE, GREEN = (0.0, 0.0, 1.0), (0.0, 1.0, 0.0)


def mesh_of(solid: Solid) -> trimesh.Trimesh:
    return trimesh.Trimesh(solid.vertices_mm, solid.faces)


@pytest.mark.parametrize(
    ("solid", "volume_mm3"),
    [
        (capsule("c", (10, 20, 30), (110, 20, 30), 50, 96), np.pi * 50**2 * 100 + 4 / 3 * np.pi * 50**3),
        (sphere("b", (1, 2, 3), 50, 96), 4 / 3 * np.pi * 50**3),
        (box("x", (-1, -2, -3), (4, 5, 6)), 5 * 7 * 9),
        (disk("d", 100, 10, 360), np.pi * 100**2 * 10),
    ],
    ids=["capsule", "sphere", "box", "disk"],
)
def test_a_solid_is_closed_and_has_its_volume(solid: Solid, volume_mm3: float) -> None:
    mesh = mesh_of(solid)
    mesh.merge_vertices()
    mesh.update_faces(mesh.nondegenerate_faces())
    assert mesh.is_watertight
    assert mesh.volume == pytest.approx(volume_mm3, rel=5e-3)  # positive: its faces look outwards


def test_joined_solids_keep_all_their_faces() -> None:
    both = join_solids("both", [sphere("a", (0, 0, 0), 10), box("b", (20, 0, 0), (30, 10, 10))])
    assert mesh_of(both).volume == pytest.approx(1000 + mesh_of(sphere("a", (0, 0, 0), 10)).volume)
    assert len(join_solids("none", []).faces) == 0


def test_a_simplified_mesh_has_fewer_faces_and_about_the_same_shape() -> None:
    fine = sphere("sphere", (5, 5, 5), 100, 200)
    coarse = with_fewer_faces(fine, 3000)
    assert 300 < len(coarse.faces) <= 3000 < len(fine.faces)
    assert mesh_of(coarse).volume == pytest.approx(4 / 3 * np.pi * 100**3, rel=0.03)
    assert np.array_equal(with_fewer_faces(coarse, 3000).faces, coarse.faces)


@pytest.mark.parametrize("perspective", [True, False])
@pytest.mark.parametrize("near_first", [True, False])
def test_what_is_nearer_hides_what_is_behind_it(near_first: bool, perspective: bool) -> None:
    near, far = sphere("near", (0, 0, 100), 40), sphere("far", (0, 0, 0), 80)
    scale = 500.0 if perspective else 1.0
    canvas = Canvas(Lookout(look_at((0, 0, 0), 500, 0, 90), scale, 200, 200, perspective=perspective))
    for solid, colour in ((near, BLUE), (far, GREEN)) if near_first else ((far, GREEN), (near, BLUE)):
        canvas.fill([solid], [colour])
    pixels = np.asarray(canvas.image())
    assert np.argmax(pixels[100, 100]) == 2
    assert np.argmax(pixels[100, 165]) == 1
    assert pixels[5, 5].tolist() == [255, 255, 255]


def test_bodies_that_cross_each_hide_a_part_of_the_other() -> None:
    lookout = Lookout(look_at((0, 0, 0), 500, 0, 90), 1.0, 200, 200, perspective=False)
    canvas = Canvas(lookout)
    slopes = [[(-90, -90, z), (90, -90, -z), (90, 90, -z), (-90, 90, z)] for z in (50.0, -50.0)]
    canvas.fill([Solid("q", np.array(slope), np.array([(0, 1, 2), (0, 2, 3)])) for slope in slopes], [BLUE, GREEN])
    pixels = np.asarray(canvas.image())
    for x_mm, nearer in ((-45, 2), (45, 1)):
        column, row = lookout.project((x_mm, 0, 0))[0]
        assert np.argmax(pixels[int(row), int(column)]) == nearer


def test_a_line_behind_a_body_is_faint_and_one_before_it_is_not() -> None:
    canvas = Canvas(Lookout(look_at((0, 0, 0), 500, 0, 90), 1.0, 200, 200, perspective=False), (0.0, 0.0, 0.0))
    canvas.fill([box("b", (-90, -90, -10), (90, 90, 10))], [(0.0, 0.0, 0.0)], has_outline=False)
    for height in (-100.0, 100.0):
        for axis in range(2):
            ends = np.zeros((2, 3))
            ends[:, axis], ends[:, 1 - axis], ends[:, 2] = (-80, 80), np.sign(height) * 40, height
            canvas.line(ends, (1.0, 1.0, 1.0), 3.0, hidden_opacity=0.2)
    levels = np.unique(np.asarray(canvas.image()).max(axis=2))
    assert 51 in levels
    assert 255 in levels


def test_the_colours_of_shares_grow_lighter_and_hold_no_red() -> None:
    scale = of_share(np.linspace(0, 1, 50))
    assert np.all(np.diff(scale @ (0.299, 0.587, 0.114)) > 0)
    assert np.all(scale[:, 1] > 0.35 * scale[:, 0])


def test_a_picture_taken_from_above_falls_on_a_rectangle_of_the_support() -> None:
    sight = Sight(look_at((10, 20, 0), 400, 0, 90), 800.0, 640, 480)
    outline = footprint(sight, None, 740.0)
    assert outline[0] == pytest.approx(outline[-1])
    assert outline[:, 2] == pytest.approx(0)
    assert sorted(np.ptp(outline[:, :2], axis=0)) == pytest.approx([240, 320])  # 400 mm x 480/800 and 640/800
    assert outline[:, :2].min(axis=0) + outline[:, :2].max(axis=0) == pytest.approx([20, 40])


def test_what_of_a_picture_falls_on_the_object_lies_on_it() -> None:
    block = box("block", (-500, -500, 0), (500, 500, 100)).corners_mm
    outline = footprint(Sight(look_at((0, 0, 0), 400, 0, 90), 800.0, 640, 480), ray_mesh(block), 740.0)
    assert outline[:, 2] == pytest.approx(100, abs=1e-3)


def test_a_picture_of_the_sky_falls_nowhere() -> None:
    assert len(footprint(Sight(look_at((0, 0, 900), 400, 0, -80), 800.0, 64, 48), None, 740.0)) == 0
