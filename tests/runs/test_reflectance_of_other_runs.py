"""`coupole reflectance RUN` on runs unlike the usual one: brackets, folds that light each other, another gain."""

from __future__ import annotations

import json
from pathlib import Path

import cells
import h5py
import numpy as np
import pytest
from cells import CellFolder
from relief_cells import RECORDS, shipped_cell


@pytest.mark.timeout(900)  # many kernels are compiled here first, while others want the machine too
def test_brackets_are_merged(tmp_path: Path) -> None:
    """Some pixels are saturated in the longer exposure, some lost in the noise of the shorter. Six LEDs are enough
    for samples, and too few for a material."""
    cell = shipped_cell(tmp_path)
    exposures = {"kind": "bracket", "exposures_us": [1000, 16_000]}
    cell.write(views=[cells.TOP], lights={"kind": "every", "every": 180}, exposure=exposures)
    assert cell.acquire().code == 0
    out = tmp_path / "result"
    ended = cells.here("reflectance", cell.run_folder, "--calibrations", RECORDS, "--out", out, "--json")
    assert ended.code == 0, ended.err
    assert ended.document["not_fitted"] == ended.document["triangles"]
    assert set(ended.document["mae"].values()) == {None}
    with h5py.File(out / "samples/top.h5") as file:
        f, u_own, reached = file["f"][()], file["u_own"][()], file["codes"][()] == 0
    stone = np.array([0.62, 0.55, 0.42]) / np.pi  # of objects for which no rig gives a material
    np.testing.assert_allclose(np.nanmedian(f, axis=(0, 1)), stone, rtol=0.01)
    assert np.isfinite(f[reached]).mean() > 0.9
    z = ((f / stone - 1) / np.hypot(u_own, 0.006))[np.isfinite(f)]
    assert 0.9 < np.mean(np.abs(z) < 1.96) < 0.99


@pytest.mark.full
def test_light_from_fold_to_fold_is_taken_off(tmp_path: Path) -> None:
    """Of a white stone whose folds light each other, in a cell that is simulated with that light."""
    white = (0.8, 0.6, 0.3)
    cell = shipped_cell(tmp_path, material={"diffuse": white}, shading="pixel")
    cell.write(views=[cells.TOP], lights={"kind": "every", "every": 180})
    assert cell.acquire().code == 0
    f = {}
    for name, options in (("with", ["--keep-inter-reflection"]), ("without", [])):
        words = (cell.run_folder, "--calibrations", RECORDS, "--out", tmp_path / name, *options)
        ended = cells.here("reflectance", "extract", *words, "--json")
        assert ended.code == 0, ended.err
        with h5py.File(tmp_path / name / "samples/top.h5") as file:
            f[name] = file["f"][()] * np.pi / white
            shares = file["inter_reflection"][()].astype(float) if name == "without" else None
    median, most = ended.document["views"][0]["inter_reflection"]
    assert 0.01 < median < 0.1 < most < 0.5
    folds = (shares > 0.1) & (shares < 0.4)
    assert folds.sum() > 1000
    assert np.median(f["with"][folds]) > 1.15
    assert np.median(f["without"][folds]) == pytest.approx(1.0, abs=0.05)
    off = np.abs(f["without"] - 1) / (0.01 + 0.2 * shares / (1 - shares))
    assert np.nanmean(off[folds] < 1.96) > 0.9


def test_powers_for_another_gain_are_refused(tmp_path: Path) -> None:
    cell = shipped_cell(tmp_path)
    cell.write(views=[cells.TOP], lights={"kind": "every", "every": 360}, gain_db=6.0)
    assert cell.acquire().code == 0
    ended = cells.here("reflectance", cell.run_folder, "--calibrations", RECORDS, "--out", tmp_path / "result")
    assert ended.code == 2
    assert "is valid for a gain of 0 dB; the run has 6 dB" in " ".join(ended.err.split())


TILE_MM = (-30.0, -40.0)
"""Where the reference tile lies beside the relief."""
MADE_WITH = {name: RECORDS / f"{name}.yaml" for name in ("flat-field", "response", "leds", "hand-eye", "camera")}


