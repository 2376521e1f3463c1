"""Light and shadow on each pixel: against closed forms and Mitsuba, and detail finer than the mesh."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numba
import numpy as np
import pytest
from numpy.typing import NDArray
from scenes import BENT, camera_above, quad, rays, relief, scene_of, sphere
from test_against_mitsuba import CAMERA, CASES, FLUX_LM, LED_MM, LOW_LED_MM, TOWARDS, Oracle
from test_picture import frame, photographer

from coupole.errors import InputError
from sim.render.camera_view import View, Viewer
from sim.render.embree import Obstacles
from sim.render.emitter import square
from sim.render.lens import Lens
from sim.render.radiance import led_radiance
from sim.scene.scene import Scene, load_surface
from sim.scene.surface import Layer, Material

LENS = Lens(160, 120, 250.0)
ABOVE = camera_above(330.0)


def lit(scene: Scene, view: View, led_mm: NDArray[np.float64]) -> NDArray[np.float32]:
    """[sites, 3] radiance of a view's sites under one LED, shadows included."""
    emitter = square(led_mm, TOWARDS, side_mm=7.0, flux_lm=FLUX_LM)
    radiance = led_radiance(view, scene.materials, scene.tables, emitter, "lambertian")
    Obstacles(scene.corners_mm).cast(radiance, view.points_mm, view.triangle, view.normals, emitter.centre_mm)
    return radiance


