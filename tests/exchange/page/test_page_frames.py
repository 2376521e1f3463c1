"""Measured frames on the page, beside what fits make of the same LED."""

from __future__ import annotations

from pathlib import Path

import cells
import h5py
import numpy as np
import pytest
from browser import needs_chromium
from relight_cases import LED, Coat, waves, write_result
from selenium.webdriver.support.select import Select
from shown_page import Page

from coupole.exchange.look.look_of_runs import look_of_result
from coupole.exchange.look.look_page import MOST_BYTES, write_page
from coupole.reflectance.new_light.light_kinds import LedLight
from coupole.reflectance.run_relighting import scene_of_view
from coupole.reflectance.run_result import RunResult

pytestmark = needs_chromium


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
