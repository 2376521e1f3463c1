"""`coupole reflectance choose` as its user has it: few pictures out of a folder, and no other is opened."""

from __future__ import annotations

import json
from pathlib import Path

import cells
import numpy as np
import pytest
from picture_cases import Case, write_case
from places import SHARED_DATA


@pytest.fixture(scope="module")
def case(tmp_path_factory: pytest.TempPathFactory) -> Case:
    return write_case(tmp_path_factory.mktemp("pictures"))


def test_as_many_are_chosen_as_asked_and_the_rest_is_what_leave_out_takes(case: Case, tmp_path: Path) -> None:
    to = tmp_path / "chosen.json"
    ended = cells.here("reflectance", "choose", *case.arguments(), "--count", "9", "--to", to, "--json")
    assert ended.code == 0, ended.err
    choice = ended.document
    assert json.loads(to.read_text()) == choice
    assert len(set(choice["chosen"])) == 9
    assert sorted(choice["chosen"] + choice["left_out"]) == list(range(len(case.directions)))
    assert [step["lights"] for step in choice["steps"]] == list(range(6, 10))
    assert choice["stopped_by"] == "count"
    left_out = ",".join(map(str, choice["left_out"]))
    fitted = cells.here("reflectance", *case.arguments(), "--leave-out", left_out, "--out", tmp_path / "out")
    assert fitted.code == 0, fitted.err


def test_pictures_that_were_not_chosen_are_not_opened(case: Case) -> None:
    asked = ("reflectance", "choose", *case.arguments(), "--count", "9", "--json")
    choice = cells.here(*asked).document
    first = next(iter(sorted(case.folder.glob("*.png"))))
    names = {first.name, *choice["pictures"]}  # the first picture tells size and depth
    kept = {path: path.read_bytes() for path in case.folder.glob("*.png") if path.name not in names}
    try:
        for path in kept:
            path.write_bytes(b"not a picture")
        assert cells.here(*asked).document["chosen"] == choice["chosen"]
    finally:
        for path, content in kept.items():
            path.write_bytes(content)


def test_it_stops_at_an_expected_error(case: Case) -> None:
    choice = cells.here("reflectance", "choose", *case.arguments(), "--count", "40", "--until", "0.3", "--json")
    assert choice.document["stopped_by"] == "relit_rms"
    assert choice.document["relit_rms"] <= 0.3
    assert len(choice.document["chosen"]) < 40


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (["--count", "400"], "--count: expected at most"),
        (["--count", "8", "--first", "9"], "--first: expected"),
        (["--count", "8", "--lights", "nowhere.lp"], "nowhere.lp"),
        (["--count", "8", "--to", "nowhere/chosen.json"], "--to: expected a file in an existing folder"),
    ],
)
def test_what_cannot_be_chosen_is_refused(case: Case, options: list[str], message: str) -> None:
    refused = cells.here("reflectance", "choose", *case.arguments(), *options)
    assert refused.code == 2
    assert message in refused.err


@pytest.mark.skipif(not (SHARED_DATA / "photometric").is_dir(), reason="real pictures are not beside the project")
@pytest.mark.parametrize("name", ["bear", "cat"])
def test_real_pictures_are_chosen_no_worse_than_spread_ones(name: str) -> None:
    """Interpolated by scipy for the 80 that were not chosen, beside sixteen that are far from each other."""
    from scipy.interpolate import RBFInterpolator

    from coupole.preflight.next_lights import spread_lights
    from coupole.reflectance.picture_set import read_pictures

    folder = SHARED_DATA / "photometric" / name
    lights, intensities = folder / "light_directions.txt", folder / "light_intensities.txt"
    asked = ["--pictures", folder, "--lights", lights, "--intensities", intensities, "--mask", folder / "mask.png"]
    chosen = cells.here("reflectance", "choose", *asked, "--count", "16", "--json").document["chosen"]
    pictures = read_pictures(folder, lights, intensities=intensities, mask=folder / "mask.png")
    values = np.stack(
        [(pictures.raw_values(n)[::16] / pictures.intensities[n]).mean(axis=1) for n in range(len(pictures))]
    )

    def rms(taken: list[int]) -> float:
        others = np.setdiff1d(np.arange(len(values)), taken)
        made = RBFInterpolator(pictures.directions[taken], values[taken], kernel="linear", degree=1)
        return float(np.sqrt(np.mean((made(pictures.directions[others]) - values[others]) ** 2)))

    assert rms(chosen) < 1.05 * rms(spread_lights(pictures.directions, np.arange(len(values)), 16).tolist())
