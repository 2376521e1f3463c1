"""Detail finer than the triangles, on the page: as the command relight shows it."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from browser import needs_chromium
from painted_texels import paint_texels
from relight_cases import GLOSSY, waves, write_result
from scipy.ndimage import gaussian_filter
from shown_page import Page, difference

from coupole.errors import InputError
from coupole.exchange.look.look_of_runs import PageChoice, look_of_result
from coupole.exchange.look.look_page import write_page
from coupole.reflectance.fits import TEXEL_CLUSTERS, TEXELS
from coupole.reflectance.new_light.light_kinds import DistantLight
from coupole.reflectance.run_relighting import scene_from
from coupole.reflectance.run_result import RunResult
from coupole.reflectance.texels.texel_cluster_file import PATH, write_texel_clusters
from coupole.reflectance.texels.texel_clusters import group_texels

pytestmark = needs_chromium
LIGHT = (-0.4, -0.3, 0.8)


@pytest.fixture(scope="module")
def detailed(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A result of triangles of 2 mm, whose texels have stripes of 5 mm and bumps across them, both of our own
    making."""
    folder = tmp_path_factory.mktemp("texels")
    paint_texels(write_result(folder / "result", waves(30), GLOSSY))
    return folder


def test_texels_look_as_the_command_relight_shows_them(page: Page, detailed: Path) -> None:
    write_page(look_of_result(detailed / "result"), "stripes", detailed / "texels.html")
    page.open(detailed / "texels.html")
    page.wait_for_all()
    page.small()
    camera = page.look(-70.0, 50.0, 150.0)
    page.run(f"coupole.setLight({', '.join(map(str, LIGHT))})")
    mine = page.picture(1)[..., :3]
    assert "(texels)" in page.browser.text("#banner")
    assert not page.driver.find_elements("css selector", "#mode option[value=residual]")  # it is of triangles
    light = [DistantLight(towards=LIGHT)]
    theirs = scene_from(RunResult(detailed / "result"), camera, TEXELS).picture(light)
    plain = scene_from(RunResult(detailed / "result"), camera, "ggx").picture(light)
    both = (mine > 0.0).all(axis=2) & (theirs > 0.0).all(axis=2)
    assert both.mean() > 0.2
    white = float(np.quantile(theirs[both], 0.99))
    assert difference(mine, theirs, white)[both].mean() < 1.5
    fine, wanted, of_triangles = (
        (one - gaussian_filter(one, (4, 4, 0)))[gaussian_filter(both.astype(float), 4.0) > 0.999]
        for one in (mine, theirs, plain)
    )
    assert np.sum(fine * wanted) / np.sum(wanted**2) == pytest.approx(1.0, abs=0.07)
    assert np.sum(of_triangles * wanted) / np.sum(wanted**2) < 0.5


def test_shared_materials_look_as_the_command_relight_shows_them(page: Page, detailed: Path) -> None:
    """Three of them for stripes whose kd is anything between two: nearer than to the texels' own."""
    result = RunResult(detailed / "result")
    write_texel_clusters(result.folder / PATH, group_texels(result, 3, 1 << 30))
    choice = PageChoice(TEXEL_CLUSTERS)
    write_page(look_of_result(detailed / "result", choice=choice), "stripes", detailed / "shared.html")
    page.open(detailed / "shared.html")
    page.wait_for_all()
    page.small()
    camera = page.look(-70.0, 50.0, 150.0)
    page.run(f"coupole.setLight({', '.join(map(str, LIGHT))})")
    mine = page.picture(1)[..., :3]
    assert "(texel_clusters)" in page.browser.text("#banner")
    theirs, own = (
        scene_from(result, camera, fit).picture([DistantLight(towards=LIGHT)]) for fit in (TEXEL_CLUSTERS, TEXELS)
    )
    both = (mine > 0.0).all(axis=2) & (theirs > 0.0).all(axis=2)
    assert both.mean() > 0.2
    white = float(np.quantile(theirs[both], 0.99))
    assert difference(mine, theirs, white)[both].mean() < 1.5
    assert difference(mine, own, white)[both].mean() > 1.5 * difference(mine, theirs, white)[both].mean()


def test_a_page_shows_triangles_until_its_texels_have_come(page: Page, detailed: Path, tmp_path: Path) -> None:
    """And says so of a tile that is missing."""
    files = write_page(look_of_result(detailed / "result"), "stripes", tmp_path / "look.html", most_bytes=1000)
    (lost,) = (file for file in files if file.name.endswith("-shape.js"))
    lost.unlink()
    page.open(tmp_path / "look.html")
    page.wait_for_all()
    assert f"{lost.stem} is missing" in page.browser.text("#status")
    page.small()
    page.look(-70.0, 50.0, 150.0)
    assert (page.picture(1)[..., :3] > 0.0).all(axis=2).mean() > 0.2


def test_what_is_clicked_is_told_of_the_triangle_as_the_mean_of_its_texels(detailed: Path) -> None:
    look = look_of_result(detailed / "result")
    assert look.about["fit"] == TEXELS
    assert look.about["measured"] > 0.7 * look.about["triangles"]
    assert "% from pixels of the views" in look.about["told"]["Texels"]
    assert {"map_places", "kd"} <= {block.name for block in look.blocks}


def test_other_choices(detailed: Path) -> None:
    assert look_of_result(detailed / "result", choice=PageChoice("ggx")).about["fit"] == "ggx"
    small = look_of_result(detailed / "result", choice=PageChoice(map_px=256))
    assert small.about["texels"]["side_px"] <= 256
    with pytest.raises(InputError, match="--residual-planes"):
        look_of_result(detailed / "result", choice=PageChoice(TEXELS, planes=9))
    with pytest.raises(InputError, match="--fit: expected"):
        look_of_result(detailed / "result", choice=PageChoice("best"))
