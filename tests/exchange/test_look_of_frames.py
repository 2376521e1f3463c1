"""A run that nothing was fitted to, in a page: frames beside their LEDs, and what lies between."""

from __future__ import annotations

import base64
import re
import zlib
from collections.abc import Iterator
from functools import lru_cache
from pathlib import Path

import cells
import cv2
import numpy as np
import pytest
from browser import needs_chromium
from cells import CellFolder
from shown_page import HEIGHT, WIDTH, Page, opened_page

from coupole.exchange.look.light_planes import light_planes
from coupole.exchange.look.look_blocks import Look, block_of
from coupole.exchange.look.look_of_frames import _plane_tiles, look_of_run
from coupole.exchange.look.look_page import write_page
from coupole.exchange.look.look_tiles import halve_pictures, levels_of, tiles_of
from coupole.reflectance.light_interpolation import weights
from coupole.storage.run import Run

UNPROVEN = "led0240"


def silent(step: str, done: int, of: int) -> None:
    pass


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """54 LEDs in one view, one of which has no proven frame."""
    cell = CellFolder(tmp_path_factory.mktemp("cell"))
    assert cell.acquire().code == 0
    journal = cell.run_folder / "journal.jsonl"
    kept = [line for line in journal.read_text().splitlines(keepends=True) if f"/{UNPROVEN}/" not in line]
    journal.write_text("".join(kept))
    return cell.run_folder


@pytest.fixture(scope="module")
def look(run: Path) -> Look:
    return look_of_run(run, (), silent)


frames_of = lru_cache(cells.stored)


def shares(run: Path, led: int) -> np.ndarray:
    """[h / 2, w / 2, 3] of the camera's range above its darks, blocks of 2 x 2 pixels of the filter GBRG."""
    stored = frames_of(run)
    darks = [frame.pixels for shot, frame in stored.items() if shot.startswith("top/dark")]
    linear = (stored[f"top/led{led:04d}/e0"].pixels - np.mean(darks, axis=0)) / (4095 - cells.BLACK_DN)
    green = (linear[::2, ::2] + linear[1::2, 1::2]) / 2
    return np.stack([linear[1::2, ::2], green, linear[::2, 1::2]], axis=2)


def test_each_led_has_its_frame_or_is_told_to_have_none(look: Look, run: Path) -> None:
    (view,) = look.about["views"]
    assert look.about["simulated"] is True
    assert len(view["frames"]) == view["proven"] == view["shots"] - 1
    assert len(view["unproven"]) == 1
    assert not [frame for frame in view["frames"] if UNPROVEN in frame["shot"]]
    assert {frame["shot"] for frame in view["frames"]} <= set(map(str, Run(run).proven()))


def test_components_give_back_frames_that_are_made_of_few() -> None:
    random = np.random.default_rng(5)
    few, mixture = random.uniform(0.1, 0.4, (5, 12, 10)), random.uniform(0.1, 0.4, (30, 3, 5))
    frames = np.einsum("ncp,phw->nhwc", mixture, few) ** 2
    ways = random.normal(size=(30, 3))
    ways /= np.linalg.norm(ways, axis=1, keepdims=True)
    taken = light_planes(lambda number: frames[number].astype(np.float32), ways, lambda *_: None, silent)
    root = np.einsum("pnc,phw->nhwc", taken.of_leds, taken.planes) + taken.means[:, None, None]
    np.testing.assert_allclose(root**2, frames, atol=1e-5)
    bases = taken.bases(ways).astype(float)
    for wanted in (ways[7], np.array([0.6, 0.0, 0.8])):
        apart = np.linalg.norm(ways - wanted, axis=1)
        plates = np.where(apart > 0, apart**2 * np.log(np.maximum(apart, 1e-300)), 0.0)
        found = np.einsum("b,bpc->pc", [*plates, 1.0, *wanted], bases)
        between = np.einsum("pc,phw->hwc", found[1:], taken.planes) + found[0]
        expected = np.einsum("n,nhwc->hwc", weights(ways, wanted[None], "thin plate")[0], np.sqrt(frames))
        np.testing.assert_allclose(between, expected, atol=2e-3)


