"""New light on known surfaces: closed forms for Lambert's law, Mitsuba for highlights."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest
import relight_cases as cases
from relief_in_mitsuba import Mitsuba
from relight_cases import Coat, moved, sheet, unit, waves, write_exr, write_result

from coupole.motion.occlusion import blocked_segments, ray_mesh
from coupole.reflectance.new_light.beams import Beam
from coupole.reflectance.new_light.light_kinds import (
    AnyLight,
    AreaLight,
    DistantLight,
    EnvironmentLight,
    LedLight,
    PointLight,
    turn_light,
)
from coupole.reflectance.new_light.pictured_surface import FreeCamera
from coupole.reflectance.new_light.shadow_edges import LIT, trace_beam
from coupole.reflectance.run_relighting import RelitScene, scene_from, scene_of_view

WHITE = Coat(kd=(1 / np.pi, 0.5 / np.pi, 0.25 / np.pi))
GREYS = np.array([1.0, 0.5, 0.25])
GLOSSY = Coat(kd=(0.05, 0.04, 0.03), ks=(0.4, 0.3, 0.2), alpha=0.15)


@pytest.fixture(scope="module")
def plane(tmp_path_factory: pytest.TempPathFactory) -> RelitScene:
    """z = 0."""
    folder = tmp_path_factory.mktemp("plane") / "result"
    return scene_of_view(write_result(folder, sheet(np.zeros((40, 40)), 60.0), WHITE))


@pytest.fixture(scope="module")
def relief(tmp_path_factory: pytest.TempPathFactory) -> RelitScene:
    return scene_of_view(write_result(tmp_path_factory.mktemp("relief") / "result", waves(), WHITE))


def places(scene: RelitScene) -> np.ndarray:
    """[pixels, 3] in the support frame."""
    inverse = np.linalg.inv(scene.result.base_from_support)
    return moved(inverse, scene.surface.places_mm[scene.surface.triangle_of_pixel >= 0].astype(float))


def shown(scene: RelitScene, *lights: AnyLight, samples: int = 256) -> np.ndarray:
    """[pixels, 3] of the same pixels."""
    values: np.ndarray = scene.picture(lights, samples)[scene.surface.triangle_of_pixel >= 0]
    return values


def test_pixels_of_a_view_see_the_place_that_its_lens_shows_there(relief: RelitScene) -> None:
    """The result does not keep the lens, whose distortion here is up to 4 px."""
    seen = relief.surface.triangle_of_pixel >= 0
    pose = cases.camera_pose(np.array((60.0, -120.0, 330.0)), np.zeros(3))
    local = (places(relief) - pose[:3, 3]) @ pose[:3, :3]
    pixels = cv2.projectPoints(local, np.zeros(3), np.zeros(3), cases.LENS.matrix(), cases.LENS.distortion())[0]
    off_px = np.linalg.norm(pixels[:, 0] - np.argwhere(seen)[:, ::-1], axis=1)
    assert np.median(off_px) < 0.05
    assert off_px.max() < 0.5


def test_a_white_diffuser_that_faces_a_distant_light_is_one(plane: RelitScene) -> None:
    np.testing.assert_allclose(
        shown(plane, DistantLight(towards=(0, 0, 5))), np.tile(GREYS, (len(places(plane)), 1))
    )
    slanted = shown(plane, DistantLight(towards=(0, np.sqrt(3), 1), strength=(2, 2, 4)))
    np.testing.assert_allclose(slanted.mean(axis=0), GREYS * (1, 1, 2), rtol=1e-5)


def test_a_near_light_fades_with_the_square_of_the_distance_pixel_by_pixel(plane: RelitScene) -> None:
    at_mm = np.array([10.0, 5.0, 40.0])
    away = at_mm - places(plane)
    distance = np.linalg.norm(away, axis=1)
    wanted = GREYS * (1e6 / distance**2 * away[:, 2] / distance)[:, None]
    np.testing.assert_allclose(shown(plane, PointLight(at_mm=tuple(at_mm))), wanted, rtol=1e-4)


def test_lights_that_are_named_together_are_summed(relief: RelitScene) -> None:
    one, other = DistantLight(towards=(1, 0, 1)), PointLight(at_mm=(0, 50, 90), strength=0.01)
    both = shown(relief, one, other)
    np.testing.assert_allclose(both, shown(relief, one) + shown(relief, other), rtol=1e-5, atol=1e-6)


def test_a_sensor_without_filter_has_the_green_of_all_lights(tmp_path: Path) -> None:
    corners = waves(30)
    grey = scene_of_view(write_result(tmp_path / "grey", corners, GLOSSY, channels=slice(1, 2)))
    colour = scene_of_view(write_result(tmp_path / "colour", corners, GLOSSY))
    sky = np.random.default_rng(3).uniform(0, 1, (1, 1, 3)) * np.ones((8, 16, 3))
    lights = (
        LedLight(number=cases.LED),
        AreaLight(at_mm=(0, 0, 90), normal=(0, 0, -1), width_mm=30, strength=(9, 5, 3)),
        EnvironmentLight(file=write_exr(tmp_path / "sky.exr", sky)),
    )
    for light in lights:
        found, wanted = grey.picture([light], 16), colour.picture([light], 16)
        assert found.shape[2] == 1
        np.testing.assert_allclose(found[..., 0], wanted[..., 1], rtol=1e-4, atol=1e-6)


@pytest.mark.full
def test_beams_alone_show_an_area_that_is_smaller_than_the_lobe(tmp_path: Path) -> None:
    """No rays are drawn for it: 256 beams against 2304."""
    scene = scene_of_view(write_result(tmp_path / "result", sheet(np.zeros((20, 20)), 60.0), GLOSSY))
    light = AreaLight(at_mm=(-40, 60, 250), normal=(0.1, -0.2, -1), width_mm=60)
    few, many = shown(scene, light), shown(scene, light, samples=2304)
    assert np.abs(few / many - 1).max() < 0.01


def parallel_rectangle(points: np.ndarray, half_x: float, half_y: float, height: float) -> np.ndarray:
    """[n] form factor of a rectangle over the origin: the sum of four that have a corner over the point (Howell, A
    catalog of radiation heat transfer configuration factors, B-4)."""
    total = np.zeros(len(points))
    for sign_x in (-1, 1):
        for sign_y in (-1, 1):
            x, y = (half_x + sign_x * points[:, 0]) / height, (half_y + sign_y * points[:, 1]) / height
            a, b = np.sqrt(1 + x * x), np.sqrt(1 + y * y)
            total += (x / a * np.arctan(y / a) + y / b * np.arctan(x / b)) / (2 * np.pi)
    return total


def test_a_rectangle_lights_a_plane_as_its_form_factor_says(plane: RelitScene) -> None:
    light = AreaLight(at_mm=(0, 0, 50), normal=(0, 0, -2), width_mm=60, height_mm=20)
    wanted = GREYS * parallel_rectangle(places(plane), 30.0, 10.0, 50.0)[:, None]
    np.testing.assert_allclose(shown(plane, light), wanted, rtol=0.004)


def test_a_rectangle_lights_nothing_behind_it(plane: RelitScene) -> None:
    assert not shown(plane, AreaLight(at_mm=(0, 0, 50), normal=(0, 0, 1), width_mm=60)).any()


def test_under_an_edge_half_of_a_rectangle_is_hidden_and_beside_it_none_or_all(tmp_path: Path) -> None:
    roof = sheet(np.full((2, 2), 100.0), 400.0) - (200.0, 0.0, 0.0)
    corners = np.concatenate([sheet(np.zeros((40, 40)), 60.0), roof])
    scene = scene_of_view(write_result(tmp_path / "result", corners, WHITE, camera_mm=(250.0, -100.0, 60.0)))
    light = AreaLight(at_mm=(0, 0, 150), normal=(0, 0, -1), width_mm=20, height_mm=16)
    x, share = places(scene)[:, 0], shown(scene, light)[:, 0]
    share /= parallel_rectangle(places(scene), 10.0, 8.0, 150.0)
    # similar triangles: the light reaches 20 or 16 mm to both sides of the edge, the other way round
    reach = 100.0 / 50.0 * 10.0
    assert (share[x < -reach - 0.3] == 0).all()
    np.testing.assert_allclose(share[x > reach + 0.3], 1.0, rtol=0.01)
    between = np.abs(x) < 0.8 * min(reach, 16.0)
    assert between.sum() > 1000
    slope = np.polyfit(x[between], share[between], 1)
    np.testing.assert_allclose(np.polyval(slope, 0.0), 0.5, atol=0.02)
    shiny = scene_of_view(write_result(tmp_path / "shiny", corners, GLOSSY, camera_mm=(250.0, -100.0, 60.0)))
    highlights = shown(shiny, light)
    assert (highlights[x < -reach - 0.3] == 0).all()
    assert (highlights[x > reach + 0.3] > 0).all()


def test_under_a_uniform_environment_radiance_is_albedo(plane: RelitScene, tmp_path: Path) -> None:
    path = write_exr(tmp_path / "white.exr", np.ones((16, 32, 3)))
    found = shown(plane, EnvironmentLight(file=path))
    np.testing.assert_allclose(found, np.tile(GREYS, (len(found), 1)), rtol=0.005)


def test_the_sun_of_an_environment_is_a_distant_light(relief: RelitScene, tmp_path: Path) -> None:
    """Up is z, the middle x, and y a quarter to the left of it; the sun stands between y and z."""
    sky = np.zeros((90, 180, 3))
    sky[22, 44:46] = (3000.0, 1500.0, 750.0)  # 45 degrees high
    solid_angle = 2 * (2 * np.pi / 180) * (np.cos(22 * np.pi / 90) - np.cos(23 * np.pi / 90))
    strength = tuple(solid_angle / np.pi * np.array([3000.0, 1500.0, 750.0]))
    light = EnvironmentLight(file=write_exr(tmp_path / "sun.exr", sky))
    sun = shown(relief, light, samples=8)
    wanted = shown(relief, DistantLight(towards=(0, 1, 1), strength=strength))
    assert np.abs(sun - wanted).mean() < 0.01 * wanted.mean()
    turned_sun = shown(relief, turn_light(light, 30.0), samples=8)
    there = turn_light(DistantLight(towards=(0, 1, 1), strength=strength), 30.0)
    assert np.abs(turned_sun - shown(relief, there)).mean() < 0.01 * wanted.mean()
    # and from y by 90 degrees to -x
    np.testing.assert_allclose(turn_light(there, 60.0).towards, (-1, 0, 1), atol=1e-12)  # type: ignore[union-attr]


def test_an_led_gives_shares_of_the_cameras_range(plane: RelitScene) -> None:
    """A Lambertian emitter of flux 1: E = cos cos' / (pi d^2)."""
    away = cases.LED_MM - places(plane)
    distance = np.linalg.norm(away, axis=1)
    leaving = np.sum(away * unit(cases.LED_MM - cases.LED_TARGET_MM), axis=1) / distance
    lit = leaving * away[:, 2] / distance / (np.pi * (distance * 1e-3) ** 2)
    wanted = lit[:, None] * np.array(WHITE.kd) * cases.FULL_SCALE
    np.testing.assert_allclose(shown(plane, LedLight(number=cases.LED)), wanted, rtol=1e-4)


