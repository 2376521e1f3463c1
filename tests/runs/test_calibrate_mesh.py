"""The loop closed for a mesh: scanned by the simulated scanner, seen over the wires, held against the truth."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from datetime import UTC, datetime, timedelta
from pathlib import Path
from typing import Any

import cells
import numpy as np
import pytest
from imperfect_cells import imperfect_rig
from numpy.typing import NDArray
from ruamel.yaml import YAML

from coupole.calibration.campaign_steps import OBJECT
from coupole.calibration.record import Input, Parameter, Record, Validity, read_record, seal_record, write_record
from coupole.errors import InputError
from coupole.geometry import transform
from coupole.plan.base_model import Pose
from sim.devices.scanner import export_scan, scanner_from_thing

BASE_FROM_SUPPORT = transform((200.0, 0.0, 1450.0), (0.0, 0.0, 180.0))
LENS_U = {"fx_px": 0.05, "fy_px": 0.05, "cx_px": 0.05, "cy_px": 0.05, "k1": 2e-4, "p1": 1e-5, "p2": 1e-5}
STEP_U = {"x_mm": 0.01, "y_mm": 0.01, "z_mm": 0.01, "rx_deg": 0.001, "ry_deg": 0.001, "rz_deg": 0.001}


@pytest.fixture
def make_rig(scale: Callable[[int, int], int]) -> Callable[..., Path]:
    """`make_rig(folder, thing...)` writes the imperfect cell with small frames and things on its support, and its
    hand-eye record."""

    def make(folder: Path, *things: Mapping[str, Any]) -> Path:
        width_px = scale(512, 2048)
        content = imperfect_rig(width_px, speed=20.0)
        content["storage"]["folder"] = str(folder / "runs")
        content["world"]["settings"]["things"] = [dict(thing) for thing in things]
        content["world"]["settings"]["camera"]["samples_per_side"] = scale(2, 3)
        folder.mkdir(parents=True, exist_ok=True)
        path = folder / "rig.yaml"
        with path.open("w") as file:
            YAML().dump(content, file)
        write_record(folder / "hand-eye.yaml", true_hand_eye(width_px, content["sensor"]["pixel_pitch_um"]))
        return path

    return make


def true_hand_eye(width_px: int, pitch_um: float) -> Record:
    """The record of a good calibration of the imperfect cell: what is true, and how well it would be known."""
    focal_px = 35.0 * 335.0 / (335.0 - 35.0) * 1e3 / pitch_um
    middle = (width_px / 2 - 0.5, width_px * 3 / 8 - 0.5)
    figures = (focal_px, focal_px, *middle, -0.03, 1e-4, -1e-4)
    lens: dict[str, float | None] = dict(zip(LENS_U, figures, strict=True))
    place = (0.0, 0.0, 120.0, None, None, None)
    values = lens | {f"flange_from_camera.{step}": value for step, value in zip(STEP_U, place, strict=True)}
    u = [*LENS_U.values(), *STEP_U.values()]
    now = datetime.now(UTC)
    return seal_record(
        kind="hand-eye",
        name="true",
        created=now,
        software="test",
        simulated=True,
        validity=Validity(expires=now + timedelta(days=1), focus_distance_mm=335.0),
        transforms={"flange_from_camera": Pose(translation_mm=(0.0, 0.0, 120.0))},
        parameters=tuple(
            Parameter(name=name, value=value, u=one, degrees_of_freedom=100.0, dominated_by="corners")
            for (name, value), one in zip(values.items(), u, strict=True)
        ),
        fixed={"k2": 0.0, "k3": 0.0},
        covariance=tuple(map(tuple, np.diag(np.square(u)).tolist())),
        noise=(),
        images=(),
        limits=(),
        remarks=(),
        inputs=(Input(name="true", sha256="0" * 64),),
    )


def plan(path: Path, rig: Path, azimuths: int) -> Path:
    """Views from all around at two heights."""
    content = {
        "schema_version": 1,
        "name": "mesh",
        "rig": str(rig),
        "views": [
            {
                "kind": "grid",
                "name": f"g{elevation_deg}",
                "target_mm": [0, 0, 15],
                "distance_mm": 335,
                "azimuths_deg": [round(-180 + 360 * (k + shift) / azimuths, 1) for k in range(azimuths)],
                "elevations_deg": [elevation_deg],
            }
            for elevation_deg, shift in ((48, 0.0), (70, 0.5))
        ],
        "lights": {"kind": "ids", "ids": [500, 700, 900]},
        "exposure": {"kind": "fixed", "exposure_us": 8000},
        "darks_per_view": 1,
    }
    path.parent.mkdir(parents=True, exist_ok=True)
    with path.open("w") as file:
        YAML().dump(content, file)
    return path


def errors_mm(record: Record, thing: Mapping[str, Any], scan: Path) -> NDArray[np.float64]:
    """[n] how far each sticker of the scan is from where the world has it, by the record's transform alone."""
    place = record.transforms["base_from_mesh"]
    true = BASE_FROM_SUPPORT @ transform(thing["translation_mm"], thing["abc_deg"])
    off = transform(place.translation_mm, place.abc_deg) - true @ np.linalg.inv(scanner_from_thing(1))
    lines = (scan / "targets.csv").read_text().splitlines()[1:]
    targets_mm = np.array([[*map(float, line.split(",")[1:4]), 1.0] for line in lines])
    return np.asarray(np.linalg.norm((targets_mm @ off.T)[:, :3], axis=1))


