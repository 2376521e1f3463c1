"""The page on which parts are painted: what is under the brush, what the saved file holds."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
import trimesh
from browser import needs_chromium
from selenium.webdriver.common.action_chains import ActionChains
from selenium.webdriver.common.keys import Keys
from shown_page import FIELD_DEG, Page
from typer.testing import CliRunner, Result

from coupole.commands.cli import app
from coupole.errors import InputError
from coupole.exchange.pick.pick_page import write_pick_page
from coupole.heritage.restoration.painted_mesh import read_painted
from coupole.heritage.restoration.part_labels import parts_of
from coupole.heritage.restoration.parts_file import read_parts

pytestmark = needs_chromium
BRUSH_MM = 9.0
HYPOTHESES = """
schema_version: 1
name: wall
hypotheses:
  - name: bare
    title: Bare
    sources: &drawn [{says: Nothing is known., reference: Assumption}]
    materials:
      stone: &grey {kind: diffuse, reflectance: {kind: constant, value: 0.5}}
      gilt rim: *grey
  - name: later
    title: Later
    sources: *drawn
    materials: {gilt rim: *grey, base: *grey}
lights:
  - {kind: candle, position_mm: [0, -500, 0], wax_height_mm: 250, flame_height_mm: 35}
"""
WALL: trimesh.Trimesh = trimesh.creation.box((40.0, 1.0, 40.0)).subdivide().subdivide().subdivide()
"""Thinner than the brush."""


@pytest.fixture
def pick(page: Page, tmp_path: Path) -> Page:
    """The page of the wall, with the brush in hand."""
    write_pick_page(np.asarray(WALL.vertices), np.asarray(WALL.faces), "wall", tmp_path / "pick.html")
    page.opened = None
    page.browser.open((tmp_path / "pick.html").as_uri())
    page.run(f"document.getElementById('brush').value = {BRUSH_MM}")
    page.browser.at("[data-tool=paint]").click()
    return page


def shown_at(page: Page, place: np.ndarray) -> tuple[int, int]:
    """Where a place of the wall is in the picture, px from its middle, by the camera that the page tells of."""
    camera = page.run("coupolePick.camera")
    width, height = page.run("[coupolePick.canvas.width, coupolePick.canvas.height]")
    a, h = np.radians([camera["azimuth"], camera["height"]])
    back = np.array([np.cos(h) * np.cos(a), np.cos(h) * np.sin(a), np.sin(h)])
    right = np.array([-np.sin(a), np.cos(a), 0.0])
    way = place - (np.array(camera["target"]) + camera["distance"] * back)
    scale = 0.5 * min(width, height) / np.tan(np.radians(FIELD_DEG / 2)) / -(way @ back)
    return round(scale * (way @ right)), round(-scale * (way @ np.cross(back, right)))


def strike(page: Page, *places: tuple[float, float]) -> None:
    """Draw the pressed pointer over places x, z of the wall's front."""
    canvas = page.browser.at("#picture")
    actions = ActionChains(page.driver, duration=20)
    for number, (x, z) in enumerate(places):
        actions.move_to_element_with_offset(canvas, *shown_at(page, np.array([x, -0.5, z])))
        if number == 0:
            actions.click_and_hold()
    actions.release().perform()


def under_brush(x: float, z: float) -> np.ndarray:
    middles = WALL.triangles_center
    near = np.linalg.norm(middles - [x, -0.5, z], axis=1) < BRUSH_MM
    return np.asarray(near & (WALL.face_normals[:, 1] < -0.5))


def test_a_stroke_paints_what_is_under_the_brush_and_the_file_gives_it_back(pick: Page, tmp_path: Path) -> None:
    strike(pick, (-8.0, 6.0))
    pick.browser.at("#add").click()
    name = pick.browser.at("[aria-label='Name of part 2']")
    name.send_keys(Keys.CONTROL, "a")
    name.send_keys("gilt rim")
    strike(pick, (11.0, -7.0))
    (tmp_path / "parts.json").write_text(pick.run("coupolePick.parts.file()"))
    mesh = tmp_path / "wall.ply"
    WALL.export(mesh)
    (tmp_path / "parts.yaml").write_text(
        "schema_version: 1\nrules: [{kind: picked, path: parts.json}]\nrest: bare\n"
    )
    parts = parts_of(read_painted(mesh), *read_parts(tmp_path / "parts.yaml"))
    assert parts.names == ("part 1", "gilt rim", "bare")
    for number, (x, z) in enumerate(((-8.0, 6.0), (11.0, -7.0))):
        wanted, got = under_brush(x, z), parts.labels == number
        edge = np.abs(np.linalg.norm(WALL.triangles_center - [x, -0.5, z], axis=1) - BRUSH_MM) < 0.6
        assert np.array_equal(got[~edge], wanted[~edge]), "the pointer is true to a pixel"
        assert got.sum() > 12
    assert pick.browser.troubles() == []


