"""Urushi on bodies: where its flakes and grains lie, and what its lacquer takes from light."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
import trimesh
from PIL import Image
from pydantic import TypeAdapter
from spectral_scenes import camera, everywhere, illuminant, plane, rendered, scene

from coupole.appearance.matter import lacquer
from coupole.appearance.optics import fresnel, indices
from coupole.appearance.render.materials import Glass, Metal
from coupole.appearance.render.objects import Object, pieces
from coupole.appearance.render.pieces import Piece
from coupole.appearance.render.spectra import scaled_power
from coupole.appearance.shapes.triangles import flat_normals
from coupole.appearance.spectra import light
from coupole.errors import InputError

HERE = Path()
RADIUS_MM, DEPTH_MM = 20.0, 0.5
BALL = {
    "kind": "turned",
    "profile_mm": [
        (0.0 if k in {0, 60} else RADIUS_MM * np.sin(np.pi * k / 60), RADIUS_MM * np.cos(np.pi * k / 60))
        for k in range(61)
    ],
}


def built(**thing: Any) -> list[Piece]:
    found = pieces(TypeAdapter(Object).validate_python(thing), HERE)
    assert all(isinstance(piece, Piece) for piece in found)
    return [piece for piece in found if isinstance(piece, Piece)]


@pytest.mark.parametrize("elevation_deg", [80.0, 50.0, 32.0])
def test_lacquer_absorbs_along_the_refracted_way(elevation_deg: float) -> None:
    """A mirror of gold under lacquer, in light from everywhere: the sum of all ways between the two, each absorbed
    over the depth by the cosine that Snell's law gives. Along the normal it would be 20 % more at 32 degrees."""
    gold = {"kind": "metal", "roughness": 0.01, "depth_mm": 0.0, "face": False}
    amber = {"kind": "glass", "index": indices.URUSHI, "absorption": {"kind": "urushi"}}
    planes = [plane(gold), {**plane(amber), "translation_mm": [0.0, 0.0, DEPTH_MM]}]
    one = scene(
        planes,
        [everywhere(illuminant("E"))],
        cameras=[camera(elevation_deg)],
        samples=300,
        bands={"step_nm": 40},
        depth=16,
    )
    reflected = rendered(one).radiance.mean(axis=(0, 1)) / scaled_power(light.illuminant("E"), 100.0)[::8]
    cosine = np.sin(np.radians(elevation_deg))
    inside = np.sqrt(1.0 - (1.0 - cosine**2) / indices.URUSHI**2)
    face = float(fresnel.reflectance(cosine, indices.URUSHI))
    twice = np.exp(-2.0 * DEPTH_MM / inside * lacquer.urushi_absorption())[::8]
    mirror = np.ravel(fresnel.reflectance(inside, indices.gold() / indices.URUSHI))[::8] * twice
    expected = face + (1.0 - face) ** 2 * mirror / (1.0 - face * mirror)
    assert reflected == pytest.approx(expected, rel=0.025, abs=0.006)
    assert expected[-1] > 3.0 * expected[0]


def test_flakes_lie_in_the_curved_lacquer_tilted_to_the_normal_there() -> None:
    body, flakes, face = built(kind="nashiji", body=BALL, depth_mm=DEPTH_MM, flakes_per_mm2=1.0, tilt_deg=6.0)

    assert isinstance(face.material, Glass)
    assert isinstance(flakes.material, Metal)
    one = flakes.corners_mm.reshape(-1, 16, 3, 3)
    away_mm = np.linalg.norm(flakes.corners_mm, axis=2)
    assert len(one) == pytest.approx(4.0 * np.pi * (RADIUS_MM + 0.5 * DEPTH_MM) ** 2, rel=0.05)
    assert np.linalg.norm(body.corners_mm, axis=2).max() < away_mm.min()
    nearest_mm = np.linalg.norm(face.corners_mm.mean(axis=1), axis=1).min()
    assert away_mm.max() < nearest_mm
    middle = one.mean(axis=(1, 2))
    depth_mm = RADIUS_MM + DEPTH_MM - np.linalg.norm(middle, axis=1)
    assert 0.0 < depth_mm.min() < 0.1
    assert 0.4 < depth_mm.max() < DEPTH_MM
    normals = flat_normals(flakes.corners_mm).reshape(-1, 16, 3)
    upward = middle / np.linalg.norm(middle, axis=1, keepdims=True)
    cosines = np.abs(np.einsum("nkj,nj->nk", normals, upward)).mean(axis=1)
    tilt_deg = np.degrees(np.arctan(np.sqrt(np.mean(np.tan(np.arccos(np.minimum(cosines, 1.0))) ** 2))))
    assert tilt_deg == pytest.approx(6.0, rel=0.1)


