"""The page opens from disk: without a network, at once, and with what is missing named."""

from __future__ import annotations

import re
import time
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from pathlib import Path
from threading import Event

import cells
import numpy as np
import pytest
from browser import needs_chromium
from relight_cases import GLOSSY, waves, write_result
from selenium.webdriver.common.action_chains import ActionChains
from shown_page import SMALL, Page

from coupole.exchange.look.look_blocks import block_of
from coupole.exchange.look.look_of_runs import PageChoice, look_of_result
from coupole.exchange.look.look_page import write_page

pytestmark = needs_chromium


def test_the_page_opens_from_disk_without_a_network_and_loads_nothing(page: Page, folder: Path) -> None:
    page.open(folder / "look.html")
    page.wide()
    assert page.run("coupole.readPicture().rgba.some(value => value > 0)")
    assert page.run("performance.getEntriesByType('resource').length") == 0
    assert "Simulated object" in page.browser.text("#banner")
    assert page.browser.text("#status") == ""
    assert page.browser.troubles() == []


FIRST_PICTURE_S, TRIALS = 3.0, 3
MARK = "performance.getEntriesByName('coupole: first picture')"


def demo_sized(folder: Path) -> Path:
    """A page of 19,602 triangles and 3 MB, as that of the demo: its frames and residuals are noise here."""
    result = write_result(folder / "result", waves(100), GLOSSY)
    look = look_of_result(result.folder)
    more = block_of("frame-more", np.random.default_rng(0).integers(0, 256, 2_000_000).astype(np.uint8))
    path, *beside = write_page(replace(look, later=(*look.later, more)), "waves", folder / "look.html")
    assert not beside
    assert path.stat().st_size > 2_900_000
    return path


def seconds_to_the_first_picture(page: Page, path: Path) -> tuple[float, float]:
    """From the start of navigation: by the clock, and the CPU time that the browser took for it."""
    taken: list[tuple[float, float]] = []
    ended = Event()

    def watch() -> None:
        while not ended.wait(0.05):
            taken.append((time.time(), page.browser.cpu_s()))

    with ThreadPoolExecutor(1) as pool:
        watched = pool.submit(watch)
        page.browser.open(path.as_uri())
        cells.wait_until(lambda: page.run(f"{MARK}.length"), "the first picture")
        ended.set()
        watched.result()
    begun, lasted = page.run(f"[performance.timeOrigin / 1000, {MARK}[0].startTime / 1000]")
    cpu = np.interp([begun, begun + lasted], *np.transpose(taken))
    return lasted, float(cpu[1] - cpu[0])


@pytest.mark.full
def test_the_first_picture_of_the_demo_comes_within_three_seconds(page: Page, tmp_path: Path) -> None:
    """On a machine that others use too, a clock tells of them: then what counts is the CPU time that all processes
    of the browser took until the picture stood there. The best of three, each with shaders that the browser has
    not seen before, as it keeps what it has compiled."""
    text = demo_sized(tmp_path).read_text()
    page.opened = None
    page.driver.set_window_size(1300, 960)
    trials: list[tuple[float, float]] = []
    while len(trials) < TRIALS and not any(min(trial) < FIRST_PICTURE_S for trial in trials):
        path = tmp_path / f"{len(trials)}.html"
        path.write_text(re.sub(r"(RELIEF_PX|HATCH_PX) = (\d)\.0", rf"\1 = \2.000{len(trials)}1", text))
        trials.append(seconds_to_the_first_picture(page, path))
    page.run("coupole.setSamples(1)")
    page.driver.set_window_size(*SMALL)
    assert min(map(min, trials)) < FIRST_PICTURE_S, trials


def test_data_that_are_gone_from_beside_the_page_are_named(page: Page, tmp_path: Path) -> None:
    write_result(tmp_path / "result", waves(16), GLOSSY)
    files = write_page(look_of_result(tmp_path / "result"), "waves", tmp_path / "look.html", most_bytes=1000)
    next(file for file in files if file.name == "kd.js").unlink()
    page.opened = None
    page.browser.open(f"file://{tmp_path / 'look.html'}")
    told = cells.wait_until(lambda: page.browser.text("#status").replace("Reading…", ""), "what is missing")
    assert "(kd): keep its .data folder beside it" in told


def test_a_coarse_picture_comes_first_and_the_whole_mesh_takes_its_place(page: Page, folder: Path) -> None:
    write_page(
        look_of_result(folder / "result", choice=PageChoice(coarse_over=500)), "waves", folder / "coarse.html"
    )
    page.open(folder / "coarse.html")
    assert page.run("performance.getEntriesByName('coupole: first picture').length") == 1
    page.small()
    page.look(-70.0, 50.0, 150.0)
    mine = page.picture(1)
    page.open(folder / "look.html")
    page.small()
    page.look(-70.0, 50.0, 150.0)
    np.testing.assert_array_equal(mine, page.picture(1))


SLOW_FINE_MESH = """
window.drawn = [];
const draw = WebGL2RenderingContext.prototype.drawArrays;
WebGL2RenderingContext.prototype.drawArrays = function (mode, first, count) {
  draw.call(this, mode, first, count);
  if (count <= 3) return;
  window.drawn.push([count / 3, this.canvas.width]);
  const begun_ms = performance.now();
  while (count / 3 > 500 && performance.now() - begun_ms < 300);
};
"""
"""Graphics for which a mesh of more than 500 triangles is too much: each of its pictures takes longer than the
page waits for the next motion."""


