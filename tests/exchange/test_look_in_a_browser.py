"""The page that `coupole show` makes, in a real browser, from disk and without a network."""

from __future__ import annotations

import base64
import json
import math
import re
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import cells
import h5py
import numpy as np
import pytest
from browser import needs_chromium
from lazily import lazily
from relief_in_mitsuba import Mitsuba
from relight_cases import LED, Coat, sheet, waves, write_exr, write_result
from selenium.webdriver.common.action_chains import ActionChains
from selenium.webdriver.common.by import By
from selenium.webdriver.common.keys import Keys
from selenium.webdriver.support.select import Select
from shown_page import CONTROLS, FIELD_DEG, HEIGHT, WIDTH, Page, opened_page

from coupole.exchange.look.look_of_runs import look_of_result
from coupole.exchange.look.look_page import MOST_BYTES, write_page
from coupole.reflectance.new_light.light_kinds import DistantLight, LedLight
from coupole.reflectance.run_relighting import scene_from, scene_of_view
from coupole.reflectance.run_result import RunResult

colour: Any = lazily("colour")

pytestmark = needs_chromium

GLOSSY = Coat((0.05, 0.04, 0.03), (0.4, 0.3, 0.2), 0.15)


@pytest.fixture(scope="module")
def page() -> Iterator[Page]:
    with opened_page() as page:
        yield page


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """`result` and its `look.html`."""
    folder = tmp_path_factory.mktemp("look")
    write_result(folder / "result", waves(), GLOSSY)
    write_page(look_of_result(folder / "result"), "waves", folder / "look.html")
    return folder


def difference(picture: np.ndarray, other: np.ndarray, white: float) -> np.ndarray:
    """CIEDE2000 of two linear pictures, shown as sRGB with a white."""
    lab = [
        colour.XYZ_to_Lab(
            colour.sRGB_to_XYZ(colour.cctf_encoding(np.clip(one / white, 0.0, 1.0))), [0.3127, 0.329]
        )
        for one in (picture, other)
    ]
    found: np.ndarray = colour.delta_E(*lab, method="CIE 2000")
    return found


def test_the_page_opens_from_disk_without_a_network_and_loads_nothing(page: Page, folder: Path) -> None:
    page.open(folder / "look.html")
    assert page.run("coupole.readPicture().rgba.some(value => value > 0)")
    assert page.run("performance.getEntriesByType('resource').length") == 0
    assert "Simulated object" in page.browser.text("#banner")
    assert page.browser.text("#status") == ""
    assert page.browser.troubles() == []


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


def with_frame(folder: Path) -> RunResult:
    """A result whose view has a frame under its LED: what `relight --led` makes of it, every second pixel."""
    result = write_result(folder, waves(), Coat(ks=(0.1, 0.1, 0.1)))
    share = scene_of_view(result, "top", "ggx").picture([LedLight(number=LED)])[::2, ::2]
    (folder / "samples/frames").mkdir()
    with h5py.File(folder / "samples/frames/top.h5", "w") as file:
        file["share"], file["leds"] = np.where(share > 0, share, np.nan).astype(np.float16)[None], [LED]
    return result


@pytest.mark.parametrize("most_bytes", [pytest.param(MOST_BYTES, marks=pytest.mark.full), 1000])
def test_a_measured_frame_lies_on_the_object_as_the_fit_under_the_same_led(
    page: Page, tmp_path: Path, most_bytes: int
) -> None:
    with_frame(tmp_path / "result")
    write_page(look_of_result(tmp_path / "result"), "waves", tmp_path / "vase #3.html", most_bytes)
    page.open(tmp_path / "vase #3.html")
    page.small()
    page.run("document.getElementById('frames-section').open = true")
    Select(page.browser.at("#view")).select_by_visible_text("top")
    page.run("coupole.state = {...coupole.state, split: 1}")
    cells.wait_until(lambda: f"measured frame under LED {LED}" in page.browser.text("#banner"), "the frame")
    measured = page.picture(1)
    assert page.browser.troubles() == []
    page.run("coupole.state = {...coupole.state, split: 0}")
    fitted = page.picture(1)
    both = (measured[..., 3] == 1) & fitted[..., :3].any(axis=2)
    assert both.mean() > 0.2
    ratio = measured[both][:, :3] / fitted[both][:, :3]
    np.testing.assert_allclose(np.median(ratio, axis=0), 1.0, atol=0.01)
    assert (np.abs(ratio - 1) < 0.1).mean() > 0.9  # the others lie at facets' edges: a frame's pixel is a wide one