@pytest.mark.parametrize("channels", [slice(0, 3), slice(1, 2)])
def test_a_light_alone_gives_what_its_two_halves_give_together(tmp_path: Path, channels: slice) -> None:
    """Eight pixels at once against eight lights of one pixel at once, in pictures of any number of pixels."""
    result = write_result(tmp_path / "result", waves(30), GLOSSY, channels=channels)
    for size in ((13, 11), (16, 9), (3, 2)):
        scene = scene_from(result, FreeCamera(np.array([30.0, -40.0, 60.0]), np.zeros(3), size, 20.0))
        assert (scene.surface.triangle_of_pixel >= 0).reshape(-1)[-5:].all()
        for light in (DistantLight(towards=(0, 1, 2)), PointLight(at_mm=(5, 20, 40))):
            half = light.model_copy(update={"strength": 0.5})
            found, wanted = scene.picture([light]), scene.picture([half, half])
            assert wanted.max() > 2 * wanted.mean()
            np.testing.assert_allclose(found, wanted, rtol=1e-4, atol=1e-7)
            again = scene.picture([light], into=wanted)
            assert again is wanted
            assert np.array_equal(again, found)


def reached_and_traced(scene: RelitScene, beam: Beam) -> tuple[np.ndarray, np.ndarray]:
    """[pixels] codes, and whether a ray from each pixel, one after the other, says that it is lit."""
    surface, seen = scene.surface, scene.surface.triangle_of_pixel >= 0
    whole = np.empty(surface.triangle_of_pixel.shape, np.uint8)
    trace_beam(scene.mesh, surface, beam, whole)
    codes = whole[seen]
    normals, places_mm = surface.normals[surface.triangle_of_pixel[seen]], surface.places_mm[seen]
    starts = places_mm + 0.1 * normals
    ends = np.broadcast_to(beam.place, starts.shape) if beam.near else starts + 3000.0 * beam.place
    facing = np.sum((ends - places_mm) * normals, axis=1) > 0
    if beam.exponent:
        facing &= (places_mm - beam.place) @ beam.axis > 0
    return codes, ~blocked_segments(ray_mesh(scene.result.corners_mm), starts, ends) & facing


