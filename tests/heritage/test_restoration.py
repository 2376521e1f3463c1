"""`coupole restore`: a part's material changes its pixels and no others, and every picture says what it is."""

from __future__ import annotations

import json
import shutil
import subprocess
from pathlib import Path
from typing import Any

import cells
import numpy as np
import OpenEXR
import pytest
from painted_plate import PARTS, PX, RESTORATION, plate_ply
from PIL import Image

LIGHT, DARK = 0.5, 0.2
LETTER = "A letter of 1300 about the façade, «very light»"


class Restored:
    """A plate, restored by the command."""

    def __init__(self, folder: Path) -> None:
        self.folder, self.out = folder, folder / "out"
        plate_ply(folder / "plate.ply")
        (folder / "parts.yaml").write_text(PARTS)
        (folder / "restoration.yaml").write_text(RESTORATION)

    def run(self, *words: str) -> dict[str, Any]:
        """What it prints."""
        files = ("plate.ply", "--parts", "parts.yaml", "--materials", "restoration.yaml", "--out", "out")
        given = [str(self.folder / word) if Path(word).suffix or word == "out" else word for word in files]
        assert cells.here("restore", *given, "--json", *words).code == 0
        return dict(json.loads((self.out / "result.json").read_text()))

    def exr(self, hypothesis: str) -> tuple[dict[str, Any], np.ndarray]:
        """Attributes, and radiances [h, w, bands]."""
        with OpenEXR.File(str(self.out / hypothesis / "front.exr"), separate_channels=True) as file:
            channels = file.channels()
            names = sorted(name for name in channels if name.startswith("S0."))
            return dict(file.header()), np.stack([np.array(channels[name].pixels) for name in names], axis=-1)


@pytest.fixture(scope="module")
def restored(tmp_path_factory: pytest.TempPathFactory) -> Restored:
    found = Restored(tmp_path_factory.mktemp("plate"))
    found.run()
    return found


