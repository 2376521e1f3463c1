"""What the page tells of a point: material, samples, uncertainty, distance."""

from __future__ import annotations

import math
import re
from pathlib import Path

import cells
import h5py
import numpy as np
import pytest
from browser import needs_chromium
from relight_cases import GLOSSY, Coat, sheet, write_result, write_sources
from selenium.webdriver.common.action_chains import ActionChains
from selenium.webdriver.common.by import By
from selenium.webdriver.common.keys import Keys
from shown_page import FIELD_DEG, Page

from coupole.exchange.look.look_of_runs import PageChoice, look_of_result
from coupole.exchange.look.look_page import MOST_BYTES, write_page

pytestmark = needs_chromium


def test_a_point_tells_its_material(page: Page, folder: Path) -> None:
    page.open(folder / "look.html")
    page.wide()
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
        write_sources(file, {"u_own": 0.02, "led_u_shared": 0.03})
    look = look_of_result(tmp_path / "result", choice=PageChoice(with_samples=True))
    files = write_page(look, "sheet", tmp_path / "look.html", most_bytes)
    page.open(tmp_path / "look.html", "#")
    page.look(-90.0, 80.0, 200.0)
    page.focus("picture")
    page.keys(Keys.ENTER)
    cells.wait_until(lambda: "median" in page.browser.text("#samples-told"), "samples")
    told = page.browser.text("#samples-told")
    assert "1 measured samples of top" in told
    below, above = map(float, re.findall(r"median ([\d.]+) % below, ([\d.]+) % above", told)[0])
    assert below == pytest.approx(above, rel=0.2)
    assert (below + above) / 2 == pytest.approx(196 * math.hypot(0.02, 0.03), rel=0.05)
    share = float(re.findall(r"difference ([\d.]+) %", told)[0])
    assert share == pytest.approx(100 * (1 - 1 / 1.2), abs=2.5)  # values are kept to 2.3 %
    assert "holds no samples" not in page.browser.text("#point")
    if most_bytes == 1000:
        next(file for file in files if file.name == "samples-top-0.js").unlink()
        page.open(tmp_path / "look.html", "#")
        page.focus("picture")
        page.keys(Keys.ENTER)
        cells.wait_until(lambda: "No samples" in page.browser.text("#samples-told"), "what is missing")


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
    told_mm = float(re.findall(r"distance ([\d.]+)", page.browser.text("#status"))[0])
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