def test_the_default_bowl_and_a_box_are_closed_bodies() -> None:
    for body in ({"kind": "turned"}, {"kind": "box", "size_mm": [30, 20, 10], "edge_mm": 2}):
        corners = built(kind="nashiji", body=body, flakes_per_mm2=0.01)[0].corners_mm
        mesh = trimesh.Trimesh(**trimesh.triangles.to_kwargs(corners))
        mesh.merge_vertices(digits_vertex=6)
        assert mesh.is_watertight
        assert mesh.volume > 0.0
    # A box less its rounded edges and corners: quarter cylinders and the corners' ball.
    r, inner = 2.0, np.array([26.0, 16.0, 6.0])
    expected = inner.prod() + 2 * r * (inner[0] * inner[1] + inner[1] * inner[2] + inner[2] * inner[0])
    expected += np.pi * r**2 * inner.sum() + 4.0 / 3.0 * np.pi * r**3
    assert mesh.volume == pytest.approx(expected, rel=2e-3)


def test_a_drawn_picture_lies_on_each_side_upright_and_covers_its_share(tmp_path: Path) -> None:
    drawn = np.zeros((40, 80), np.uint8)
    drawn[:20, 40:] = 255  # the right upper quarter
    Image.fromarray(drawn).save(tmp_path / "drawn.png")
    powder, bare = built(
        kind="makie",
        body={"kind": "box", "size_mm": [40, 40, 20], "edge_mm": 1},
        drawing={"kind": "picture", "path": str(tmp_path / "drawn.png"), "width_mm": 40},
        density=1.0,
        grain_mm=0.5,
        metal={"kind": "metal", "gold": 0.0},
    )

    assert isinstance(powder.material, Metal)
    assert powder.material.gold == 0.0
    normals = flat_normals(powder.corners_mm)
    middles = powder.corners_mm.mean(axis=1)
    front = middles[normals[:, 1] < -0.99]  # seen from -y: right is +x, up is +z
    assert front[:, [0, 2]].min(axis=0) == pytest.approx([0.0, 10.0], abs=1.0)
    back = middles[normals[:, 1] > 0.99]
    assert back[:, 0].max() == pytest.approx(0.0, abs=1.0)
    top = middles[normals[:, 2] > 0.99]  # seen from above: up is +y; 20 mm of the picture's height
    assert (top[:, 0].min(), top[:, 1].min(), top[:, 1].max()) == pytest.approx((0.0, 0.0, 10.0), abs=1.0)
    area = [float(trimesh.triangles.area(piece.corners_mm).sum()) for piece in (powder, bare)]
    assert area[0] / sum(area) == pytest.approx((2 * 20 * 10 + 4 * 20 * 10) / 6400, abs=0.03)


def test_takamakie_rises_where_it_is_drawn_and_nowhere_else(tmp_path: Path) -> None:
    Image.fromarray(np.full((10, 10), 255, np.uint8)).save(tmp_path / "full.png")
    thing = {
        "kind": "makie",
        "body": {"kind": "box", "size_mm": [30, 30, 10], "edge_mm": 1},
        "drawing": {"kind": "picture", "path": str(tmp_path / "full.png"), "width_mm": 8},
        "wrapped": "above",
        "grain_mm": 0.5,
        "density": 1.0,
    }
    powder, bare = built(**thing, raised_mm=0.3)
    lid = powder.corners_mm[flat_normals(powder.corners_mm)[:, 2] > 0.99]
    assert lid[..., 2].max() == pytest.approx(10.3)
    assert np.median(lid[..., 2]) == pytest.approx(10.3)
    far = bare.corners_mm[np.abs(bare.corners_mm.mean(axis=1)[:, :2]).max(axis=1) > 5.0]
    assert far[..., 2].max() == pytest.approx(10.0)


