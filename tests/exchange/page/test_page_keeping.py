"""What the page saves and reads: notes as W3C Web Annotations, pictures at print size; lengths and uncertainty."""

from __future__ import annotations

import json
import math
import re
from datetime import datetime, timedelta
from pathlib import Path
from typing import Any

import cells
import numpy as np
import pytest
from browser import needs_chromium
from checkers import annotation_faults, needs_checkers
from PIL import Image
from relight_cases import GLOSSY, sheet, write_result
from selenium.webdriver.common.action_chains import ActionChains
from selenium.webdriver.common.keys import Keys
from shown_page import FIELD_DEG, Page

from coupole.exchange.look.look_of_runs import look_of_result
from coupole.exchange.look.look_page import write_page

pytestmark = needs_chromium


@pytest.fixture
def downloads(page: Page, tmp_path: Path) -> Path:
    folder = tmp_path / "downloads"
    page.driver.execute_cdp_cmd(
        "Browser.setDownloadBehavior", {"behavior": "allow", "downloadPath": str(folder), "eventsEnabled": True}
    )
    return folder


def downloaded(folder: Path, ending: str) -> Path:
    path: Path = cells.wait_until(lambda: next(iter(folder.glob(f"*{ending}")), None), ending)
    return path


def keep_note(page: Page, words: str) -> None:
    page.focus("picture")
    page.keys("n")
    page.keys(words, Keys.ENTER)


def load(page: Page, path: Path) -> str:
    """Choose a file of notes; what the page says then."""
    before = page.browser.text("#status")
    page.driver.execute_script("document.getElementById('status').textContent = ''")
    page.browser.at("#load-notes").send_keys(str(path))
    return str(cells.wait_until(lambda: page.browser.text("#status"), f"a word after {before!r}"))


@needs_checkers
def test_notes_go_into_a_file_that_a_validator_takes_and_come_back(
    page: Page, folder: Path, downloads: Path
) -> None:
    page.open(folder / "look.html", "#")
    page.wide()
    keep_note(page, 'a worn <edge> "here"')
    page.keys(Keys.ESCAPE)
    page.focus("picture")
    page.keys(Keys.ARROW_RIGHT)
    keep_note(page, "Goldhöhung, später")
    kept = page.run("coupole.state.notes")
    page.driver.execute_script("document.getElementById('save-notes').click()")
    path = downloaded(downloads, ".annotations.jsonld")
    document = json.loads(path.read_text(encoding="utf-8"))
    assert annotation_faults(document) == []
    assert annotation_faults({**document, "items": [{**document["items"][0], "target": 1}]}), "it can refuse"
    assert all(datetime.fromisoformat(item["created"]).utcoffset() == timedelta(0) for item in document["items"])
    assert [item["body"]["value"] for item in document["items"]] == ['a worn <edge> "here"', "Goldhöhung, später"]
    page.open(folder / "look.html", "#")
    assert page.run("coupole.state.notes") == []
    assert load(page, path).startswith("2 notes of ")
    for note, again in zip(kept, page.run("coupole.state.notes"), strict=True):
        assert note["text"] == again["text"]
        np.testing.assert_allclose(note["place"], again["place"], atol=5e-4)
        assert note["camera"]["azimuth"] == pytest.approx(again["camera"]["azimuth"], abs=0.01)
    load(page, path)
    assert len(page.run("coupole.state.notes")) == 2, "the same notes are not there twice"


FOREIGN: dict[str, Any] = {
    "@context": "http://www.w3.org/ns/anno.jsonld",
    "id": "http://example.org/anno1",
    "type": "Annotation",
    "body": [{"type": "TextualBody", "value": "of another program"}],
    "target": {
        "source": "http://example.org/model",
        "selector": {"type": "PointSelector", "x": 0, "y": 0, "z": 4},
    },
}


def test_an_annotation_of_another_program_is_read(page: Page, folder: Path, tmp_path: Path) -> None:
    page.open(folder / "look.html", "#")
    (tmp_path / "other.json").write_text(json.dumps(FOREIGN))
    page.show_settings("notes-section")
    assert load(page, tmp_path / "other.json") == "1 note of other.json"
    assert page.browser.text("#notes li span") == "of another program"


def changed(**parts: Any) -> str:
    return json.dumps([FOREIGN, {**FOREIGN, **parts}], indent=1)


@pytest.mark.parametrize(
    ("text", "told"),
    [
        ('{\n "type": }', "line 2, column 10: expected JSON"),
        ('{"a": [1, 2,\n ]}', "line 2, column 2: expected JSON"),
        ("[]", "at least one annotation"),
        (changed(type="Person"), "line 22: annotation 2, type: expected Annotation"),
        (changed(body=[]), "annotation 2, body: expected a TextualBody"),
        (changed(target="http://example.org/model"), "annotation 2, target.selector: expected a PointSelector"),
        (
            changed(target={"selector": {"type": "PointSelector", "x": 0, "y": 0, "z": 40}}),
            "mm off this surface: expected notes of this object",
        ),
        (changed(target={"selector": {"type": "PointSelector", "x": "a", "y": 0, "z": 4}}), "with x, y, z in mm"),
    ],
)
def test_bad_files_of_notes_are_refused_in_words(
    page: Page, folder: Path, tmp_path: Path, text: str, told: str
) -> None:
    page.open(folder / "look.html")
    (tmp_path / "bad.jsonld").write_text(text)
    said = load(page, tmp_path / "bad.jsonld")
    assert said.startswith("bad.jsonld: line ")
    assert told in said
    assert page.run("coupole.state.notes") == []


