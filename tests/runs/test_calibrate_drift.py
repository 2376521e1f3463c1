"""The loop closed for drift: LEDs that are warmer and older than when they were calibrated, seen on a tile."""

from __future__ import annotations

import csv
import json
from pathlib import Path
from typing import Any

import cells
import numpy as np
import pytest
from cells import Ended
from imperfect_cells import imperfect_rig
from numpy.typing import NDArray

from coupole.calibration.light.frames import LightFrame, open_light_frames
from coupole.calibration.record import Record, read_record
from coupole.preflight.exposure_scale import exposure_scale
from coupole.preflight.job import read_job
from sim.optics.led_light import LedModel, led_flux_factor

LEDS = {"kind": "every", "every": 24}
"""45 of them, all round the dome."""
HOURS_SHONE, AMBIENT_C = 3000.0, 30.0
WARM_K, COOLING_S = 50.0, 22.0
"""In the later run boards are warm from one before it, and cool."""
BESIDE_MM = (60.0, -90.0)
"""Where the tile lies beside an object."""


def rig(
    folder: Path, things: list[dict[str, Any]], *, hours_shone: float, ambient_c: float, warm_k: float = 0.0
) -> Path:
    """The imperfect cell with small frames, faster than life; slower where boards cool while a session begins, of
    which a busy machine makes several seconds."""
    content = imperfect_rig(256, speed=5.0 if warm_k else 20.0)
    content["storage"]["folder"] = str(folder / "runs")
    boards = {"ambient_c": ambient_c, "warm_k": warm_k, "thermal_time_constant_s": COOLING_S}
    settings = content["world"]["settings"]
    settings |= {"things": things, "ledbox": boards}
    settings["leds"] = {"hours_shone": hours_shone}
    folder.mkdir(parents=True, exist_ok=True)
    path = folder / "rig.yaml"
    path.write_text(json.dumps(content))
    return path


def acquire(folder: Path, x_mm: float, y_mm: float) -> Path:
    """Two views of the tile at a place; returns the run."""
    view = {"kind": "look_at", "target_mm": [x_mm, y_mm, 10], "distance_mm": 335}
    directions = {
        "low": {"azimuth_deg": -120, "elevation_deg": 45},
        "high": {"azimuth_deg": 60, "elevation_deg": 72},
    }
    content = {
        "schema_version": 1,
        "name": "tile",
        "rig": "rig.yaml",
        "views": [{**view, "name": name, **direction} for name, direction in directions.items()],
        "lights": LEDS,
        "exposure": {"kind": "bracket", "exposures_us": [2000, 6000]},
        "darks_per_view": 4,
    }
    (folder / "plan.yaml").write_text(json.dumps(content))
    ended = cells.here("acquire", folder / "plan.yaml", "--json")
    assert ended.code == 0, ended.err
    return Path(ended.document["run"])


def tile(folder: Path, x_mm: float, y_mm: float) -> Path:
    """Its description."""
    path = folder / "tile.yaml"
    place = {"translation_mm": [x_mm, y_mm, 10.0]}
    path.write_text(json.dumps({"schema_version": 1, "minnaert": 1.0, "support_from_tile": place}))
    return path


