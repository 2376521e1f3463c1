"""Light on the page: as a path tracer, the command relight and closed forms have it."""

from __future__ import annotations

import json
import math
from pathlib import Path
from typing import Any

import cells
import h5py
import numpy as np
import pytest
from browser import needs_chromium
from lazily import lazily
from relief_in_mitsuba import Mitsuba
from relight_cases import GLOSSY, Coat, sheet, waves, write_exr, write_result
from selenium.webdriver.support.select import Select
from shown_page import HEIGHT, WIDTH, Page, difference

from coupole.exchange.look.look_of_runs import look_of_result
from coupole.exchange.look.look_page import write_page
from coupole.reflectance.new_light.light_kinds import DistantLight
from coupole.reflectance.run_relighting import scene_from
from coupole.reflectance.run_result import RunResult

colour: Any = lazily("colour")

pytestmark = needs_chromium


MATERIALS = (
    pytest.param(GLOSSY, id="glossy"),
    pytest.param(Coat((0.1, 0.12, 0.2), (0.05, 0.05, 0.05), 0.08), id="sharp", marks=pytest.mark.full),
    pytest.param(Coat(), id="matte", marks=pytest.mark.full),
    pytest.param(Coat(ks=(0.1, 0.1, 0.1)), id="satin", marks=pytest.mark.full),
    pytest.param(Coat((0.02, 0.01, 0.005), (0.9, 0.7, 0.3), 0.4), id="metal", marks=pytest.mark.full),
)


@pytest.mark.parametrize("coat", MATERIALS)
@pytest.mark.parametrize("way", [(-0.4, -0.3, 0.8), pytest.param((0.6, 0.3, 0.5), marks=pytest.mark.full)])
def test_new_light_looks_as_in_an_independent_path_tracer(
    page: Page, tmp_path: Path, coat: Coat, way: tuple[float, float, float]
) -> None:
    write_result(tmp_path / "result", waves(), coat)
    write_page(look_of_result(tmp_path / "result"), "waves", tmp_path / "look.html")
    page.open(tmp_path / "look.html")
    page.small()
    camera = page.look(-70.0, 50.0, 150.0)
    page.run(f"coupole.setLight({', '.join(map(str, way))})")
    mine = page.picture(16)
    light = {"type": "directional", "direction": [-one for one in way], "irradiance": math.pi}
    theirs = Mitsuba(tmp_path, camera, coat).render(light, 32)
    whole = mine[..., 3] > 0.999
    assert whole.mean() > 0.2
    off = difference(mine[..., :3], theirs, float(np.quantile(theirs[whole], 0.999)))[whole]
    assert off.mean() < 0.5
    assert np.quantile(off, 0.95) < 1.5


def test_a_light_gives_what_the_command_relight_gives_with_its_shadows(page: Page, folder: Path) -> None:
    page.open(folder / "look.html")
    page.small()
    camera = page.look(-70.0, 50.0, 150.0)
    page.run("coupole.setLight(0.9, 0.3, 0.3)")
    mine = page.picture(1)[..., :3]
    scene = scene_from(RunResult(folder / "result"), camera, "ggx")
    theirs = scene.picture([DistantLight(towards=(0.9, 0.3, 0.3))])
    lit = mine.any(axis=2) | theirs.any(axis=2)
    assert lit.mean() > 0.2
    alike = np.isclose(mine, theirs, rtol=0.01, atol=1e-4).all(axis=2)
    assert alike[lit].mean() > 0.95  # the others lie at edges of shadows and of the sheet


def test_a_white_sheet_under_the_whole_sky_is_as_white_as_facing_a_lamp(page: Page, tmp_path: Path) -> None:
    white = Coat(kd=(1 / np.pi,) * 3)
    write_result(tmp_path / "result", sheet(np.zeros((12, 12)), 60.0), white, camera_mm=(0.0, 0.0, 330.0))
    write_page(look_of_result(tmp_path / "result"), "sheet", tmp_path / "look.html")
    page.open(tmp_path / "look.html")
    page.small()
    page.look(-90.0, 80.0, 150.0)
    page.run("coupole.setLight(0, 0, 1)")
    np.testing.assert_allclose(page.picture(1)[60, 80, :3], 1.0, rtol=1e-3)
    page.run("coupole.state = {...coupole.state, lights: [{...coupole.state.lights[0], strength: 0}], sky: 1}")
    np.testing.assert_allclose(page.picture(64)[60, 80, :3], 1.0, rtol=0.01)