def test_a_picture_for_print_has_its_resolution_its_size_and_a_true_scale_bar(
    page: Page, tmp_path: Path, downloads: Path
) -> None:
    """The sheet's side is 60 mm: found on paper, beside the bar that says how long it is."""
    write_result(tmp_path / "result", sheet(np.zeros((5, 5)), 60.0), camera_mm=(0.0, 0.0, 330.0))
    write_page(look_of_result(tmp_path / "result"), "sheet", tmp_path / "look.html")
    page.open(tmp_path / "look.html", "#")
    page.look(-90.0, 89.0, 300.0)
    page.driver.execute_script("""
        document.getElementById("print-width").value = 80;
        document.getElementById("print-dpi").value = "150";
        document.getElementById("print-caption").value = "Our sheet";
        document.getElementById("print-button").click();""")
    with Image.open(downloaded(downloads, "-print.png")) as picture:
        assert picture.info["dpi"] == pytest.approx((150, 150), abs=0.02)  # whole pixels in a metre
        assert picture.width == round(80 / 25.4 * 150)
        assert picture.info["Description"].startswith("Our sheet\n")
        pixels = np.asarray(picture.convert("L")).astype(float)
        scale = 1.0 / float(re.findall(r"Scale 1 : ([\d.]+)", picture.info["Description"])[0])
    row = pixels[int(page.run("coupole.readPicture().height / coupole.readPicture().width") * len(pixels[0]) / 2)]
    across = np.flatnonzero(row < 250)
    side_on_paper_mm = (across[-1] - across[0] + 1) / 150 * 25.4
    assert side_on_paper_mm == pytest.approx(60.0 * scale, rel=0.02)
    longest = max(
        (len(run) for line in pixels for run in re.findall(rb"\x01+", (line < 10).astype(np.uint8).tobytes())),
    )
    bar_mm = longest / 150 * 25.4 / scale
    assert min(abs(bar_mm - one) / one for one in (10.0, 20.0, 50.0)) < 0.02
    assert page.run("document.getElementById('picture').width") != picture.width, "the page is as before"


def test_pictures_that_are_too_large_for_print_are_refused(page: Page, folder: Path) -> None:
    page.open(folder / "look.html", "#")
    page.driver.execute_script("""
        document.getElementById("print-width").value = 1000;
        document.getElementById("print-dpi").value = "600";
        document.getElementById("print-button").click();""")
    told = cells.wait_until(lambda: page.browser.text("#status"), "the refusal")
    assert re.search(r"more than 12 million: choose at most \d+ dots per inch", told)


NOISE_MM = 0.03


def test_intervals_of_lengths_hold(page: Page, tmp_path: Path) -> None:
    """Between marked places of a sheet, each of which a scanner has moved by its noise: what is clicked is the
    pixel of the scanned place, the interval is the one that the page tells."""
    random = np.random.default_rng(4)
    write_result(tmp_path / "result", sheet(np.zeros((7, 7)), 60.0), GLOSSY, camera_mm=(0.0, 0.0, 330.0))
    write_page(look_of_result(tmp_path / "result"), "sheet", tmp_path / "look.html")
    page.open(tmp_path / "look.html", "#")
    page.wide()
    camera = page.look(-90.0, 89.0, 250.0)
    page.show_settings("lengths-section")
    page.browser.at("[data-tool=measure]").click()
    canvas = page.browser.at("#picture")
    width, height = canvas.size["width"], canvas.size["height"]
    per_mm = min(width, height) / 2 / math.tan(math.radians(FIELD_DEG / 2))

    def pixel_of(place: np.ndarray) -> tuple[int, int]:
        back = camera.at_mm / 250.0
        up = np.array([0.0, math.sin(math.radians(89.0)), math.cos(math.radians(89.0))])
        depth = 250.0 - place @ back
        x, y = place[0] / depth * per_mm, place @ up / depth * per_mm
        return math.floor(width / 2 + x), math.floor(height / 2 - y)

    held, told = [], ""
    for _ in range(40):
        true = np.column_stack([random.uniform(-20.0, 20.0, (2, 2)), np.zeros(2)])
        scanned = true + random.normal(0.0, NOISE_MM, true.shape)
        for place in scanned:
            x, y = pixel_of(place)
            ActionChains(page.driver, duration=0).move_to_element_with_offset(
                canvas, x - width // 2, y - height // 2
            ).click().perform()
        told = page.browser.text("#status")
        size, interval = map(float, re.findall(r"distance ([\d.]+) ± ([\d.]+) mm", told)[0])
        held.append(abs(size - np.linalg.norm(true[1] - true[0])) <= interval)
    assert np.mean(held) >= 0.9, (np.mean(held), told)
    assert "scan 0.042 mm" in page.browser.text("#lengths")
    assert interval < 1.0