def test_parts_of_the_hypotheses_are_offered_by_name(page: Page, tmp_path: Path) -> None:
    """Names are those of the file, in its order, once each; the page begins with the first."""
    WALL.export(tmp_path / "wall.ply")
    (tmp_path / "hypotheses.yaml").write_text(HYPOTHESES)
    ended = picked(tmp_path, "--json")
    assert ended.exit_code == 0, ended.output
    assert json.loads(ended.stdout)["parts"] == ["stone", "gilt rim", "base"]
    page.opened = None
    page.browser.open((tmp_path / "pick.html").as_uri())
    page.run(f"document.getElementById('brush').value = {BRUSH_MM}")
    page.browser.at("[data-tool=paint]").click()
    strike(page, (-8.0, 6.0))
    page.browser.at("[aria-label='Paint as gilt rim']").click()
    strike(page, (11.0, -7.0))
    assert json.loads(page.run("coupolePick.parts.file()"))["names"] == ["stone", "gilt rim"]
    assert page.browser.troubles() == []


def picked(folder: Path, *more: str) -> Result:
    words = [str(folder / "wall.ply"), "--materials", str(folder / "hypotheses.yaml")]
    return CliRunner().invoke(app, ["restore", "pick", *words, "--out", str(folder / "pick.html"), *more])


def test_hypotheses_that_cannot_be_read_are_refused(tmp_path: Path) -> None:
    WALL.export(tmp_path / "wall.ply")
    (tmp_path / "hypotheses.yaml").write_text(HYPOTHESES.replace("materials:", "material:"))
    ended = picked(tmp_path)
    assert isinstance(ended.exception, InputError)
    assert "hypotheses.yaml:8:" in str(ended.exception)
    assert not (tmp_path / "pick.html").exists()


def test_a_whole_stroke_is_undone_at_once_and_a_saved_file_is_taken_up_again(pick: Page, tmp_path: Path) -> None:
    strike(pick, (-8.0, 6.0))
    saved = pick.run("coupolePick.parts.file()")
    strike(pick, (-8.0, -10.0), (0.0, -10.0), (8.0, -10.0))
    assert pick.run("coupolePick.parts.file()") != saved
    pick.browser.at("#undo").click()
    assert pick.run("coupolePick.parts.file()") == saved
    pick.browser.at("#undo").click()
    assert not pick.browser.at("#undo").is_enabled()
    pick.browser.at("#save").click()
    assert pick.browser.text("#status") == "Nothing is painted yet."
    (tmp_path / "parts.json").write_text(saved)
    pick.browser.at("#open").send_keys(str(tmp_path / "parts.json"))
    painted = f"{len(np.flatnonzero(np.array(marks(saved))))} of {len(WALL.faces)} triangles are painted."
    pick.driver.execute_async_script("setTimeout(arguments[0], 100)")
    assert pick.browser.text("#told") == painted
    other = json.dumps({**json.loads(saved), "triangles": "AAAA"})
    (tmp_path / "other.json").write_text(other)
    pick.browser.at("#open").send_keys(str(tmp_path / "other.json"))
    pick.driver.execute_async_script("setTimeout(arguments[0], 100)")
    assert pick.browser.text("#status") == "other.json: this file is of another mesh."


def marks(text: str) -> list[int]:
    import base64

    return list(base64.b64decode(json.loads(text)["parts"]))


def test_the_surface_is_drawn_in_the_colours_of_its_parts(pick: Page) -> None:
    def middle() -> list[int]:
        pixel = """(() => { const gl = coupolePick.drawing.gl, px = new Uint8Array(4);
            const x = gl.drawingBufferWidth / 2, y = gl.drawingBufferHeight / 2;
            gl.readPixels(x, y, 1, 1, gl.RGBA, gl.UNSIGNED_BYTE, px);
            return [...px]; })()"""
        return list(pick.run(pixel))[:3]

    before = middle()
    assert max(before) - min(before) < 8
    assert min(before) > 90
    strike(pick, (0.0, 0.0))
    wanted = np.array(pick.run("coupolePick.parts.palette[1]"))
    assert np.allclose(np.array(middle()) / wanted, np.mean(np.array(middle()) / wanted), atol=0.03)
    assert max(middle()) - min(middle()) > 60


def test_a_mesh_that_is_too_fine_is_simplified_for_the_page(tmp_path: Path) -> None:
    fine = trimesh.creation.icosphere(4, 50.0)
    count = write_pick_page(
        np.asarray(fine.vertices), np.asarray(fine.faces), "ball", tmp_path / "p.html", most_triangles=2000
    )
    assert 500 < count <= 2000
    assert '"title": "ball"' in (tmp_path / "p.html").read_text()