def test_a_snapshot_of_a_measured_frame_tells_the_white_that_was_used(page: Page, tmp_path: Path) -> None:
    with_frame(tmp_path / "result")
    look = look_of_result(tmp_path / "result")
    write_page(look, "waves", tmp_path / "look.html")
    page.open(tmp_path / "look.html")
    page.small()
    page.driver.execute_script("""
        HTMLAnchorElement.prototype.click = () => {};
        CanvasRenderingContext2D.prototype.fillText = (words) => { window.words = words; };""")
    page.browser.at("#snapshot").click()
    white = page.run("coupole.state.white")
    assert f"white {white:#.4g} 1/sr" in page.run("words")
    page.run("coupole.state = {...coupole.state, view: 'top'}")
    assert not page.browser.at("#white-row").is_displayed()
    page.browser.at("#snapshot").click()
    peak = look.about["views"][0]["frames"][0]["peak"]
    assert f"white {peak:#.4g} of the camera's range" in page.run("words")


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


def test_dragging_the_light_moves_it_and_changes_the_picture(page: Page, folder: Path) -> None:
    page.open(folder / "look.html")
    before, way = page.run("coupole.readPixel(260, 200)"), page.run("coupole.state.lights[0].direction")
    page.browser.at("[data-tool=light]").click()
    canvas = page.browser.at("#picture")
    ActionChains(page.driver).drag_and_drop_by_offset(canvas, 60, 0).perform()
    after = page.run("coupole.state.lights[0].direction")
    assert after[0] > way[0] + 0.2
    assert page.run("coupole.readPixel(260, 200)") != before


def test_keys_alone_turn_light_measure_and_note(page: Page, folder: Path) -> None:
    page.open(folder / "look.html")
    page.focus("picture")
    page.keys(Keys.ARROW_RIGHT)
    assert page.driver.find_elements(By.CSS_SELECTOR, "#marks .aim"), "where the keys point to"
    assert page.run("coupole.state.camera.azimuth") == pytest.approx(-94.2)
    ActionChains(page.driver).key_down(Keys.SHIFT).send_keys(Keys.ARROW_UP).key_up(Keys.SHIFT).perform()
    page.keys("m", Keys.ARROW_LEFT, Keys.ARROW_LEFT, "+", "m", "n")
    assert "distance" in page.browser.text("#status") or "note" in page.browser.text("#status")
    page.keys("a worn <edge>", Keys.ENTER)
    assert page.browser.text("#notes li span") == "a worn <edge>"


def test_tab_reaches_every_control(page: Page, folder: Path) -> None:
    page.open(folder / "look.html")
    page.driver.execute_script("document.querySelectorAll('details').forEach(one => one.open = true)")
    shown = f"[...document.querySelectorAll('{CONTROLS}')].filter(one => one.checkVisibility() && !one.disabled)"
    page.driver.execute_script(f"{shown}.forEach((one, k) => one.dataset.place = k)")
    wanted = set(range(page.run(f"{shown}.length")))
    reached = set()
    for _ in range(len(wanted) + 2):
        page.keys(Keys.TAB)
        place = page.run("document.activeElement.dataset.place")
        reached.add(None if place is None else int(place))
    assert wanted - reached == set()


def test_every_control_has_a_name(page: Page, folder: Path) -> None:
    page.open(folder / "look.html")
    page.driver.execute_script("document.querySelectorAll('details').forEach(one => one.open = true)")
    controls = page.driver.find_elements(By.CSS_SELECTOR, CONTROLS)
    nameless = [
        one.get_attribute("outerHTML") for one in controls if one.is_displayed() and not one.accessible_name
    ]
    assert nameless == []


