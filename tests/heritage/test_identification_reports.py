"""Reports of identifications: what they say, who signed them, and whether they were changed; lines of points."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
from browser import Browser, needs_chromium
from cubes import SHAPES, areas, batch, write_cube, write_library
from PIL import Image

from coupole.appearance.spectra.grid import WAVELENGTHS_NM
from coupole.commands.identify import identify
from coupole.commands.keeping import verify
from coupole.errors import ChecksumMismatch, InputError, StorageError
from coupole.heritage.result_pages.class_colours import class_colour, code_colours
from coupole.heritage.result_pages.identification_record import RECORD, check_record
from coupole.storage.durable import sha256

NAMED = {"signed_by": "Test Person", "role": "conservator"}


@pytest.fixture(scope="module")
def library(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Path]:
    path, classes = write_library(tmp_path_factory.mktemp("library"), SHAPES[:4])
    (path.parent / "LICENCE").write_text("CC BY 4.0\nAll of it.\n")
    return {"library": path, "classes": classes}


def spot(folder: Path, shape: str, *comments: str) -> Path:
    path = folder / f"{shape}.csv"
    rows = [f"{nm:g};{value:.5f}" for nm, value in zip(WAVELENGTHS_NM, batch(shape, 99), strict=True)]
    path.write_text("\n".join([*comments, "nm;R", *rows]), encoding="utf-8")
    return path


def line(folder: Path, shapes: list[str], head: str = "name,x_cm,y_cm", **changes: str) -> Path:
    """Points 25 mm apart, in x and y."""
    rows = [f"{head}," + ",".join(f"{nm:g}" for nm in WAVELENGTHS_NM)]
    for number, shape in enumerate(shapes):
        places = f"{1.5 * number:g},{2.0 * number:g}" if head.count(",") == 2 else f"{20 - 2.5 * number:g}"
        name = f"p{number}," if head.startswith("name") else ""
        rows.append(f"{name}{places}," + ",".join(f"{value:.5f}" for value in batch(shape, 50 + number)))
    text = "\n".join(rows)
    for old, new in changes.items():
        text = text.replace(old, new)
    (folder / "line.csv").write_text("# instrument: probe 7\n" + text, encoding="utf-8")
    return folder / "line.csv"


def test_a_report_says_what_was_compared_and_who_signs(
    library: dict[str, Path], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path = spot(tmp_path, "azurite", "# Instrument: probe 7", "# operator: A. Person", "# date: 2026-02-03")
    out = tmp_path / "seen"

    identify([path], **library, report=out, object_name="Panel <3>", sample="robe", **NAMED, as_json=True)

    told = json.loads(capsys.readouterr().out)
    record = json.loads((out / RECORD).read_text())
    assert record["facts"] == {
        "object": "Panel <3>", "sample": "robe", "instrument": "probe 7", "measured by": "A. Person",
        "measured on": "2026-02-03",
    }  # fmt: skip
    assert record["simulated"] is False
    assert record["library"]["licence"] == "CC BY 4.0 (LICENCE)"
    assert (record["library"]["spectra"], record["library"]["classes"]) == (24, 4)
    assert set(record["inputs"]) == {"azurite.csv"}
    assert set(record["library"]["files"]) == {"pigments.csv", "classes.csv"}
    assert record["findings"][0]["class"] == told["class"] == "azurite"
    assert record["signature"]["name"] == "Test Person"
    page = (out / "identification.html").read_text()
    for words in (
        "Panel &lt;3&gt;", "probe 7", "CC BY 4.0", "The spectrum shows azurite, with a probability of",
        "could be confused with", "Measured against fitted", "Limits of the method", "Test Person", "conservator",
        record["content_sha256"], record["inputs"]["azurite.csv"], "does not prove who signed",
    ):  # fmt: skip
        assert words in page, words
    assert "simulated" not in page


def test_without_a_signature_there_is_room_for_one(library: dict[str, Path], tmp_path: Path) -> None:
    identify([spot(tmp_path, "azurite", "# simulated spectrum")], **library, report=tmp_path / "seen")

    page = (tmp_path / "seen" / "identification.html").read_text()
    assert page.count("________________") >= 4
    assert "The data are simulated" in page
    check = check_record(tmp_path / "seen")
    assert (check.signature, check.problems) == (None, ())


@pytest.mark.parametrize(
    ("name", "old", "new", "said"),
    [
        (RECORD, '"verdict": "match"', '"verdict": "unknown"', "identification.json: its content"),
        (RECORD, "Test Person", "Other Person", "identification.json: its content"),
        (RECORD, "2026", "2027", "identification.json: its content"),
        ("identification.html", "Test Person", "Other Person", "identification.html: it was changed"),
        ("identification.html", None, None, "identification.html: No such file"),
    ],
)
def test_a_changed_report_is_told(
    library: dict[str, Path],
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
    name: str,
    old: str | None,
    new: str | None,
    said: str,
) -> None:
    out = tmp_path / "seen"
    identify([spot(tmp_path, "azurite", "# date: 2026-01-01")], **library, report=out, **NAMED)
    verify(out)
    assert "signed by Test Person, conservator" in capsys.readouterr().err.replace("\n", " ")

    if old is None:
        (out / name).unlink()
    else:
        text = (out / name).read_text()
        assert old in text
        (out / name).write_text(text.replace(old, str(new)))

    with pytest.raises(ChecksumMismatch, match="is not as it was written"):
        verify(out, as_json=True)
    told = json.loads(capsys.readouterr().out)
    assert told["ok"] is False
    assert any(problem.startswith(said) for problem in told["bad"])


def test_a_changed_page_whose_checksum_was_entered_is_told(library: dict[str, Path], tmp_path: Path) -> None:
    out = tmp_path / "seen"
    identify([spot(tmp_path, "azurite")], **library, report=out, **NAMED)
    page = out / "identification.html"
    page.write_text(page.read_text().replace("azurite", "malachite"))
    record = json.loads((out / RECORD).read_text())
    record["files"][page.name] = sha256(page)
    (out / RECORD).write_text(json.dumps(record))

    assert [problem.split(":")[0] for problem in check_record(out).problems] == [RECORD]


def test_a_folder_that_cannot_be_written_is_refused(library: dict[str, Path], tmp_path: Path) -> None:
    (tmp_path / "seen").write_text("a file")

    with pytest.raises(StorageError, match="seen"):
        identify([spot(tmp_path, "azurite")], **library, report=tmp_path / "seen")
    cube = write_cube(tmp_path / "panel.hdr", areas(SHAPES[:1], 4)[0])
    with pytest.raises(StorageError, match="seen"):
        identify([cube], **library, report=tmp_path / "seen")


def test_what_is_no_record_is_refused(tmp_path: Path) -> None:
    (tmp_path / RECORD).write_text("{")
    with pytest.raises(InputError, match=r"identification.json:1:2: not valid JSON"):
        verify(tmp_path)
    (tmp_path / RECORD).write_text('{"kind": "other", "files": {}}')
    with pytest.raises(InputError, match="expected a record of an identification"):
        verify(tmp_path)


def test_half_a_signature_and_options_alone_are_refused(library: dict[str, Path], tmp_path: Path) -> None:
    path = spot(tmp_path, "azurite")

    with pytest.raises(InputError, match="--signed-by and --role together"):
        identify([path], **library, report=tmp_path / "seen", signed_by="Test Person")
    with pytest.raises(InputError, match="--role: expected 1 to 200 characters, found 0"):
        identify([path], **library, report=tmp_path / "seen", signed_by="Test Person", role=" ")
    with pytest.raises(InputError, match="expected --report with a folder"):
        identify([path], **library, object_name="Panel")


def test_a_line_of_points_is_a_profile(library: dict[str, Path], tmp_path: Path) -> None:
    shapes = ["azurite", "azurite", "vermilion", "malachite"]
    out = tmp_path / "seen"

    identify([line(tmp_path, shapes)], **library, report=out)

    record = json.loads((out / RECORD).read_text())
    points = record["line"]["points"]
    assert [point["says"] for point in points] == shapes
    assert [point["distance_mm"] for point in points] == pytest.approx([0.0, 25.0, 50.0, 75.0])
    assert points[2]["x_mm"] == pytest.approx(30.0)
    assert record["facts"]["instrument"] == "probe 7"
    assert set(record["files"]) == {"identification.html", "profile.png", "profile.csv"}
    with Image.open(out / "profile.png") as picture:
        across = [picture.getpixel((int(share * 900), 20)) for share in (0.05, 0.3, 0.6, 0.9)]
    assert across == [class_colour(0), class_colour(0), class_colour(1), class_colour(2)]
    assert (out / "profile.csv").read_text().splitlines()[3].startswith("p2,50.0,30.0,40.0,match,vermilion")
    assert "4 points along a line" in (out / "identification.html").read_text()
    verify(out)


def test_points_by_position_are_sorted(library: dict[str, Path], tmp_path: Path) -> None:
    shapes = ["azurite", "vermilion", "malachite"]

    identify([line(tmp_path, shapes, head="position_mm")], **library, report=tmp_path / "seen")

    points = json.loads((tmp_path / "seen" / RECORD).read_text())["line"]["points"]
    assert [point["says"] for point in points] == shapes[::-1]
    assert [point["distance_mm"] for point in points] == pytest.approx([0.0, 2.5, 5.0])
    assert [point["name"] for point in points] == ["point 3", "point 2", "point 1"]


def test_lines_with_mistakes_are_refused_with_their_line(library: dict[str, Path], tmp_path: Path) -> None:
    out = {"report": tmp_path / "seen"}
    shapes = ["azurite", "vermilion", "malachite"]

    with pytest.raises(InputError, match=r"line.csv:4:1: x_cm: expected a number, found 'left'"):
        identify([line(tmp_path, shapes, **{"p1,1.5": "p1,left"})], **library, **out)
    with pytest.raises(InputError, match=r"line.csv:4:1: expected another place than the place of p0"):
        identify([line(tmp_path, shapes, **{"p1,1.5,2": "p1,0,0"})], **library, **out)
    with pytest.raises(InputError, match=r"line.csv:2:1: expected position_mm, or x_mm, y_mm and z_mm"):
        identify([line(tmp_path, shapes, **{"x_cm,y_cm": "x_cm,x_mm"})], **library, **out)
    with pytest.raises(InputError, match=r"line.csv:4:1: the name 'p0' is used in .*line.csv:3"):
        identify([line(tmp_path, shapes, **{"p1,": "p0,"})], **library, **out)
    with pytest.raises(InputError, match="a line of points needs --report"):
        identify([line(tmp_path, shapes)], **library)


def test_colours_of_classes_are_distinct() -> None:
    colours = code_colours(104)

    assert len(set(colours)) == 104
    distances = np.abs(np.array(colours[:20])[:, None] - np.array(colours[:20])[None]).sum(axis=2)
    assert distances[~np.eye(20, dtype=bool)].min() > 40


@needs_chromium
def test_the_page_fits_paper_and_a_telephone(library: dict[str, Path], tmp_path: Path) -> None:
    identify([line(tmp_path, ["azurite", "vermilion"])], **library, report=tmp_path / "seen", **NAMED)
    browser = Browser()
    try:
        for width in (400, 1200):
            browser.driver.set_window_size(width, 900)
            browser.open((tmp_path / "seen" / "identification.html").as_uri())
            assert browser.run("document.documentElement.scrollWidth - document.documentElement.clientWidth") <= 0
            assert browser.run("[...document.images].every(image => image.naturalWidth > 0)")
        browser.driver.execute_cdp_cmd("Emulation.setEmulatedMedia", {"media": "print"})
        assert "Test Person" in browser.text("#signature")
        assert not browser.troubles()
    finally:
        browser.driver.quit()
