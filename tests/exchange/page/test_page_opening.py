"""The page opens from disk: without a network, at once, and with what is missing named."""

from __future__ import annotations

from pathlib import Path

import cells
import numpy as np
from browser import needs_chromium
from relight_cases import GLOSSY, waves, write_result
from shown_page import Page

from coupole.exchange.look.look_of_runs import look_of_result
from coupole.exchange.look.look_page import write_page

pytestmark = needs_chromium


def test_the_page_opens_from_disk_without_a_network_and_loads_nothing(page: Page, folder: Path) -> None:
    page.open(folder / "look.html")
    assert page.run("coupole.readPicture().rgba.some(value => value > 0)")
    assert page.run("performance.getEntriesByType('resource').length") == 0
    assert "Simulated object" in page.browser.text("#banner")
    assert page.browser.text("#status") == ""
    assert page.browser.troubles() == []


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