@pytest.fixture(scope="module")
def calibrated(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with the LEDs' powers, calibrated when they were new and cool."""
    folder = tmp_path_factory.mktemp("calibrated")
    new = rig(folder, [{"kind": "spectralon_tile"}], hours_shone=0.0, ambient_c=24.0)
    run = acquire(folder, 0.0, 0.0)
    where = ["--tile", tile(folder, 0.0, 0.0), "--rig", new, "--out", folder, "--name", "led-power"]
    ended = cells.here("calibrate", "led-power", run, *where, "--json")
    assert ended.code == 0, ended.err
    return folder


@pytest.fixture(scope="module")
def later(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with a run of an object, the tile beside it, when the LEDs were old and warm."""
    folder = tmp_path_factory.mktemp("later")
    x_mm, y_mm = BESIDE_MM
    things = [
        {"kind": "spectralon_tile", "translation_mm": [x_mm, y_mm, 0.0]},
        {"kind": "paint_wedge", "translation_mm": [-80.0, 60.0, 0.0]},
    ]
    rig(folder, things, hours_shone=HOURS_SHONE, ambient_c=AMBIENT_C, warm_k=WARM_K)
    run = acquire(folder, x_mm, y_mm)
    run.rename(folder / "run")
    return folder


def test_the_leds_powers_tell_how_bright_white_will_be(calibrated: Path) -> None:
    """The world's word: white reaches 60 % of full scale in the rig's `white_at_us` under the median LED."""
    content = json.loads((calibrated / "plan.yaml").read_text())
    content |= {"calibrations": ["led-power.yaml"]}
    (calibrated / "known.yaml").write_text(json.dumps(content))
    job = read_job(calibrated / "known.yaml")
    scale = exposure_scale(job)
    assert scale is not None
    known = scale.dn_per_s > 0
    white_at_s = 1e-6 * job.cell.rig.world.settings["white_at_us"]
    shares = scale.dn_per_s[known] * white_at_s / (job.cell.rig.sensor.white_dn - job.cell.rig.sensor.black_dn)
    assert known.sum() == 45
    assert np.median(shares) == pytest.approx(0.6, rel=0.15)  # 45 of 1080 LEDs, each with a flux of its own


def drift(calibrated: Path, later: Path, out: Path, x_mm: float, y_mm: float) -> Ended:
    where = ["--led-power", calibrated / "led-power.yaml", "--rig", later / "rig.yaml"]
    where += ["--tile", tile(later, x_mm, y_mm), "--out", out, "--name", "drift"]
    return cells.here("calibrate", "drift", later / "run", *where, "--json")


def by_record(record: Record, frames: list[LightFrame], table: Path) -> tuple[NDArray[np.float64], ...]:
    """Factor of each frame by the formula of the record, its relative uncertainty, and the truth."""
    board_c = {int(row["id"]): float(row["board_c"]) for row in rows_of(table)}
    leds = [frame.led for frame in frames]
    hours = np.array([(frame.t_s - record.value("start_s")) / 3600 for frame in frames])
    warmer_k = np.array([frame.temperature_c - board_c[led] for frame, led in zip(frames, leds, strict=True)])
    design = np.stack([np.ones_like(hours), hours, warmer_k], axis=1)
    found = design @ [record.value(name) for name in ("level", "rate_per_h", "per_k")]
    u = np.sqrt(np.einsum("ni,ij,nj->n", design, record.covariance_matrix, design))
    steady = LedModel(flicker=0.0)
    true = [
        led_flux_factor(steady, led, 0, frame.temperature_c, hours=HOURS_SHONE)
        / led_flux_factor(steady, led, 0, board_c[led])
        for frame, led in zip(frames, leds, strict=True)
    ]
    return found, u, np.log(true)


def rows_of(table: Path) -> list[dict[str, str]]:
    return list(csv.DictReader(line for line in table.read_text().splitlines() if not line.startswith("#")))


@pytest.mark.timeout(600)
def test_the_factor_of_each_frame_is_that_of_the_world(calibrated: Path, later: Path, tmp_path: Path) -> None:
    ended = drift(calibrated, later, tmp_path, *BESIDE_MM)
    assert ended.code == 0, ended.err
    record = read_record(tmp_path / "drift.yaml")
    assert record.kind == "drift"
    assert {line.name for line in record.inputs} >= {"led-power.yaml", "tile.yaml", "rig.yaml"}
    frames = [frame for frame in open_light_frames([later / "run"]).lit if frame.led is not None]
    found, u, true = by_record(record, frames, calibrated / "led-power.csv")
    assert true.max() < -0.02  # it is drift that is looked for
    warm_c = [frame.temperature_c for frame in frames]
    assert max(warm_c) - min(warm_c) > 5.0  # within the run too
    assert np.abs(found - true).max() < 0.01
    assert (np.abs(found - true) < 3 * u).all()


@pytest.mark.timeout(600)
def test_a_record_of_something_else_is_refused(calibrated: Path, later: Path, tmp_path: Path) -> None:
    ended = drift(calibrated, later, tmp_path, *BESIDE_MM)
    assert ended.code == 0, ended.err
    own = ["--led-power", tmp_path / "drift.yaml", "--rig", later / "rig.yaml", "--tile", later / "tile.yaml"]
    again = cells.here("calibrate", "drift", later / "run", *own, "--out", tmp_path, "--name", "again", "--json")
    assert again.code == 2
    assert "expected a record of the kind `led-power`, found one of `drift`" in again.err


@pytest.mark.timeout(600)
def test_a_run_without_the_tile_is_refused(calibrated: Path, later: Path, tmp_path: Path) -> None:
    ended = drift(calibrated, later, tmp_path, 400.0, 300.0)
    assert ended.code == 2
    assert "no view shows the whole reference tile" in ended.err


SECOND = {
    "name": "second tile",
    "serial": "T-2",
    "certificate": {"number": "R-2", "laboratory": "Laboratory B", "date": "2026-01-20"},
    "reflectance": {"geometry": "8/h", "k": 2, "values": [[400, 0.99, 0.008], [700, 0.99, 0.008]]},
}


def check(calibrated: Path, run: Path, folder: Path, place_mm: tuple[float, float], serial: str = "T-2") -> Ended:
    """`check-artefact` of a run with a tile of a certificate."""
    place = {"translation_mm": [*place_mm, 10.0]}
    described = {"minnaert": 1.0, "support_from_tile": place, "artefact": SECOND | {"serial": serial}}
    folder.mkdir(exist_ok=True)
    path = folder / "second.yaml"
    path.write_text(json.dumps(described))
    words = ["--tile", path, "--records", calibrated / "led-power.yaml", "--out", folder, "--name", "check"]
    return cells.here("calibrate", "check-artefact", run, *words, "--json")


@pytest.mark.timeout(600)
def test_a_second_tile_agrees_with_its_certificate(calibrated: Path, tmp_path: Path) -> None:
    things = [{"kind": "spectralon_tile", "translation_mm": [30.0, 20.0, 0.0]}]
    rig(tmp_path, things, hours_shone=0.0, ambient_c=24.0)
    ended = check(calibrated, acquire(tmp_path, 30.0, 20.0), tmp_path, (30.0, 20.0))
    assert ended.code == 0, ended.err
    record = read_record(tmp_path / "check.yaml")
    assert [value.name for value in record.comparisons] == ["R", "G", "B"]
    for value in record.comparisons:
        assert value.measured_value == pytest.approx(0.99, abs=value.expanded_u_measured)
        assert value.en < 1.0
    assert record.artefacts[0].figures["reflectance.G"] == pytest.approx(0.99)
    used_images = check(calibrated, next((calibrated / "runs").glob("*-tile")), tmp_path / "x", (0.0, 0.0))
    assert used_images.code == 2
    assert "was made from the same images" in used_images.err


@pytest.mark.timeout(600)
def test_a_second_tile_and_a_drift_record_tell_that_the_leds_have_faded(
    calibrated: Path, later: Path, tmp_path: Path
) -> None:
    ended = check(calibrated, later / "run", tmp_path, BESIDE_MM)
    assert ended.code == 3
    assert "largest E_n of one value" in ended.err
    faded = [
        value.measured_value / value.certified_value for value in read_record(tmp_path / "check.yaml").comparisons
    ]
    assert max(faded) < 0.97
    assert drift(calibrated, later, tmp_path, *BESIDE_MM).code == 0
    told = cells.here("budget", calibrated / "led-power.yaml", tmp_path / "drift.yaml", "--json")
    doubts = [doubt for doubt in told.document["doubts"] if "expired by drift" in doubt]
    assert len(doubts) == 1
    assert "the LEDs' power has changed by -" in doubts[0]
