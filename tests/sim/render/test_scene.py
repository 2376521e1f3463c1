"""Meshes and the support as they stand in the dome."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from scenes import GREY, quad, sphere

from coupole.errors import InputError
from coupole.geometry import transform
from sim.scene.scene import PAINTED, STONE, build_scene, load_surface, support_disk
from sim.scene.surface import Material, Surface


def test_the_support_is_a_whole_disk_of_small_triangles_that_look_up() -> None:
    corners = support_disk(200.0, cell_mm=5.0).corners_mm
    cross = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    assert np.all(cross[:, 2] > 0)
    assert cross[:, 2].sum() / 2 == pytest.approx(np.pi * 100.0**2, rel=1e-3)
    assert np.linalg.norm(corners[:, 1] - corners[:, 0], axis=1).max() < 1.5 * 5.0


@pytest.mark.parametrize("ending", ["ply", "stl", "obj"])
def test_a_mesh_comes_in_with_every_triangle_in_mm(ending: str, tmp_path: Path) -> None:
    import trimesh

    corners = sphere(0.03, 2)
    mesh = trimesh.Trimesh(corners.reshape(-1, 3), np.arange(3 * len(corners)).reshape(-1, 3), process=False)
    mesh.export(tmp_path / f"ball.{ending}")
    surface = load_surface(tmp_path / f"ball.{ending}", "m")
    assert surface.corners_mm == pytest.approx(corners * 1000.0, abs=1e-4)
    assert surface.materials == (STONE,)
    assert surface.tint is None


def test_colours_of_a_mesh_are_taken_from_srgb_to_linear(tmp_path: Path) -> None:
    import trimesh

    colours = np.array([[255, 188, 0, 255]] * 4, np.uint8)
    vertices, faces = [[0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0]], [[0, 1, 2], [0, 2, 3]]
    trimesh.Trimesh(vertices, faces, vertex_colors=colours, process=False).export(tmp_path / "tile.ply")
    surface = load_surface(tmp_path / "tile.ply", "mm")
    assert surface.tint == pytest.approx(np.array([[1.0, 0.5029, 0.0]] * 2), abs=1e-4)
    assert surface.materials == (PAINTED,)


def test_a_texture_colours_triangles_at_their_centroids(tmp_path: Path) -> None:
    from PIL import Image

    Image.fromarray(np.array([[[255, 0, 0], [0, 255, 0]], [[0, 0, 255], [255, 255, 255]]], np.uint8)).save(
        tmp_path / "tile.png"
    )
    (tmp_path / "tile.mtl").write_text("newmtl tile\nmap_Kd tile.png\n")
    # One triangle in each quarter: v points up, rows of the picture down.
    lines = ["mtllib tile.mtl", "usemtl tile"]
    for i, (u, v) in enumerate([(0.1, 0.6), (0.6, 0.6), (0.1, 0.1), (0.6, 0.1)]):
        lines += [f"v {x} {y} 0\nvt {u + 0.1 * x} {v + 0.1 * y}" for x, y in ((0, 0), (1, 0), (0, 1))]
        lines.append(f"f {3 * i + 1}/{3 * i + 1} {3 * i + 2}/{3 * i + 2} {3 * i + 3}/{3 * i + 3}")
    (tmp_path / "tile.obj").write_text("\n".join(lines))
    tint = load_surface(tmp_path / "tile.obj", "mm").tint
    assert tint is not None
    assert tint.tolist() == [[1, 0, 0], [0, 1, 0], [0, 0, 1], [1, 1, 1]]


def test_what_is_no_mesh_is_refused_with_its_name(tmp_path: Path) -> None:
    (tmp_path / "notes.ply").write_text("not a mesh")
    with pytest.raises(InputError, match=r"notes\.ply: expected a mesh of triangles"):
        load_surface(tmp_path / "notes.ply", "mm")


def test_things_stand_where_their_transforms_put_them_with_their_own_materials() -> None:
    red = Material("red", (0.9, 0.1, 0.1), (0.04, 0.04, 0.04), 0.3)
    tile = Surface(quad((0, 0, 0), 1.0), (GREY, red), np.array([0, 1], np.int32))
    scene = build_scene([(tile, np.eye(4)), (tile, transform((10.0, 20.0, 30.0)))])
    assert scene.materials[scene.material[[0, 1, 3]], 0].tolist() == [0.5, 0.9, 0.9]
    moved = scene.corners_mm[:2] + np.array([10.0, 20.0, 30.0])
    assert scene.corners_mm[2:] == pytest.approx(moved)