def distant(scene: RelitScene, towards: np.ndarray) -> Beam:
    way = unit(scene.result.base_from_support[:3, :3] @ towards)
    return Beam(False, way, -way, 0, np.ones(3))


@pytest.mark.parametrize("towards", [(1.0, 0.4, 0.35), (-0.3, 1.0, 0.2)])
def test_shadows_are_those_of_a_ray_for_each_pixel(
    relief: RelitScene, towards: tuple[float, float, float]
) -> None:
    codes, lit = reached_and_traced(relief, distant(relief, np.array(towards)))
    assert 0.05 < lit.mean() < 0.95
    assert np.mean((codes == LIT) != lit) < 2e-4


@pytest.mark.parametrize("exponent", [0, 1])
def test_shadows_of_a_near_light_are_those_of_a_ray_for_each_pixel(relief: RelitScene, exponent: int) -> None:
    """It stands low and, with an exponent, looks away from a part of the surface."""
    pose = relief.result.base_from_support
    place, axis = moved(pose, np.array([12.0, -9.0, 5.0])), pose[:3, :3] @ unit(np.array([-1.0, 0.3, -0.2]))
    codes, lit = reached_and_traced(relief, Beam(True, place, axis, exponent, np.ones(3)))
    assert (0.3, 0.2)[exponent] < lit.mean() < (0.9, 0.6)[exponent]
    assert np.mean((codes == LIT) != lit) < 5e-4


