"""Which triangle a pixel sees: against rays, at the near plane, and with any number of threads."""

from __future__ import annotations

import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray
from places import REPO
from scenes import BENT, camera_above, hits, quad, rays, relief, scene_of, sphere

from coupole.geometry import Transform
from sim.render.lens import NO_DISTORTION, Distortion, Lens, sight
from sim.render.raster import visible_triangles

ROOT = REPO
LENS = Lens(160, 120, 200.0)
NO_TRIANGLE = -1


def ids(corners_mm: NDArray[np.float64], lens: Lens, pose: Transform) -> NDArray[np.int32]:
    """[h, w] triangle of the scene that each pixel sees, or -1."""
    pixels, seen = visible_triangles(scene_of(corners_mm).corners_mm, sight(lens), pose)
    return np.where(pixels >= 0, seen[pixels], NO_TRIANGLE) if len(seen) else pixels


@pytest.mark.parametrize("distortion", [NO_DISTORTION, BENT])
@pytest.mark.parametrize("tilt_deg", [3.0, 55.0])
def test_pixels_see_what_rays_hit(
    distortion: Distortion, tilt_deg: float, scale: Callable[[int, int], int]
) -> None:
    factor = scale(1, 4)
    lens = Lens(160 * factor, 120 * factor, 200.0 * factor, distortion)
    corners = np.concatenate([quad((0, 0, -20), 2000.0), relief(120, 40 * factor, 5.0), sphere(30.0, 3)])
    pose = camera_above(200.0, tilt_deg)
    expected = hits(scene_of(corners).corners_mm, pose[:3, 3], rays(lens, pose))
    assert (ids(corners, lens, pose) == expected).mean() > 0.9995  # the rest: rays that graze an edge


@settings(max_examples=25)
@given(
    corners=st.lists(st.floats(-300, 300), min_size=27, max_size=27),
    distortion=st.sampled_from([NO_DISTORTION, BENT]),
)
def test_large_triangles_that_reach_behind_the_camera_are_neither_dropped_nor_bent_wrongly(
    corners: list[float], distortion: Distortion
) -> None:
    lens = Lens(64, 48, 60.0, distortion)
    triangles = np.array(corners).reshape(3, 3, 3)
    pose = camera_above(50.0)
    depth = 50.0 - triangles[..., 2]
    crossing_near = (depth.min(axis=1) < 2.0) & (depth.max(axis=1) > 0.0)
    seen = ids(triangles, lens, pose)
    ways = rays(lens, pose)
    expected = hits(scene_of(triangles).corners_mm, pose[:3, 3] + 0.0, ways)
    nearer = np.zeros(seen.shape, bool)
    for t in np.flatnonzero(crossing_near):
        # Rays start at the projection centre, the picture 1 mm in front of it.
        normal = np.cross(triangles[t, 1] - triangles[t, 0], triangles[t, 2] - triangles[t, 0])
        with np.errstate(divide="ignore", invalid="ignore"):
            nearer |= (expected == t) & ~(
                np.abs((triangles[t, 0] - pose[:3, 3]) @ normal / (ways @ normal)) > 1.001
            )
    assert ((seen == expected) | nearer).mean() > 0.995


def test_a_plane_through_half_the_picture_ends_at_its_horizon() -> None:
    picture = ids(quad((0, 0, -10), 1e5), LENS, camera_above(0.001, 90.0))
    assert np.all(picture[:59] == NO_TRIANGLE) != np.all(picture[61:] == NO_TRIANGLE)
    assert np.isin(picture[[0, -1]], [0, 1]).any(axis=1).sum() == 1


def test_triangles_with_common_edges_leave_no_cracks() -> None:
    assert np.all(ids(relief(400, 150, 3.0), LENS, camera_above(200.0, 20.0)) >= 0)


def test_of_equally_near_triangles_the_first_is_seen() -> None:
    twice = np.concatenate([quad((0, 0, 0), 50.0), quad((0, 0, 0), 50.0)])
    assert ids(twice, LENS, camera_above(200.0)).max() == 1