@pytest.fixture(scope="module")
def aged(tmp_path_factory: pytest.TempPathFactory) -> CellFolder:
    """A run with LEDs that have shone for 6000 hours and are 10 K warmer than at their calibration, the tile in
    view."""
    tile = {"kind": "spectralon_tile", "translation_mm": [*TILE_MM, 0.0]}
    cell = shipped_cell(tmp_path_factory.mktemp("aged"), things=[tile])
    cell.world_settings.update(leds={"hours_shone": 6000.0}, ledbox={"ambient_c": 35.0})
    cell.write(views=[cells.TOP], lights={"kind": "every", "every": 30})
    assert cell.acquire().code == 0
    return cell


def drift_of(cell: CellFolder, without: str = "") -> cells.Ended:
    tile = cell.folder / "tile.yaml"
    place = {"translation_mm": [*TILE_MM, 10.0]}
    tile.write_text(json.dumps({"schema_version": 1, "minnaert": 1.0, "support_from_tile": place}))
    words: list[str | Path] = ["--rig", cell.folder / "rig.yaml", "--tile", tile, "--led-power"]
    words += [RECORDS / "led-power.yaml", "--out", cell.folder, "--name", without or "drift"]
    for name, path in MADE_WITH.items():
        if name != without:
            words += ["--flat" if name == "flat-field" else f"--{name}", path]
    return cells.here("calibrate", "drift", cell.run_folder, *words)


@pytest.mark.full
def test_leds_that_are_old_and_warm_are_corrected_by_the_runs_own_drift(aged: CellFolder, tmp_path: Path) -> None:
    """Without its record only the usual loss of light with warmth is known."""
    assert (ended := drift_of(aged)).code == 0, ended.err
    ratio, u_shared = {}, {}
    for name, records in (("without", [RECORDS]), ("with", [RECORDS, aged.folder / "drift.yaml"])):
        words = [word for path in records for word in ("--calibrations", path)]
        ended = cells.here("reflectance", "extract", aged.run_folder, *words, "--out", tmp_path / name)
        assert ended.code == 0, ended.err
        with h5py.File(tmp_path / name / "samples/top.h5") as file:
            stone = np.array([0.62, 0.55, 0.42]) / np.pi
            ratio[name] = np.nanmedian(file["f"][()].astype(float), axis=(0, 1)) / stone
            u_shared[name] = file["led_u_shared"][()]
    np.testing.assert_allclose(ratio["without"], 0.7 ** (6000 / 50_000), atol=0.012)
    np.testing.assert_allclose(ratio["with"], 1.0, atol=0.012)
    told = next(
        line for line in (aged.folder / "drift.yaml").read_text().splitlines() if "the drift factor" in line
    )
    u_drift = float(told.split('"found": ')[1].split(",")[0])
    np.testing.assert_allclose(u_shared["with"] ** 2 - u_shared["without"] ** 2, u_drift**2, rtol=1e-6)


@pytest.mark.full
@pytest.mark.parametrize("kind", ["flat-field", "response"])
def test_frames_are_not_read_otherwise_than_those_that_powers_come_from(
    aged: CellFolder, tmp_path: Path, kind: str
) -> None:
    ended = drift_of(aged, without=kind)
    assert ended.code == 2
    assert f"led-power.yaml: was made with a {kind} record" in " ".join(ended.err.split())
    words = [
        word
        for name in ("led-power", *MADE_WITH)
        if name != kind
        for word in ("--calibrations", RECORDS / f"{name}.yaml")
    ]
    ended = cells.here("reflectance", aged.run_folder, *words, "--out", tmp_path / "result")
    assert ended.code == 2
    assert f"{kind}.yaml too" in " ".join(ended.err.split())


def test_records_of_another_camera_are_refused(tmp_path: Path) -> None:
    cell = CellFolder(tmp_path, speed=10.0)
    cell.write(lights={"kind": "every", "every": 360})
    assert cell.acquire().code == 0
    ended = cells.here("reflectance", cell.run_folder, "--calibrations", RECORDS, "--out", tmp_path / "result")
    assert ended.code == 2
    assert "frames of 512 x 384 pixels" in " ".join(ended.err.split())
