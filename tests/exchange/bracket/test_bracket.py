"""Brackets of photographs by cameras of other responses than the code knows."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path

import numpy as np
import OpenEXR
import pytest
from in_part import in_part
from PIL import Image
from PIL.TiffImagePlugin import IFDRational
from typer.testing import CliRunner

from coupole.commands.cli import app
from coupole.exchange.bracket import camera_response, exposure_merging
from coupole.exchange.bracket.photographs import Photographs

TIMES_S = 2.0 ** np.arange(-4.0, 4.0)
Curve = Callable[[np.ndarray], np.ndarray]


def srgb(v: np.ndarray) -> np.ndarray:
    """IEC 61966-2-1."""
    return np.where(v <= 0.0031308, 12.92 * v, 1.055 * v ** (1 / 2.4) - 0.055)


def s_shaped(v: np.ndarray) -> np.ndarray:
    """As a film's, steep in the middle."""
    return v**0.55 * (1.0 + 0.06 * np.sin(2.0 * np.pi * v**0.55))


def linear(v: np.ndarray) -> np.ndarray:
    return v


def radiance() -> np.ndarray:
    """[60, 120, 3], over a range of 400 times."""
    y, x = np.mgrid[:60, :120] / 60.0
    return np.exp(3.0 * (x - 1.0) + 0.4 * np.sin(9.0 * y))[..., None] * np.array([1.0, 0.7, 0.4])


def photographed(curve: Curve, levels: int = 255) -> np.ndarray:
    """[times, h, w, 3] in levels, with noise of a level's size of 8 bits."""
    random = np.random.default_rng(1)
    exposed = np.clip(0.5 * radiance() * TIMES_S[:, None, None, None], 0.0, 1.0)
    return np.rint(levels * np.clip(curve(exposed) + random.normal(0.0, 1 / 255, exposed.shape), 0.0, 1.0))


@pytest.mark.parametrize("curve", [srgb, s_shaped, linear])
def test_the_response_comes_back_and_the_merged_picture_is_the_scene(curve: Curve) -> None:
    taken = Photographs((), (photographed(curve) / 255).astype(np.float32), TIMES_S, 256, raw=False)

    found = camera_response.found_response(taken)
    merged = exposure_merging.merge_exposures(taken, found)

    z = np.linspace(0.0, 1.0, camera_response.NODES)[20:236]
    fine = np.linspace(1e-6, 1.0, 100_001)
    true = np.log(np.interp(z, curve(fine), fine)) - np.log(np.interp(z[108], curve(fine), fine))
    off = found.log_exposure[20:236] - found.log_exposure[128] - true[:, None]
    assert np.abs(off).max() < 0.04
    assert np.median(np.abs(off)) < 0.012
    known = ~(merged.saturation_mask | merged.dark).any(axis=2)
    assert known.mean() > 0.95
    ratio = np.where(known[..., None], merged.radiance / radiance(), np.nan)
    ratio /= np.nanmedian(ratio, axis=(0, 1))
    blocks = np.nanmean(ratio.reshape(6, 10, 12, 10, 3), axis=(1, 3))
    noise = np.nanmean(
        np.where(known[..., None], merged.uncertainty, np.nan).reshape(6, 10, 12, 10, 3), axis=(1, 3)
    )
    assert np.nanmax(np.abs(blocks - 1.0) / np.maximum(0.012, 0.4 * noise)) < 1.0
    assert np.nanmedian(np.abs(blocks - 1.0)) < 0.004
    scatter = ((ratio - 1.0) / merged.uncertainty)[known]
    assert 0.7 < np.std(scatter[np.isfinite(scatter)]) < 1.3
    assert not merged.contradicting.mean() > 0.004


@pytest.mark.parametrize(
    ("step", "curves"),
    in_part(
        [
            (2, (srgb, linear)),
            (2, (s_shaped,)),
            (4, (srgb, linear)),
            (4, (s_shaped,)),
            (8, (srgb, s_shaped, linear)),
        ],
        (2, (s_shaped,)),
        (4, (s_shaped,)),
        (8, (srgb, s_shaped, linear)),
    ),
)
def test_intervals_hold_at_wide_steps_and_the_response_has_no_waves(step: int, curves: tuple[Curve, ...]) -> None:
    every = {2: slice(None), 4: slice(0, 8, 2), 8: slice(0, 8, 3)}[step]
    held, off = [], []
    for curve in curves:
        values = (photographed(curve)[every] / 255).astype(np.float32)
        taken = Photographs((), values, TIMES_S[every], 256, raw=False)

        found = camera_response.found_response(taken)
        merged = exposure_merging.merge_exposures(taken, found)

        z, fine = np.linspace(0.0, 1.0, camera_response.NODES), np.linspace(1e-6, 1.0, 100_001)
        true = np.interp(z, curve(fine), fine)
        missed = found.log_exposure - np.log(true / true[128])[:, None]
        off.append(np.abs(missed[13:243]).max())
        known = np.isfinite(merged.uncertainty)
        ratio = merged.radiance[known] / (radiance() * 0.5 / true[128])[known]
        held.append((np.abs(ratio - 1.0) < 1.96 * merged.uncertainty[known]).mean())
    assert 0.93 < np.mean(held) < 0.98
    assert min(held) > 0.9
    assert max(off) < {2: 0.01, 4: 0.025, 8: 0.05}[step]


