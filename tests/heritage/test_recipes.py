"""Recipes of colours: shares come back, a missing paint is said to be missing, lights and costs are told."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import cells
import numpy as np
import pytest
from lazily import lazily
from painted_films import in_air
from places import REPO

from coupole.appearance.matter.glossy_face import face
from coupole.appearance.matter.paint_file import read_paint
from coupole.appearance.spectra.grid import WAVELENGTHS_NM
from coupole.errors import InputError
from coupole.heritage.analysis import colour_match, recipe_search
from coupole.heritage.analysis.palette import Paint, read_palette

colour: Any = lazily("colour")
OIL = REPO.parent / "shared" / "data" / "pigments" / "oilpaint" / "oilpaint.rs"
NOISE, FACE = 0.002, face(1.5)
NM = np.arange(400, 761, 5)


def opaque_in_air(k: np.ndarray, s: np.ndarray) -> np.ndarray:
    """R_inf as Kubelka and Munk have it, under a face by Saunderson's published numbers."""
    a = 1.0 + k / s
    return in_air(a - np.sqrt(a * a - 1.0))


def paints() -> dict[str, tuple[np.ndarray, np.ndarray]]:
    """K and S of four virtual paints at NM."""
    x = (NM - 400) / 360.0
    return {
        "white": (0.01 + 0.0 * x, 1.0 + 0.0 * x),
        "red": (3.0 / (1.0 + np.exp((NM - 590.0) / 10.0)) + 0.02, 0.3 + 0.1 * x),
        "blue": (1.5 * np.exp(-0.5 * ((NM - 620.0) / 60.0) ** 2) + 0.05, 0.2 - 0.05 * x),
        "ochre": (0.9 / (1.0 + np.exp((NM - 500.0) / 20.0)) + 0.08, 0.4 + 0.0 * x),
    }


def library(folder: Path, names: list[str]) -> Path:
    (folder / "spectra.txt").write_text("\n".join(map(str, NM)))
    rows = [f'"{name}"\t' + "\t".join(f"{v:.9g}" for v in np.concatenate(paints()[name])) for name in names]
    (folder / "paints.rs").write_text("\n".join(rows) + "\n")
    return folder / "paints.rs"


def target(shares: dict[str, float], seed: int = 1) -> np.ndarray:
    k, s = (sum(share * paints()[name][i] for name, share in shares.items()) for i in (0, 1))
    return opaque_in_air(np.asarray(k), np.asarray(s)) + NOISE * np.random.default_rng(seed).standard_normal(
        len(NM)
    )


def on_grid(values: np.ndarray) -> np.ndarray:
    whole = np.full(81, np.nan)
    whole[np.isin(WAVELENGTHS_NM, NM)] = values
    return whole


SHARES = {"white": 0.6, "red": 0.1, "blue": 0.3}


def test_shares_come_back_in_their_intervals_and_no_other_paint_is_used(tmp_path: Path) -> None:
    palette = read_palette([library(tmp_path, list(paints()))])
    held = []
    for seed in range(15):
        found = recipe_search.find(on_grid(target(SHARES, seed)), palette, FACE, NOISE, 4)
        assert set(found.best.shares) == set(SHARES)
        assert found.is_explained
        for name, share in SHARES.items():
            assert found.best.shares[name] == pytest.approx(share, abs=0.02)
            held.append(abs(found.best.shares[name] - share) < found.best.half_widths[name])
    assert np.mean(held) > 0.85


def test_a_paint_that_another_may_stand_for_is_not_said_to_be_told(tmp_path: Path) -> None:
    palette = read_palette([library(tmp_path, list(paints()))])
    blue = next(paint for paint in palette if paint.name == "blue")
    twin = Paint(**{**vars(blue), "name": "twin", "absorption": 1.001 * blue.absorption})

    alone = recipe_search.find(on_grid(target(SHARES)), palette, FACE, NOISE, 3)
    beside = recipe_search.find(on_grid(target(SHARES)), [*palette, twin], FACE, NOISE, 3)

    assert alone.rivals == ()
    assert all(alone.told_within(name) < recipe_search.TOLD_WITHIN for name in SHARES)
    unsure = next(name for name in beside.best.shares if name in ("blue", "twin"))
    assert beside.told_within(unsure) == pytest.approx(0.3, abs=0.02)
    assert beside.told_within("white") < recipe_search.TOLD_WITHIN


def test_without_one_paint_the_verdict_says_where_it_is_missed(tmp_path: Path) -> None:
    palette = read_palette([library(tmp_path, ["white", "red", "ochre"])])

    found = recipe_search.find(on_grid(target(SHARES)), palette, FACE, NOISE, 4)

    assert not found.is_explained
    assert "no mixture of this palette" in found.verdict()
    # The blue absorbs about 620 nm: without it the recipe is too light there, or too dark in the blue.
    assert found.best.rms > 5.0 * NOISE


