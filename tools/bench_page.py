"""The page of `coupole show` with many texels, in Chromium with its software renderer: the time to the first
picture, and pictures a second while the object is turned by the mouse.

The object is a wavy sheet with stripes and bumps of its texels, made without a run. A clock tells of other
programs on the machine too, so each figure also has the CPU time that all processes of the browser took.
"""

from __future__ import annotations

import statistics
import sys
import tempfile
import time
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

FIRST_PICTURE_S, PICTURES_PER_S = 3.0, 15.0
"""Limits."""
TURNED_S, BEFORE_S, LEAST_PICTURES = 5.0, 2.0, 8
"""Duration of a turn that is measured, and of the turning before it, in which the page finds its detail; and the
fewest pictures of each, on a machine that needs more time for them."""
WHOLE_WITHIN_S = 1800.0
"""Longest wait until all texels have come. A software renderer needs minutes."""
_MARK = "performance.getEntriesByName('coupole: first picture')"
_WHEN_WHOLE = "void coupole.ready.then(() => coupole.whole()).then(() => { window.isWhole = true; })"
"""Script that notes when all texels have come. A script that waits for it would exceed the driver's time limit."""
_COUNT = """
window.drawn = 0;
const read = WebGL2RenderingContext.prototype.readPixels;
WebGL2RenderingContext.prototype.readPixels = function (...words) {
  window.drawn += 1;
  return read.apply(this, words);
};
"""
"""Script that counts pictures: while something moves, the page reads one pixel after each, to wait for it."""


@dataclass(frozen=True)
class Size:
    """Rows of the sheet's grid, how many times as fine as 160 x 120 its view is, greatest width of the maps."""

    rows: int = 400
    finer: int = 31
    map_px: int = 16384


SMALLEST = Size(20, 1, 512)


def figures(root: Path, rounds: int, *, smallest: bool = False) -> Iterator[dict[str, Any]]:
    """First picture and turning, for 20 million texels. Without Chromium there are none."""
    sys.path[:0] = [str(root), str(root / "tests")]
    from browser import CHROMIUM, DRIVER

    if not (CHROMIUM and DRIVER):
        return
    with tempfile.TemporaryDirectory(prefix="coupole-page-") as folder:
        path, more = _page(Path(folder), SMALLEST if smallest else Size())
        trials = [_trial(path) for _ in range(rounds)]
    middle = {name: statistics.median(trial[name] for trial in trials) for name in trials[0]}
    first_s, cpu_s = middle["first_picture_s"], middle["first_picture_cpu_s"]
    yield {
        "name": "page_first_picture", "value": first_s, "unit": "s", "peer": "limit_3_s",
        "ratio": FIRST_PICTURE_S / first_s, "cpu_s": round(cpu_s, 3), **more,
    }  # fmt: skip
    per_s = middle["pictures_per_s"]
    yield {
        "name": "page_turning", "value": per_s, "unit": "pictures/s", "peer": "limit_15_per_s",
        "ratio": per_s / PICTURES_PER_S, "cpu_s_a_picture": round(middle["cpu_s_a_picture"], 4),
        "canvas_share": round(middle["canvas_share"], 2), **more,
    }  # fmt: skip


def _page(folder: Path, size: Size) -> tuple[Path, dict[str, Any]]:
    """The page's file, and the numbers of its texels, triangles and bytes."""
    from painted_texels import paint_texels
    from relight_cases import GLOSSY, waves, write_result

    from coupole.exchange.look.look_of_runs import PageChoice, look_of_result
    from coupole.exchange.look.look_page import write_page

    result = write_result(folder / "result", waves(size.rows), GLOSSY, finer=size.finer)
    paint_texels(result)
    look = look_of_result(result.folder, choice=PageChoice(map_px=size.map_px))
    files = write_page(look, "waves", folder / "look.html")
    texels = int(look.about["told"]["Texels"].split(" ", 1)[0].replace(",", ""))
    written_mb = sum(file.stat().st_size for file in files) / 1e6
    return files[0], {"texels": texels, "triangles": look.about["triangles"], "mb": round(written_mb, 1)}


def _trial(path: Path) -> dict[str, float]:
    """A browser that has never seen the page."""
    from browser import Browser

    browser = Browser()
    try:
        browser.driver.set_script_timeout(600)
        before_s = browser.cpu_s()
        browser.driver.execute_cdp_cmd("Page.navigate", {"url": path.as_uri()})
        while not browser.run(f"{_MARK}.length"):
            time.sleep(0.02)
        cpu_s = browser.cpu_s() - before_s
        figures_of_trial = {
            "first_picture_s": browser.run(f"{_MARK}[0].startTime / 1000"),
            "first_picture_cpu_s": cpu_s,
        }
        browser.run(_WHEN_WHOLE)
        begun_s = time.monotonic()
        while not browser.run("window.isWhole === true"):
            if time.monotonic() - begun_s > WHOLE_WITHIN_S:
                raise TimeoutError(f"not all texels have come within {WHOLE_WITHIN_S:g} s")
            time.sleep(0.5)
        browser.driver.execute_script(_COUNT)
        return figures_of_trial | _turn_by_mouse(browser)
    finally:
        browser.driver.quit()


def _turn_by_mouse(browser: Any) -> dict[str, float]:
    """Pictures while the mouse turns the object."""
    from browser import Browser

    assert isinstance(browser, Browser)
    left_px, top_px, width, height = browser.run(
        "(() => { const { x, y, width, height } = document.getElementById('picture').getBoundingClientRect();"
        " return [x, y, width, height]; })()"
    )
    row = top_px + height / 2

    def mouse(kind: str, column: float) -> None:
        words = {"type": kind, "x": column, "y": row, "button": "left", "buttons": 1, "clickCount": 1}
        browser.driver.execute_cdp_cmd("Input.dispatchMouseEvent", words)

    def turn(seconds: float) -> None:
        begun_s, pictures_at_first = time.monotonic(), browser.run("window.drawn")
        while (since_s := time.monotonic() - begun_s) < seconds or (
            browser.run("window.drawn") - pictures_at_first < LEAST_PICTURES
        ):
            mouse("mouseMoved", left_px + width * (0.3 + 0.4 * abs(since_s % 2.0 - 1.0)))

    mouse("mousePressed", left_px + 0.7 * width)
    turn(BEFORE_S)
    pictures_before, cpu_s, begun_s = browser.run("window.drawn"), browser.cpu_s(), time.monotonic()
    turn(TURNED_S)
    pictures, taken_s = browser.run("window.drawn") - pictures_before, time.monotonic() - begun_s
    cpu_s = browser.cpu_s() - cpu_s
    share = browser.run("document.getElementById('picture').width") / (width * browser.run("devicePixelRatio"))
    mouse("mouseReleased", left_px + 0.5 * width)
    return {"pictures_per_s": pictures / taken_s, "cpu_s_a_picture": cpu_s / pictures, "canvas_share": share}
