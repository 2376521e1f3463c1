"""Charts of a mesh and their places in a texture: nothing of a surface is lost, or shown at two places."""

from __future__ import annotations

import re

import numpy as np
import pytest
import trimesh
from places import REPO

from coupole.errors import InputError
from coupole.exchange.atlas.atlas_layout import PADDING_PX, Atlas, MapSize, lay_out
from coupole.exchange.atlas.charts import chart_axes, cut_charts, double_areas, neighbours_of, unit
from coupole.exchange.atlas.open_sky import open_sky


def ramp_beside_a_plain() -> trimesh.Trimesh:
    """A ramp that winds about z, all of it facing up, floors above floors; so few of all triangles that one chart
    takes it."""
    angle, radius = np.meshgrid(np.linspace(0, 2 * np.pi * 2.6, 80), np.linspace(10, 20, 4), indexing="ij")
    ramp = np.stack([radius * np.cos(angle), radius * np.sin(angle), 0.6 * angle], axis=-1)
    x, y = np.meshgrid(np.linspace(30, 90, 200), np.linspace(0, 60, 200))
    plain = np.stack([x, y, np.zeros_like(x)], axis=-1).transpose(1, 0, 2)
    corners = np.concatenate([sheet(ramp), sheet(plain)])
    return trimesh.Trimesh(corners.reshape(-1, 3), np.arange(3 * len(corners)).reshape(-1, 3)).process()


def sheet(points: np.ndarray) -> np.ndarray:
    """[n, 3, 3] triangles of a grid of points."""
    a, b, c, d = points[:-1, :-1], points[1:, :-1], points[1:, 1:], points[:-1, 1:]
    return np.concatenate([np.stack(three, axis=2).reshape(-1, 3, 3) for three in ((a, c, b), (a, d, c))])


MESHES = {
    "ball": trimesh.creation.icosphere(4, 30.0),
    "ring": trimesh.creation.torus(30.0, 9.0, 96, 48),
    "box": trimesh.creation.box((20.0, 30.0, 40.0)).subdivide_to_size(3.0),
    "ramp": ramp_beside_a_plain(),
    "relief": trimesh.load(REPO / "configs/objects/relief.ply", process=True),
}
TEXEL_MM = 0.5


@pytest.fixture(scope="module", params=list(MESHES))
def mesh(request: pytest.FixtureRequest) -> trimesh.Trimesh:
    return MESHES[request.param]


@pytest.fixture(scope="module")
def atlas(mesh: trimesh.Trimesh) -> Atlas:
    return lay_out(np.asarray(mesh.triangles), np.asarray(mesh.faces), MapSize(TEXEL_MM, 16384))