def test_on_a_telephone_nothing_sticks_out_and_all_is_large_enough_to_touch(page: Page, folder: Path) -> None:
    metrics = {"width": 400, "height": 800, "deviceScaleFactor": 1, "mobile": True}
    page.driver.execute_cdp_cmd("Emulation.setDeviceMetricsOverride", metrics)
    try:
        page.open(folder / "look.html", "#")
        page.driver.execute_script("document.querySelectorAll('details').forEach(one => one.open = true)")
        assert page.run("document.documentElement.scrollWidth") <= 400
        boxes = page.run(
            f"[...document.querySelectorAll('{CONTROLS}')].filter(one => one.checkVisibility())"
            ".map(one => [one.id || one.textContent, ...Object.values(one.getBoundingClientRect().toJSON())])"
        )
        outside = [name for name, x, _, width, *_ in boxes if x < 0 or x + width > 400]
        assert outside == []
        assert [name for name, _, _, width, height, *_ in boxes if width < 24 or height < 24] == []  # WCAG 2.5.8
        tools, canvas = page.browser.at("#tools").rect, page.browser.at("#picture").rect
        assert tools["y"] + tools["height"] <= canvas["y"] + canvas["height"]
    finally:
        page.driver.execute_cdp_cmd("Emulation.clearDeviceMetricsOverride", {})


def luminance(text: str) -> float:
    """Relative, of a colour as the browser tells it (WCAG 2.2)."""
    red, green, blue = (int(one) / 255 for one in re.findall(r"\d+", text)[:3])
    linear = [one / 12.92 if one <= 0.04045 else ((one + 0.055) / 1.055) ** 2.4 for one in (red, green, blue)]
    return 0.2126 * linear[0] + 0.7152 * linear[1] + 0.0722 * linear[2]


def contrast(one: str, other: str) -> float:
    low, high = sorted([luminance(one), luminance(other)])
    return (high + 0.05) / (low + 0.05)


BEHIND = """(one) => {
  while (getComputedStyle(one).backgroundColor === 'rgba(0, 0, 0, 0)') one = one.parentElement;
  return getComputedStyle(one).backgroundColor;
}"""


@pytest.mark.parametrize("theme", ["dark", "light"])
def test_all_words_and_the_focus_stand_out_from_what_is_behind_them(page: Page, folder: Path, theme: str) -> None:
    """WCAG 2.2: 4.5 at least of words (1.4.3), 3 of controls' edges and of the focus (1.4.11)."""
    page.open(folder / "look.html")
    page.driver.execute_script("document.querySelectorAll('details').forEach(one => one.open = true)")
    page.driver.execute_script(
        "document.head.append(Object.assign(document.createElement('style'), "
        "{textContent: '* { transition: none !important; }'}))"
    )
    Select(page.browser.at("#theme")).select_by_value(theme)
    try:
        pairs = page.run(f"""[...document.querySelectorAll('#panel *, #tools *, #banner, #scale')]
            .filter(one => one.checkVisibility() && [...one.childNodes].some(node => node.nodeType === 3))
            .map(one => [getComputedStyle(one).color, ({BEHIND})(one), one.textContent])""")
        assert len(pairs) > 30
        for front, behind, words in pairs:
            assert contrast(front, behind) >= 4.5, words
        edges = page.run(f"""[...document.querySelectorAll('button, select, input[type=number]')]
            .filter(one => one.checkVisibility())
            .map(one => [getComputedStyle(one).borderTopColor, ({BEHIND})(one.parentElement), one.textContent])""")
        for edge, behind, words in edges:
            assert contrast(edge, behind) >= 3.0, words
        page.focus("white")
        page.keys(Keys.TAB)
        focus = page.run("getComputedStyle(document.activeElement).outlineColor")
        assert page.run("parseFloat(getComputedStyle(document.activeElement).outlineWidth)") >= 2
        for behind in ("#panel", "body"):
            assert contrast(focus, page.browser.at(behind).value_of_css_property("background-color")) >= 3.0
    finally:
        Select(page.browser.at("#theme")).select_by_value("system")


def test_the_page_is_as_light_as_the_system_unless_it_is_told_otherwise(page: Page, folder: Path) -> None:
    page.open(folder / "look.html")
    for system, chosen, shown in (("light", "system", 0.5), ("dark", "system", 0.0), ("dark", "light", 0.5)):
        media = {"features": [{"name": "prefers-color-scheme", "value": system}]}
        page.driver.execute_cdp_cmd("Emulation.setEmulatedMedia", media)
        Select(page.browser.at("#theme")).select_by_value(chosen)
        found = luminance(page.browser.at("body").value_of_css_property("background-color"))
        assert found == pytest.approx(shown + 0.25, abs=0.25), (system, chosen)
    page.driver.execute_cdp_cmd("Emulation.setEmulatedMedia", {"features": []})
    Select(page.browser.at("#theme")).select_by_value("system")


