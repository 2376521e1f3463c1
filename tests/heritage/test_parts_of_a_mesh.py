"""Which triangle is of which part: colours, pictures of labels, boxes, planes; and what is refused, where."""

from __future__ import annotations

import base64
import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import trimesh
from painted_plate import BLUE, PARTS, RED, RESTORATION, grid, middles, plate_obj, plate_ply
from PIL import Image

from coupole.appearance.render.materials import Metal
from coupole.appearance.render.objects import Piece
from coupole.appearance.render.scene_file import Camera
from coupole.commands.restore import checked_restoration
from coupole.errors import InputError
from coupole.heritage.restoration.painted_mesh import read_painted
from coupole.heritage.restoration.part_labels import Parts, parts_of
from coupole.heritage.restoration.parts_file import read_parts
from coupole.heritage.restoration.restoration_file import (
    Choice,
    RestorationFile,
    chosen_file,
    read_restoration,
)
from coupole.heritage.restoration.restoring import Restoration
from coupole.heritage.restoration.seen_parts import SeenParts

LEFT = np.array(middles()) < 0


def found(mesh: Path, rules: str, folder: Path) -> Parts:
    path = folder / "parts.yaml"
    path.write_text(rules)
    return parts_of(read_painted(mesh), *read_parts(path))


def is_part(parts: Parts, name: str) -> np.ndarray:
    return parts.labels == parts.names.index(name)


