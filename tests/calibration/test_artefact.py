"""Certificates of boards and tiles: read, applied, propagated, and kept in records."""

from __future__ import annotations

import hashlib
import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from photographed import BOARD_YAML, write_folder
from typer.testing import CliRunner

from coupole.calibration.artefact import LightSpectrum, temperature_of
from coupole.calibration.lens.board import read_board
from coupole.calibration.light.led_power import prior_of
from coupole.calibration.light.spectralon import Tile, read_tile
from coupole.calibration.record import read_record
from coupole.commands.calibrate import calibrate_app
from coupole.commands.uncertainty import budget
from coupole.errors import InputError

CERTIFIED = """\
artefact:
  name: board
  serial: CB-7
  certificate: {number: L-26-104, laboratory: Laboratory A, date: 2026-02-11, due: 2028-02-11, file: c.pdf}
  temperature_c: 20.0
  expansion_ppm_per_k: {value: 10.0, expanded_u: 1.0, k: 2}
  square_mm: {value: 16.0016, expanded_u: 0.0008, k: 2}
  flatness_um: {value: 12, expanded_u: 4, k: 2}
"""
TILE = """\
artefact:
  name: white tile
  serial: T-3
  certificate: {number: R-26-9, laboratory: Laboratory B, date: 2026-01-20}
  reflectance:
    geometry: 8/h
    k: 2
    values: [[400, 0.97, 0.012], [500, 0.98, 0.008], [600, 0.99, 0.006], [700, 0.99, 0.006]]
"""


def board_file(folder: Path, text: str = CERTIFIED) -> Path:
    folder.mkdir(parents=True, exist_ok=True)
    (folder / "c.pdf").write_bytes(b"the certificate")
    path = folder / "board.yaml"
    path.write_text(BOARD_YAML + text)
    return path


def problems_of(path: Path, read: Any = read_board) -> str:
    with pytest.raises(InputError) as refused:
        read(path)
    return str(refused.value)


def tile_of(folder: Path, text: str = TILE) -> Tile:
    path = folder / "tile.yaml"
    path.write_text(text)
    return read_tile(path)


def test_a_board_has_its_certified_lengths_at_the_temperature_of_its_pictures(tmp_path: Path) -> None:
    board = read_board(board_file(tmp_path))
    warm, (kept,) = board.measured_at(temperature_of(26.0, 0.5, (31.0, 40.0)))
    assert warm.square_mm == pytest.approx(16.0016 * (1 + 60e-6), rel=1e-9)
    # 25 ppm of its squares, 6 K of 0.5 ppm/K (and 0.5 K of it), 0.5 K of 10 ppm/K
    u_ppm = np.sqrt((0.0004 / 16.0016 * 1e6) ** 2 + (0.5**2) * (6**2 + 0.5**2) + 5.0**2)
    assert warm.scale_u_ppm == pytest.approx(u_ppm, rel=1e-6)
    assert (kept.correction_ppm, kept.measured_by) == (pytest.approx(60.0), "entered by hand")
    assert kept.artefact.certificate is not None
    assert kept.artefact.certificate.sha256 == hashlib.sha256(b"the certificate").hexdigest()


def test_a_temperature_that_nobody_measured_is_the_runs_or_allowed_for(tmp_path: Path) -> None:
    board = read_board(board_file(tmp_path))
    by_run, (kept,) = board.measured_at(temperature_of(None, 0.5, (24.0, 40.0)))
    assert by_run.square_mm == pytest.approx(16.0016 * (1 + 40e-6), rel=1e-9)
    assert kept.u_measured_k == 2.0
    unknown, (kept,) = board.measured_at(temperature_of(None, 0.5, None))
    assert unknown.square_mm == 16.0016
    assert kept.measured_c is None
    assert unknown.scale_u_ppm > 50.0  # 5 K of 10 ppm/K


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (
            ("file: c.pdf", "file: d.pdf"),
            "board.yaml:8:102: artefact.certificate.file: expected the certificate's file",
        ),
        (("file: c.pdf", f"file: c.pdf, sha256: '{'0' * 64}'"), "which differs from its `sha256`"),
        (("k: 2}\n  flatness", "k: 0}\n  flatness"), "board.yaml:11:"),
        (("16.0016", "25.4"), "16 mm within 1 %"),
        (("artefact:", "scale_u_ppm: 20\nartefact:"), "no `scale_u_ppm` beside a certified artefact.square_mm"),
        (("  serial: CB-7\n", ""), "serial"),
    ],
)
def test_a_certificate_that_cannot_be_is_refused(tmp_path: Path, change: tuple[str, str], message: str) -> None:
    assert message in problems_of(board_file(tmp_path, CERTIFIED.replace(*change)))