def test_a_material_changes_the_pixels_of_its_part_and_no_others(restored: Restored) -> None:
    light, dark = (restored.exr(name)[1] for name in ("light", "dark"))
    left, right = np.s_[:, : PX // 2], np.s_[:, PX // 2 :]
    inside = slice(2, PX - 2)
    assert np.array_equal(light[right], dark[right])
    ratio = light[left][inside, 2:] / dark[left][inside, 2:]
    assert np.allclose(ratio, LIGHT / DARK, rtol=1e-5)


def test_differences_of_parts_are_those_of_greys_of_these_reflectances(restored: Restored) -> None:
    (view,) = json.loads((restored.out / "result.json").read_text())["views"]
    (difference,) = view["differences"]
    first, second = (116.0 * np.cbrt(value) - 16.0 for value in (LIGHT, DARK))
    away = ((first + second) / 2.0 - 50.0) ** 2  # Luo, Cui, Rigg 2001, equations for two greys
    expected = (first - second) / (1.0 + 0.015 * away / np.sqrt(20.0 + away))
    assert difference["hypotheses"] == ["light", "dark"]
    assert difference["parts"]["left"]["de00_of_means"] == pytest.approx(expected, abs=0.011)
    assert difference["parts"]["left"]["mean_de00"] == pytest.approx(expected, abs=0.011)
    assert difference["parts"]["right"] == {**difference["parts"]["right"], "mean_de00": 0.0, "de00_of_means": 0.0}
    assert difference["parts"]["left"]["pixels"] == difference["parts"]["right"]["pixels"]


def test_every_picture_says_that_it_is_a_hypothesis_and_names_its_sources(restored: Restored) -> None:
    pictures = sorted(restored.out.rglob("*.png"))
    assert [path.relative_to(restored.out).as_posix() for path in pictures] == [
        "dark/front.png", "difference-light-dark-front.png", "light/front.png", "side-by-side-front.png",
    ]  # fmt: skip
    for path in pictures:
        with Image.open(path) as opened:
            told = opened.info
            strip = np.asarray(opened.convert("L"))[PX:]
        assert "ypothesis" in told["Description"]
        assert "not a photograph" in told["Disclaimer"]
        assert (LETTER in told["Sources"]) == ("light" in path.as_posix() or "side" in path.name)
        assert strip.max() > 120, "words below the picture"
    attributes = restored.exr("light")[0]
    assert attributes["hypothesis"] == "light: A light left half"
    assert attributes["sources"] == f"{LETTER}: It was light"


@pytest.mark.skipif(shutil.which("exiftool") is None, reason="ExifTool is not installed (see tools/bootstrap.sh)")
def test_exiftool_reads_the_sources_as_xmp(restored: Restored) -> None:
    asked = ["exiftool", "-j", "-XMP:all", str(restored.out / "light" / "front.png")]
    (told,) = json.loads(subprocess.run(asked, capture_output=True, check=True).stdout)
    assert told["Title"] == "Hypothesis: light: A light left half"
    assert told["Source"] == f"{LETTER}: It was light"


def test_the_report_has_all_in_one_file(restored: Restored) -> None:
    page = (restored.out / "report.html").read_text(encoding="utf-8")
    assert page.count('src="data:image/png;base64,') == 3
    assert "http" not in page
    for words in (LETTER, "It was dark", "red_shape", "index 1.5, roughness 0.25", "dE00 of mean colours"):
        assert words in page
    assert "scattering_per_mm" not in page  # the paint is opaque


def test_pictures_that_are_there_are_not_rendered_again(restored: Restored, tmp_path: Path) -> None:
    again = Restored(tmp_path)
    shutil.copytree(restored.out, again.out)
    assert again.run()["made_anew"] == 0
    (tmp_path / "restoration.yaml").write_text(RESTORATION.replace("It was dark", "It was black"))
    found = again.run()
    assert (found["made_anew"], again.exr("dark")[0]["sources"]) == (0, "An assumption: It was black")
    assert np.array_equal(again.exr("dark")[1], restored.exr("dark")[1])
    (tmp_path / "restoration.yaml").write_text(RESTORATION.replace("value: 0.2", "value: 0.3"))
    found = again.run("--hypothesis", "dark")
    assert (found["made_anew"], found["taken_as_they_were"], len(found["hypotheses"])) == (1, 0, 1)
    assert np.median(again.exr("dark")[1][4:12, 3:7] / restored.exr("dark")[1][4:12, 3:7]) == pytest.approx(1.5)


def test_each_hypothesis_is_a_scene_that_can_be_moved_rendered_and_shown(
    restored: Restored, tmp_path: Path
) -> None:
    shutil.copytree(restored.out, tmp_path / "elsewhere")
    scene = tmp_path / "elsewhere/light/scene.yaml"
    rendered = cells.here("render", scene, "--out", tmp_path / "rendered", "--json")
    assert rendered.code == 0, rendered.err
    with OpenEXR.File(str(tmp_path / "rendered/plate-light-front.exr"), separate_channels=True) as file:
        names = sorted(name for name in file.channels() if name.startswith("S0."))
        radiance = np.stack([np.array(file.channels()[name].pixels) for name in names], axis=-1)
    assert np.allclose(radiance[:, : PX // 2], restored.exr("light")[1][:, : PX // 2], rtol=0.02)
    white = json.loads((restored.out / "result.json").read_text())["white_cd_m2"]
    assert [camera["white_cd_m2"] for camera in json.loads(rendered.out)["cameras"].values()] == [white]
    shown = cells.here("show", scene, "--out", tmp_path / "page.html", "--json")
    assert shown.code == 0, shown.err
    assert "diffuse" in " ".join(json.loads(shown.out)["about"]["materials"])
    refused = cells.here("show", tmp_path / "elsewhere", "--out", tmp_path / "no.html")
    assert refused.code == 2
    assert "dark/scene.yaml" in (refused.out + refused.err).replace("\n", "")


def test_a_restoration_is_exported_as_a_crate_that_says_it_is_computed(restored: Restored, tmp_path: Path) -> None:
    words = ("--licence", "CC BY 4.0", "--author", "A. Person", "--out", tmp_path / "crate")
    ended = cells.here("export", restored.out, "--to", "rocrate", *words)
    assert ended.code == 0, ended.err
    graph = json.loads((tmp_path / "crate/ro-crate-metadata.json").read_text())["@graph"]
    (root,) = [entity for entity in graph if entity["@id"] == "./"]
    assert "A light left half" in root["description"]
    assert "computed, not measured" in root["description"]
    assert (tmp_path / "crate/data/light/scene.yaml").is_file()
