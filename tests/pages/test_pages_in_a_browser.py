"""Maps in a real browser, from disk and without a network: the value under pointer, finger and keys."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
from axe_selenium_python import Axe
from browser import Browser, needs_chromium
from selenium.webdriver.common.action_chains import ActionChains
from selenium.webdriver.common.keys import Keys
from test_page_parts import everything

from coupole.pages.maps import normal_map, shaded_map, value_map
from coupole.pages.page_parts import Page, Section
from coupole.pages.page_rendering import write_page

pytestmark = needs_chromium
TELEPHONE = {"width": 400, "height": 800, "deviceScaleFactor": 1, "mobile": False}
HEIGHT, WIDTH = 30, 40
SLOPE = np.tile(np.linspace(-2.0, 2.0, WIDTH), (HEIGHT, 1))
"""Values that rise from left to right."""


@pytest.fixture(scope="module")
def browser() -> Iterator[Browser]:
    opened = Browser()
    opened.driver.set_network_conditions(offline=True, latency=0, throughput=0)
    yield opened
    opened.driver.quit()


@pytest.fixture(scope="module")
def page(tmp_path_factory: pytest.TempPathFactory) -> Path:
    values = SLOPE.copy()
    values[:, 0] = np.nan
    tilted = np.broadcast_to(np.array([0.0, 0.6, 0.8]), (HEIGHT, WIDTH, 3))
    maps = [
        value_map("distance", values, "mm", 1.0, low=-2.0, palette="signed"),
        normal_map("normals", tilted),
        shaded_map("shaded", values, np.full((HEIGHT, WIDTH), 0.5), "mm", 2.0, low=-2.0, palette="amount"),
    ]
    path = tmp_path_factory.mktemp("page") / "maps.html"
    write_page(path, Page("maps", maps[:1], "a", "b", "c", sections=[Section("more", "More", figures=maps[1:])]))
    return path


def told(browser: Browser, number: int, across: float, down: float = 0.5) -> str:
    """What the page says when the pointer is at a place of a map, in shares of its size."""
    shown = browser.driver.find_elements("css selector", ".map")[number]
    size = shown.size
    x, y = (round((share - 0.5) * size[side]) for share, side in ((across, "width"), (down, "height")))
    ActionChains(browser.driver).move_to_element_with_offset(shown, x, y).perform()
    return str(browser.driver.find_elements("css selector", "output")[number].text)


def test_the_value_under_the_pointer_is_told_with_its_unit(browser: Browser, page: Path) -> None:
    browser.open(page.as_uri())
    for number in (0, 2):
        for across in (0.3, 0.5, 0.7):
            value, unit = told(browser, number, across).split()
            assert (unit, float(value)) == ("mm", pytest.approx(np.interp(across, [0, 1], [-2, 2]), abs=0.1))
    assert told(browser, 0, 0.99) == "at least 1 mm"
    assert told(browser, 0, 0.005) == "no value here"
    assert told(browser, 1, 0.5) == "x 0.00392, y 0.6, z 0.804"
    assert browser.troubles() == []


def test_keys_move_the_pointer_and_a_reader_hears_the_value(browser: Browser, page: Path) -> None:
    browser.open(page.as_uri())
    ActionChains(browser.driver).send_keys(Keys.TAB).perform()
    shown = browser.run("document.activeElement")
    assert shown.get_attribute("aria-label").startswith("distance")
    said = browser.at("output")
    assert said.get_attribute("aria-live") == "polite"
    before = float(said.text.split()[0])
    ActionChains(browser.driver).send_keys(Keys.ARROW_RIGHT, Keys.ARROW_RIGHT).perform()
    assert float(said.text.split()[0]) == pytest.approx(before + 8 / 39, abs=0.03)
    ActionChains(browser.driver).send_keys(*[Keys.ARROW_LEFT] * 60).perform()
    assert said.text == "no value here"


@pytest.mark.parametrize("scheme", ["light", "dark"])
def test_all_parts_are_for_everybody_on_a_telephone_too(browser: Browser, tmp_path: Path, scheme: str) -> None:
    path = tmp_path / "page.html"
    write_page(path, everything("some words"))
    driver = browser.driver
    driver.execute_cdp_cmd("Emulation.setDeviceMetricsOverride", TELEPHONE)
    features = [{"name": "prefers-color-scheme", "value": scheme}]
    driver.execute_cdp_cmd("Emulation.setEmulatedMedia", {"features": features})
    try:
        browser.open(path.as_uri())
        axe = Axe(driver)
        axe.inject()
        assert [f"{found['id']}: {found['nodes'][0]['html']}" for found in axe.run()["violations"]] == []
        assert browser.run("document.documentElement.scrollWidth <= window.innerWidth")
    finally:
        driver.execute_cdp_cmd("Emulation.clearDeviceMetricsOverride", {})
        driver.execute_cdp_cmd("Emulation.setEmulatedMedia", {"features": []})


def test_paper_is_white_and_has_what_is_folded(browser: Browser, tmp_path: Path) -> None:
    path = tmp_path / "page.html"
    write_page(path, Page("t", [], "a", "b", "c", sections=[Section("s", "S", words=["folded"], is_folded=True)]))
    driver = browser.driver
    features = [{"name": "prefers-color-scheme", "value": "dark"}]
    browser.open(path.as_uri())
    assert not browser.at("details p").is_displayed()
    driver.execute_cdp_cmd("Emulation.setEmulatedMedia", {"media": "print", "features": features})
    try:
        assert browser.run("getComputedStyle(document.body).backgroundColor") == "rgb(255, 255, 255)"
        assert browser.run("document.querySelector('details p').getBoundingClientRect().height") > 0
    finally:
        driver.execute_cdp_cmd("Emulation.setEmulatedMedia", {"media": "", "features": []})