def test_an_address_brings_back_view_light_and_notes(page: Page, folder: Path) -> None:
    page.open(folder / "look.html")
    page.look(30.0, 40.0, 170.0, softness=2.0)
    page.run("coupole.setLight(0.3, -0.2, 0.9)")
    page.focus("picture")
    page.keys("n")
    page.keys("here", Keys.ENTER)
    page.browser.at("#link").click()
    left, address = page.run("coupole.state"), page.run("location.hash")
    page.open(folder / "look.html", address)
    found = page.run("coupole.state")
    assert [note["text"] for note in found["notes"]] == ["here"]
    assert found["camera"]["azimuth"] == 30.0
    assert found["camera"]["distance"] == 170.0
    assert found["lights"][0]["softness"] == 2.0
    np.testing.assert_allclose(found["lights"][0]["direction"], left["lights"][0]["direction"], rtol=1e-4)


def test_an_address_that_was_damaged_opens_the_page_as_it_begins(page: Page, folder: Path) -> None:
    page.open(folder / "look.html", "#eyJtb2RlIjoi")
    assert page.run("coupole.state.mode") == "relit"
    sound = page.run("coupole.state")
    inherited = [{"mode": "toString"}, {"quantity": "toString"}]
    inherited += [{"lights": [{**sound["lights"][0], "illuminant": "toString"}]}]
    for wrong in inherited:
        address = base64.urlsafe_b64encode(json.dumps({**sound, "white": 0.25, **wrong}).encode()).decode()
        page.open(folder / "look.html", "#" + address.rstrip("="))
        assert page.run("coupole.state.white") != 0.25
    assert page.browser.troubles() == []


def test_a_point_tells_its_material(page: Page, folder: Path) -> None:
    page.open(folder / "look.html")
    page.focus("picture")
    page.keys(Keys.ENTER)
    told = page.browser.text("#point")
    assert "0.0500 / 0.0400 / 0.0300" in told
    assert "0.400 / 0.300 / 0.200" in told
    assert "holds no samples" in told
    assert page.driver.find_elements(By.CSS_SELECTOR, "#point svg polyline")


@pytest.mark.parametrize("most_bytes", [MOST_BYTES, 1000])
def test_a_point_tells_its_measured_samples_beside_the_fit(page: Page, tmp_path: Path, most_bytes: int) -> None:
    result = write_result(tmp_path / "result", sheet(np.zeros((5, 5)), 60.0), camera_mm=(0.0, 0.0, 330.0))
    with h5py.File(result.views[0].path, "a") as file:
        file["f"][...] = 1.2 * np.array(Coat().kd)
        file["u_own"], file["led_u_own"] = np.full(file["f"].shape, 0.02, np.float16), np.zeros((1, 3))
    look = look_of_result(tmp_path / "result", with_samples=True)
    files = write_page(look, "sheet", tmp_path / "look.html", most_bytes)
    page.open(tmp_path / "look.html", "#")
    page.look(-90.0, 80.0, 200.0)
    page.focus("picture")
    page.keys(Keys.ENTER)
    cells.wait_until(lambda: "median" in page.browser.text("#samples-told"), "samples")
    told = page.browser.text("#samples-told")
    assert "1 measured samples of top" in told
    share = float(re.findall(r"difference ([\d.]+) %", told)[0])
    assert share == pytest.approx(100 * (1 - 1 / 1.2), abs=2.5)  # values are kept to 2.3 %
    assert "holds no samples" not in page.browser.text("#point")
    if most_bytes == 1000:
        next(file for file in files if file.name == "samples-top-0.js").unlink()
        page.open(tmp_path / "look.html", "#")
        page.focus("picture")
        page.keys(Keys.ENTER)
        cells.wait_until(lambda: "No samples" in page.browser.text("#samples-told"), "what is missing")


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
    assert "eye used to the chosen light (Bradford)" in page.browser.text("#banner")