@pytest.mark.parametrize("ending", ["ply", "obj", "glb"])
def test_colours_of_vertices_are_read_from_each_format(ending: str, tmp_path: Path) -> None:
    points, triangles = grid()
    colours = [RED if (row // 4) % 4 < 2 else BLUE for row in range(len(points))]
    path = tmp_path / f"plate.{ending}"
    trimesh.Trimesh(points, triangles, vertex_colors=colours, process=False).export(path)
    parts = found(path, PARTS, tmp_path)
    assert np.array_equal(is_part(parts, "left"), LEFT)
    assert np.array_equal(is_part(parts, "right"), ~LEFT)


def test_a_picture_of_labels_is_read_the_right_way_up(tmp_path: Path) -> None:
    """Upper left quarter red, all else blue: the picture's first row is at v = 1."""
    picture = np.full((32, 32, 3), BLUE, np.uint8)
    picture[:16, :16] = RED
    Image.fromarray(picture).save(tmp_path / "labels.png")
    points, triangles = grid()
    upper = np.array([np.mean([points[corner][2] for corner in triangle]) for triangle in triangles]) > 0
    rules = PARTS.replace("vertex_colours", "texture")
    for named in (rules, rules + "    image: labels.png\n"):
        mesh = plate_obj(tmp_path / "plate.obj", "labels.png" if named is rules else "absent.png")
        assert np.array_equal(is_part(found(mesh, named, tmp_path), "left"), LEFT & upper)


def test_later_rules_win_and_that_is_said(tmp_path: Path) -> None:
    rules = """\
schema_version: 1
rules:
  - {kind: plane, part: left, point_mm: [0, 0, 0], normal: [-1, 0, 0]}
  - {kind: box, part: corner, low_mm: [-20, -1, -20], high_mm: [-10, 1, -10]}
rest: right
"""
    parts = found(plate_ply(tmp_path / "plate.ply"), rules, tmp_path)
    assert parts.counts() == {"left": 14, "corner": 2, "right": 16}
    assert parts.remarks == ("rule 2 comes later, and takes 2 triangles of 'left' for 'corner'",)


PLANE = "schema_version: 1\nrules:\n  - {kind: plane, part: left, point_mm: [0, 0, 0], normal: [-1, 0, 0]}\n"


@pytest.mark.parametrize(
    ("rules", "said"),
    [
        (PLANE, "parts.yaml:3:3: rules: 16 of 32 triangles have no part; name a part for them as `rest`"),
        (PLANE.replace("[-1, 0, 0]}", "[0, -1, 0]}") + "  - {kind: box, part: far, low_mm: [90, 0, 0], "
         "high_mm: [91, 1, 1]}\n", "parts.yaml:4:5: rules[1]: the part 'far' has no triangle"),
        (PLANE + "rest: left\n" + "extra: 1\n", "parts.yaml:5:1: extra: "),
        (PARTS.replace("#0000ff", "#00ff00"), "16 of 32 triangles have no part"),
        (PARTS.replace("#0000ff", "#00ff00") + "rest: other\n", "the part 'right' has no triangle: no rule gives "
         "it a triangle, or later rules took all of them; rule 1 (vertex_colours): 32 of 64 places differ from "
         "every part's colour by more than 8, most often #0000ff (32)"),
        (PARTS.replace("vertex_colours", "texture"), "parts.yaml:3:5: rules[0]: "),
        (PLANE.replace("normal: [-1, 0, 0]", "normal: [0, 0, 0]"), "the normal has no direction"),
        ("schema_version: 1\nrules:\n  - {kind: picked, path: absent.json}\n", "absent.json: no such file"),
    ],
)  # fmt: skip
def test_wrong_parts_are_refused_with_their_place(rules: str, said: str, tmp_path: Path) -> None:
    with pytest.raises(InputError) as refused:
        found(plate_ply(tmp_path / "plate.ply"), rules, tmp_path)
    assert said in str(refused.value)


def restoration(folder: Path, text: str, *names: str) -> Restoration:
    mesh = plate_ply(folder / "plate.ply")
    (folder / "parts.yaml").write_text(PARTS)
    (folder / "r.yaml").write_text(text)
    return checked_restoration(
        mesh, folder / "parts.yaml", folder / "r.yaml", Choice(names), "mm", lambda *_: None
    )


@pytest.mark.parametrize(
    ("old", "new", "said"),
    [
        ("      left: {kind: diffuse, reflectance: {kind: constant, value: 0.5}}\n", "",
         "r.yaml:10:7: hypotheses[0].materials: hypothesis light has no material for the part 'left'"),
        ("      left:", "      hat: {kind: metal}\n      left:", "r.yaml:10:12: hypotheses[0].materials.hat: "),
        ("pigment: {kind: shape, name: red_shape}", "pigment: {kind: paint_file, path: no.csv}", "no such file"),
        ("name: dark", "name: light", "two hypotheses have the same name"),
        ("kind: diffuse", "kind: difuse", "r.yaml:10:20: hypotheses[0].materials.left.kind: "),
        ("display: {white_cd_m2: 100}", "outputs: {xyz: false}", "pictures are shown and compared by X, Y, Z"),
        ("views: {kind: cameras", "views: {kind: camera", "r.yaml:19:15: views.kind: expected one of `turntable`"),
    ],
)  # fmt: skip
def test_wrong_hypotheses_are_refused_with_their_place(old: str, new: str, said: str, tmp_path: Path) -> None:
    with pytest.raises(InputError) as refused:
        restoration(tmp_path, RESTORATION.replace(old, new))
    assert said in str(refused.value)


def test_an_unknown_hypothesis_is_refused(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="--hypothesis golden: expected one of light, dark"):
        restoration(tmp_path, RESTORATION, "golden")


def test_cameras_that_are_found_see_all_of_the_object(tmp_path: Path) -> None:
    """By projecting its corners, independently of the rays; for a flat and a tall picture."""
    begins = RESTORATION.index("views:")
    rest = RESTORATION[RESTORATION.index("lights:") :]
    for views in ("auto", "{kind: turntable, views: 7, height_deg: 40, width_px: 300, height_px: 100}"):
        asked = restoration(tmp_path, f"{RESTORATION[:begins]}views: {views}\n{rest}")
        points = asked.corners_mm.reshape(-1, 3)
        for camera in asked.cameras:
            ahead = np.subtract(camera.target_mm, camera.position_mm) / np.linalg.norm(
                np.subtract(camera.target_mm, camera.position_mm)
            )
            right = np.cross(ahead, [0, 0, 1]) / np.linalg.norm(np.cross(ahead, [0, 0, 1]))
            way = points - camera.position_mm
            across = np.abs(way @ right / (way @ ahead)).max()
            along = np.abs(way @ np.cross(right, ahead) / (way @ ahead)).max() * camera.width_px / camera.height_px
            assert 0.6 < max(across, along) / np.tan(np.radians(camera.field_deg() / 2)) < 1.0


def picked(path: Path, points: Any, triangles: Any, parts: list[int]) -> Path:
    def coded(values: Any, kind: str) -> str:
        return base64.b64encode(np.asarray(values, kind).tobytes()).decode()

    numbers = {
        "vertices_mm": coded(points, "<f4"),
        "triangles": coded(triangles, "<u4"),
        "parts": coded(parts, "u1"),
    }
    path.write_text(
        json.dumps({"schema_version": 1, "kind": "picked parts", "names": ["front", "back"], **numbers})
    )
    return path


def test_painted_triangles_are_carried_to_a_finer_mesh_on_both_sides_of_a_thin_wall(tmp_path: Path) -> None:
    coarse = trimesh.creation.box((40.0, 1.0, 40.0)).subdivide().subdivide()
    facing = np.where(coarse.face_normals[:, 1] < -0.5, 1, 2)
    fine = coarse.subdivide().subdivide()
    fine.export(tmp_path / "fine.ply")
    path = picked(tmp_path / "parts.json", coarse.vertices, coarse.faces, facing.tolist())
    parts = parts_of(read_painted(tmp_path / "fine.ply"), *read_parts(path))
    assert np.array_equal(is_part(parts, "front"), fine.face_normals[:, 1] < -0.5)


def test_a_picked_file_whose_numbers_do_not_fit_is_refused(tmp_path: Path) -> None:
    points, triangles = grid()
    path = picked(tmp_path / "parts.json", points, triangles, [1] * (len(triangles) - 1))
    with pytest.raises(InputError, match="31 marks do not fit together"):
        parts_of(read_painted(plate_ply(tmp_path / "plate.ply")), *read_parts(path))


def test_shipped_restorations_are_whole() -> None:
    folder = Path(__file__).parents[2] / "configs" / "restorations"
    document, given = read_restoration(folder / "bust.yaml")
    wanted = checked_restoration(
        folder / "bust.ply",
        folder / "bust-parts.yaml",
        document.path,
        Choice(),
        "mm",
        lambda *_: None,
    )
    assert len(wanted.hypotheses) == len(given.hypotheses) == 3
    assert min(wanted.parts.counts().values()) > 100
    assert not wanted.parts.remarks


def test_a_camera_sees_a_part_where_it_is_and_not_behind_something_else() -> None:
    """A triangle in the upper left corner, and one in the lower right behind a sheet."""
    camera = Camera.model_validate(
        {"name": "c", "position_mm": [0, -1000, 0], "target_mm": [0, 0, 0], "width_px": 20, "height_px": 20,
         "optics": {"kind": "field", "degrees": 4}}
    )  # fmt: skip
    upper_left = np.array([[[-30.0, 0, 30], [-20, 0, 30], [-20, 0, 20]]])
    sheet = np.array([[[0.0, -1, 0], [60, -1, 0], [60, -1, -60]], [[0, -1, 0], [60, -1, -60], [0, -1, -60]]])
    covered = Piece(sheet, Metal(kind="metal"))
    corners = np.concatenate([upper_left, -upper_left])
    seen = SeenParts(corners, np.array([0, 1], np.int16), [covered]).part_of_pixel(camera)
    rows, columns = np.nonzero(seen == 0)
    assert set(np.unique(seen)) == {-1, 0}
    assert (rows.max() <= 5, columns.max() <= 5, rows.min() >= 1) == (True, True, True)
    assert np.array_equal(
        np.unique(SeenParts(corners, np.array([0, 1], np.int16), []).part_of_pixel(camera)), [-1, 0, 1]
    )


def test_a_triangle_takes_the_part_of_two_of_its_corners_or_the_first_that_is_known(tmp_path: Path) -> None:
    points = [(0, 0, 0), (1, 0, 0), (0, 1, 0), (1, 1, 0)]
    colours = [RED, BLUE, BLUE, (0, 255, 0)]
    mixed = trimesh.Trimesh(points, [(0, 1, 2), (3, 1, 0), (3, 0, 1)], vertex_colors=colours, process=False)
    mixed.export(tmp_path / "mixed.ply")
    parts = found(tmp_path / "mixed.ply", PARTS, tmp_path)
    assert [parts.names[label] for label in parts.labels] == ["right", "right", "left"]


def test_parts_that_were_painted_on_a_mesh_elsewhere_are_refused(tmp_path: Path) -> None:
    points, triangles = grid()
    moved = np.add(points, (300.0, 0.0, 0.0))
    path = picked(tmp_path / "parts.json", moved, triangles, [1] * (len(triangles) - 1) + [2])
    with pytest.raises(InputError, match="painted on a mesh that lies elsewhere: 100 % of it"):
        parts_of(read_painted(plate_ply(tmp_path / "plate.ply")), *read_parts(path))


def test_other_lights_are_taken_by_their_name(tmp_path: Path) -> None:
    candle = "{kind: environment, luminance_cd_m2: 5, spectrum: {kind: illuminant, name: A}}"
    text = f"{RESTORATION}other_lights:\n  - {{name: candles, lights: [{candle}]}}\n"
    document = restoration(tmp_path, text).document
    asked = chosen_file(document, document.validate(RestorationFile), Choice(lights="candles"))
    assert [light.luminance_cd_m2 for light in asked.lights if light.kind == "environment"] == [5.0]
    with pytest.raises(InputError, match=r"--lights sun: expected one of the lights of .*: candles"):
        chosen_file(document, document.validate(RestorationFile), Choice(lights="sun"))
