"""Lenses of several colours from the same images: their difference is known better than each of them."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import cells
import numpy as np
import pytest
from photographed import BOARD_YAML, write_folder, write_run
from synthesis import Cell, make_cell

from coupole.calibration.lens.board import Sighting
from coupole.calibration.lens.chromatic import calibrate_channels
from coupole.calibration.record import read_record
from coupole.errors import InputError

MAGNIFIED = 1.0004
FIELD = np.array([[x, y] for x in (20.0, 500.0, 1000.0) for y in (20.0, 380.0, 750.0)])


def in_red(cell: Cell, seed: int) -> list[Sighting]:
    """The cell's images as red sees them: magnified about the principal point, with noise of its own."""
    random = np.random.default_rng(seed)
    centre = np.array(cell.lens.centre_px)
    return [
        replace(
            seen, pixels=centre + MAGNIFIED * (seen.pixels - centre) + random.normal(0, 0.15, seen.pixels.shape)
        )
        for seen in cell.sightings
    ]


def test_lateral_colour_is_found_to_a_tenth_of_a_pixel_with_an_interval_that_holds() -> None:
    cell = make_cell(31, images=20, pixel_px=0.0)
    random = np.random.default_rng(1)
    green = [replace(s, pixels=s.pixels + random.normal(0, 0.1, s.pixels.shape)) for s in cell.sightings]
    found = calibrate_channels({"green": green, "red": in_red(cell, 2)}, cell.size_px)
    shift, covariance = found.shift("red", "green", FIELD)
    lens = found.intrinsics["green"]
    directions = np.c_[(FIELD - (lens.cx, lens.cy)) / (lens.fx, lens.fy), np.ones(len(FIELD))]
    true = (MAGNIFIED - 1) * (cell.lens.see(directions) - np.array(cell.lens.centre_px))
    u = np.sqrt(np.einsum("kii->ki", covariance))
    assert np.abs(shift - true).max() < 0.1
    assert np.abs((shift - true) / u).max() < 4.0
    assert found.sigma_px["green"] == pytest.approx(0.1, rel=0.1)
    assert found.sigma_px["red"] == pytest.approx(0.15, rel=0.1)
    red, green_fx = (found.names.index(f"{channel}.fx") for channel in ("red", "green"))
    apart = found.covariance[red, red] + found.covariance[green_fx, green_fx] - 2 * found.covariance[red, green_fx]
    assert apart < 0.5 * found.covariance[red, red]


def test_channels_with_different_images_are_refused() -> None:
    cell = make_cell(32, images=8)
    with pytest.raises(InputError, match="every channel needs the same images"):
        calibrate_channels({"green": cell.sightings, "red": cell.sightings[:7]}, cell.size_px)


def test_the_command_finds_a_red_that_is_magnified_and_a_blue_that_is_not(tmp_path: Path) -> None:
    board = tmp_path / "board.yaml"
    board.write_text(BOARD_YAML)
    run = write_run(tmp_path / "run", red_scale=1.002).folder
    words = ("--board", board, "--model", "radial", "--out", tmp_path, "--name", "colours", "--json")
    ended = cells.here("calibrate", "chromatic", run, *words)
    assert ended.code in (0, 3), ended.err
    record = read_record(tmp_path / "colours.yaml")
    assert record.kind == "chromatic"
    names = [parameter.name for parameter in record.parameters]
    for channel, true in (("red", 1.002), ("blue", 1.0)):
        apart = np.zeros(len(names))
        apart[names.index(f"{channel}.fx_px")], apart[names.index("green.fx_px")] = 1.0, -1.0
        found = record.value(f"{channel}.fx_px") - record.value("green.fx_px")
        u = np.sqrt(apart @ record.covariance_matrix @ apart)
        assert abs(found - (true - 1.0) * record.value("green.fx_px")) < 4.0 * u
        assert u < 0.5
    assert any(remark.startswith("red is seen up to 0.") for remark in record.remarks)
    assert (tmp_path / "colours.png").stat().st_size > 10_000


def test_pictures_without_colours_are_refused(tmp_path: Path) -> None:
    ended = cells.here("calibrate", "chromatic", write_folder(tmp_path / "grey"), "--out", tmp_path)
    assert ended.code == 2
    assert "has no red channel" in ended.err