def test_tiles_are_means_of_what_they_stand_for() -> None:
    values = np.random.default_rng(2).uniform(size=(1, 300, 515)).astype(np.float32)
    values[0, :2, :2] = np.nan
    values[0, 2, 2] = np.nan
    tiles = {(tile.level, tile.column, tile.row): tile.values[0] for tile in tiles_of(values)}
    assert levels_of(515, 300) == [[515, 300], [258, 150], [129, 75]]
    assert len(tiles) == 3 * 2 + 2 * 1 + 1
    assert tiles[0, 2, 1][0, 0] == values[0, 256, 512]
    assert np.isnan(tiles[0, 2, 1][50, 0])
    assert np.isnan(tiles[1, 0, 0][0, 0])
    assert tiles[1, 0, 0][1, 1] == pytest.approx(np.nanmean(values[0, 2:4, 2:4]))
    assert halve_pictures(values)[0, -1, -1] == pytest.approx(values[0, -2:, -1].mean())


@pytest.fixture(scope="module")
def page() -> Iterator[Page]:
    with opened_page() as page:
        yield page


def seen(page: Page, mode: str) -> np.ndarray:
    """[h / 2, w / 2, 3] of the view: means of 2 x 2 of its pixels, each of which is one of the page."""
    camera = f"{{target: [64, 48, 0], azimuth: -90, height: 90, distance: {HEIGHT / 2} / Math.tan(Math.PI / 15)}}"
    light = "{...coupole.state.lights[0], softness: 0}"
    page.run(f"coupole.state = {{mode: '{mode}', camera: {camera}, lights: [{light}], chosen: 0}}")
    page.wait_for_all()
    middle = page.picture(1)[(HEIGHT - 96) // 2 :, (WIDTH - 128) // 2 :][:96, :128]
    assert (middle[..., 3] == 1).all()
    found: np.ndarray = middle[..., :3].reshape(48, 2, 64, 2, 3).mean(axis=(1, 3))
    return found


@needs_chromium
def test_the_nearest_frame_and_what_lies_between_are_those_of_the_camera(
    page: Page, look: Look, run: Path, tmp_path: Path
) -> None:
    write_page(look, "run", tmp_path / "look.html", most_bytes=200_000)
    page.open(tmp_path / "look.html")
    page.small()
    frame = look.about["views"][0]["frames"][20]
    page.run(f"coupole.setLight({', '.join(map(str, frame['way']))})")
    expected = shares(run, frame["led"])
    words = {"measured": f"frame under LED {frame['led']}, proven", "between": "hypothesis"}
    for mode, off in (("measured", 0.01), ("between", 0.05)):
        found = seen(page, mode)
        assert words[mode] in page.browser.text("#banner")
        assert "Simulated run" in page.browser.text("#banner")
        np.testing.assert_allclose(found.mean(axis=(0, 1)), expected.mean(axis=(0, 1)), rtol=off)
        assert np.median(np.abs(found - expected)) < off * expected.max()
    assert "53 of 54 shots" in page.browser.at("#shot").get_attribute("textContent")
    assert page.browser.troubles() == []


@needs_chromium
def test_a_light_between_leds_mixes_their_frames(page: Page, look: Look, run: Path, tmp_path: Path) -> None:
    write_page(look, "run", tmp_path / "look.html")
    page.open(tmp_path / "look.html")
    page.small()
    frames = look.about["views"][0]["frames"]
    ways, wanted = np.array([frame["way"] for frame in frames]), np.array([0.3, -0.2, 0.93])
    page.run("coupole.setLight(0.3, -0.2, 0.93)")
    found = seen(page, "between")
    mixed = weights(ways, wanted[None] / np.linalg.norm(wanted), "thin plate")[0]
    roots = [np.sqrt(np.maximum(shares(run, frame["led"]), 0.0)) for frame in frames]
    expected = np.maximum(np.einsum("n,nhwc->hwc", mixed, roots), 0.0) ** 2
    np.testing.assert_allclose(found.mean(axis=(0, 1)), expected.mean(axis=(0, 1)), rtol=0.03)
    np.testing.assert_allclose(found, between(look, ways, wanted / np.linalg.norm(wanted)), atol=2e-3)


def between(look: Look, ways: np.ndarray, wanted: np.ndarray) -> np.ndarray:
    """[48, 64, 3] of what the page holds: thin plates of the distances, components, tile."""
    (view,), (lights,) = look.about["views"], look.blocks
    rows = np.frombuffer(zlib.decompress(base64.b64decode(lights.text)), np.uint8).reshape(4, -1)
    bases = np.ascontiguousarray(rows.T).view(np.float32).reshape(lights.shape).astype(float)
    apart = np.linalg.norm(ways - wanted, axis=1)
    found = np.einsum("b,bpc->pc", [*(apart**2 * np.log(apart)), 1.0, *wanted], bases)
    tile = next(block for block in look.later if block.name == "tile-top-0-0-0")
    codes = cv2.imdecode(np.frombuffer(base64.b64decode(tile.text), np.uint8), cv2.IMREAD_GRAYSCALE)
    planes = codes.reshape(-1, 256, 256)[:, :96, :128] * np.array(view["step"])[:, None, None]
    planes += np.array(view["low"])[:, None, None]
    picture = np.maximum(np.einsum("pc,phw->hwc", found[1:], planes) + found[0], 0.0) ** 2
    made: np.ndarray = picture.reshape(48, 2, 64, 2, 3).mean(axis=(1, 3))
    return made


@needs_chromium
def test_zooming_into_twelve_megapixels_asks_for_the_tiles_that_are_seen(page: Page, tmp_path: Path) -> None:
    wide, high = 4096, 3072
    plane = np.zeros((1, high, wide), np.float32)
    plane[0, :, wide // 2 :] = 0.5
    plane[0, 1024:1280:2, 1024:1280] = 1.0  # lines that only the finest level shows
    low, step = np.zeros(1, np.float32), np.full(1, 1 / 255, np.float32)
    tiles = list(_plane_tiles(plane, "top", low, step, silent))
    lights = np.zeros((1 + 4, 2, 3), np.float32)
    lights[1, 1] = 1.0  # the constant of the tail: the plane, whatever the light
    view = {
        "name": "top", "picture_px": [wide, high], "levels": levels_of(wide, high), "tiles": "tile-top",
        "lights": "lights-top", "planes": 1, "low": [0.0], "step": [1 / 255], "frame_step_px": 7,
        "shortest_us": 1, "apart_deg": 5, "unproven": [], "hidden": [], "shots": 0, "proven": 0,
        "frames": [{"led": 1, "way": [0, 0, 1], "shot": "top/led0001/e0", "exposure_us": 1, "block": "none"}],
    }  # fmt: skip
    about = {
        "kind": "run", "picture_px": [wide, high], "views": [view], "fit": "none", "simulated": True,
        "software": {}, "origin_mm": [0, 0, 0], "step_mm": 1, "irradiance": 1, "unit": "", "told": {},
    }  # fmt: skip
    look = Look(about, (block_of("lights-top", lights),), tuple(tiles))
    files = write_page(look, "wide", tmp_path / "look.html", most_bytes=1000)
    assert len(files) == 1 + 1 + 16 * 12 + 8 * 6 + 4 * 3 + 2 * 2 + 1
    page.open(tmp_path / "look.html")
    page.small()
    tags = "[...document.querySelectorAll('script[src*=tile]')].map(tag => tag.getAttribute('src'))"

    def look_at(x: float, y: float, half: float) -> list[str]:
        before = set(page.run(tags))
        distance = f"{half} / Math.tan(Math.PI / 15)"
        camera = f"{{target: [{x}, {high - y}, 0], azimuth: -90, height: 90, distance: {distance}}}"
        page.run(f"coupole.state = {{mode: 'between', camera: {camera}}}")
        page.wait_for_all()
        return sorted(set(page.run(tags)) - before)

    look_at(2048, 1536, 1536)
    whole = page.run(tags)
    assert len(whole) <= 1 + 4
    assert {int(re.findall(r"top-(\d)", one)[0]) for one in whole} <= {3, 4}
    near = page.picture(1)
    assert near[60, 40, 0] == pytest.approx(0.0, abs=1e-3)
    assert near[60, 120, 0] == pytest.approx(0.25, rel=0.02)
    assert look_at(1152, 1152, 60) == ["look.data/tile-top-0-4-4.js"]
    lines = page.picture(1)[:, 80, 0]
    assert lines.max() > 0.95
    assert lines.min() < 0.05
    assert np.count_nonzero(np.diff(lines > 0.5)) == pytest.approx(120, abs=2)
    assert len(page.run(tags)) <= len(whole) + 1