@pytest.mark.parametrize(("samples", "distortion"), [(1, (0.0,) * 5), (1, BENT), (3, (0.0,) * 5)])
def test_sites_are_where_the_pixels_rays_meet_the_surface(samples: int, distortion: tuple[float, ...]) -> None:
    """A tilted plane in front of the camera: scipy inverts the lens, the meeting point is a closed form."""
    plane = quad((0.0, 0.0, 0.0), 400.0)
    plane[..., 2] = 0.4 * plane[..., 0] - 0.2 * plane[..., 1]
    lens = Lens(40, 30, 60.0, distortion)  # type: ignore[arg-type]
    pose = camera_above(330.0, 20.0)
    view = Viewer(scene_of(plane), lens, samples, "pixel").look(pose)
    ways = rays(lens, pose)
    normal = np.array([-0.4, 0.2, 1.0])
    expected = pose[:3, 3] - ways * (pose[:3, 3] @ normal / (ways @ normal))[..., None]
    found = view.points_mm[view.site[samples // 2 :: samples, samples // 2 :: samples]]
    one_triangle = np.ones((30, 40), bool)
    if samples > 1:  # pixels that see both triangles have two sites
        parts = view.site.reshape(30, samples, 40, samples).transpose(0, 2, 1, 3).reshape(30, 40, -1)
        one_triangle = (parts == parts[..., :1]).all(axis=2)
        assert 1000 < one_triangle.sum() < 1200
    # Where perspective bends the rays' spacing, the mean of a pixel's points is off its centre by 1e-3 of a pixel.
    assert np.abs(found - expected)[one_triangle].max() < (0.02 if samples > 1 else 1e-3)


@pytest.mark.parametrize("distortion", [(0.0,) * 5, BENT])
def test_a_site_of_several_rays_lies_within_its_triangle(distortion: tuple[float, ...]) -> None:
    corners = relief(150.0, 12, 6.0)
    view = Viewer(scene_of(corners), Lens(80, 60, 125.0, distortion), 3, "pixel").look(ABOVE)  # type: ignore[arg-type]
    assert len(view.points_mm) > 1.1 * (view.site[::3, ::3] >= 0).sum()  # pixels on edges have several
    a, b, c = corners[(view.sides >> 1)[view.triangle]].transpose(1, 0, 2)
    normal = np.cross(b - a, c - a)
    area = np.einsum("ij,ij->i", normal, normal)
    for one, other in ((a, b), (b, c), (c, a)):
        share = np.einsum("ij,ij->i", np.cross(other - one, view.points_mm - one), normal) / area
        assert share.min() > -1e-3


def test_light_falls_off_smoothly_over_one_large_triangle() -> None:
    """A matt plane of two triangles: each pixel has E rho / pi of its own place, as of a far Lambertian point."""
    scene = scene_of(quad((0.0, 0.0, 0.0), 300.0))
    led_mm = np.array([200.0, -100.0, 900.0])
    view = Viewer(scene, LENS, 1, "pixel").look(ABOVE)
    radiance = lit(scene, view, led_mm)[view.site][..., 1]
    ways = rays(LENS, ABOVE)
    places = ABOVE[:3, 3] - ways * (ABOVE[2, 3] / ways[..., 2:])
    to_led = led_mm - places
    distance = np.linalg.norm(to_led, axis=-1)
    cosines = to_led[..., 2] / distance * -(to_led @ (TOWARDS / np.linalg.norm(TOWARDS))) / distance
    expected = 0.5 / np.pi * FLUX_LM / np.pi * cosines / (distance * 1e-3) ** 2
    assert np.abs(radiance / expected - 1.0).max() < 5e-5
    assert np.ptp(expected) > 0.1 * expected.mean()
    steps = np.unique(
        led_radiance(
            Viewer(scene, LENS).look(ABOVE),
            scene.materials,
            scene.tables,
            square(led_mm, TOWARDS, side_mm=7.0, flux_lm=FLUX_LM),
            "lambertian",
        )[:, 1]
    )
    assert len(steps) == 2  # `flat` has one step for each triangle


def test_the_edge_of_a_blades_shadow_lies_where_geometry_says() -> None:
    """A straight blade above a floor of two triangles: every pixel 0.01 mm from the edge is on its right side."""
    angle = np.radians(17.0)
    along, across = np.array([np.cos(angle), np.sin(angle), 0.0]), np.array([-np.sin(angle), np.cos(angle), 0.0])
    edge = np.array([0.0, 0.0, 60.0])
    a, b = edge - 300.0 * along, edge + 300.0 * along
    blade = np.array([[a, b, b + 300.0 * across], [a, b + 300.0 * across, a + 300.0 * across]])
    scene = scene_of(np.concatenate([quad((0.0, 0.0, 0.0), 300.0), blade]))
    led_mm = np.array([150.0, 500.0, 800.0])
    view = Viewer(scene, LENS, 1, "pixel").look(ABOVE)
    bright = lit(scene, view, led_mm)[:, 1] > 0.0
    floor = (view.sides >> 1)[view.triangle] < 2
    # The plane through the LED and the blade's edge divides the floor.
    normal = np.cross(along, edge - led_mm)
    side = (view.points_mm.astype(float) - edge) @ normal
    clear = floor & (np.abs(side) / np.linalg.norm(normal[:2]) > 0.01)
    behind_blade = np.sign(across @ normal)
    assert np.array_equal(bright[clear], (side * behind_blade < 0.0)[clear])
    assert 0.2 < bright[floor].mean() < 0.8


@pytest.mark.parametrize("shape", ["sphere", "relief"])
@pytest.mark.parametrize("kind", CASES)
def test_each_pixels_radiance_is_mitsubas(
    shape: str, kind: str, tmp_path: Path, scale: Callable[[int, int], int]
) -> None:
    corners = sphere(40.0, 1) if shape == "sphere" else relief(150.0, 12, 6.0)  # some hundred pixels each
    material, bsdfs = CASES[kind]
    scene = scene_of(corners, material)
    view = Viewer(scene, LENS, 1, "pixel").look(CAMERA)
    radiance = lit(scene, view, LED_MM)
    chosen = np.random.default_rng(2).permutation(np.flatnonzero(radiance[:, 0] > 0))[: scale(25, 1000)]
    oracle = Oracle(tmp_path, corners, bsdfs)
    differences = []
    for i in chosen:
        found = oracle.at(view.points_mm[i].astype(float), view.normals[view.triangle[i]].astype(float))
        expected = oracle.radiance(found, CAMERA[:3, 3])
        differences.append(np.abs(radiance[i] / expected - 1.0)[expected > 0])
    assert np.median(np.concatenate(differences)) < 1e-4
    assert np.quantile(np.concatenate(differences), 0.9) < 1e-3


def test_each_pixels_shadow_is_mitsubas(tmp_path: Path, scale: Callable[[int, int], int]) -> None:
    corners = np.concatenate([relief(150.0, 12, 12.0), quad((0.0, 0.0, -40.0), 200.0)])
    scene = scene_of(corners)
    view = Viewer(scene, LENS, 1, "pixel").look(CAMERA)
    bright = lit(scene, view, LOW_LED_MM)[:, 0] > 0
    normals = view.normals[view.triangle]
    facing = np.flatnonzero(np.einsum("ij,ij->i", normals, LOW_LED_MM - view.points_mm) > 0)
    chosen = np.random.default_rng(1).permutation(facing)[: scale(500, 10_000)]
    oracle = Oracle(tmp_path, corners, [])
    theirs = np.array(
        [
            oracle.reached(oracle.at(view.points_mm[i].astype(float), normals[i].astype(float)), LOW_LED_MM)
            for i in chosen
        ]
    )
    assert 0.1 < theirs.mean() < 0.9
    assert (theirs == bright[chosen]).mean() > 0.995


def test_pixels_are_the_same_to_the_bit_with_one_and_two_threads(tmp_path: Path) -> None:
    world = {"shading": "pixel", "detail": [{"period_mm": 2.0, "texture": 0.1, "slope_deg": 5.0}]}
    pictures = []
    before = numba.get_num_threads()
    for threads in (1, 2):
        numba.set_num_threads(min(threads, numba.config.NUMBA_NUM_THREADS))
        by = photographer(tmp_path, world, samples_per_side=2, blur=True, f_number=2.0)
        pictures.append(frame(by, {7: 0.004}, camera_above(200.0)))
    numba.set_num_threads(before)
    assert np.array_equal(*pictures)


def detailed(*detail: Layer, turned: bool = False) -> tuple[Scene, View]:
    """A matt plane of two triangles with detail, seen from above over 211 x 158 mm (or from below)."""
    plane = quad((0.0, 0.0, 0.0), 300.0)
    scene = scene_of(plane[:, ::-1] if turned else plane, Material("grey", (0.5, 0.4, 0.3), detail=detail))
    return scene, Viewer(scene, LENS, 1, "pixel").look(ABOVE)


def test_a_texture_has_the_mean_reflectance_of_its_material_and_the_spread_that_was_asked_for() -> None:
    scene, view = detailed(Layer(period_mm=5.0, texture=0.4))
    assert view.fine is not None
    assert view.fine.texture.mean() == pytest.approx(1.0, abs=0.005)
    assert view.fine.texture.std() == pytest.approx(0.25 * 0.4, rel=0.05)
    assert np.abs(view.fine.texture - 1.0).max() <= 0.4
    plain_scene, plain = detailed()
    led_mm = np.array([0.0, 0.0, 900.0])
    mean = lit(plain_scene, plain, led_mm).mean(axis=0)
    assert lit(scene, view, led_mm).mean(axis=0) == pytest.approx(mean, rel=0.01)


def test_detail_of_a_period_repeats_no_faster_than_that() -> None:
    _, view = detailed(Layer(period_mm=12.0, texture=0.3))
    assert view.fine is not None
    spectrum = np.abs(np.fft.rfft2(view.fine.texture[view.site] - 1.0)) ** 2
    per_mm = np.hypot(np.fft.fftfreq(120, 330.0 / 250.0)[:, None], np.fft.rfftfreq(160, 330.0 / 250.0))
    assert spectrum[per_mm > 1.15 / 12.0].sum() < 0.02 * spectrum.sum()
    assert spectrum[per_mm > 0.5 / 12.0].sum() > 0.3 * spectrum.sum()


def test_bumps_have_the_slope_that_was_asked_for() -> None:
    _, view = detailed(Layer(period_mm=6.0, slope_deg=10.0))
    assert view.fine is not None
    assert np.linalg.norm(view.fine.normals, axis=1) == pytest.approx(1.0, abs=1e-6)
    slopes = view.fine.normals[:, :2] / view.fine.normals[:, 2:]
    assert np.sqrt((slopes**2).sum(axis=1).mean()) == pytest.approx(np.tan(np.radians(10.0)), rel=0.1)
    assert np.abs(slopes.mean(axis=0)).max() < 0.01


def test_normals_are_those_of_the_height_whose_texture_is_seen() -> None:
    """Texture and height are the same waves: slopes are differences of the texture from pixel to pixel, scaled."""
    _, view = detailed(Layer(period_mm=40.0, texture=0.4, slope_deg=6.0))
    assert view.fine is not None
    texture, places = view.fine.texture[view.site].astype(float), view.points_mm[view.site].astype(float)
    slopes = (view.fine.normals[:, :2] / view.fine.normals[:, 2:])[view.site].astype(float)
    by_x = (texture[:, 2:] - texture[:, :-2]) / (places[:, 2:, 0] - places[:, :-2, 0])
    by_y = (texture[2:] - texture[:-2]) / (places[2:, :, 1] - places[:-2, :, 1])
    ratio = slopes[:, 1:-1, 0].std() / by_x.std()
    assert np.abs(slopes[:, 1:-1, 0] + ratio * by_x).max() < 0.03 * slopes.std()
    assert np.abs(slopes[1:-1, :, 1] + ratio * by_y).max() < 0.03 * slopes.std()


def test_bumps_seen_from_behind_are_dents() -> None:
    front, back = (
        detailed(Layer(period_mm=20.0, slope_deg=8.0), turned=turned)[1].fine for turned in (False, True)
    )
    assert front is not None
    assert back is not None
    assert back.normals[:, 2] == pytest.approx(front.normals[:, 2], abs=1e-6)
    assert back.normals[:, :2] == pytest.approx(-front.normals[:, :2], abs=1e-6)


def test_detail_is_where_the_object_is_and_goes_with_it() -> None:
    from sim.scene.scene import build_scene
    from sim.scene.surface import Surface

    material = Material("grey", (0.5, 0.5, 0.5), detail=(Layer(period_mm=15.0, texture=0.4, slope_deg=5.0),))
    plane = Surface(quad((0.0, 0.0, 0.0), 300.0), (material,), np.zeros(2, np.int32))
    turn = camera_above(0.0, 30.0) @ np.diag([1.0, -1.0, -1.0, 1.0])
    turn[:3, 3] = [40.0, -25.0, 10.0]
    here, there = (
        Viewer(build_scene([(plane, pose)]), LENS, 1, "pixel").look(pose @ ABOVE) for pose in (np.eye(4), turn)
    )
    assert here.fine is not None
    assert there.fine is not None
    assert there.fine.texture == pytest.approx(here.fine.texture, abs=1e-3)
    assert there.fine.normals == pytest.approx(here.fine.normals @ turn[:3, :3].T, abs=1e-3)


def test_a_texture_that_would_reflect_more_than_all_light_is_refused(tmp_path: Path) -> None:
    import trimesh

    path = tmp_path / "white.ply"
    trimesh.Trimesh(quad((0, 0, 0), 5.0).reshape(-1, 3), np.arange(6).reshape(-1, 3), process=False).export(path)
    white = Material("white", (0.9, 0.9, 0.9))
    with pytest.raises(InputError, match=r"white\.ply: expected textures .* 0\.90 .* found changes of 0\.2 "):
        load_surface(path, "mm", white, (Layer(period_mm=1.0, texture=0.2),))
    assert load_surface(path, "mm", white, (Layer(period_mm=1.0, texture=0.1),)).materials[0].detail


def test_lines_have_one_direction_and_their_period() -> None:
    ((*way, _, texture, height_mm),) = Layer(period_mm=0.2, texture=0.3, along=(2.0, 0.0, 0.0)).waves()
    np.testing.assert_allclose(way, [2 * np.pi / 0.2, 0.0, 0.0])
    assert (texture, height_mm) == (0.3, 0.0)