def test_triangles_seen_are_numbered_as_rows_and_columns_meet_them() -> None:
    corners = scene_of(relief(120, 30, 5.0)).corners_mm
    pixels, seen = visible_triangles(corners, sight(LENS), camera_above(200.0))
    numbers = pixels[pixels >= 0]
    first = np.unique(numbers, return_index=True)[1]
    assert np.all(np.diff(first) > 0)
    assert len(np.unique(seen)) == len(seen) == numbers.max() + 1


def test_an_empty_scene_is_seen_as_nothing() -> None:
    pixels, seen = visible_triangles(np.zeros((0, 3, 3), np.float32), sight(LENS), camera_above(200.0))
    assert len(seen) == 0
    assert np.all(pixels == -1)


def test_samples_of_a_pixel_lie_within_it() -> None:
    fine = ids(quad((0.0, 0, 0), 50.0), LENS.with_supersampling(4), camera_above(200.0))
    share = (fine >= 0).reshape(120, 4, 160, 4).mean(axis=(1, 3))
    # 100 mm at 200 mm and 200 pixels of focal length: 100 pixels, from 29.5 to 129.5 of pixels' centres.
    assert share.sum() == pytest.approx(100.0 * 100.0)
    assert np.array_equal(share == 1.0, ids(quad((0, 0, 0), 50.0), LENS, camera_above(200.0)) >= 0)


@pytest.mark.parametrize("distortion", [NO_DISTORTION, (1e-9, 0.0, 0.0, 0.0, 0.0)], ids=["straight", "bent"])
@pytest.mark.parametrize("across", [False, True], ids=["rows", "columns"])
def test_an_edge_along_the_pixels_grows_in_as_many_steps_as_a_pixel_has_samples(
    distortion: Distortion, across: bool
) -> None:
    samples, lens = 3, Lens(40, 40, 200.0, distortion)
    shares = []
    for step in range(28):
        edge_mm = step / 27.0  # 1 mm at 200 mm is a pixel
        corners = quad((50.0 + edge_mm, 0, 0) if across else (0, 50.0 + edge_mm, 0), 50.0)
        fine = ids(corners, lens.with_supersampling(samples), camera_above(200.0)) >= 0
        shares.append(fine.sum() / (40 * samples**2))
    steps = np.unique(np.round(np.abs(np.diff(shares)), 6))
    assert steps == pytest.approx([0.0, 1.0 / samples**2])


_WITH_THREADS = """
import hashlib, sys
sys.path[:0] = {paths!r}
import numba
from scenes import *
from sim.render.embree import Obstacles
from sim.render.emitter import square
from sim.render.lens import sight
from sim.render.radiance import led_radiance
from sim.render.shadows import Shadows
from sim.render.camera_view import Viewer
scene = scene_of(np.concatenate([quad((0, 0, -20), 2000.0), relief(120, 60, 5.0), sphere(30.0, 4)]),
                 Material("glossy", (0.3, 0.2, 0.1), (0.04, 0.05, 0.06), 0.2))
light = np.array([[300.0, 200.0, 900.0]])
for threads in (1, 2, 8):
    numba.set_num_threads(threads)
    view = Viewer(scene, Lens(320, 240, 400.0, BENT)).look(camera_above(200.0, 30.0))
    shadows = Shadows(Obstacles(scene.corners_mm), light, 1 << 20)
    places = shadows.places(view.sides)
    lamp = square(light[0], -light[0], side_mm=7.0, flux_lm=1800.0)
    lit = led_radiance(view, scene.materials, scene.tables, lamp, "lambertian", places, shadows.reached_bits(0))
    digest = hashlib.sha256(view.site.tobytes() + view.sides.tobytes() + lit.tobytes())
    print(digest.hexdigest(), lit.max() > 0)
"""


def test_the_picture_is_the_same_to_the_bit_with_1_2_and_8_threads() -> None:
    paths = [str(ROOT), str(Path(__file__).parent)]
    script = _WITH_THREADS.format(paths=paths)
    environment = {"NUMBA_NUM_THREADS": "8", "PATH": "/usr/bin:/bin"}
    done = subprocess.run(
        [sys.executable, "-c", script], env=environment, capture_output=True, text=True, check=False
    )
    lines = done.stdout.split("\n")[:-1]
    assert len(lines) == 3, done.stderr
    assert len(set(lines)) == 1
    assert lines[0].endswith("True")
