"""The commands of radiometric calibration from beginning to end: runs in, records out."""

from __future__ import annotations

import json
from datetime import UTC, datetime
from pathlib import Path

import h5py
import numpy as np
import pytest
import typer
from light_runs import FOCAL_PX, SIZE_PX, Taken, write_light_run
from light_synthesis import Array, TrueSensor
from typer.testing import CliRunner, Result

from coupole.calibration.record import Record, read_record, seal_record, write_record
from coupole.commands import calibrate_light
from coupole.commands.uncertainty import budget
from coupole.errors import CalibrationRefused, CoupoleError, InputError

SHAPE = (SIZE_PX[1], SIZE_PX[0])
SENSOR = TrueSensor(SHAPE, hot=5, dark_e_per_s=300.0)
LIMIT = ("--limit", "linearity=0.01")
"""128 x 96 pixels tell less of a curve than a camera's."""
EXPOSURES_US = (2000, 50_000, 200_000)


def run(command: object, *arguments: str | Path) -> Result:
    app = typer.Typer()
    app.command()(command)  # type: ignore[type-var]
    return CliRunner().invoke(app, list(map(str, arguments)))


def record_of(command: object, folder: Path, *arguments: str | Path) -> Record:
    """Run a command that writes a record `x` into a folder."""
    result = run(command, *arguments, "--out", folder, "--name", "x", "--json")
    if result.exception is not None and not isinstance(result.exception, CalibrationRefused):
        raise result.exception
    return read_record(folder / "x.yaml")


def darks(folder: Path, each: int = 6) -> Path:
    random = np.random.default_rng(1)
    frames = [
        Taken(f"d/dark{i}/e{e}", t, np.eye(4), SENSOR.frame(0.0, t * 1e-6, random))
        for e, t in enumerate(EXPOSURES_US)
        for i in range(each)
    ]
    return write_light_run(folder, frames)


def bracket(folder: Path) -> Path:
    random = np.random.default_rng(2)
    slope = np.linspace(0.3, 1.0, SHAPE[1])
    frames = []
    for e, t in enumerate((500, 1000, 2000, 4000, 8000, 12000, 16000, 24000, 96000)):
        light = 0.8 * 4031 * 3.2 * t / 16000 * slope
        frames += [
            Taken(f"s/panel1/e{e}{repeat}", t, np.eye(4), SENSOR.frame(light, t * 1e-6, random))
            for repeat in ("", "/r1")
        ]
    return write_light_run(folder, frames)


def panel_views(folder: Path) -> tuple[Path, Array]:
    """Views of a panel 400 mm before the camera; its true fall-off [H, W]."""
    random = np.random.default_rng(3)
    columns, rows = np.meshgrid(np.arange(SIZE_PX[0]), np.arange(SIZE_PX[1]))
    tangent = np.hypot(columns - 66.0, rows - 45.0) / FOCAL_PX
    falloff = (1 + tangent**2) ** -2.0
    away = np.stack([(columns - 63.5) / FOCAL_PX, (rows - 47.5) / FOCAL_PX], axis=-1) * 400
    frames = []
    for v, (dx, dy, roll) in enumerate([(0, 0, 0), (40, 0, 90), (-40, 10, 180), (0, 40, 45), (10, -40, 270)]):
        a = np.radians(roll)
        pose = np.eye(4)
        pose[:2, :2] = [[np.cos(a), -np.sin(a)], [np.sin(a), np.cos(a)]]
        pose[:2, 3] = dx, dy
        x = (away @ pose[:2, :2].T + (dx, dy))[..., 0] / 100
        light = 8000 * falloff * (1 - 0.05 * x**2)
        for r in range(3):
            shot = f"f{v}/panel1/e0" + (f"/r{r}" if r else "")
            frames.append(Taken(shot, 2000, pose, SENSOR.frame(light, 0.002, random)))
    return write_light_run(folder, frames), falloff