def test_a_drawing_by_texture_coordinates_follows_the_mesh(tmp_path: Path) -> None:
    drawn = np.zeros((64, 64), np.uint8)
    drawn[:, :32] = 255
    Image.fromarray(drawn).save(tmp_path / "left.png")
    # A square whose texture runs along its y.
    (tmp_path / "sheet.obj").write_text(
        "v 0 0 0\nv 10 0 0\nv 10 10 0\nv 0 10 0\nvt 0 0\nvt 0 1\nvt 1 1\nvt 1 0\nf 1/1 2/2 3/3\nf 1/1 3/3 4/4\n"
    )
    powder, bare = built(
        kind="makie",
        body={"kind": "mesh", "path": str(tmp_path / "sheet.obj")},
        drawing={"kind": "picture", "path": str(tmp_path / "left.png"), "width_mm": 1},
        wrapped="uv",
        density=1.0,
    )
    assert powder.corners_mm.mean(axis=1)[:, 1].max() == pytest.approx(5.0, abs=0.4)
    assert bare.corners_mm.mean(axis=1)[:, 1].min() == pytest.approx(5.0, abs=0.4)


@pytest.mark.parametrize(
    ("thing", "told"),
    [
        ({"body": {"kind": "turned", "profile_mm": [(0, 0), (10, 0), (0, 10)]}}, "opposite order"),
        ({"body": {"kind": "turned", "profile_mm": [(1, 0), (10, 0), (0, 10)]}}, "axis"),
        ({"body": {"kind": "turned"}, "flakes_per_mm2": 1000}, "sprinkle fewer"),
        ({"body": {"kind": "turned"}, "depth_mm": 60}, "thinner"),
        ({"body": {"kind": "box", "size_mm": [9, 9, 9], "edge_mm": 8}}, "half its least side"),
    ],
)
def test_impossible_bodies_are_refused(thing: dict[str, Any], told: str) -> None:
    with pytest.raises(InputError, match=told):
        built(kind="nashiji", **thing)


def test_texture_coordinates_that_are_not_there_are_refused() -> None:
    thing = {"kind": "makie", "body": {"kind": "turned"}, "drawing": {"kind": "motif", "name": "waves"}}
    with pytest.raises(InputError, match="no texture coordinates"):
        built(**thing, wrapped="uv")


def test_a_turntable_turns_objects_about_the_scenes_axis() -> None:
    ball = {"kind": "sphere", "radius_mm": 5, "translation_mm": [10, 0, 3], "abc_deg": [5, 10, 15]}
    black = {"kind": "lacquer"}
    one = scene(
        [{**ball, "material": black}, plane(black)], [everywhere(illuminant("E"))], turntable={"frames": 4}
    )
    assert one.turntable is not None
    assert one.turntable.angles_deg() == [0.0, 90.0, 180.0, 270.0]
    turned = one.turned_about_z(90.0).objects
    assert turned[0].translation_mm == pytest.approx((0.0, 10.0, 3.0))
    quarter = np.array([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])
    before = one.objects[0].scene_from_thing()[:3, :3]
    assert turned[0].scene_from_thing()[:3, :3] == pytest.approx(quarter @ before)
    assert turned[1] == one.objects[1]


def test_polarised_light_through_lacquer_is_refused() -> None:
    amber = {"kind": "glass", "absorption": {"kind": "urushi"}}
    one = scene([plane(amber)], [everywhere(illuminant("E"))], bands={"step_nm": 40}, polarisation=True)
    with pytest.raises(InputError, match="no absorbing body"):
        rendered(one)