def test_a_recipe_with_one_paint_less_is_never_nearer(tmp_path: Path) -> None:
    found = recipe_search.find(
        on_grid(target(SHARES)), read_palette([library(tmp_path, list(paints()))]), FACE, NOISE, 4
    )

    assert [len(one.shares) for one in found.recipes] == [1, 2, 3, 4]
    assert np.all(np.diff([one.rms for one in found.recipes]) < 1e-6)
    assert found.chosen_index == 2


def test_a_large_palette_is_searched_by_growing_and_finds_the_same(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(recipe_search, "_EXHAUSTIVE", 4)
    palette = read_palette([library(tmp_path, list(paints()))])

    found = recipe_search.find(on_grid(target(SHARES)), palette, FACE, NOISE, 3)

    assert set(found.best.shares) == set(SHARES)


@pytest.mark.skipif(not OIL.is_file(), reason="the data of oil paints are not in a checkout")
def test_measured_oil_paints_are_found_with_their_shares_and_missed_when_they_lack() -> None:
    palette = read_palette([OIL])
    by_name = {paint.name: paint for paint in palette}
    shares = {"Titanium white": 0.6, "Indigo": 0.1, "Red lake": 0.3}
    k, s = (
        sum(share * getattr(by_name[name], what) for name, share in shares.items())
        for what in ("absorption", "scattering")
    )
    noisy = opaque_in_air(np.asarray(k), np.asarray(s)) + NOISE * np.random.default_rng(5).standard_normal(81)

    found = recipe_search.find(noisy, palette, FACE, NOISE, 4)
    lacking = recipe_search.find(noisy, [p for p in palette if p.name != "Indigo"], FACE, NOISE, 4)

    assert found.best.shares == pytest.approx(shares, abs=0.02)
    assert found.is_explained
    assert not lacking.is_explained
    assert lacking.best.rms > 2.0 * found.best.rms


@pytest.mark.filterwarnings("ignore:Aligning", "ignore:Integration")
def test_differences_are_those_of_colour_science_and_a_metameric_pair_has_an_index() -> None:
    one = np.linspace(0.2, 0.6, 81)
    other = one + 0.05 * np.sin(np.linspace(0.0, 6.0 * np.pi, 81))

    under = colour_match.matches(one, other, ["D65", "A"])

    spectral = [colour.SpectralDistribution(values, WAVELENGTHS_NM) for values in (one, other)]
    observer = colour.MSDS_CMFS["CIE 1964 10 Degree Standard Observer"]
    for match in under:
        lamp = colour.SDS_ILLUMINANTS[match.light]
        xyz = [colour.sd_to_XYZ(sd, observer, lamp, method="Integration") / 100.0 for sd in spectral]
        white = colour.sd_to_XYZ(colour.sd_ones(), observer, lamp) / 100.0
        lab = [colour.XYZ_to_Lab(v, colour.XYZ_to_xy(white)) for v in xyz]
        assert match.delta_e00 == pytest.approx(float(colour.delta_E(*lab, method="CIE 2000")), abs=0.05)
    assert under[0].metamerism == 0.0
    assert under[1].metamerism > 0.5
    darker = colour_match.matches(one, 0.9 * one, ["D65", "A"])[1]
    assert darker.delta_e00 > 1.0
    assert darker.metamerism == pytest.approx(0.0, abs=1e-9)
    same = colour_match.matches(one, one, ["D65", "LED-B3"])
    assert [match.delta_e00 for match in same] == [0.0, 0.0]


def paint(name: str, source: str, unit: str = "per mm", k: float = 1.0) -> str:
    rows = "".join(f"{nm},{k},{20 + nm / 100}\n" for nm in range(400, 701, 20))
    return f"# coupole: paint 1\n# name: {name}\n# unit: {unit}\n# binder_index: 1.5\nwavelength_nm,K,S\n{rows}"


@pytest.mark.parametrize(
    ("files", "words"),
    [
        ({"a": paint("ochre", "a"), "b": paint("ochre", "b", k=2.0)}, "two paints are named 'ochre'"),
        ({"a": paint("ochre", "a"), "b": paint("earth", "b")}, "have the same K and S"),
        ({"a": paint("ochre", "a"), "b": paint("white", "b", "relative", 2.0)}, "cannot be mixed"),
        ({"a": paint("o", "a", "per layer"), "b": paint("w", "b", "per layer", 2.0)}, "unknown thickness"),
        ({}, "found none"),
    ],
)
def test_what_cannot_be_mixed_is_refused_by_file(files: dict[str, str], words: str, tmp_path: Path) -> None:
    for name, text in files.items():
        (tmp_path / f"{name}.paint.csv").write_text(text)
    with pytest.raises(InputError, match=words) as refused:
        read_palette([tmp_path])
    assert str(tmp_path) in str(refused.value)


def test_a_band_that_a_paint_does_not_know_is_not_compared(tmp_path: Path) -> None:
    palette = read_palette([library(tmp_path, ["white", "red"])])
    half: list[Paint] = [palette[0], Paint(**{**vars(palette[1]), "scattering": palette[1].scattering.copy()})]
    half[1].scattering[:20] = np.nan

    found = recipe_search.find(on_grid(target({"white": 0.5, "red": 0.5})), half, FACE, NOISE, 2)
    assert not found.bands[:20].any()
    half[1].scattering[:] = np.nan
    with pytest.raises(InputError, match="0 common bands"):
        recipe_search.find(on_grid(target({"white": 1.0})), half, FACE, NOISE, 2)


def test_a_library_is_not_known_where_its_k_or_s_are_no_coefficients(tmp_path: Path) -> None:
    path = library(tmp_path, ["white", "red"])
    name, *values = path.read_text().splitlines()[1].split("\t")
    values[0], values[len(NM) + 40] = "-0.3", "-0.1"
    path.write_text(path.read_text().splitlines()[0] + "\n" + "\t".join([name, *values]) + "\n")

    red = read_palette([path])[1]

    unknown = WAVELENGTHS_NM[np.isnan(red.absorption + red.scattering)]
    assert {400.0, 600.0} <= set(unknown)
    assert set(unknown) <= {*WAVELENGTHS_NM[:5], 595.0, 600.0, 605.0, *WAVELENGTHS_NM[77:]}


def test_the_command_tells_shares_lights_costs_and_draws_them(tmp_path: Path) -> None:
    rows = "".join(f"{nm},{value:.6f}\n" for nm, value in zip(NM, target(SHARES), strict=True))
    (tmp_path / "sleeve.csv").write_text(f"nm,R\n{rows}")
    palette = library(tmp_path, list(paints()))
    words = ["recipe", str(tmp_path / "sleeve.csv"), "--palette", str(palette), "--light", "D65,A,LED-B3"]
    words += ["--noise", str(NOISE), "--out", str(tmp_path / "sleeve.html")]

    def run(*more: str) -> tuple[int, str, str]:
        ended = cells.here(*words, *more)
        return ended.code, ended.out, ended.err

    code, out, _ = run("--json")
    told = json.loads(out)
    best = told["recipes"][told["chosen"] - 1]
    assert code == 0
    assert best["shares"] == pytest.approx(SHARES, abs=0.02)
    assert set(best["delta_e00"]) == {"D65", "A", "LED-B3"}
    page = (tmp_path / "sleeve.html").read_text()
    assert (page.count("<rect"), page.count("<script")) == (6, 0)
    (tmp_path / "sleeve.html").write_text("mine")
    code, _, err = run()
    assert (code, (tmp_path / "sleeve.html").read_text()) == (2, "mine")
    assert "sleeve.html: exists already" in err
    assert run("--overwrite")[2].count("dE00") >= 5
    assert (tmp_path / "sleeve.html").read_text() == page
    code, _, err = run("--overwrite", "--light", "moonlight")
    assert (code, "moonlight" in err) == (2, True)
    code, _, err = run("--overwrite", "--geometry", "d:8")
    assert (code, "--geometry: expected" in err) == (2, True)


def test_the_mixture_is_a_paint_that_looks_as_the_recipe(tmp_path: Path) -> None:
    """Its K and S are sums by share; opaque under the binder's face it is the target."""
    library(tmp_path, list(paints()))
    rows = "\n".join(f"{nm};{value:.6f}" for nm, value in zip(NM, target(SHARES), strict=True))
    (tmp_path / "sleeve.csv").write_text(f"nm;reflectance\n{rows}\n")
    arguments = (
        "recipe",
        tmp_path / "sleeve.csv",
        "--palette",
        tmp_path / "paints.rs",
        "--noise",
        "0.002",
        "--json",
    )

    ended = cells.here(*arguments, "--paint", tmp_path / "mixed/sleeve.paint.csv")

    assert ended.code == 0, ended.err
    told = json.loads(ended.out)
    mixture = read_paint(tmp_path / "mixed/sleeve.paint.csv")
    assert (mixture.name, mixture.unit) == ("sleeve", "relative")
    assert dict(mixture.head_lines["shares"]) == pytest.approx(
        told["recipes"][told["chosen"] - 1]["shares"], abs=1e-5
    )
    at = np.searchsorted(mixture.wavelengths_nm, NM)
    seen = opaque_in_air(mixture.absorption[at], mixture.scattering[at])
    assert np.abs(seen - target(SHARES)).max() < 4.0 * NOISE
    standing = cells.here(*arguments, "--paint", tmp_path / "mixed/sleeve.paint.csv")
    assert standing.code == 2
    assert "sleeve.paint.csv: exists already" in standing.err
    refused = cells.here(*arguments, "--paint", tmp_path / "sleeve.txt")
    assert refused.code == 2
    assert ".paint.csv" in refused.out + refused.err