def test_thin_shadows_are_followed_along_their_edges(tmp_path: Path) -> None:
    """Of slanted wires outside the picture, two pixels wide: few of the rays from every fourth pixel meet them."""
    corners = [sheet(np.zeros((40, 40)), 60.0)]
    for number in range(6):
        turn = np.radians(12.0 + 3.0 * number)
        across, along = np.array([np.cos(turn), np.sin(turn), 0]), np.array([-np.sin(turn), np.cos(turn), 0])
        wire = sheet(np.zeros((2, 2)), 1.0)
        middle = np.array([8.0 * number + 60.0, 0.0, 60.0])
        corners.append(wire[..., :1] * 0.6 * across + wire[..., 1:2] * 60.0 * along + middle)
    scene = scene_of_view(write_result(tmp_path / "result", np.concatenate(corners), WHITE))
    codes, lit = reached_and_traced(scene, distant(scene, np.array([80.0, 0.0, 60.0])))
    assert 0.01 < np.mean(~lit) < 0.1
    assert np.count_nonzero((codes == LIT) != lit) < 0.02 * np.count_nonzero(~lit)


def test_a_camera_anywhere_sees_what_it_looks_at(relief: RelitScene) -> None:
    camera = FreeCamera(np.array([100.0, 80.0, 200.0]), np.array([5.0, -3.0, 0.0]), (81, 61), 10.0)
    scene = scene_from(relief.result, camera)
    surface = scene.surface
    rows, columns = np.nonzero(surface.triangle_of_pixel >= 0)
    local = places(scene) - camera.at_mm
    forward = unit(np.array([5.0, -3.0, 0.0]) - camera.at_mm)
    right = unit(np.cross(forward, [0, 0, 1]))
    down = np.cross(forward, right)
    focal_px = 40.5 / np.tan(np.radians(5.0))
    depth = local @ forward
    np.testing.assert_allclose(local @ right / depth * focal_px, columns - 40, atol=1e-3)
    np.testing.assert_allclose(local @ down / depth * focal_px, rows - 30, atol=1e-3)
    assert len(rows) > 0.8 * surface.triangle_of_pixel.size