def test_files_with_exif_are_merged_by_the_command_and_read_elsewhere(tmp_path: Path) -> None:
    values = photographed(srgb).astype(np.uint8)
    values[2, :20, :20] = 255 - values[2, :20, :20] // 2  # somebody walks through the third
    values[:, 40:50, 40:50] = 255  # a lamp
    for number, time_s in enumerate(TIMES_S):
        exif = Image.Exif()
        exif[0x8769] = {0x829A: IFDRational(time_s), 0x829D: 8.0, 0x8827: 100}
        Image.fromarray(values[number]).save(tmp_path / f"{number}.png", exif=exif)
    paths = [str(tmp_path / f"{number}.png") for number in (3, 0, 1, 2, 4, 5, 6, 7)]

    done = CliRunner().invoke(app, ["bracket", *paths, "--out", str(tmp_path / "merged.exr"), "--json"])

    assert done.exit_code == 0, done.output
    told = json.loads(done.stdout)
    assert [one["exposure_s"] for one in told["photographs"]] == pytest.approx(TIMES_S)
    # Some of the intruder is as bright as what he hides, or too dark to say anything.
    assert 0.7 * 400 / 7200 < told["photographs"][2]["contradicting"] < 1.01 * 400 / 7200
    assert max(told["photographs"][k]["contradicting"] for k in range(8) if k != 2) < 1e-3
    assert told["saturated"] == pytest.approx(100 / 7200, rel=0.05)
    channels = OpenEXR.File(str(tmp_path / "merged.exr"), separate_channels=True).channels()
    red = channels["R"].pixels
    ratio = red / radiance()[..., 0]
    assert np.median(ratio[:20, :20]) == pytest.approx(np.median(ratio[:20, 20:40]), rel=0.02)
    assert channels["saturated"].pixels[45, 45] == 1.0
    assert channels["contradicting"].pixels[:20, :20].mean() > 0.7
    assert np.isinf(channels["u.R"].pixels[45, 45])
    with Image.open(tmp_path / "merged-response.png") as drawn:
        assert drawn.size[0] > 300
    assert told["remarks"] == []


def test_steps_that_leave_waves_of_the_response_open_are_told_and_written(tmp_path: Path) -> None:
    values = photographed(srgb).astype(np.uint8)
    words = []
    for number in range(0, 8, 2):
        Image.fromarray(values[number]).save(tmp_path / f"{number}.png")
        words += [str(tmp_path / f"{number}.png"), "--exposure-s", str(TIMES_S[number])]

    done = CliRunner().invoke(app, ["bracket", *words, "--out", str(tmp_path / "merged.exr"), "--json"])

    assert done.exit_code == 0, done.output
    (remark,) = json.loads(done.stdout)["remarks"]
    assert "differ by at least 4.0 times" in remark
    header = OpenEXR.File(str(tmp_path / "merged.exr")).header()
    assert any(remark in str(value) for value in header.values())


def test_linear_values_are_a_straight_line(tmp_path: Path) -> None:
    import cv2

    values = photographed(linear, 65535).astype(np.uint16)
    paths = [str(tmp_path / f"{number}.tif") for number in range(len(values))]
    for path, one in zip(paths, values, strict=True):
        cv2.imwrite(path, one)
    times = [part for time_s in TIMES_S for part in ("--exposure-s", str(time_s))]

    done = CliRunner().invoke(
        app, ["bracket", *paths, *times, "--linear", "--out", str(tmp_path / "m.exr"), "--json"]
    )

    assert done.exit_code == 0, done.output
    told = json.loads(done.stdout)
    assert told["used_response"] == "linear"
    assert told["departure_from_straight"] < 0.03


@pytest.mark.parametrize(
    ("arguments", "told"),
    [
        (["one.png"], "two photographs or more"),
        (["one.png", "two.png"], "no exposure time"),
        (["one.png", "small.png", "--exposure-s", "1", "--exposure-s", "2"], "one size"),
        (["one.png", "two.png", "--exposure-s", "1"], "a time for each"),
        (["one.png", "two.png", "--exposure-s", "1", "--exposure-s", "1"], "steps of 2 to 4"),
        (["one.png", "two.png", "--exposure-s", "1", "--exposure-s", "4"], "many pixels"),
        (["one.png", "text.nef", "--exposure-s", "1", "--exposure-s", "4"], "LibRaw"),
        (["one.png", "text.png", "--exposure-s", "1", "--exposure-s", "4"], "8 or 16 bits"),
    ],
)
def test_what_is_no_bracket_is_refused(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, arguments: list[str], told: str
) -> None:
    monkeypatch.chdir(tmp_path)
    for name, side in (("one", 8), ("two", 8), ("small", 4)):
        Image.fromarray(np.full((side, side, 3), 255, np.uint8)).save(f"{name}.png")
    Path("text.nef").write_text("no picture")
    Path("text.png").write_text("no picture")

    done = CliRunner().invoke(app, ["bracket", *arguments, "--out", "m.exr"])

    assert told in f"{done.output}{done.exception}"
    assert not Path("m.exr").exists()