@pytest.fixture(scope="module")
def dark_record(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("dark")
    record_of(calibrate_light.dark, folder, darks(folder / "run"))
    return folder / "x.yaml"


@pytest.fixture(scope="module")
def response_record(tmp_path_factory: pytest.TempPathFactory, dark_record: Path) -> Path:
    folder = tmp_path_factory.mktemp("response")
    record_of(calibrate_light.response, folder, bracket(folder / "run"), "--dark", dark_record, *LIMIT)
    return folder / "x.yaml"


def test_dark_frames_become_maps_beside_a_record(dark_record: Path) -> None:
    record = read_record(dark_record)
    assert record.value("read_noise_dn") == pytest.approx(13 / 3.2, rel=0.02)
    with h5py.File(dark_record.with_suffix(".h5")) as file:
        assert file["offset_dn"].shape == SHAPE
        assert len(file["hot_row_column"]) >= 5
    assert dark_record.with_suffix(".png").stat().st_size > 10_000


def test_a_map_that_was_changed_is_refused(tmp_path: Path) -> None:
    record_of(calibrate_light.dark, tmp_path, darks(tmp_path / "run", each=3))
    with h5py.File(tmp_path / "x.h5", "a") as file:
        file["offset_dn"][0, 0] = 0
    with pytest.raises(InputError, match=r"x\.h5 beside the record was changed"):
        read_record(tmp_path / "x.yaml")


def test_a_bracket_becomes_a_response(response_record: Path) -> None:
    record = read_record(response_record)
    gain = next(p for p in record.parameters if p.name == "gain_dn_per_e.G")
    assert gain.value is not None
    assert abs(gain.value - 1 / 3.2) < 4 * gain.u
    assert any(i.name == "x.yaml" for i in record.inputs)


def test_views_of_a_panel_become_a_flat_field(tmp_path: Path, dark_record: Path) -> None:
    folder, falloff = panel_views(tmp_path / "p")
    record = record_of(calibrate_light.flat_field, tmp_path, folder, "--dark", dark_record, "--panel-mm", "400")
    with h5py.File(tmp_path / "x.h5") as file:
        found = file["g"][()]
    off = np.log(found / falloff)
    assert np.std(off) < 0.01
    assert {p.name for p in record.parameters} >= {"cx_px.G", "k1.R", "e5.B"}


def test_the_budget_takes_what_records_say(tmp_path: Path, response_record: Path) -> None:
    result = run(budget, response_record, "--out", tmp_path / "budget.png", "--json")
    document = json.loads(result.stdout)
    assert {s["said_by"] for s in document["sources"]} >= {"response x", "Lucat et al. 2025"}
    assert (tmp_path / "budget.png").stat().st_size > 10_000
    assert json.loads((tmp_path / "budget.json").read_text()) == document


@pytest.mark.parametrize(("option", "kind"), [("--dark", "dark"), ("--response", "response")])
def test_a_record_of_another_camera_is_refused(
    tmp_path: Path, dark_record: Path, response_record: Path, option: str, kind: str
) -> None:
    path = {"dark": dark_record, "response": response_record}[kind]
    record = read_record(path)
    content = dict(record)
    del content["sha256"], content["schema_version"]
    for name, validity, why in (
        ("larger", {"size_px": (1024, 768)}, "is valid for frames of 1024 x 768 pixels"),
        ("other", {"camera": "Other 7"}, "is valid for the camera Other 7"),
        ("old", {"expires": datetime(2020, 1, 1, tzinfo=UTC)}, "expired on 2020-01-01"),
    ):
        other = seal_record(**content | {"validity": record.validity.model_copy(update=validity)})
        write_record(path.with_name(f"{name}.yaml"), other)
        folder, _ = panel_views(tmp_path / name)
        result = run(calibrate_light.flat_field, folder, option, path.with_name(f"{name}.yaml"), "--out", tmp_path)
        assert isinstance(result.exception, InputError)
        assert why in str(result.exception)


@pytest.mark.parametrize(
    ("command", "plan"),
    [(calibrate_light.response, "response"), (calibrate_light.flat_field, "flat-field")],
)
def test_a_run_without_light_is_refused_with_the_plan_to_take(tmp_path: Path, command: object, plan: str) -> None:
    result = run(command, darks(tmp_path / "run", each=2), "--out", tmp_path)
    assert isinstance(result.exception, CoupoleError)
    assert f"coupole plan new {plan}" in str(result.exception)
