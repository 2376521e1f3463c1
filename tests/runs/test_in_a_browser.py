"""The pages that operators look at, in a real browser without a screen: Chromium, where it is installed."""

from __future__ import annotations

import signal
from collections.abc import Iterator
from pathlib import Path

import cells
import pytest
from axe_selenium_python import Axe
from browser import Browser, needs_chromium
from cells import CellFolder
from selenium.webdriver.common.action_chains import ActionChains
from selenium.webdriver.common.by import By
from selenium.webdriver.common.keys import Keys
from test_live import live

pytestmark = needs_chromium
TELEPHONE = {"width": 400, "height": 800, "deviceScaleFactor": 1, "mobile": False}


@pytest.fixture(scope="module")
def browser() -> Iterator[Browser]:
    opened = Browser()
    yield opened
    opened.driver.quit()


@pytest.fixture(scope="module")
def shown_cell(tmp_path_factory: pytest.TempPathFactory) -> CellFolder:
    return CellFolder(tmp_path_factory.mktemp("shown"))


def test_a_plan_is_drawn_and_keys_go_from_view_to_view(browser: Browser, shown_cell: CellFolder) -> None:
    ended = cells.here("view", shown_cell.plan, "--out", shown_cell.folder, "--json")
    assert ended.code == 0, ended.err
    browser.open(f"file://{ended.document['html']}")
    browser.at(".gl-container canvas")
    assert browser.text("#view") == "all views"
    shown = "document.querySelector('.plotly-graph-div').data.map(trace => trace.visible)"
    before = browser.run(shown)
    ActionChains(browser.driver).send_keys(Keys.TAB, Keys.ARROW_RIGHT).perform()
    cells.wait_until(lambda: browser.text("#view").startswith("1 "), "the first view's words")
    assert browser.at("#step").get_attribute("aria-valuetext") == "1 top"
    assert browser.run(shown) != before
    buttons = browser.driver.find_elements(By.CSS_SELECTOR, ".modebar-btn")
    assert len(buttons) == 6
    assert [button for button in buttons if "hare" in str(button.get_dom_attribute("data-title"))] == []
    assert browser.run("document.documentElement.scrollWidth <= window.innerWidth")
    assert browser.troubles() == []


def test_the_operator_chooses_light_and_exposure(browser: Browser, shown_cell: CellFolder) -> None:
    with live(shown_cell.plan, "--fps", "20") as (viewer, _):
        browser.open(viewer.url)
        led = browser.at("#led")
        cells.wait_until(led.is_displayed, "the form")
        led.send_keys("500", Keys.ENTER)
        cells.wait_until(lambda: "500" in browser.text("#title"), "a frame under LED 500")
        assert "8000 us" in browser.text("#table")
        cells.wait_until(lambda: browser.run("document.getElementById('picture').naturalWidth") > 0, "a picture")
        inked = (
            "Array.from(document.getElementById('histogram').getContext('2d')"
            ".getImageData(0, 0, 384, 160).data).some(value => value > 0)"
        )
        assert browser.run(inked)
        picture, controls = browser.at("#picture").rect, browser.at("aside").rect
        assert picture["x"] + picture["width"] <= controls["x"], "the controls stand beside the picture"
        assert controls["y"] + controls["height"] <= browser.run("window.innerHeight"), "all can be seen at once"
        assert browser.run("document.documentElement.scrollWidth <= window.innerWidth"), "nothing sticks out"
        led.clear()
        led.send_keys("501")
        exposure = browser.at("#exposure")
        exposure.clear()
        exposure.send_keys("99999990", Keys.ENTER)
        cells.wait_until(lambda: "exposure" in browser.text("#error"), "why it is refused")
        browser.at("#none").click()
        exposure.clear()
        exposure.send_keys("4000", Keys.ENTER)
        cells.wait_until(lambda: "4000 us" in browser.text("#table"), "the shorter exposure")
        cells.wait_until(lambda: browser.text("#error") == "", "no reason of a refusal")
        refused = [line for line in browser.troubles() if "choose" not in line]
        assert refused == []


def test_the_page_says_when_the_live_view_has_ended(browser: Browser, shown_cell: CellFolder) -> None:
    with live(shown_cell.plan, "--fps", "5") as (viewer, process):
        browser.open(viewer.url)
        cells.wait_until(lambda: browser.text("#title") != "waiting for a frame", "a frame")
        process.send_signal(signal.SIGINT)
        cells.wait_until(lambda: "ended" in browser.text("#error"), "word that it has ended")


def test_a_run_s_report_is_whole_and_for_everybody(browser: Browser, tmp_path: Path) -> None:
    """All pictures and links lead somewhere; on a telephone nothing sticks out; axe-core finds nothing."""
    cell = CellFolder(tmp_path)
    assert cell.acquire().code == 0
    driver = browser.driver
    driver.execute_cdp_cmd("Emulation.setDeviceMetricsOverride", TELEPHONE)
    try:
        for scheme in ("light", "dark"):
            features = [{"name": "prefers-color-scheme", "value": scheme}]
            driver.execute_cdp_cmd("Emulation.setEmulatedMedia", {"features": features})
            browser.open(f"file://{cell.run_folder / 'report.html'}")
            axe = Axe(driver)
            axe.inject()
            assert [f"{found['id']}: {found['nodes'][0]['html']}" for found in axe.run()["violations"]] == []
        assert browser.run("document.documentElement.scrollWidth <= window.innerWidth")
    finally:
        driver.execute_cdp_cmd("Emulation.clearDeviceMetricsOverride", {})
        driver.execute_cdp_cmd("Emulation.setEmulatedMedia", {"features": []})
    pictures = driver.find_elements(By.TAG_NAME, "img")
    assert pictures
    assert all(int(picture.get_property("naturalWidth")) > 0 for picture in pictures)
    places = [str(link.get_dom_attribute("href")) for link in driver.find_elements(By.TAG_NAME, "a")]
    files = {place for place in places if not place.startswith("#")}
    assert {"journal.jsonl", "views/top.h5", "inputs/plan.yaml"} <= files
    assert [name for name in files if not (cell.run_folder / name).is_file()] == []
    anchors = {place[1:] for place in places} - {name[1:] for name in files}
    assert [name for name in anchors if not driver.find_elements(By.ID, name)] == []
    assert browser.troubles() == []