def test_a_camera_without_field_of_view_sees_the_whole_object(relief: RelitScene) -> None:
    seen = (
        scene_from(
            relief.result, FreeCamera(np.array([0.0, -200.0, 200.0]), size_px=(160, 120))
        ).surface.triangle_of_pixel
        >= 0
    )
    border = np.concatenate([seen[0], seen[-1], seen[:, 0], seen[:, -1]])
    assert not border.any()
    assert (
        max(np.ptp(np.flatnonzero(seen.any(axis=0))) / 160, np.ptp(np.flatnonzero(seen.any(axis=1))) / 120) > 0.9
    )


def blocks(picture: np.ndarray) -> np.ndarray:
    """Means of 8 x 8 pixels."""
    height, width = picture.shape[:2]
    means: np.ndarray = picture.reshape(height // 8, 8, width // 8, 8, 3).mean(axis=(1, 3))
    return means


@pytest.mark.parametrize(
    ("kind", "alpha", "most"),
    [("area", 0.05, 0.1), pytest.param("area", 0.3, 0.015, marks=pytest.mark.full), ("environment", 0.3, 0.025)],
)
def test_highlights_of_large_lights_are_those_of_an_independent_renderer(
    tmp_path: Path, kind: str, alpha: float, most: float
) -> None:
    """Of the sharp ones single pixels differ: ours are seen through their centres alone."""
    coat = Coat(GLOSSY.kd, GLOSSY.ks, alpha)
    camera = FreeCamera(np.array([30.0, -120.0, 150.0]), np.zeros(3), (64, 48), 12.0)
    scene = scene_from(write_result(tmp_path / "result", waves(), coat), camera)
    other = Mitsuba(tmp_path, camera, coat)
    transform = other.mi.ScalarTransform4f
    if kind == "area":
        at, normal = np.array([-20.0, 80.0, 90.0]), np.array([0.2, -0.7, -0.8])
        ours: AnyLight = AreaLight(at_mm=tuple(at), normal=tuple(normal), width_mm=60, height_mm=30, strength=5)
        place = transform().look_at(at.tolist(), (at + normal).tolist(), [0, 0, 1]).scale([30.0, 15.0, 1.0])
        theirs = {"type": "rectangle", "to_world": place, "emitter": {"type": "area", "radiance": 5.0}}
    else:
        sky = np.random.default_rng(5).uniform(0.2, 1.0, (16, 32, 3)) ** 2
        sky[4, 7] = 20.0
        path = write_exr(tmp_path / "sky.exr", np.repeat(np.repeat(sky, 8, 0), 8, 1))
        ours = EnvironmentLight(file=path)
        # there y is up, the middle is z and its left is x
        place = transform(np.array([[0, 0, 1, 0], [1, 0, 0, 0], [0, 1, 0, 0], [0, 0, 0, 1]], float))
        theirs = {"type": "envmap", "filename": str(path), "to_world": place}
    whole = blocks(np.repeat((scene.surface.triangle_of_pixel >= 0)[..., None], 3, axis=2))[..., 0] == 1
    assert whole.mean() > 0.8
    ratio = blocks(scene.picture([ours]))[whole] / blocks(other.render(theirs, 128))[whole]
    np.testing.assert_allclose(np.median(ratio, axis=0), 1.0, atol=0.02)
    assert np.abs(ratio - 1).mean() < most