def test_light_from_all_around_is_as_white_as_a_lamp_and_its_sun_as_a_light(page: Page, tmp_path: Path) -> None:
    white = Coat(kd=(1 / np.pi,) * 3)
    write_result(tmp_path / "result", sheet(np.zeros((12, 12)), 60.0), white, camera_mm=(0.0, 0.0, 330.0))
    around = np.ones((32, 64, 3))
    sun = np.zeros((64, 128, 3))
    sun[16, 64] = np.array([1.0, 0.5, 0.25]) * 1000.0
    height = np.pi / 2 - 16.5 * np.pi / 64
    solid = 2 * np.pi / 128 * (np.sin(height + np.pi / 128) - np.sin(height - np.pi / 128))
    expected = sun[16, 64] * solid * np.sin(height) / np.pi
    for name, radiance, shown in (("around", around, np.ones(3)), ("sun", sun, expected)):
        write_exr(tmp_path / f"{name}.exr", radiance)
        words = ("--environment", tmp_path / f"{name}.exr", "--out", tmp_path / f"{name}.html")
        ended = cells.here("show", tmp_path / "result", *words)
        assert ended.code == 0, ended.err
        page.open(tmp_path / f"{name}.html")
        page.small()
        page.look(-90.0, 80.0, 150.0)
        page.run("coupole.state = {...coupole.state, lights: [{...coupole.state.lights[0], strength: 0}]}")
        np.testing.assert_allclose(page.picture(64)[60, 80, :3], shown, rtol=0.03)
        assert f"surroundings {name}.exr" in page.browser.text("#banner")


