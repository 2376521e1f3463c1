"""Texture coordinates of a mesh as other programs write it: found again on a result's triangles, or refused."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import trimesh
from places import REPO

from coupole.errors import InputError
from coupole.exchange.atlas.atlas_layout import MapSize, lay_out, lay_out_given
from coupole.exchange.atlas.textured_mesh import TexturedMesh, read_textured_mesh

TURN = trimesh.transformations.rotation_matrix(1.1, [0.3, -0.5, 0.8])[:3, :3]


@pytest.fixture(scope="module")
def scan() -> trimesh.Trimesh:
    """A relief with the noise of a scanner, so that no two triangles are alike."""
    mesh = trimesh.load(REPO / "configs/objects/relief.ply", process=True).copy()
    mesh.update_faces(mesh.face_normals[:, 2] > 0.2)
    mesh.remove_unreferenced_vertices()
    mesh.vertices = mesh.vertices + np.random.default_rng(2).normal(0.0, 0.02, mesh.vertices.shape)
    return mesh


def large_parts(chart: np.ndarray) -> int:
    """The ground and the tops of two blocks are such; sides are left out, and noise parts single triangles."""
    return int(np.count_nonzero(np.bincount(chart) > 100))


def seen_from_above(points: np.ndarray) -> np.ndarray:
    """[n, 2] u and v (upwards) of points [n, 3], 0.1 to 0.9."""
    low, high = points[:, :2].min(axis=0), points[:, :2].max(axis=0)
    return 0.1 + 0.8 * (points[:, :2] - low) / (high - low).max()


def written(mesh: trimesh.Trimesh, path: Path, faces: np.ndarray, uv: np.ndarray) -> Path:
    """By trimesh: in metres, turned, elsewhere, with these faces."""
    vertices = 1e-3 * (np.asarray(mesh.vertices) @ TURN.T) + [0.2, -0.1, 0.4]
    visual = trimesh.visual.TextureVisuals(uv=uv)
    other = trimesh.Trimesh(vertices, faces, visual=visual, process=False)
    path.write_bytes(
        other.export(file_type=path.suffix[1:], **({"digits": 7} if path.suffix == ".obj" else {})).encode()
        if path.suffix == ".obj"
        else other.export(file_type=path.suffix[1:])
    )
    return path


@pytest.mark.parametrize("suffix", [".obj", ".ply", ".glb"])
@pytest.mark.parametrize("order", ["same", "mixed", "part"])
def test_triangles_are_found_in_files_of_others(
    scan: trimesh.Trimesh, tmp_path: Path, suffix: str, order: str
) -> None:
    """Whatever unit, position, order, first corner; and where a part was cut away, the rest."""
    random, faces = np.random.default_rng(5), np.asarray(scan.faces)
    numbers = np.arange(len(faces)) if order == "same" else random.permutation(len(faces))
    numbers = numbers[: int(0.7 * len(faces))] if order == "part" else numbers
    mixed = faces[numbers]
    if order != "same":
        turns = random.integers(0, 3, len(mixed))
        mixed = np.take_along_axis(mixed, (np.arange(3) + turns[:, None]) % 3, axis=1)
    uv = seen_from_above(np.asarray(scan.vertices))
    path = written(scan, tmp_path / f"model{suffix}", mixed, uv)
    rows, places = read_textured_mesh(path).shared_with(np.asarray(scan.triangles))
    np.testing.assert_array_equal(rows, np.sort(numbers))
    np.testing.assert_allclose(places, (uv * [1, -1] + [0, 1])[faces[rows]], atol=2e-6)


def test_another_mesh_is_refused(scan: trimesh.Trimesh, tmp_path: Path) -> None:
    """One whose shape changed: simplified, smoothed, or of another scan."""
    other = scan.copy()
    other.vertices = other.vertices + np.random.default_rng(9).normal(0.0, 0.05, other.vertices.shape)
    path = written(
        other, tmp_path / "other.ply", np.asarray(other.faces), seen_from_above(np.asarray(other.vertices))
    )
    with pytest.raises(InputError, match=r"has 0 of the result's 16,946 triangles; expected the mesh"):
        read_textured_mesh(path).shared_with(np.asarray(scan.triangles))


QUAD = "v 0 0 0\nv 1 0 0\nv 1 1 0\nv 0 1 0\n"


@pytest.mark.parametrize(
    ("text", "told"),
    [
        (QUAD + "f 1 2 3\n", "has no texture coordinates"),
        (
            QUAD + "vt 0 0\nvt 1.4 0\nvt 1 1\nf 1/1 2/2 3/3\nf 1/1 3/3 4/3\n",
            "1 of 2 triangles lie outside the texture",
        ),
        (QUAD, "has no triangles"),
        ("", "--uv"),
        ("v 0 0 x\nf 1 1 1\n", "cannot be read"),
    ],
)
def test_files_that_cannot_be_are_refused(tmp_path: Path, text: str, told: str) -> None:
    path = tmp_path / "bad.obj"
    path.write_text(text)
    with pytest.raises(InputError, match="--uv") as refused:
        read_textured_mesh(path)
    assert told in str(refused.value)


@pytest.mark.parametrize("name", ["mesh.stl", "none.obj"])
def test_names_that_cannot_be_are_refused(tmp_path: Path, name: str) -> None:
    if name.endswith("stl"):
        (tmp_path / name).write_bytes(trimesh.creation.box().export(file_type="stl"))
    with pytest.raises(InputError, match="--uv"):
        read_textured_mesh(tmp_path / name)


def test_each_place_has_its_texel_where_charts_are_given(scan: trimesh.Trimesh) -> None:
    corners_mm, faces = np.asarray(scan.triangles), np.asarray(scan.faces)
    places = (seen_from_above(np.asarray(scan.vertices)) * [1, -1] + [0, 1])[faces]
    atlas = lay_out_given(places, corners_mm, faces, MapSize(0.3, 4096))
    assert large_parts(atlas.chart) == 3
    assert (atlas.handedness == 1.0).mean() > 0.99
    texels = np.flatnonzero(atlas.is_inside.reshape(-1))
    shown = seen_from_above(np.concatenate([atlas.places_mm(corners_mm, texels), np.asarray(scan.vertices)]))
    row, column = np.divmod(texels, atlas.side_px)
    expected = np.stack([(column + 0.5) / atlas.side_px, 1.0 - (row + 0.5) / atlas.side_px], axis=1)
    np.testing.assert_allclose(shown[: len(texels)], expected, atol=1e-6)
    assert atlas.texel_mm == pytest.approx(0.3, rel=0.03)
    ours = lay_out(corners_mm, faces, MapSize(0.3, 4096))
    assert atlas.is_inside.sum() == pytest.approx(ours.is_inside.sum(), rel=0.15)


def test_mirrored_charts_are_told_and_stacked_ones_refused(scan: trimesh.Trimesh) -> None:
    """Half of it mirrored about its middle lies on the other half; beside it, it is a chart of its own."""
    corners_mm, faces = np.asarray(scan.triangles), np.asarray(scan.faces)
    places = (seen_from_above(np.asarray(scan.vertices)) * [1, -1] + [0, 1])[faces]
    middle = 0.5 * (places[..., 0].min() + places[..., 0].max())
    is_right = places[..., 0].mean(axis=1) > middle
    stacked = places.copy()
    stacked[is_right, :, 0] = 2.0 * middle - places[is_right, :, 0]
    with pytest.raises(InputError, match="% of the surface shares texels with other parts"):
        lay_out_given(stacked, corners_mm, faces, MapSize(0.3, 4096))
    apart = 0.5 * stacked
    apart[is_right, :, 0] += 0.5
    atlas = lay_out_given(apart, corners_mm, faces, MapSize(0.3, 4096))
    for sides in (atlas.chart[atlas.handedness > 0], atlas.chart[atlas.handedness < 0]):
        assert large_parts(sides) >= 1
    assert not np.intersect1d(atlas.chart[atlas.handedness > 0], atlas.chart[atlas.handedness < 0]).size
    assert (atlas.handedness[is_right] == -1.0).mean() > 0.99
    assert (atlas.handedness[~is_right] == 1.0).mean() > 0.99


def test_given_charts_have_the_sizes_that_are_asked(scan: trimesh.Trimesh) -> None:
    corners_mm, faces = np.asarray(scan.triangles), np.asarray(scan.faces)
    places = (seen_from_above(np.asarray(scan.vertices)) * [1, -1] + [0, 1])[faces]
    with pytest.raises(InputError, match="give --texel-mm"):
        lay_out_given(places, corners_mm, faces, MapSize(0.01, 512))
    assert lay_out_given(places, corners_mm, faces, MapSize(0.01, 512, may_be_coarser=True)).side_px == 512


def test_a_file_of_few_triangles_has_no_shape_to_go_by() -> None:
    corners = np.random.default_rng(1).normal(size=(5, 3, 3))
    own = TexturedMesh(Path("few.obj"), corners, np.zeros((5, 3, 2)))
    with pytest.raises(InputError, match="has 0 of the result's 40 triangles"):
        own.shared_with(np.random.default_rng(2).normal(size=(40, 3, 3)))
