"""`coupole identify` as a user and a program meet it."""

from __future__ import annotations

import json
from html.parser import HTMLParser
from pathlib import Path

import numpy as np
import pytest
from relight_cases import BASE_FROM_SUPPORT, Coat, moved, waves, write_result

import coupole
from coupole.appearance.matter import kubelka_munk, typical
from coupole.appearance.spectra.channels import channel_values, channel_weights
from coupole.appearance.spectra.grid import WAVELENGTHS_NM
from coupole.commands.identify import identify
from coupole.errors import InputError

CLASSES = {"azurite": "copper blue", "vermilion": "cinnabar", "malachite": "copper green"}


@pytest.fixture(scope="module")
def library(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Five batches of three pigments, wavelengths in the first line; classes in a table beside it."""
    folder = tmp_path_factory.mktemp("library")
    lines = ["name," + ",".join(f"{nm:g}" for nm in WAVELENGTHS_NM)]
    table = ["name;class;colour index"]
    for shape, class_name in CLASSES.items():
        for number in range(5):
            values = kubelka_munk.opaque(
                (0.6 + 0.2 * number) * kubelka_munk.k_over_s(typical.reflectance(shape).values)
            )
            lines.append(f'"{shape}, {number}",' + ",".join(f"{value:.5f}" for value in values))
            table.append(f"{shape}, {number};{class_name};")
    (folder / "pigments.csv").write_text("\n".join(lines), encoding="utf-8")
    (folder / "classes.tsv").write_text("\n".join(table), encoding="utf-8")
    return folder / "pigments.csv"


def spot(folder: Path, shape: str) -> Path:
    """An export in percent, with decimal commas."""
    rows = zip(WAVELENGTHS_NM, 100 * typical.reflectance(shape).values, strict=True)
    path = folder / f"{shape}.txt"
    text = "nm;R %\n" + "\n".join(f"{nm:g};{value:.3f}".replace(".", ",") for nm, value in rows)
    path.write_text(text, encoding="utf-8")
    return path


def test_one_spectrum_is_an_object_and_several_are_a_list(
    library: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    classes = library.parent / "classes.tsv"
    blue, red = spot(tmp_path, "azurite"), spot(tmp_path, "vermilion")

    identify([blue], library=library, classes=classes, as_json=True)
    one = json.loads(capsys.readouterr().out)
    identify([blue, red], library=library, classes=classes, as_json=True)
    several = json.loads(capsys.readouterr().out)

    assert (one["name"], one["verdict"], one["class"]) == ("azurite", "match", "copper blue")
    from_python = coupole.identify([blue, red], library=library, classes=classes)
    told = [(finding.name, finding.verdict, finding.not_in_library) for finding in from_python]
    assert told == [(each["name"], each["verdict"], each["not_in_library"]) for each in several]
    assert [found["class"] for found in several] == ["copper blue", "cinnabar"]
    probabilities = [candidate["probability"] for candidate in one["candidates"]]
    assert probabilities == sorted(probabilities, reverse=True)
    assert set(one["candidates"][0]) == {"name", "class", "probability"}
    assert one["candidates"][0]["name"].startswith("azurite, ")
    assert one["held_out"]["unknown_without_the_class"]["of"] == 15


class Page(HTMLParser):
    """What a browser would fetch, and the words of a page."""

    def __init__(self) -> None:
        super().__init__()
        self.outside: list[str] = []
        self.words: list[str] = []
        self.curves = self.bars = 0

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.outside += [value or "" for name, value in attrs if name in ("src", "href")]
        self.curves += tag == "polyline"
        self.bars += tag == "rect"

    def handle_data(self, data: str) -> None:
        self.words.append(data)


def test_the_page_has_curves_and_evidence_and_fetches_nothing(library: Path, tmp_path: Path) -> None:
    hostile = tmp_path / "<img src=x>.txt"
    spot(tmp_path, "azurite").rename(hostile)

    paths = [hostile, spot(tmp_path, "vermilion")]
    identify(paths, library=library, classes=library.parent / "classes.tsv", report=tmp_path / "seen")

    page = Page()
    page.feed((tmp_path / "seen" / "identification.html").read_text(encoding="utf-8"))
    assert {"#library", "#s0", "#s1"} <= set(page.outside)
    assert all(link.startswith("#") for link in page.outside)
    assert page.curves == 2 * (3 + 2 + 2)
    assert page.bars == 2 * 41
    assert "<img src=x>" in page.words
    assert "copper blue" in page.words


def test_a_library_without_classes_is_refused(library: Path, tmp_path: Path) -> None:
    other = tmp_path / "wrong.csv"
    other.write_text("name,class\nazurite\n", encoding="utf-8")
    twice = tmp_path / "twice.csv"
    twice.write_text("azurite,blue\nazurite,green\n", encoding="utf-8")

    with pytest.raises(InputError, match=r"no table of classes comes with Coupole .* --classes"):
        identify([spot(tmp_path, "azurite")], library=library)
    with pytest.raises(InputError, match=r"wrong.csv:2:1: expected a name and a class, found 'azurite'"):
        identify([spot(tmp_path, "azurite")], library=library, classes=other)
    with pytest.raises(InputError, match=r"twice.csv:2:1: 'azurite' is in two classes: blue, green"):
        identify([spot(tmp_path, "azurite")], library=library, classes=twice)


def test_a_dark_spectrum_in_percent_is_not_taken_for_a_light_one(library: Path, tmp_path: Path) -> None:
    rows = np.column_stack([WAVELENGTHS_NM, np.full(81, 1.8)])
    np.savetxt(tmp_path / "black.txt", rows, fmt="%.2f")

    with pytest.raises(InputError, match=r"1.8, may be percent or a fraction; say which with `unit`"):
        identify([tmp_path / "black.txt"], library=library, classes=library.parent / "classes.tsv")


@pytest.fixture(scope="module")
def spectra_of_cell(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Path]:
    """Tables of a sensor with three bands, and of a white light that falls towards the red."""
    folder = tmp_path_factory.mktemp("cell")
    bands = [np.exp(-(((WAVELENGTHS_NM - middle) / 35.0) ** 2)) for middle in (600.0, 540.0, 460.0)]
    np.savetxt(folder / "sensor.csv", np.column_stack([WAVELENGTHS_NM, *bands]), fmt="%.6f", delimiter=";")
    power = np.column_stack([WAVELENGTHS_NM, 2.0 - WAVELENGTHS_NM / 800.0])
    np.savetxt(folder / "leds.csv", power, fmt="%.6f", delimiter=";")
    return folder / "sensor.csv", folder / "leds.csv"


def test_three_channels_leave_classes_that_cannot_be_told_apart(
    library: Path, spectra_of_cell: tuple[Path, Path], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    # The object has the camera's values of a batch of azurite; its mesh has waves of 20 by 20.
    sensor, leds = spectra_of_cell
    weights = channel_weights(np.loadtxt(leds, delimiter=";")[:, 1], np.loadtxt(sensor, delimiter=";")[:, 1:].T)
    red, green, blue = channel_values(typical.reflectance("azurite").values, weights) / np.pi
    result = write_result(tmp_path / "result", waves(20), Coat((red, green, blue), (0.01, 0.01, 0.01), 0.3))
    middle = result.corners_mm[result.triangles[7]].mean(axis=0)
    at = ",".join(f"{value:.3f}" for value in moved(np.linalg.inv(BASE_FROM_SUPPORT), middle[None])[0])
    spot = {"result": result.folder, "sensor_spectra": sensor, "led_spectrum": leds}
    named = {"library": library, "classes": library.parent / "classes.tsv"}

    identify(**named, **spot, at=at, as_json=True)

    told = json.loads(capsys.readouterr().out)
    assert (told["verdict"], told["class"]) == ("ambiguous", "copper blue")
    assert "copper blue" in told["not_told_apart"]
    assert "cinnabar" not in told["not_told_apart"]
    np.testing.assert_allclose(told["reflectance"], np.pi * np.array([red, green, blue]), rtol=1e-5)
    with pytest.raises(InputError, match=r"nearest triangle is \d+\.\d mm away"):
        identify(**named, **spot, at="500,500,500")
    with pytest.raises(InputError, match="--at, --led-spectrum: a spot of a result needs"):
        identify(**named, result=result.folder, sensor_spectra=sensor)
    with pytest.raises(InputError, match="found both or neither"):
        identify(**named)