def places_on(mesh: trimesh.Trimesh, atlas: Atlas, count: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Places [n, 3] on the mesh, random and even by area, their triangles, and where the atlas has them, px."""
    random = np.random.default_rng(3)
    triangle = random.choice(len(mesh.faces), count, p=mesh.area_faces / mesh.area)
    weights = random.dirichlet([1.0, 1.0, 1.0], count)
    places_mm = np.einsum("nc,ncx->nx", weights, np.asarray(mesh.triangles)[triangle])
    return places_mm, triangle, np.einsum("nc,ncx->nx", weights, atlas.corners_px[triangle])


def test_each_place_of_a_surface_is_shown_by_its_texel(mesh: trimesh.Trimesh, atlas: Atlas) -> None:
    places_mm, triangle, px = places_on(mesh, atlas, 20_000)
    column, row = np.floor(px).astype(int).T
    shown_mm = atlas.places_mm(np.asarray(mesh.triangles), row * atlas.side_px + column)
    cosine = np.einsum(
        "nk,nk->n", mesh.face_normals, chart_axes(np.asarray(mesh.triangles), atlas.chart)[atlas.chart]
    )
    off_mm = np.linalg.norm(shown_mm - places_mm, axis=1)
    stretched_mm = TEXEL_MM / np.maximum(cosine[triangle], 0.05)
    assert (off_mm <= 0.75 * TEXEL_MM + 1.5 * stretched_mm).mean() > 0.999
    assert np.quantile(off_mm, 0.99) < 3 * TEXEL_MM


def test_charts_are_faced_and_hang_together(mesh: trimesh.Trimesh) -> None:
    corners_mm, neighbours = np.asarray(mesh.triangles), neighbours_of(np.asarray(mesh.faces))
    chart = cut_charts(corners_mm, neighbours)
    assert (chart >= 0).all()
    facing = np.einsum("nk,nk->n", unit(double_areas(corners_mm)), chart_axes(corners_mm, chart)[chart])
    assert (facing > 0.0).mean() > 0.999
    within = [(a, b) for a, three in enumerate(neighbours) for b in three if b >= 0 and chart[a] == chart[b]]
    parts = trimesh.graph.connected_components(np.array(within), nodes=np.arange(len(chart)))
    assert len(parts) == chart.max() + 1 < len(chart) / 20


def test_neighbours_are_those_of_trimesh(mesh: trimesh.Trimesh) -> None:
    ours = {
        (min(a, b), max(a, b))
        for a, three in enumerate(neighbours_of(np.asarray(mesh.faces)))
        for b in three
        if b >= 0
    }
    assert ours == {(min(a, b), max(a, b)) for a, b in mesh.face_adjacency.tolist()}


def test_texels_are_as_large_as_asked(mesh: trimesh.Trimesh, atlas: Atlas) -> None:
    axes = chart_axes(np.asarray(mesh.triangles), atlas.chart)[atlas.chart]
    faced_mm2 = float(np.sum(mesh.area_faces * np.abs(np.einsum("nk,nk->n", mesh.face_normals, axes))))
    assert atlas.is_inside.sum() * TEXEL_MM**2 == pytest.approx(faced_mm2, rel=0.02)
    assert faced_mm2 > 0.75 * mesh.area


def test_padding_goes_on_from_the_nearest_triangle(mesh: trimesh.Trimesh, atlas: Atlas) -> None:
    padding = np.flatnonzero(((atlas.triangle_of_texel >= 0) & ~atlas.is_inside).reshape(-1))
    assert len(padding) > 100
    weights = atlas.barycentric(padding)
    np.testing.assert_allclose(weights.sum(axis=1), 1.0, atol=1e-9)
    triangles = np.asarray(mesh.triangles)[atlas.triangle_of_texel.reshape(-1)[padding]]
    flat = atlas.places_mm(np.asarray(mesh.triangles), padding)
    np.testing.assert_allclose(flat, np.einsum("nc,ncx->nx", weights, triangles), atol=1e-6)
    row, column = np.divmod(padding, atlas.side_px)
    inside = np.argwhere(atlas.is_inside)
    distance = [np.abs(inside - [r, c]).max(axis=1).min() for r, c in zip(row[::97], column[::97], strict=True)]
    assert max(distance) <= PADDING_PX


def test_what_is_too_large_says_what_would_do() -> None:
    ball = MESHES["ball"]
    with pytest.raises(InputError, match="--texel-mm") as refused:
        lay_out(np.asarray(ball.triangles), np.asarray(ball.faces), MapSize(0.05, 2048))
    enough = re.search(r"give --texel-mm ([0-9.]+)", str(refused.value))
    assert enough is not None
    assert (
        lay_out(np.asarray(ball.triangles), np.asarray(ball.faces), MapSize(float(enough[1]), 2048)).side_px
        <= 2048
    )


def test_texels_become_coarser_until_a_map_is_as_small_as_asked() -> None:
    """And a map in which not even padding has room says how large it has to be."""
    relief = MESHES["relief"]
    corners_mm, triangles = np.asarray(relief.triangles), np.asarray(relief.faces)
    small = lay_out(corners_mm, triangles, MapSize(0.01, 1024, may_be_coarser=True))
    assert 900 < small.side_px <= 1024
    assert small.texel_mm > 0.05
    with pytest.raises(InputError, match=r"charts need a map (\d+) px wide; give --map-px \1") as refused:
        lay_out(corners_mm, triangles, MapSize(0.5, 64, may_be_coarser=True))
    enough = int(str(refused.value).rpartition(" ")[2])
    assert lay_out(corners_mm, triangles, MapSize(0.5, enough, may_be_coarser=True)).side_px <= enough


def test_the_open_sky_of_a_corner_and_of_a_groove() -> None:
    """On a floor at the foot of an endless wall half of the sky is open; at the bottom of a long groove of half
    angle a, sin a of it (the view factor of its mouth)."""
    far = 4000.0
    floor = [[[-far, -far, 0], [far, -far, 0], [far, far, 0]], [[-far, -far, 0], [far, far, 0], [-far, far, 0]]]
    wall = [[[0, -far, 0], [0, far, 0], [0, far, far]], [[0, -far, 0], [0, far, far], [0, -far, far]]]
    at, up = np.array([[3.0, 0.0, 0.0], [-3.0, 0.0, 0.0]]), np.tile([0.0, 0.0, 1.0], (2, 1))
    np.testing.assert_allclose(open_sky(np.array(floor + wall, float), at, up), 0.5, atol=0.05)
    np.testing.assert_allclose(open_sky(np.array(floor, float), at, up), 1.0)
    angle, foot, tip = (
        np.radians(40.0),
        [0.0, far, 0.0],
        60.0 * np.array([np.sin(np.radians(40.0)), 0.0, np.cos(np.radians(40.0))]),
    )
    sides = []
    for mirrored in ([1, 1, 1], [-1, 1, 1]):
        near_foot, near_tip, far_tip = -np.array(foot), tip * mirrored - foot, tip * mirrored + foot
        sides += [[near_foot, foot, far_tip], [near_foot, far_tip, near_tip]]
    found = open_sky(np.array(sides, float), np.array([[0.0, 0.0, 0.5]]), up[:1])
    assert found[0] == pytest.approx(np.sin(angle), abs=0.05)
