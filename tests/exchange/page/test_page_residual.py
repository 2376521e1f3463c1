"""What GGX leaves, on the page: as `relight` has it of the same fit, nearer to frames, and of its view alone."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pytest
from browser import needs_chromium
from relight_cases import waves
from residual_cases import LEFT_OUT, true_frame, write_backscatter
from selenium.webdriver.support.select import Select
from shown_page import Page, difference

from coupole.exchange.look.look_blocks import Look
from coupole.exchange.look.look_of_runs import look_of_result
from coupole.exchange.look.look_page import write_page
from coupole.reflectance.new_light.light_kinds import LedLight
from coupole.reflectance.run_relighting import scene_of_view

pytestmark = needs_chromium

RELIT, TRUE = LEFT_OUT, 2 * LEFT_OUT
"""LEDs that the fit has not seen: of the one the frame is `relight`'s of the fit, of the other the truth."""


@pytest.fixture(scope="module")
def look(tmp_path_factory: pytest.TempPathFactory) -> tuple[Look, Path]:
    folder = tmp_path_factory.mktemp("residual")
    result = write_backscatter(folder / "result", waves(26))
    relit = scene_of_view(result, "top", "ggx_rbf").picture([LedLight(number=RELIT)])
    frames = [np.where(relit > 0, relit, np.nan), true_frame(result, TRUE)]
    (folder / "result/samples/frames").mkdir()
    with h5py.File(folder / "result/samples/frames/top.h5", "w") as file:
        file["share"], file["leds"] = np.stack(frames).astype(np.float16), [RELIT, TRUE]
    look = look_of_result(folder / "result")
    write_page(look, "waves", folder / "look.html")
    return look, folder / "look.html"


def pictures(page: Page, look: Look, led: int) -> tuple[np.ndarray, dict[bool, np.ndarray], np.ndarray]:
    """The frame of an LED on the page, the fit with and without residual, and pixels that all have."""
    (frame,) = (one for one in look.about["views"][0]["frames"] if one["led"] == led)
    middle_mm = look.about["origin_mm"] + look.about["step_mm"] * np.mean(look.about["box"], axis=0)
    page.run(f"coupole.setLight(...{(frame['at_mm'] - middle_mm).tolist()})")

    def shown(split: int, *, with_residual: bool) -> np.ndarray:
        wanted: dict[str, Any] = {"split": split, "withResidual": with_residual}
        page.driver.execute_script("coupole.state = arguments[0]", wanted)
        page.wait_for_all()
        return page.picture(1)

    measured = shown(1, with_residual=True)
    fitted = {added: shown(0, with_residual=added) for added in (True, False)}
    both = (measured[..., 3] == 1) & fitted[True][..., :3].any(axis=2)
    assert both.mean() > 0.2
    return measured[..., :3], {added: one[..., :3] for added, one in fitted.items()}, both


def test_the_page_adds_the_residual_as_the_command_relight_does_and_is_nearer_to_frames(
    page: Page, look: tuple[Look, Path]
) -> None:
    page.open(look[1])
    page.small()
    page.run("document.getElementById('frames-section').open = true")
    Select(page.browser.at("#view")).select_by_visible_text("top")
    for led in (RELIT, TRUE):
        measured, fitted, both = pictures(page, look[0], led)
        white = float(np.quantile(measured[both], 0.999))
        off = {added: difference(one, measured, white)[both].mean() for added, one in fitted.items()}
        assert off[True] < 1.0  # of which the frame's 8 bits are some 0.3
        assert off[True] < 0.3 * off[False]
        missed = {added: np.abs(one - measured)[both].mean() for added, one in fitted.items()}
        assert missed[True] < 0.2 * missed[False]
    page.run("coupole.state = {withResidual: true}")
    assert f"with {100 * look[0].about['residual']['kept']:.4g} % of its residual" in page.browser.text("#banner")
    assert page.browser.troubles() == []


def test_far_from_its_view_the_residual_is_left_out_and_the_picture_says_so(
    page: Page, look: tuple[Look, Path]
) -> None:
    page.open(look[1])
    page.small()
    for azimuth, height, words in ((-63.4, 45.0, "23° from here"), (100.0, 30.0, "GGX alone")):
        page.look(azimuth, height, 150.0)
        page.run("coupole.setLight(-0.5, -0.6, 0.6)")
        page.wait_for_all()
        assert words in page.browser.text("#banner")
        mine = page.picture(1)
        Select(page.browser.at("#with-residual")).select_by_value("no")
        assert "GGX alone" in page.browser.text("#banner")
        assert np.array_equal(mine, page.picture(1)) == (words == "GGX alone")
        Select(page.browser.at("#with-residual")).select_by_value("yes")


def test_a_residual_that_is_gone_from_beside_the_page_is_named(
    page: Page, look: tuple[Look, Path], tmp_path: Path
) -> None:
    files = write_page(look[0], "waves", tmp_path / "look.html", most_bytes=1000)
    next(file for file in files if file.name == "residual-top.js").unlink()
    page.open(tmp_path / "look.html")
    page.look(-63.4, 67.0, 150.0)
    page.wait_for_all()
    assert "residual-top is missing" in page.browser.text("#status")
    assert "GGX alone" in page.browser.text("#banner")