def test_the_ruler_measures_what_the_object_measures(page: Page, tmp_path: Path) -> None:
    flat = sheet(np.zeros((5, 5)), 60.0)
    write_result(tmp_path / "result", flat, camera_mm=(0.0, 0.0, 330.0))
    write_page(look_of_result(tmp_path / "result"), "sheet", tmp_path / "look.html")
    page.open(tmp_path / "look.html")
    page.look(-90.0, 89.0, 300.0)
    page.browser.at("[data-tool=measure]").click()
    canvas = page.browser.at("#picture")
    for offset in (-60, 60):
        ActionChains(page.driver).move_to_element_with_offset(canvas, offset, 0).click().perform()
    shorter = min(canvas.size["width"], canvas.size["height"])
    expected_mm = 120 * 2 * 300.0 * math.tan(math.radians(FIELD_DEG / 2)) / shorter
    told_mm = float(re.findall(r"([\d.]+) mm", page.browser.text("#status"))[0])
    assert told_mm == pytest.approx(expected_mm, rel=0.01)


def test_a_pixel_tells_how_well_its_material_is_known(page: Page, folder: Path) -> None:
    page.open(folder / "look.html")
    page.small()
    page.look(-70.0, 50.0, 150.0)
    page.run("coupole.state = {...coupole.state, mode: 'roughness'}")
    values = page.picture(1)
    assert values[60, 80, 0] == pytest.approx(GLOSSY.alpha, rel=1e-3)
    page.run("coupole.state = {...coupole.state, mode: 'uncertainty'}")
    assert page.picture(1)[60, 80, 0] == pytest.approx(1e-4, rel=0.03)  # 0 in the file, the least that is told


def test_pixels_outside_of_the_picture_and_lights_without_direction_are_refused(page: Page, folder: Path) -> None:
    page.open(folder / "look.html")
    for call in ("readPixel(-1, 5)", "readPixel(5, 1e6)", "readPixel(0.5, 5)", "setLight(0, 0, 0)", "setLight(1)"):
        refused = f"try {{ coupole.{call}; }} catch (error) {{ return error.message; }}"
        assert "expected" in page.driver.execute_script(refused), call


def test_data_that_are_gone_from_beside_the_page_are_named(page: Page, tmp_path: Path) -> None:
    write_result(tmp_path / "result", waves(16), GLOSSY)
    files = write_page(look_of_result(tmp_path / "result"), "waves", tmp_path / "look.html", most_bytes=1000)
    next(file for file in files if file.name == "kd.js").unlink()
    page.opened = None
    page.browser.open(f"file://{tmp_path / 'look.html'}")
    told = cells.wait_until(lambda: page.browser.text("#status").replace("Reading…", ""), "what is missing")
    assert "(kd): keep its .data folder beside it" in told


def test_a_coarse_picture_comes_first_and_the_whole_mesh_takes_its_place(page: Page, folder: Path) -> None:
    write_page(look_of_result(folder / "result", coarse_over=500), "waves", folder / "coarse.html")
    page.open(folder / "coarse.html")
    assert page.run("performance.getEntriesByName('coupole: first picture').length") == 1
    page.small()
    page.look(-70.0, 50.0, 150.0)
    mine = page.picture(1)
    page.open(folder / "look.html")
    page.small()
    page.look(-70.0, 50.0, 150.0)
    np.testing.assert_array_equal(mine, page.picture(1))


def test_the_coarse_picture_stays_where_the_rest_is_missing(page: Page, folder: Path, tmp_path: Path) -> None:
    look = look_of_result(folder / "result", coarse_over=500)
    files = write_page(look, "waves", tmp_path / "look.html", most_bytes=1000)
    next(file for file in files if file.name == "kd.js").unlink()
    page.opened = None
    page.browser.open(f"file://{tmp_path / 'look.html'}")
    cells.wait_until(lambda: "(kd)" in page.browser.text("#status"), "what is missing")
    bright = """(() => {
        const shown = Object.assign(document.createElement("canvas"), { width: 60, height: 60 }).getContext("2d");
        shown.drawImage(document.getElementById("picture"), 0, 0, 60, 60);
        return shown.getImageData(0, 0, 60, 60).data.filter((value, k) => k % 4 === 1 && value > 60).length;
    })()"""
    assert page.run(bright) > 300


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
