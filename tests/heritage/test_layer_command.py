"""`coupole layer` from files to paint file and page."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import cells
import numpy as np
import pytest
from painted_films import in_air, two_fluxes

from coupole.appearance.matter.paint_file import read_paint

NM = np.arange(400, 701, 10)
K, S = np.linspace(12.0, 2.0, len(NM)), np.linspace(18.0, 24.0, len(NM))
NOISE = 0.002


def spectrum(folder: Path, name: str, values: np.ndarray, header: str = "nm,R") -> str:
    noise = NOISE * np.random.default_rng(len(name)).standard_normal(len(NM))
    rows = "".join(f"{nm},{value:.6f}\n" for nm, value in zip(NM, values + noise, strict=True))
    (folder / f"{name}.csv").write_text(f"{header}\n{rows}")
    return str(folder / f"{name}.csv")


@pytest.fixture
def films(tmp_path: Path) -> dict[str, str]:
    def over(h: float, ground: float) -> np.ndarray:
        return in_air(np.array([two_fluxes(k, s, h, ground) for k, s in zip(K, S, strict=True)]))

    grounds = {name: in_air(np.full(len(NM), g)) for name, g in (("black", 0.02), ("white", 0.9))}
    made = {"over-black": over(0.03, 0.02), "over-white": over(0.03, 0.9), **grounds}
    return {name: spectrum(tmp_path, name, values) for name, values in made.items()}


def run(*words: str) -> tuple[int, str, str]:
    ended = cells.here(*words)
    return ended.code, ended.out, ended.err


def options(films: dict[str, str], **changed: str) -> list[str]:
    given = {**films, **{name.replace("_", "-"): value for name, value in changed.items()}}
    return [word for name, value in given.items() for word in (f"--{name}", value)]


def test_a_drawdown_card_gives_k_and_s_in_their_intervals_a_paint_file_and_a_page(
    films: dict[str, str], tmp_path: Path
) -> None:
    asked = [*options(films, thickness_um="30", u_thickness_um="0.1", noise="0.002", name="ochre"), "--json"]
    code, out, _ = run("layer", *asked, "--out", str(tmp_path / "out"))

    told: dict[str, Any] = json.loads(out)
    nm = np.array(told["wavelength_nm"])
    assert (code, told["unit"], nm[0], nm[-1]) == (0, "per mm", 400.0, 700.0)
    for name, truth in (("K", K), ("S", S)):
        missed = np.abs(np.array(told[name]) - np.interp(nm, NM, truth)) / np.array(told[f"half_width_{name}"])
        assert np.mean(missed < 1.0) > 0.85
    assert told["model"]["deserved"] == "four fluxes"
    paint = read_paint(tmp_path / "out" / "ochre.paint.csv")
    assert paint.absorption == pytest.approx(told["K"], rel=1e-4)
    page = (tmp_path / "out" / "ochre.html").read_text()
    assert (page.count("<polygon"), page.count("<script")) == (2, 0)
    (tmp_path / "out" / "ochre.html").unlink()
    (tmp_path / "out" / "ochre.paint.csv").write_text("mine")
    code, _, err = run("layer", *asked, "--out", str(tmp_path / "out"))
    assert (code, (tmp_path / "out" / "ochre.paint.csv").read_text()) == (2, "mine")
    assert "ochre.paint.csv: exists already" in err
    assert not (tmp_path / "out" / "ochre.html").exists()
    code, _, _ = run("layer", *asked, "--out", str(tmp_path / "out"), "--overwrite")
    assert (code, read_paint(tmp_path / "out" / "ochre.paint.csv").name) == (0, "ochre")


def test_a_film_is_predicted_at_another_thickness_with_its_interval_in_text_json_and_page(
    films: dict[str, str], tmp_path: Path
) -> None:
    asked = ["layer", *options(films, thickness_um="30", noise="0.002", name="ochre"), "--at-um", "60"]
    code, out, _ = run(*asked, "--json", "--out", str(tmp_path / "out"))

    told = json.loads(out)["at"]
    assert (code, [film["over"] for film in told]) == (0, ["black.csv", "white.csv"])
    for film, ground in zip(told, (0.02, 0.9), strict=True):
        truth = in_air(np.array([two_fluxes(k, s, 0.06, ground) for k, s in zip(K, S, strict=True)]))
        nm = np.linspace(400, 700, len(film["reflectance"]))
        off = np.abs(np.array(film["reflectance"]) - np.interp(nm, NM, truth))
        assert np.mean(off < film["half_width"]) > 0.9
        assert np.all(np.array(film["half_width"]) > film["half_width_of_model"])
    assert "Predicted at 60 um" in (tmp_path / "out" / "ochre.html").read_text()
    assert "at 60 um over white.csv" in "".join(run(*asked)[1:])


def test_a_thickness_cannot_be_asked_for_without_that_of_the_films(films: dict[str, str]) -> None:
    code, _, err = run("layer", *options(films), "--at-um", "60")
    assert (code, "give --thickness-um" in err) == (2, True)


def test_a_series_in_a_yaml_file_is_solved_and_says_how_well_it_agrees(
    films: dict[str, str], tmp_path: Path
) -> None:
    thick = in_air(np.array([two_fluxes(k, s, 0.06, 0.9) for k, s in zip(K, S, strict=True)]))
    spectrum(tmp_path, "thick", thick)
    (tmp_path / "series.yaml").write_text(
        "name: ochre\nnoise: 0.002\nfilms:\n"
        "  - {spectrum: over-black.csv, over: black.csv, thickness_um: 30}\n"
        "  - {spectrum: over-white.csv, over: white.csv, thickness_um: 30}\n"
        "  - {spectrum: thick.csv, over: white.csv, thickness_um: 60}\n"
    )
    code, out, _ = run("layer", str(tmp_path / "series.yaml"), "--json")

    told = json.loads(out)
    assert (code, told["spectra"]) == (0, 3)
    assert told["misfit"] < 1.5
    assert np.array(told["S"])[5] == pytest.approx(np.interp(told["wavelength_nm"][5], NM, S), rel=0.1)


@pytest.mark.parametrize(
    ("changed", "words"),
    [
        ({"over_black": "over-white", "over_white": "over-black"}, "is darker over the lighter ground"),
        ({"over_white": "percent"}, "percent.csv: the reflectance is 1 at 400 nm"),
        ({"over_white": "gap"}, "gap.csv: has a gap of more than 20 nm"),
        ({"over_white": "micrometres"}, "micrometres.csv:2:1: expected a wavelength in nm"),
        ({"over_white": "nowhere"}, "nowhere.csv: no such file"),
        ({"geometry": "d:8"}, "--geometry: expected gloss excluded"),
    ],
)
def test_films_that_contradict_themselves_are_refused_by_name(
    changed: dict[str, str],
    words: str,
    films: dict[str, str],
    tmp_path: Path,
) -> None:
    rows = Path(films["over-white"]).read_text().splitlines()
    (tmp_path / "percent.csv").write_text("nm,R\n" + "".join(f"{nm},1.0\n" for nm in NM))
    (tmp_path / "gap.csv").write_text("\n".join([*rows[:10], *rows[14:]]) + "\n")
    (tmp_path / "micrometres.csv").write_text("nm,R\n" + "".join(f"{nm / 1000},0.4\n" for nm in NM))
    named = {key: value if key == "geometry" else str(tmp_path / f"{value}.csv") for key, value in changed.items()}

    code, _, err = run("layer", *options(films, **named))

    assert code == 2
    assert words in err


def test_one_spectrum_is_refused_with_what_else_is_needed(films: dict[str, str]) -> None:
    code, _, err = run("layer", "--over-white", films["over-white"])
    assert (code, "--over-white: needs --white" in err) == (2, True)
