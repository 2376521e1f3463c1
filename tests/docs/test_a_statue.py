"""The tutorial of the statue: its commands, taken from the page, lead from the shipped case to its truth.

In short the pictures are small and coarse, and the two states are not compared; `--full` does all as on the page.
"""

from __future__ import annotations

import json
import re
import shlex
import subprocess
from dataclasses import dataclass
from pathlib import Path

import cells
import numpy as np
import pytest
import trimesh
from nursery import NURSERY
from places import REPO
from scipy.spatial import cKDTree

from coupole.appearance.matter.paint_file import read_paint
from coupole.intake.plain_data import yaml_of

PAGE = REPO / "docs/tutorial/a-statue.md"
SMALLEST = ("--width", "48", "--samples", "2", "--step", "40")
CASE = REPO / "configs/examples/statue"


def page_commands() -> list[list[str]]:
    """Words of the commands in the page's blocks of `sh`, in their order."""
    blocks = re.findall(r"^```sh\n(.*?)^```", PAGE.read_text(encoding="utf-8"), re.MULTILINE | re.DOTALL)
    return [shlex.split(line) for block in blocks for line in block.splitlines()]


def command_in(folder: Path, *words: str) -> cells.Ended:
    """Run a command in a folder, forked where all modules are."""
    pipes = dict.fromkeys(("stdout", "stderr"), subprocess.PIPE)
    with NURSERY.command([*words], stdin=subprocess.DEVNULL, text=True, cwd=folder, **pipes) as process:
        out, err = process.communicate(timeout=1500)
    return cells.Ended(process.returncode, out, err)


@dataclass(frozen=True)
class Walked:
    """A folder in which the tutorial was followed, and what each command printed."""

    folder: Path
    printed: dict[str, str]


@pytest.fixture(scope="module")
def walked(tmp_path_factory: pytest.TempPathFactory, request: pytest.FixtureRequest) -> Walked:
    folder = tmp_path_factory.mktemp("walk")
    is_full = request.config.getoption("--full")
    printed = {}
    for words in page_commands():
        if words[0] == "cd":
            folder /= words[1]
            continue
        assert words[0] == "coupole"
        if words[1] == "compare" and not is_full:
            continue
        globbed = [
            found
            for word in words[1:]
            for found in (sorted(map(str, folder.glob(word))) if "*" in word else [word])
        ]
        more = SMALLEST if words[1:3] == ["restore", "registered/mesh.ply"] and not is_full else ()
        ended = command_in(folder, *globbed, *more)
        assert ended.code == 0, (words, ended.err[-2000:])
        printed[" ".join(words)] = ended.out + ended.err
    return Walked(folder, printed)


@pytest.mark.timeout(3000)
def test_the_scans_come_to_their_true_places_in_the_frame_of_the_site(walked: Walked) -> None:
    found = json.loads((walked.folder / "registered/registration.json").read_text())
    assert found["mesh"]["frame"] == "site"
    assert found["unplaced"] == []
    true_poses = json.loads((walked.folder / "truth/poses.json").read_text())["site_from_scan"]
    for name, pose in found["poses"].items():
        points = np.asarray(trimesh.load(walked.folder / "scans" / name).vertices)
        off = np.array(found["site_from_first"]) @ np.array(pose) - np.array(true_poses[name])
        off_mm = np.sqrt(np.mean(np.sum((points @ off[:3, :3].T + off[:3, 3]) ** 2, axis=1)))
        stated_mm = found["uncertainties"][name]["of_a_point_mm"]
        assert off_mm < 0.35
        assert off_mm / 2 < stated_mm < 4 * off_mm
    surface = np.asarray(trimesh.load(walked.folder / "truth/surface.ply").vertices)
    nearest = cKDTree(trimesh.load(walked.folder / "registered/mesh.ply").vertices).query(surface)[0]
    assert np.median(nearest) < 1.6  # cells of 3 mm


