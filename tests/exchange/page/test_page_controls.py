"""The page's controls: by pointer, keys and touch, for all eyes, kept in the address."""

from __future__ import annotations

import base64
import json
import re
from pathlib import Path

import cells
import numpy as np
import pytest
from axe_selenium_python import Axe
from browser import needs_chromium
from selenium.webdriver.common.action_chains import ActionChains
from selenium.webdriver.common.by import By
from selenium.webdriver.common.keys import Keys
from selenium.webdriver.support.select import Select
from shown_page import CONTROLS, Page

pytestmark = needs_chromium


def _pixel(page: Page) -> list[int]:
    """A pixel, once the picture has its whole size: while something moves it may have less."""
    look = "(() => { try { return coupole.readPixel(230, 110); } catch (error) { return null; } })()"
    found: list[int] = cells.wait_until(lambda: page.run(look), "the picture in its whole size")
    return found


def test_dragging_the_light_moves_it_and_changes_the_picture(page: Page, folder: Path) -> None:
    page.open(folder / "look.html")
    page.wide()
    before, way = _pixel(page), page.run("coupole.state.lights[0].direction")
    page.browser.at("[data-tool=light]").click()
    canvas = page.browser.at("#picture")
    ActionChains(page.driver).drag_and_drop_by_offset(canvas, 60, 0).perform()
    after = page.run("coupole.state.lights[0].direction")
    assert after[0] > way[0] + 0.2
    assert _pixel(page) != before


def test_keys_alone_turn_light_measure_and_note(page: Page, folder: Path) -> None:
    page.open(folder / "look.html")
    page.wide()
    page.focus("picture")
    page.keys(Keys.ARROW_RIGHT)
    assert page.driver.find_elements(By.CSS_SELECTOR, "#marks .aim"), "where the keys point to"
    assert page.run("coupole.state.camera.azimuth") == pytest.approx(-94.2)
    ActionChains(page.driver).key_down(Keys.SHIFT).send_keys(Keys.ARROW_UP).key_up(Keys.SHIFT).perform()
    page.keys("m", Keys.ARROW_LEFT, Keys.ARROW_LEFT, "+", "m", "n")
    assert "distance" in page.browser.text("#status") or "note" in page.browser.text("#status")
    page.keys("a worn <edge>", Keys.ENTER)
    assert page.browser.text("#notes li span") == "a worn <edge>"


@pytest.mark.parametrize(
    ("preset", "across", "up"), [("raking 0", 1.0, 0.0), ("raking 3", -0.71, 0.71), ("candle", -0.82, -0.57)]
)
def test_presets_light_from_where_they_say_as_the_picture_has_it(
    page: Page, folder: Path, preset: str, across: float, up: float
) -> None:
    """Whatever the camera: its right is where the sum of azimuth and 90 degrees points."""
    page.open(folder / "look.html")
    page.small()
    for azimuth in (-90.0, 20.0):
        page.look(azimuth, 60.0, 150.0)
        page.driver.execute_script(
            "const chosen = document.getElementById('preset'); chosen.value = arguments[0];"
            "chosen.dispatchEvent(new Event('change'))",
            preset,
        )
        (light,) = page.run("coupole.state.lights")
        x, y, z = light["direction"]
        right = np.radians(azimuth + 90.0)
        level = np.hypot(x, y)
        assert (x * np.cos(right) + y * np.sin(right)) / level == pytest.approx(across, abs=0.01)
        assert (y * np.cos(right) - x * np.sin(right)) / level == pytest.approx(up, abs=0.01)
        assert np.degrees(np.arctan2(z, level)) == pytest.approx(12.0 if "raking" in preset else 20.0, abs=0.1)
        assert page.run("document.getElementById('preset').value") == ""
    assert (page.picture(1)[..., :3] > 0.0).any()


def test_tab_reaches_every_control(page: Page, folder: Path) -> None:
    page.open(folder / "look.html")
    page.wide()
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
    page.wide()
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
    page.wide()
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
    page.wide()
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
    page.wide()
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


def test_pixels_outside_of_the_picture_and_lights_without_direction_are_refused(page: Page, folder: Path) -> None:
    page.open(folder / "look.html")
    page.wide()
    for call in ("readPixel(-1, 5)", "readPixel(5, 1e6)", "readPixel(0.5, 5)", "setLight(0, 0, 0)", "setLight(1)"):
        refused = f"try {{ coupole.{call}; }} catch (error) {{ return error.message; }}"
        assert "expected" in page.driver.execute_script(refused), call


@pytest.mark.parametrize(("width", "height"), [(1440, 900), (360, 780)])
def test_axe_finds_nothing_with_all_of_the_settings_open(
    page: Page, folder: Path, width: int, height: int
) -> None:
    metrics = {"width": width, "height": height, "deviceScaleFactor": 1, "mobile": width < 700}
    page.driver.execute_cdp_cmd("Emulation.setDeviceMetricsOverride", metrics)
    try:
        page.open(folder / "look.html", "#")
        page.driver.execute_script("document.querySelectorAll('details').forEach(one => one.open = true)")
        axe = Axe(page.driver)
        axe.inject()
        assert [f"{found['id']}: {found['nodes'][0]['html']}" for found in axe.run()["violations"]] == []
        assert page.run("document.documentElement.scrollWidth") <= width
    finally:
        page.driver.execute_cdp_cmd("Emulation.clearDeviceMetricsOverride", {})
