"""Two pictures on the page, divided by a line: of two lights, and of two states of an object."""

from __future__ import annotations

import json
import shutil
from pathlib import Path

import cells
import h5py
import numpy as np
import pytest
from browser import needs_chromium
from relight_cases import GLOSSY, moved, waves, write_result
from selenium.webdriver.common.action_chains import ActionChains
from selenium.webdriver.support.select import Select
from shown_page import WIDTH, Page

from coupole.exchange.look.look_of_runs import OtherState, PageChoice, look_of_result
from coupole.exchange.look.look_page import write_page

pytestmark = needs_chromium

TURN = np.array([[0.0, -1.0, 0.0, 12.0], [1.0, 0.0, 0.0, -7.0], [0.0, 0.0, 1.0, 3.0], [0.0, 0.0, 0.0, 1.0]])
"""From the later state's frame into that of the earlier one."""


def test_two_lights_are_each_on_their_side_as_they_are_alone(page: Page, folder: Path) -> None:
    page.open(folder / "look.html")
    page.small()
    page.look(-70.0, 50.0, 150.0)
    page.run("coupole.setLight(-0.5, 0.1, 0.8)")
    left = page.picture(1)
    page.show_settings("beside-section")
    Select(page.browser.at("#beside")).select_by_value("light")
    page.run("coupole.setLight(0.6, -0.3, 0.4)")
    both = page.picture(1)
    Select(page.browser.at("#beside")).select_by_value("")
    right = page.picture(1)
    half = WIDTH // 2
    np.testing.assert_array_equal(both[:, :half], left[:, :half])
    np.testing.assert_array_equal(both[:, half:], right[:, half:])
    assert np.abs(left - right).max() > 0.05


def test_the_line_is_dragged_by_its_handle_and_the_object_stays(page: Page, folder: Path) -> None:
    page.open(folder / "look.html")
    page.wide()
    page.show_settings("beside-section")
    Select(page.browser.at("#beside")).select_by_value("light")
    azimuth, canvas = page.run("coupole.state.camera.azimuth"), page.browser.at("#picture")
    ActionChains(page.driver).move_to_element(canvas).click_and_hold().move_by_offset(90, 0).release().perform()
    assert page.run("coupole.state.split") == pytest.approx(0.5 + 90 / canvas.size["width"], abs=0.01)
    assert page.run("coupole.state.camera.azimuth") == azimuth
    assert "another light" in page.browser.text("#banner")
    Select(page.browser.at("#beside")).select_by_value("")


@pytest.fixture(scope="module")
def states(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """`before` and `after`, which is half as bright and lies elsewhere on the support."""
    folder = tmp_path_factory.mktemp("states")
    write_result(folder / "before", waves(), GLOSSY)
    inverse = np.linalg.inv(TURN)
    write_result(folder / "after", moved(inverse, waves().reshape(-1, 3)).reshape(-1, 3, 3), GLOSSY)
    for path in (folder / "after/fits").glob("ggx*.h5"):
        with h5py.File(path, "a") as file:
            file["kd"][...] *= 0.5
            file["ks"][...] *= 0.5
    return folder


def test_two_states_lie_on_each_other_and_each_has_its_material(page: Page, states: Path) -> None:
    choice = PageChoice(beside=OtherState(states / "after", TURN, "Known to us."))
    write_page(look_of_result(states / "before", choice=choice), "before", states / "two.html")
    page.open(states / "two.html", "#")
    page.small()
    page.look(-70.0, 50.0, 150.0)
    alone = page.picture(1)
    Select(page.browser.at("#beside")).select_by_value("state")
    page.wait_for_all()
    both = page.picture(1)
    half = WIDTH // 2
    np.testing.assert_array_equal(both[:, half:], alone[:, half:])
    has_both = (both[:, :half, 3] == 1.0) & (alone[:, :half, 3] == 1.0) & (alone[:, :half, 1] > 0.01)
    assert has_both.sum() > 500
    ratio = both[:, :half, 1][has_both] / alone[:, :half, 1][has_both]
    assert np.median(ratio) == pytest.approx(0.5, abs=0.002)
    assert np.percentile(ratio, [10, 90]) == pytest.approx([0.5, 0.5], abs=0.02), "triangles lie on each other"
    assert "left: after" in page.browser.text("#banner")
    Select(page.browser.at("#beside")).select_by_value("")


def test_the_command_brings_states_together_and_says_how_well(states: Path, tmp_path: Path) -> None:
    out = tmp_path / "two.html"
    ended = cells.here("show", states / "before", "--beside", states / "after", "--out", out, "--json")
    assert ended.code == 0, ended.err
    beside = json.loads(ended.out)["about"]["beside"]
    assert beside["name"] == "after"
    assert "standard uncertainty" in beside["told"]
    assert beside["fit"] == json.loads(ended.out)["about"]["fit"]


@pytest.mark.parametrize(
    ("options", "told"),
    [
        (("--beside", "before"), "is the result itself"),
        (("--beside", "none"), "expected a result of runs"),
        (("--aligned",), "there is no --beside"),
    ],
)
def test_states_that_do_not_fit_are_refused(
    states: Path, tmp_path: Path, options: tuple[str, ...], told: str
) -> None:
    given = [states / one if one in ("before", "none") else one for one in options]
    ended = cells.here("show", states / "before", *given, "--out", tmp_path / "two.html")
    assert ended.code == 2
    assert told in " ".join(ended.err.split())
    assert not list(tmp_path.iterdir())


def test_an_object_of_another_shape_is_refused(states: Path, tmp_path: Path) -> None:
    other = tmp_path / "other"
    shutil.rmtree(other, ignore_errors=True)
    corners = waves(40, 20.0)
    corners[..., 2] += 5.0 * np.sin(corners[..., 0])
    write_result(other, corners, GLOSSY)
    ended = cells.here("show", states / "before", "--beside", other, "--out", tmp_path / "two.html")
    assert ended.code == 2
    assert "--beside" in ended.err