def test_two_eyes_see_what_cameras_at_their_sides_see(page: Page, folder: Path) -> None:
    page.open(folder / "look.html")
    page.small()
    page.look(-70.0, 50.0, 150.0)
    page.run("coupole.state = {...coupole.state, stereo: true}")
    eyes = page.picture(1)
    assert "for two eyes" in page.browser.text("#banner")
    half = f"document.getElementById('stage').style.cssText = 'width:{WIDTH // 2}px; height:{HEIGHT}px'"
    page.driver.execute_script(half)
    cells.wait_until(lambda: page.run("document.getElementById('picture').width") == WIDTH // 2, "the size")
    for side, seen in ((-1, eyes[:, : WIDTH // 2]), (1, eyes[:, WIDTH // 2 :])):
        page.look(-70.0 + side * 1.7, 50.0, 150.0)
        page.run("coupole.state = {...coupole.state, stereo: false}")
        one = np.array(page.run("[...coupole.readPicture().rgba]"), np.float32).reshape(HEIGHT, WIDTH // 2, 4)
        assert (one[..., 3] > 0).mean() > 0.1
        np.testing.assert_allclose(seen, one, atol=1e-5)


def test_an_illuminant_has_its_chromaticity_and_an_eye_may_be_used_to_it(page: Page, tmp_path: Path) -> None:
    coat = Coat(kd=(0.2, 0.1, 0.05))
    write_result(tmp_path / "result", sheet(np.zeros((12, 12)), 60.0), coat, camera_mm=(0.0, 0.0, 330.0))
    write_page(look_of_result(tmp_path / "result"), "sheet", tmp_path / "look.html")
    page.open(tmp_path / "look.html")
    page.small()
    page.look(-90.0, 80.0, 150.0)
    page.run("coupole.setLight(0, 0, 1)")
    page.run("document.getElementById('panel').scrollTo(0, 300)")
    Select(page.browser.at("#illuminant")).select_by_value("A")
    whites = colour.CCS_ILLUMINANTS["CIE 1931 2 Degree Standard Observer"]
    white_a, white_d65 = (colour.xy_to_XYZ(whites[name]) for name in ("A", "D65"))
    tint = colour.XYZ_to_RGB(white_a, "sRGB", apply_cctf_encoding=False)
    expected = np.array(coat.kd) * np.pi * tint / tint.mean()
    found = page.picture(1)[60, 80, :3]
    np.testing.assert_allclose(found, expected, rtol=2e-3)
    pixel = """(() => {
        const shown = Object.assign(document.createElement("canvas"), { width: 1, height: 1 }).getContext("2d");
        shown.drawImage(document.getElementById("picture"), 80, 60, 1, 1, 0, 0, 1, 1);
        return [...shown.getImageData(0, 0, 1, 1).data].slice(0, 3);
    })()"""
    for adapted in (False, True):
        page.driver.execute_script(f"coupole.state = {{adapted: {str(adapted).lower()}, white: 1.2}}")
        page.picture(1)
        xyz = colour.RGB_to_XYZ(expected / 1.2, "sRGB")
        if adapted:
            xyz = colour.adaptation.chromatic_adaptation_VonKries(xyz, white_a, white_d65, transform="Bradford")
        shown = (
            colour.cctf_encoding(np.clip(colour.XYZ_to_RGB(xyz, "sRGB", apply_cctf_encoding=False), 0, 1)) * 255
        )
        np.testing.assert_allclose(page.run(pixel), shown, atol=1.5)
    assert "eye adapted to the chosen light (Bradford)" in page.browser.text("#banner")


def test_a_flat_picture_has_the_radiance_of_each_pixel_where_it_lies(page: Page, tmp_path: Path) -> None:
    mask = np.ones((6, 8), bool)
    mask[0, 0] = False
    normal = np.tile([0.0, 0.6, 0.8], (47, 1))
    normal[-1] = [0.6, 0.0, 0.8]  # the lower right pixel
    kd = np.tile([0.5, 0.25, 0.125], (47, 1))
    write_pictures(tmp_path / "result", mask, normal, kd)
    ended = cells.here("show", tmp_path / "result", "--out", tmp_path / "look.html")
    assert ended.code == 0, ended.err
    page.open(tmp_path / "look.html")
    page.small()
    camera = "{target: [4, 3, 0], azimuth: -90, height: 90, distance: 3 / Math.tan(Math.PI / 15)}"
    page.run(f"coupole.state = {{camera: {camera}, lights: [{{...coupole.state.lights[0], softness: 0}}]}}")
    page.run("coupole.setLight(0.6, 0, 0.8)")
    picture = page.picture(1)
    side = HEIGHT // 6
    assert picture[side // 2, side // 2, 3] == 0.0
    np.testing.assert_allclose(
        picture[side // 2, 5 * side + 9, :3], np.array([0.5, 0.25, 0.125]) * 0.64, rtol=1e-3
    )
    np.testing.assert_allclose(picture[5 * side + 9, 7 * side + 9, :3], [0.5, 0.25, 0.125], rtol=1e-3)
    assert "Pictures of an object" in page.browser.text("#banner")


def write_pictures(folder: Path, mask: np.ndarray, normal: np.ndarray, kd: np.ndarray) -> None:
    """A result of pictures with known materials of the mask's pixels, without highlights."""
    (folder / "samples").mkdir(parents=True)
    (folder / "fits").mkdir()
    (folder / "result.json").write_text(json.dumps({"schema": "coupole-reflectance-pictures/1"}))
    with h5py.File(folder / "samples/pictures.h5", "w") as file:
        file["mask"], file["directions"] = mask, np.eye(3)
    with h5py.File(folder / "fits/materials.h5", "w") as file:
        file["normal"], file["kd"], file["ks"] = normal, kd, np.zeros_like(kd)
        file["alpha"], file["residual"] = np.full(len(kd), 0.5), np.zeros(len(kd))