def test_a_record_keeps_the_certificate_and_a_budget_names_it(tmp_path: Path) -> None:
    folder = write_folder(tmp_path / "pictures")
    board_file(folder)
    words = ["--model", "brown4", "--out", str(tmp_path), "--json", "--limit", "robot_ratio=9"]
    result = CliRunner().invoke(
        calibrate_app, ["hand-eye", str(folder), *words, "--name", "he", "--board-c", "30"]
    )
    document = json.loads(result.stdout)
    assert document["traceability"] == [
        "board board, serial CB-7: certificate L-26-104 of Laboratory A, 2026-02-11"
    ]
    (kept,) = read_record(tmp_path / "he.yaml").artefacts
    assert kept.correction_ppm == pytest.approx(100.0)
    scale = document["parameters"]["board_scale"]
    assert scale["u"] <= 1.01e-6 * (kept.u_scale_ppm or 0.0)
    page = (tmp_path / "he.html").read_text()
    assert "L-26-104, Laboratory A, 2026-02-11, due 2028-02-11" in page
    assert "12 um, U 4 um (k = 2, 95%)" in page
    (folder / "board.yaml").write_text(BOARD_YAML)
    CliRunner().invoke(calibrate_app, ["hand-eye", str(folder), *words, "--name", "plain"])
    assert "artefacts" not in (tmp_path / "plain.yaml").read_text()
    assert "not traceable: no certificate" in (tmp_path / "plain.html").read_text()
    from typer import Typer

    app = Typer()
    app.command()(budget)
    told = json.loads(CliRunner().invoke(app, [str(tmp_path / "he.yaml"), "--json"]).stdout)
    assert told["traceability"] == [
        "hand-eye he: board board, serial CB-7: certificate L-26-104 of Laboratory A, 2026-02-11"
    ]


def test_a_tiles_certificate_is_weighed_by_the_light_in_each_channel(tmp_path: Path) -> None:
    tile = tile_of(tmp_path)
    flat = tile.of_channel("R")
    nm = np.arange(580.0, 680.01, 0.5)
    by_hand = np.mean(np.where(nm < 600, 0.98 + (nm - 500) * 1e-4, 0.99))
    assert flat.reflectance == pytest.approx(by_hand, abs=2e-5)
    assert 0.003 < flat.u_reflectance < 0.0035  # the certificate's 0.003, and a band 20 nm off
    blue_light = LightSpectrum(np.array([430.0, 440.0, 441.0]), np.array([1.0, 1.0, 0.0]), "led.csv")
    blue = tile.of_channel("B", blue_light)
    assert blue.reflectance == pytest.approx(0.9735, abs=2e-4)
    assert flat.geometry == "8/h"
    assert prior_of(blue)[-2] == pytest.approx(blue.u_reflectance / blue.reflectance)


@pytest.mark.parametrize(("geometry", "way"), [("8/h", 8.0), ("0/45", 45.0)])
def test_the_law_gives_back_the_certified_figure_in_its_geometry(geometry: str, way: float) -> None:
    for minnaert in (0.95, 1.0, 1.2):
        tile = Tile(reflectance=0.98, geometry=geometry, minnaert=minnaert)  # type: ignore[arg-type]
        cosine = np.cos(np.radians(way))
        if geometry == "0/45":
            found = np.pi * float(tile.brdf(np.array(1.0), np.array(cosine)))
        else:
            out = (np.arange(20000) + 0.5) / 20000  # cosines of observation
            found = float(np.mean(2 * np.pi * out * tile.brdf(np.full_like(out, cosine), out)))
        assert found == pytest.approx(0.98, rel=1e-5)


def test_a_tile_says_its_reflectance_once_and_for_all_its_channels(tmp_path: Path) -> None:
    (tmp_path / "tile.yaml").write_text("reflectance: 0.99\n" + TILE)
    assert "no reflectance beside a certified" in problems_of(tmp_path / "tile.yaml", read_tile)
    short = tile_of(tmp_path, TILE.replace(", [600, 0.99, 0.006], [700, 0.99, 0.006]", ""))
    with pytest.raises(InputError, match="from 400 to 500 nm do not cover the band of R, 580 to 680 nm"):
        short.of_channel("R")
    assert "fractions, not percent" in problems_of(
        Path(tile_path(tmp_path, TILE.replace("0.97,", "97,"))), read_tile
    )


def tile_path(folder: Path, text: str) -> Path:
    path = folder / "other.yaml"
    path.write_text(text)
    return path