def test_on_slow_graphics_the_coarse_mesh_is_turned_and_all_comes_back_at_rest(page: Page, folder: Path) -> None:
    look = look_of_result(folder / "result", choice=PageChoice(coarse_over=500))
    page.open(write_page(look, "waves", folder / "turned.html")[0])
    page.wide()
    fine, wide = look.about["triangles"], page.run("document.getElementById('picture').width")
    page.run("coupole.whole()")
    page.driver.execute_script(SLOW_FINE_MESH)
    pointer = ActionChains(page.driver, duration=50).click_and_hold(page.browser.at("#picture"))
    for number in range(30):
        pointer.move_by_offset(5 if number % 10 < 5 else -5, 0)
    pointer.release().perform()
    drawn = cells.wait_until(
        lambda: (seen := page.run("drawn"))[-1] == [fine, wide] and len(seen) > 5 and seen, "all of the detail"
    )
    turned = [width for triangles, width in drawn if triangles <= 500]
    assert turned, "the coarse mesh was never drawn"
    assert set(turned) == {round(wide / 4)}
    assert len([one for one in drawn if one[0] == fine]) < 8


def test_the_coarse_picture_stays_where_the_rest_is_missing(page: Page, folder: Path, tmp_path: Path) -> None:
    look = look_of_result(folder / "result", choice=PageChoice(coarse_over=500))
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


MOTION = "Emulation.setEmulatedMedia"


def test_the_light_moves_at_first_and_stops_where_it_is_at_the_first_touch(page: Page, folder: Path) -> None:
    page.driver.execute_cdp_cmd(
        MOTION, {"features": [{"name": "prefers-reduced-motion", "value": "no-preference"}]}
    )
    try:
        page.opened = None
        page.browser.open((folder / "look.html").as_uri())
        way = "coupole.state?.lights[0].direction"
        first = cells.wait_until(lambda: page.run(way), "the page's interface")
        cells.wait_until(lambda: np.abs(np.subtract(page.run(way), first)).max() > 0.02, "the light to move")
        assert page.browser.at("#moving").get_attribute("aria-pressed") == "true"
        assert not page.browser.at("#panel").is_displayed()
        ActionChains(page.driver).move_to_element(page.browser.at("#picture")).click().perform()
        assert page.browser.at("#moving").get_attribute("aria-pressed") == "false"
        rests = page.run(way)
        time.sleep(0.5)
        assert page.run(way) == rests
        page.browser.at("#moving").click()
        cells.wait_until(lambda: np.abs(np.subtract(page.run(way), rests)).max() > 0.02, "the light to move again")
        page.run("coupole.setSamples(1)")
    finally:
        page.driver.execute_cdp_cmd(MOTION, {"features": []})


def test_no_light_moves_for_who_wants_less_motion_or_has_an_address(page: Page, folder: Path) -> None:
    page.open(folder / "look.html", "#")
    assert page.browser.at("#moving").get_attribute("aria-pressed") == "false"
    address = page.run("location.hash") or "#"
    page.driver.execute_cdp_cmd(
        MOTION, {"features": [{"name": "prefers-reduced-motion", "value": "no-preference"}]}
    )
    try:
        page.browser.at("#link").click()
        address = page.run("location.hash")
        page.open(folder / "look.html", address)
        before = page.run("coupole.state.lights[0].direction")
        time.sleep(0.5)
        assert page.run("coupole.state.lights[0].direction") == before
    finally:
        page.driver.execute_cdp_cmd(MOTION, {"features": []})


def test_the_object_fills_the_window_between_words_and_tools(page: Page, folder: Path) -> None:
    page.open(folder / "look.html", "#")
    page.wide()
    page.browser.at("#reset").click()
    seen = page.driver.execute_script("""
        coupole.readPixel(0, 0);
        const picture = document.getElementById("picture"), { width, height } = picture;
        const copy = Object.assign(document.createElement("canvas"), { width, height }).getContext("2d");
        copy.drawImage(picture, 0, 0);
        const { data } = copy.getImageData(0, 0, width, height), found = [width, height, 0, 0];
        for (let k = 0; k < data.length; k += 4) {
          if (data[k] === data[0] && data[k + 1] === data[1]) continue;  // the ground
          const x = k / 4 % width, y = Math.floor(k / 4 / width);
          found[0] = Math.min(found[0], x); found[1] = Math.min(found[1], y);
          found[2] = Math.max(found[2], x); found[3] = Math.max(found[3], y);
        }
        const stage = document.getElementById("stage").getBoundingClientRect();
        const end = (name, side) => document.getElementById(name).getBoundingClientRect()[side] - stage.top;
        return { found, width, top: end("words", "bottom"), bottom: end("tools", "top") };""")
    left, top, right, bottom = seen["found"]
    assert top >= seen["top"] - 1
    assert bottom <= seen["bottom"] + 1
    assert max((right - left) / seen["width"], (bottom - top) / (seen["bottom"] - seen["top"])) > 0.9