@pytest.mark.timeout(600)
def test_a_campaign_finds_the_mesh_where_the_world_has_it(
    tmp_path: Path, make_rig: Callable[..., Path], scale: Callable[[int, int], int]
) -> None:
    out = tmp_path / "campaign"
    rig = make_rig(out)
    plan(out / "plans/mesh.yaml", out / "rigs/mesh.yaml", scale(3, 8))
    ended = cells.here("calibrate", "all", "--rig", rig, "--out", out, "--only", "mesh", "--json")
    assert ended.code == 0, ended.err
    record = read_record(Path(ended.document["records"]["mesh"]))
    assert record.is_accepted
    assert errors_mm(record, OBJECT, out / "scan").max() < 0.06
    assert record.remarks[1:] == ()
    assert {line.name for line in record.inputs} >= {
        "scan/mesh.ply",
        "scan/targets.csv",
        "hand-eye.yaml",
        "rig.yaml",
    }


@pytest.mark.full
@pytest.mark.timeout(600)
def test_a_third_of_the_stickers_may_be_missing_and_as_many_false(
    tmp_path: Path, make_rig: Callable[..., Path], scale: Callable[[int, int], int]
) -> None:
    changed = {**OBJECT, "stickers": {"count": 18, "new": 6, "fallen": 6}}
    make_rig(tmp_path, changed)
    ended = cells.here("acquire", plan(tmp_path / "stickers.yaml", tmp_path / "rig.yaml", scale(3, 8)), "--json")
    assert ended.code == 0, ended.err
    mesh, targets = export_scan(changed, tmp_path / "scanner")
    assert cells.here("scan", mesh, "--targets", targets, "--out", tmp_path / "scan").code == 0
    known = ["--scan", tmp_path / "scan", "--hand-eye", tmp_path / "hand-eye.yaml", "--rig", tmp_path / "rig.yaml"]
    calibrated = cells.here(
        "calibrate", "mesh", ended.document["run"], *known, "--out", tmp_path, "--name", "mesh", "--json"
    )
    assert calibrated.code == 0, calibrated.err
    record = read_record(tmp_path / "mesh.yaml")
    assert errors_mm(record, changed, tmp_path / "scan").max() < 0.06
    missing, false = record.remarks[1:]
    assert missing.startswith("6 stickers of the table were not found: T")
    assert false.startswith("6 detected points are not in the table")


def test_the_scanner_leaves_nothing_of_the_world_but_its_files(tmp_path: Path) -> None:
    export_scan(OBJECT, tmp_path / "scanner")
    assert {path.name for path in (tmp_path / "scanner").iterdir()} == {"scan.stl", "targets.txt"}


def test_a_thing_without_stickers_is_not_scanned(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="a scan has no targets"):
        export_scan({"kind": "grey_card"}, tmp_path)