def test_the_recipes_are_the_true_ones(walked: Walked) -> None:
    truth = yaml_of((walked.folder / "truth/spectra.yaml").read_text(), "truth")["recipes"]
    for name, shares in truth.items():
        mixture = read_paint(walked.folder / f"mixtures/{name}.paint.csv")
        assert dict(mixture.head_lines["shares"]) == pytest.approx(shares, abs=0.015)


def test_gold_and_the_paints_are_identified_and_what_the_library_lacks_is_not(walked: Walked) -> None:
    (told,) = [text for command, text in walked.printed.items() if " identify " in command]
    assert re.search(r"hair: gold leaf with 9\d%", told)
    assert re.search(r"mantle: blue with 9\d%", told)
    assert "repair: the probability that the library has the spectrum's class is 0%" in told


def test_hypotheses_differ_where_they_should_by_day_and_by_candles(walked: Walked) -> None:
    for lights in ("day", "candles"):
        result = json.loads((walked.folder / lights / "result.json").read_text())
        assert result["lights"] == (None if lights == "day" else "candles")
        differences = {tuple(pair["hypotheses"]): pair["parts"] for pair in result["views"][0]["differences"]}
        hair = differences["gilded-hair", "yellow-hair"]
        assert hair["hair"]["de00_of_means"] > 8.0
        assert hair["mantle"]["de00_of_means"] < 3.0
        assert differences["today", "gilded-hair"]["mantle"]["de00_of_means"] > 20.0


def test_page_and_crate_are_whole(walked: Walked) -> None:
    page = (walked.folder / "statue.html").read_text(encoding="utf-8")
    assert "statue-gilded-hair" in page
    crate = walked.folder / "statue-crate"
    assert (crate / "data/files/mantle.paint.csv").is_file()
    assert "computed, not measured" in (crate / "ro-crate-metadata.json").read_text()


def test_pictures_by_day_are_not_written_over_by_those_by_candles(walked: Walked) -> None:
    before = (walked.folder / "day/result.json").read_bytes()
    words = "restore registered/mesh.ply --parts parts.json --materials hypotheses.yaml --lights candles --out day"
    ended = command_in(walked.folder, *words.split(), *SMALLEST)
    assert (ended.code, "has pictures under the file's own `lights`" in ended.err.replace("\n", " ")) == (2, True)
    assert (walked.folder / "day/result.json").read_bytes() == before
    kept = walked.folder / "statue-crate/data"
    assert all(path.stat().st_nlink == 1 for path in kept.rglob("*") if path.is_file())


@pytest.mark.full
def test_the_flake_that_the_mantle_lost_is_the_largest_change(walked: Walked) -> None:
    region = json.loads((walked.folder / "since-1998/comparison.json").read_text())["shape"]["regions"][0]
    assert -8.0 < region["distance_mm"] < -2.0
    assert 30.0 < region["across_mm"] < 65.0


def test_the_example_given_twice_keeps_what_is_there_and_adds_what_is_missing(tmp_path: Path) -> None:
    first = cells.here("example", "statue", tmp_path / "case", "--json")
    assert first.code == 0, first.err
    assert len(json.loads(first.out)["new"]) == len([path for path in CASE.rglob("*") if path.is_file()])
    (tmp_path / "case/parts.json").write_text("mine")
    (tmp_path / "case/stone/limestone.csv").unlink()
    again = json.loads(cells.here("example", "statue", tmp_path / "case", "--json").out)
    assert (again["new"], again["changed"]) == (["stone/limestone.csv"], ["parts.json"])
    assert (tmp_path / "case/parts.json").read_text() == "mine"


def test_an_example_is_not_put_among_other_files(tmp_path: Path) -> None:
    (tmp_path / "thesis.tex").write_text("mine")
    ended = cells.here("example", "statue", tmp_path)
    assert (ended.code, sorted(path.name for path in tmp_path.iterdir())) == (2, ["thesis.tex"])
    assert "holds other files" in (ended.out + ended.err).replace("\n", " ")
    unknown = cells.here("example", "vase", tmp_path / "new")
    assert unknown.code == 2
    assert "expected one of statue" in (unknown.out + unknown.err).replace("\n", " ")
